"""Config values: frozen, hashable, and checked when they are made."""

import dataclasses
import math

import numpy as np
import pytest

from pegasus_jax.checks import ConfigError, did_you_mean, whole
from pegasus_jax.config import BNN, MLP, Analytic, Config, Explore, Fit, Period, Search
from pegasus_jax.config_models import DROPOUTS


def test_a_config_is_a_key():
    """What `build` is cached on: equal configs are one key, and nobody can change one after the fact."""
    assert hash(Config()) == hash(Config())
    assert Config() == Config()
    assert len({Config(), Config(seed=1), Config(), dataclasses.replace(Config(), fit=Fit(steps=1))}) == 3
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().seed = 1  # type: ignore[misc]


def test_layers_given_as_a_list_are_still_hashable():
    assert BNN(hidden=[50, 50]) == BNN(hidden=(50, 50))  # type: ignore[arg-type]
    assert hash(MLP(hidden=[50, 50])) == hash(MLP(hidden=(50, 50)))  # type: ignore[arg-type]


def test_the_defaults_are_the_measured_ones():
    """docs/decisions: a change here changes every result. test_settings holds algorithm=paper to the paper."""
    c = Config()
    assert (c.model.hidden, c.model.dropout, c.model.heteroscedastic) == (
        (200, 200),
        "log_normal",
        True,
    )
    assert (c.policy.hidden, c.policy.dropout) == ((200, 200), 0.0)
    assert (c.fit.steps, c.fit.batch_size, c.fit.learning_rate) == (2000, 100, 3e-4)
    assert (c.search.steps, c.search.particles, c.search.learning_rate, c.search.grad_clip) == (1000, 100, 1e-3, 1.0)
    assert (c.search.matching, c.search.standardized_noise) == ("always", False)
    assert c.search.period == Period(start=1, dynamics=100, policy=1, sensor=1, match=1)
    assert (c.model.activation, c.model.kl_weight, c.search.init) == ("silu", 0.1, "better")
    assert (c.search.cost_estimator, c.search.cost_width_start) == ("gaussian", None)  # docs/decisions.md 0002, 0033
    assert (c.explore.trials, c.explore.kind) == (1, "uniform")


IMPOSSIBLE = [
    (BNN, dict(hidden=(50, 0)), "model.hidden=0"),
    (BNN, dict(dropout="lognormal"), "'log_normal'"),
    (BNN, dict(initializer="glorrot"), "'glorot'"),
    (BNN, dict(weight_decay=-1.0), "model.weight_decay=-1"),
    (BNN, dict(log_z_min=0.0), "model.log_z_min=0"),
    (BNN, dict(log_z_min=-math.inf), "model.log_z_min=-inf"),
    (BNN, dict(log_z_min=math.nan), "model.log_z_min=nan"),
    (MLP, dict(hidden=(-3,)), "policy.hidden=-3"),
    (MLP, dict(squash="tan"), "'tanh'"),
    (MLP, dict(dropout=1.0), "the nearest is 0.99"),
    (Fit, dict(steps=0), "the nearest is 1"),
    (Fit, dict(batch_size=0), "fit.batch_size=0"),
    (Fit, dict(learning_rate=0.0), "(0, inf)"),
    (Fit, dict(learning_rate=math.nan), "fit.learning_rate=nan"),
    (Period, dict(start=-1), "search.period.start=-1"),
    (Period, dict(match=-2), "search.period.match=-2"),
    (Search, dict(steps=0), "search.steps=0"),
    (Search, dict(particles=1), "the nearest is 2"),
    (Search, dict(learning_rate=-1e-3), "search.learning_rate=-0.001"),
    (Search, dict(grad_clip=0.0), "search.grad_clip=0"),
    (Search, dict(init="fresh"), "search.refine_fraction=0.5; the nearest is better"),
    (Search, dict(init="new"), "previous, better, fresh"),
    (Analytic, dict(init="fresh"), "previous, better"),
    (Search, dict(observation_noise="plants"), "did you mean 'plant'?"),
    (Search, dict(state_noise=-1.0), "search.state_noise=-1"),
    (Explore, dict(trials=-1), "explore.trials=-1"),
    (Explore, dict(kind="walking"), "'walk'"),
    (Config, dict(seed=-1), "seed=-1"),
    (Config, dict(seed=2**32), "the nearest is 4294967295"),
    (Config, dict(trials=0), "trials=0"),
    (Config, dict(trials=10**6), "the nearest is 10000"),
    (Config, dict(trials=1.5), "trials=1.5 is not a whole number; for example trials=15"),
    (Config, dict(seed=1.5), "seed=1.5 is not a whole number"),
    (Config, dict(trials=True), "trials=true is not a whole number"),
    (Config, dict(trials="many"), "trials=many is not a whole number"),
    (Config, dict(model="bnn"), "model=bnn is not"),
    (Config, dict(angles=[[1]]), "angles=[[1]] is not a list of whole numbers"),
    (Config, dict(angles=3), "angles=3 is not a list of whole numbers, which are places in the observation"),
    (Config, dict(start_std=(0.5,), task="gym"), "start_std=[0.5] needs start_mean="),
    (Config, dict(angles=(0, 0)), "names 0 twice"),
    (Config, dict(start_mean=(math.nan, 0.0)), "start_mean=nan is not a finite number"),
    (Config, dict(dt="fast"), "dt=fast is not a number or null"),
    (Config, dict(dt=1e9), "the nearest is"),
    (Config, dict(success=0.0), "success=0"),
    (Config, dict(x64="double"), "x64=double is not true or false"),
    (Search, dict(steps=1.5), "search.steps=1.5 is not a whole number"),
    (
        Search,
        dict(standardized_noise="no"),
        "search.standardized_noise=no is not true or false; for example search.standardized_noise=false",
    ),
    (Search, dict(grad_clip="none"), "search.grad_clip=none is not a number or null"),
    (Search, dict(steps=10**20), "the nearest is 10000000"),
    (Period, dict(match=None), "search.period.match=null is not a whole number"),
    (MLP, dict(squash=None), "policy.squash=null is not a word"),
    (Fit, dict(steps="10"), "fit.steps=10 is not a whole number as written, '10'; write fit.steps=10"),
    (Fit, dict(steps=1e3), "fit.steps=1000 is not a whole number as written, 1000.0; write fit.steps=1000"),
    (
        BNN,
        dict(hidden=[8.0]),
        "model.hidden=[8] is not a list of whole numbers as written, [8.0]; write model.hidden=[8]",
    ),
    (Search, dict(grad_clip="None"), "is not a number or null as written, 'None'; write search.grad_clip=null"),
    (Config, dict(x64="true"), "x64=true is not true or false as written, 'true'; write x64=true"),
]


@pytest.mark.parametrize(("kind", "fields", "part"), IMPOSSIBLE)
def test_an_impossible_value_is_named_in_one_line(kind, fields, part):
    with pytest.raises(ConfigError) as caught:
        kind(**fields)
    message = str(caught.value)
    assert part in message
    assert "\n" not in message
    assert next(iter(fields)) in message


def test_a_number_without_end_is_one_line():
    """Python itself refuses to read thousands of digits, and to make floats of hundreds."""
    for digits in (25, 400, 5000):
        with pytest.raises(ConfigError, match=rf"^episodes=10+\.\.\. has {digits} digits; expected a number in \["):
            whole("episodes", "1" + "0" * (digits - 1))


def test_numbers_of_numpy_become_pythons_own():
    """A config is a key and is stored as text: a number of another kind would be neither."""
    chosen = Config(seed=np.int64(3), trials=np.int32(2), start_mean=np.float32([1, 2]).tolist(), dt=np.float64(0.5))
    assert chosen == Config(seed=3, trials=2, start_mean=(1.0, 2.0), dt=0.5)
    assert [type(value) for value in (chosen.seed, chosen.trials, chosen.dt)] == [int, int, float]


def test_limits_themselves_are_possible():
    BNN(weight_decay=0.0, hidden=(1,))
    MLP(dropout=0.0)
    Fit(steps=1, batch_size=1, learning_rate=1e-12)
    Search(steps=1, particles=2, grad_clip=None)
    Explore(trials=0)
    Config(seed=2**32 - 1, trials=1)


def test_the_nearest_choice():
    assert did_you_mean("lognormal", DROPOUTS) == f"did you mean 'log_normal'? choices: {', '.join(DROPOUTS)}"
    assert did_you_mean("xyz", ("tanh", "sine")) == "choices: tanh, sine"
