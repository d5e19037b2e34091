"""A limit on how fast a control changes holds wherever a control is made: imagined, explored, learned, on a robot."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax import memory, tasks
from pegasus_jax.assembly.experiments import build, compose
from pegasus_jax.checks import ConfigError
from pegasus_jax.policies.rate_limited import explored, follow, rate_limited
from pegasus_jax.runs import config_io
from pegasus_jax.runs.check import before_training
from pegasus_jax.tasks.remembered import kept_by, remembering
from pegasus_jax.types import Policy
from probes import cart, linear_policy, tiny, unchecked

RATE = 1.5  # [N/s], .45 N a period of the probe's cart
MOST = RATE * 0.3 + 1e-6
WORDS: dict[str, Any] = dict(control_rate=(RATE,), search__matching="never", search__cost_estimator="particles")


def changes(u: Any) -> np.ndarray:
    """The largest change of the controls [..., H, U] of each episode, which begin at 0."""
    u = np.asarray(u)
    return np.abs(np.diff(u, axis=-2, prepend=np.zeros_like(u[..., :1, :]))).max((-1, -2))


@given(u=st.floats(-2, 2), last=st.floats(-2, 2), change=st.floats(1e-3, 10))
def test_a_control_follows_as_far_as_it_may(u, last, change):
    """No further, never beyond the limits, and all the way where that is allowed."""
    task = cart()._replace(control_rate=np.array([change / 0.3]))
    found = float(follow(np.array([u]), np.array([last]), task, np)[0])
    assert abs(found - last) <= change * (1 + 1e-9)
    assert min(u, last) <= found <= max(u, last)
    assert abs(u - last) >= change * (1 - 1e-9) or found == u


def test_the_gradient_goes_through_the_control_that_is_there():
    task = cart()._replace(control_rate=np.array([RATE]))
    slopes = jax.vmap(jax.grad(lambda u, last: follow(u, last, task, jnp)[0], (0, 1)), (0, None))
    new, old = slopes(jnp.array([0.1, 2.0, -2.0]), jnp.array(0.0))
    np.testing.assert_array_equal(new, [1, 0, 0])
    np.testing.assert_array_equal(old, [0, 1, 1])


def test_without_a_limit_everything_is_what_it_was():
    task, policy, plan = cart(), linear_policy(2, 1), jnp.array([2.0])
    assert rate_limited(policy, task) is policy
    assert explored(task, None, plan, None, jnp) is plan
    assert compose(tiny(), task).task.memory.names == ()


@pytest.mark.parametrize("guided", [False, True])
def test_no_control_of_an_episode_or_an_imagined_one_changes_by_more(guided):
    """Random ones, those of a user's first controller, the policy's; and the limit is used."""
    guide = (lambda x: jnp.where(x[:1] > 0, -2.0, 2.0)) if guided else None
    exp = compose(tiny(**WORDS), cart()._replace(guide=guide))
    state = jax.jit(exp.init)(jax.random.key(0))
    wild = jax.tree.map(lambda leaf: 20 * leaf, state.policy.params)
    keys = jax.random.split(jax.random.key(1), 20)
    fly = unchecked(jax.jit(jax.vmap(exp.episode, (0, None, None))))
    for exploring in (True, False):
        most = changes(fly(keys, wild, exploring).u)
        assert most.max() <= MOST
        assert np.median(most) > 0.99 * RATE * 0.3
    if not guided:
        state = exp.add_episode(state, jax.jit(exp.collect)(state))
        rolled, _ = jax.jit(exp.imagine)(state._replace(policy=state.policy._replace(params=wild)))
        assert changes(np.swapaxes(rolled.u, 0, 1)).max() <= MOST
        np.testing.assert_array_equal(rolled.x[1:, :, 2], rolled.u[:, :, 0])  # the state knows the control before


def test_how_many_controls_are_kept_is_a_number():
    """Of an exported policy's contract, in JSON, where a truth would be `true`."""
    assert type(kept_by(tiny(**WORDS), cart()._replace(control_rate=np.ones(1))).controls) is int


@pytest.mark.parametrize("exploring", [True, False])
def test_a_robot_gets_no_control_that_changes_by_more(exploring):
    x, sent = np.array([1.0, 0.0], np.float32), []

    def step(u):
        sent.append(np.array(u))
        return x, np.array(u), ""

    robot = SimpleNamespace(reset=lambda seed: x, step=step, close=lambda: None, rest=lambda: None)
    exp = compose(tiny(**WORDS), cart()._replace(plant=None, environment=robot))
    assert exp.drive is not None
    wild = jax.tree.map(lambda leaf: 20 * leaf, exp.policy.init(jax.random.key(0)))
    ran = exp.drive(jax.random.key(2), wild, exploring)
    assert ran.error is None
    assert 0.99 * RATE * 0.3 < changes(np.stack(sent)) <= MOST
    np.testing.assert_array_equal(ran.trajectory.u, np.stack(sent))


def test_one_rate_for_all_controls_or_one_each():
    names, low = ("left", "right"), np.array([-1.0, 0.5])
    task = cart()._replace(control_names=names, control_low=low, control_high=np.ones(2))
    for rates, most in (((2.0,), [0.6, 0.6]), ((2.0, 1.0), [0.6, 0.3])):
        slow = tasks.augmented(remembering(tiny(control_rate=rates), task))
        policy = rate_limited(Policy(None, None, lambda *_: jnp.array([1.0, 1.0]), memory=slow.memory), slow)  # type: ignore[arg-type]
        m = memory.begin(slow.memory, jax.random.key(0), jnp.zeros(2))
        see, _, advance = memory.steps(slow.memory)
        u = policy.apply(None, None, see(m, jnp.zeros(2)))
        np.testing.assert_allclose(u, np.minimum(1, np.array([0.0, 0.5]) + most), rtol=1e-6)  # from rest
        np.testing.assert_allclose(advance(m, jnp.zeros(2), u), u)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("control_rate=0", r"control_rate=0 is out of range; expected a number in \(0, inf\)"),
        ("control_rate=-5", "control_rate=-5 is out of range"),
        ("control_rate=[1,.inf]", "control_rate=inf is out of range"),
        ("control_rate=[1,2]", r"control_rate=\[1,2\] must be one number for all, or 1, of force \[N\]"),
        ("control_rate=fast", "control_rate=fast is not a list of numbers"),
        ("control_rate=true", "control_rate=true is not a list of numbers"),
        ("control_rate=20 algorithm=pilco model=gp policy=rbf", "is remembered beside it .* needs another algorithm="),
    ],
)
def test_what_cannot_be_is_one_line(words, says):
    with pytest.raises(ConfigError, match=says) as refused:
        build(config_io.parse({"task": "cartpole", **dict(word.split("=", 1) for word in words.split())}))
    assert "\n" not in str(refused.value)


def test_a_limit_that_is_none_or_too_low_is_a_note():
    def notes(rate):
        config = config_io.parse({"task": "cartpole", "control_rate": rate})
        return before_training(config, build(config).task)

    assert notes("200") == ["control_rate=200 lets force [N] from -10 to 10 in one period: it limits nothing"]
    assert notes(6) == ["control_rate=6 lets force [N] from -10 to 10 in 33 periods; an episode has 25"]
    assert notes("[100]") == []
