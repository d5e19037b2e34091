"""A user's cost: everything that it cannot be is one line, and a cost that can be learned from is let through."""

import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import start
from pegasus_jax.checks import ConfigError
from pegasus_jax.imagine import costs as imagined
from pegasus_jax.runs import check
from pegasus_jax.tasks import cost_check, user_code
from pegasus_jax.types import Cost

COSTS = """
import jax, jax.numpy as jnp, numpy as np, math
def np_cost(x): return 1 - np.exp(-x[0] ** 2)
def float_cost(x): return 1 - math.exp(-float(x[0]) ** 2)
def if_cost(x): return 0.0 if x[0] > 0 else 1.0
def two(x, u): return 1 - jnp.exp(-x[0] ** 2 - 0.01 * u[0] ** 2)
def nothing(): return 1.0
def vec(x): return 1 - jnp.exp(-x ** 2)
def one(x): return 1 - jnp.exp(-x[:1] ** 2)
def reward(x): return -(1 - jnp.cos(x[0])) / 2
def const(x): return 0.5
def constj(x): return jnp.float32(0.5)
def intc(x): return (jnp.abs(x[0]) > 1).astype(int)
def boolc(x): return jnp.abs(x[0]) > 1
def step(x): return jnp.where(jnp.abs(x[0]) > 1, 1.0, 0.0)
def root(x): return jnp.minimum(jnp.sqrt(x[0] * 0 + x[1] * 0), 1.0)
def norm(x): return jnp.tanh(jnp.linalg.norm(jnp.array([x[0], 0.1 * x[1]])))
def nan(x): return jnp.log(x[0] - 10.0)
def sometimes_nan(x): return jnp.tanh(jnp.arccos(x[0]))
def none(x): jnp.exp(x[0])
def dic(x): return {"cost": x[0]}
def text(x): return "0.5"
def compl(x): return jnp.exp(1j * x[0])
def out_of_range(x): return 1 - jnp.exp(-x[7] ** 2)
def below(x): return 1 - jnp.exp(-x[-3] ** 2)
def listed(x): return 1 - jnp.exp(-x[jnp.array([0, 2])] @ jnp.ones(2))
@jax.jit
def jitted(x): return 1 - jnp.exp(-x[2] ** 2)
def divides(x): return len(3) + x[0]
def index(x): return jnp.array([[0.0, 1.0][int(x[0])]])
def loop(x): return jax.lax.while_loop(lambda v: v < 1, lambda v: 2 * v, jnp.abs(x[0]) + 1e-3)
def leaves(x): raise SystemExit(3)
"""
REFUSED = {
    "np_cost": "is not a JAX function: it makes a Python number or a NumPy array of x at costs.py:3; use jax.numpy",
    "float_cost": "is not a JAX function: it makes a Python number or a NumPy array of x at costs.py:4; use jax.numpy",
    "if_cost": "costs.py:5; use jax.numpy, and jnp.where instead of if",
    "two": ": TypeError: two() missing 1 required positional argument: 'u' (costs.py:6)",
    "nothing": "takes 0 positional arguments but 1 was given (costs.py:7)",
    "vec": "returns an array of shape (2,); expected one number, as jnp.sum makes of it (costs.py:8)",
    "one": "returns an array of shape (1,)",
    "reward": "negative, at x=[",
    "const": "returns 0.5 whatever the state is",
    "constj": "has a gradient of 0 at each of",
    "intc": "returns a whole number or true or false, whose gradient is 0",
    "boolc": "returns a whole number or true or false, whose gradient is 0",
    "step": "has a gradient of 0 at each of",
    "root": "has a gradient that is nan at x=[",
    "norm": "has a gradient that is nan at x=[0, 0] (costs.py:17)",
    "nan": "is nan at x=[",
    "sometimes_nan": "is nan at x=[",
    "none": "returns nothing; its return is missing (costs.py:20)",
    "dic": "returns a dict; expected one number",
    "text": "returns a str; expected one number",
    "compl": "returns a complex number",
    "out_of_range": "reads entry 7 of an array of 2 at costs.py:24; x has 2, 0 to 1, and rates behind them",
    "below": "reads entry -3 of an array of 2 at costs.py:25",
    "listed": "reads entry 2 of an array of 2 at costs.py:26",
    "jitted": "reads entry 2 of an array of 2 at costs.py:28",
    "divides": ": TypeError: object of type 'int' has no len() (costs.py:29)",
    "index": "is not a JAX function",
    "loop": "Reverse-mode differentiation does not work",
    "leaves": "it ends the program, sys.exit(3) (costs.py:32)",
}


@pytest.fixture(scope="module")
def costs(tmp_path_factory):
    """The module above, loaded as a user's."""
    folder = tmp_path_factory.mktemp("costs")
    (folder / "costs.py").write_text(COSTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [*sys.path])
        yield lambda name: user_code.load("cost", f"costs:{name}")
    del sys.modules["costs"]


def facts(mean=(np.pi, 0.0), std=(0.05, 0.05), angles=(0,), limit=np.inf):
    size = len(mean)
    return cost_check.Facts(
        np.array(mean), np.array(std), angles, np.full(size, -limit), np.full(size, limit), np.zeros((0, size))
    )


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_learned_from_is_one_line(costs, name):
    with pytest.raises(ConfigError) as caught:
        cost_check.notes(costs(name), facts(), f"cost=costs:{name}")
    message = str(caught.value)
    assert REFUSED[name] in message
    assert message.startswith(f"cost=costs:{name}")
    assert "\n" not in message
    assert len(message) < 400


def interpolated(x):
    return jnp.interp(jnp.abs(x[0]), jnp.array([0.0, 1.0, 4.0]), jnp.array([0.0, 0.8, 1.0]))


FINE = {
    "of an angle": (lambda x: 1 - jnp.exp(-2 * (1 - jnp.cos(x[0]))), facts()),
    "its direction": (lambda x: 1 - jnp.exp(-(jnp.arctan2(x[1], x[0]) ** 2)), facts((1, 0, 0), (0.5,) * 3, ())),
    "a unit vector": (lambda x: (1 - x[0] / jnp.linalg.norm(x[:2])) / 2, facts((-1, 0, 0), (0.5,) * 3, ())),
    "a cosine": (lambda x: (1 - x[0]) / 2, facts((-1, 0), (0.1, 0.1), (), limit=1.0)),
    "an arc cosine": (lambda x: jnp.arccos(0.999 * x[0]) / jnp.pi, facts((-1, 0), (0.1, 0.1), (), limit=1.0)),
    "micrometres": (lambda x: 1 - jnp.exp(-((x[0] * 1e6) ** 2)), facts((2e-6, 0), (1e-7, 1.0), ())),
    "a table": (interpolated, facts()),
    "clipped on purpose": (lambda x: 1 - jnp.exp(-(jnp.take(x, 9, mode="clip") ** 2)), facts()),
    "a part": (lambda x: 1 - jnp.exp(-(x[-1] ** 2) - jnp.sum(x[1:5]) ** 2), facts()),
    "compiled": (jax.jit(lambda x: jnp.tanh(x @ x)), facts()),
    "an absolute value": (lambda x: jnp.minimum(jnp.abs(x[0]) / 4, 1.0), facts()),
}


@pytest.mark.parametrize("name", FINE)
def test_a_cost_that_can_be_learned_from_is_let_through(name):
    cost, known = FINE[name]
    assert cost_check.notes(cost, known, "cost=x:y") == []


def test_a_cost_above_one_is_only_noted():
    (note,) = cost_check.notes(lambda x: 10 * (1 - jnp.cos(x[0])), facts(), "cost=x:y")
    assert note.startswith("cost=x:y is ")
    assert "success=0.2" in note


@pytest.mark.parametrize(
    ("width", "factor", "flat"), [(10, 1, True), (10, 3, True), (20, 1, True), (20, 2.3, False), (100, 1, False)]
)
def test_a_cost_that_is_flat_where_episodes_start_also_as_a_search_sees_it_is_noted(width, factor, flat):
    far, cost = facts((0, 0), (0.1, 0.1), ()), Cost(lambda x: 1 - jnp.exp(-(((x[0] - 100) / width) ** 2) / 2))
    seen = None if factor == 1 else lambda: imagined.widened(cost, factor).of_state
    found = cost_check.notes(cost.of_state, far, "cost=x:y", seen)
    assert ["is 1 where episodes start and changes by" in note for note in found] == [True] * flat


def test_probes_are_the_start_zero_and_all_around_the_circle_within_the_limits():
    points = cost_check.probes(facts((np.pi, 0.5), limit=2.0))
    assert len(points) == 104
    np.testing.assert_allclose(points[:2], [[2, 0.5], [0, 0]])
    assert np.abs(points).max() <= 2
    free = cost_check.probes(facts())
    assert np.isfinite(free).all()
    assert free[:, 0].min() < -3
    assert free[-100:, 0].max() > 3
    assert np.array_equal(free, cost_check.probes(facts()))


class Turning(gymnasium.Env):
    """The cosine and the sine of an angle, and its rate."""

    observation_space = gymnasium.spaces.Box(-9.0, 9.0, (3,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    dt = 0.1

    def reset(self, *, seed=None, options=None):
        return np.array([-1.0, 0.0, 0.0], np.float32), {}


gymnasium.register("Turning-v0", Turning)
TURNING = {"env": "Turning-v0", "horizon": 9, "start_mean": [-1, 0, 0], "circles": [[0, 1]]}
BEYOND = {
    "constraint": lambda x: x[3] - 8.0,
    "stop": lambda x: jnp.abs(x[3]) > 8,
    "prior": lambda x, u: x * x[3],
}


@pytest.mark.parametrize("name", BEYOND)
def test_nothing_of_the_user_s_reads_beyond_the_observation(name):
    """As no cost does: JAX would give the last entry."""
    words = TURNING | {"cost": lambda x, u: 1 - jnp.exp(-(x[1] ** 2) - u[0] ** 2), name: BEYOND[name]}
    with pytest.raises(
        ConfigError, match=rf"{name}=.* reads entry 3 of an array of 3 at test_cost_check.py:\d+; x has 3"
    ):
        check.report(start.preset("gym", settings=words))


@pytest.mark.parametrize(
    ("name", "reads"), [("prior", lambda x, u: x + u[1]), ("explore.policy", jax.jit(lambda x: jnp.stack([x[7]])))]
)
def test_a_simulator_and_a_first_controller_read_what_there_is(name, reads):
    with pytest.raises(ConfigError, match=rf"{name}=.* reads entry \d of an array of \d at test_cost_check.py"):
        check.report(start.preset("cartpole", model="log_normal", settings={name: reads}))


def test_what_x_has_is_said_where_it_is_x_that_is_read() -> None:
    for cost, of_x in ((lambda x, u: x[4] + u[0], True), (lambda x, u: x[0] + u[1], False)):
        with pytest.raises(ConfigError, match=r"reads entry [14] of an array of") as error:
            cost_check.within(cost, (2, 1), 2, "cost=it")
        assert ("x has 2, 0 to 1" in str(error.value)) == of_x
