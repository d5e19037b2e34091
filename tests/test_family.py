"""Every model with every policy, and each of them matched and not, and analytically: one loop serves them all."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.assembly.experiments import compose
from pegasus_jax.assembly.pieces import dynamics_of
from pegasus_jax.imagine.costs import saturating
from pegasus_jax.presets import ALGORITHMS, MODELS, POLICIES
from pegasus_jax.runs import config_io
from pegasus_jax.tasks import make
from pegasus_jax.types import Trajectory
from probes import Counter, same, unchecked

HORIZON, SEEDS = 3, 2
WIDTH = 3.0  # [m], of the cost: it is flat nowhere that a model can imagine here
UPRIGHT = np.array([0, 0, 0, np.pi])
# What is small of each kind of section; a word counts only where the section has such a setting.
SMALL = {
    "model.hidden": "[8]",
    "model.ensemble_size": "2",
    "model.substeps": "1",
    "policy.hidden": "[8]",
    "policy.num_centers": "5",
    "fit.steps": "2",
    "fit.num_starts": "2",
    "search.steps": "2",
    "search.particles": "6",
    # test_trial.py and test_build_search.py have these; here they would be half of each program to compile.
    "search.init": "previous",
    "search.refine_fraction": "0",
    "trials": "3",
}
PIECES = [policy for policy in POLICIES if policy != "rbf100"]  # which is rbf with more units
MOMENTS = [("gp", "linear", "analytic"), ("ssgp", "rbf", "analytic")]
# Every pair of model, policy and how: of all three together half, in turn, would compile for minutes to say no more.
TURNS = [
    (model, policy, ("matched", "kept")[(i + j) % 2])
    for i, model in enumerate(MODELS)
    for j, policy in enumerate(PIECES)
]
# What else the paper's figures run, all of them matched.
PAPER = [("log_normal", "dropout_mlp"), ("binary", "mlp"), ("binary", "rbf"), ("concrete", "dropout_mlp")]
FAMILY = [*TURNS, *((*pair, "matched") for pair in PAPER), *MOMENTS]
# Networks as log_normal's and binary's, of other masks, which tests/test_dropout.py has.
MASKS = ("concrete", "gaussian", "sparse")
# Of make test: each other model once, each policy, and each way at least twice.
TURN = [TURNS[len(PIECES) * i + (i + i // 2) % len(PIECES)] for i in range(len(MODELS))]
QUICK = [member for member in TURN if member[0] not in MASKS]
# The others, the paper's pairs too, say no more of a piece that is in these; PILCO's search is in tests/test_build.py.
MEMBERS = [
    pytest.param(*member, id="-".join(member), marks=() if member in QUICK else pytest.mark.campaign)
    for member in FAMILY
]


def composed(model, policy, how):
    """The member of the family on a cart-pole, and how often its model was traced."""
    chosen = {"model": model, "policy": policy, **({"algorithm": "pilco"} if how == "analytic" else {})}
    there = config_io.leaves(config_io.parse(chosen))
    small = {key: value for key, value in SMALL.items() if key in there}
    if model != "ensemble":
        small.pop("model.ensemble_size", None)
    if how == "kept":
        small |= {
            "search.matching": "never",
            "search.cost_estimator": "particles",
            "search.cost_width_start": "1",
            "search.init": "previous",
        }
    config, task = config_io.parse(chosen | small), make("cartpole")
    task = task._replace(
        horizon=HORIZON,
        start_mean=UPRIGHT,
        start_std=np.full(4, 0.02),
        cost=saturating(task.plant.error, WIDTH, task.angles),
    )
    dynamics = dynamics_of(config.model, task)
    apply, moments = Counter(dynamics.apply), dynamics.moments and Counter(dynamics.moments)
    traces = lambda: apply.count + (moments.count if moments else 0)  # noqa: E731
    return compose(config, task, dynamics=dynamics._replace(apply=apply, moments=moments)), traces


def episodes(trial):
    """One for each seed, of nothing in particular, near the goal."""
    keys = jax.random.split(jax.random.key(trial), 2)
    x = UPRIGHT + 0.03 * jax.random.normal(keys[0], (SEEDS, HORIZON + 1, 4)).cumsum(1)
    return Trajectory(x, 5 * jax.random.normal(keys[1], (SEEDS, HORIZON, 1)), jnp.ones((SEEDS, HORIZON)))


@cache
def fitted(model):
    """A model's fit, compiled once for all policies: (state, episodes) -> state and report."""
    exp, _ = composed(model, "mlp", "matched")
    return unchecked(jax.jit(jax.vmap(lambda state, episode: exp.fit(exp.add_episode(state, episode)))))


@cache
def begun(model, policy, analytic):
    """The first state of two seeds, drawn once for matched and kept, whose searches have the same optimizer."""
    exp, _ = composed(model, policy, "analytic" if analytic else "matched")
    return jax.jit(jax.vmap(exp.init))(jax.vmap(jax.random.key)(jnp.arange(SEEDS)))


def described(tree):
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)), tree)


@pytest.mark.parametrize(("model", "policy", "how"), MEMBERS)
def test_member_of_the_family(model, policy, how):
    """Three trials of two seeds: shapes and types kept, all finite, no update skipped, one trace, and repeatable."""
    exp, traced = composed(model, policy, how)
    search = unchecked(jax.jit(jax.vmap(exp.search)))
    state = begun(model, policy, how == "analytic")
    traces = []
    for trial in range(3):
        # The policy waits outside: a model's fit does not know what kind it is.
        learned, report = fitted(model)(state._replace(policy=None), episodes(trial))
        before = learned._replace(policy=state.policy)
        after, searched = search(before)
        traces.append(traced())
        assert described(after) == described(before) == described(state)
        for leaf in jax.tree.leaves((after.model.params, after.policy.params, report, searched)):
            assert np.all(np.isfinite(leaf))
        assert not np.any(searched.skipped)
        assert np.all(searched.gradient_norm > 0)
        state = after
    assert traces[0] > 0
    assert len(set(traces)) == 1
    again, repeated = search(before)
    assert same(repeated.objective, searched.objective)
    assert same(again.policy.params, state.policy.params)
    assert any(not np.array_equal(leaf[0], leaf[1]) for leaf in jax.tree.leaves(state.policy.params))


FIGURES = [
    "model=ssgp policy=rbf algorithm=pilco",
    *(f"model={model} policy=rbf" for model in ("binary", "log_normal")),
    *(f"model={model} policy={policy}" for model in ("binary", "log_normal") for policy in ("mlp", "dropout_mlp")),
    "model=concrete policy=dropout_mlp",
]


@pytest.mark.parametrize("words", FIGURES)
def test_the_papers_combinations_are_members(words):
    """Of its cart-pole figures; tests/test_train.py runs one of each kind of section as a user does."""
    chosen = dict(word.split("=") for word in words.split())
    how = "analytic" if chosen.get("algorithm") == "pilco" else "matched"
    assert (chosen["model"], chosen["policy"], how) in FAMILY
    assert {"paper", "pegasus", "deep_pilco", "pilco"} == {*ALGORITHMS}
