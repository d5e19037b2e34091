"""The AI-Olympics' arms: our part of them with a stand-in for the organizers' simulator, which no test has."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.plants_suite.costs import two_links

NAME = "benchmarks.plants_suite.of_ai_olympics"
PACKAGE = {
    "__init__": "",
    "model/__init__": "",
    "simulation/__init__": "",
    "model/model_parameters": """
class model_parameters:
    def __init__(self, filepath):
        self.l = [float(word) for word in open(filepath).read().split()]
    def set_motor_inertia(self, value): pass
    set_damping = set_cfric = set_motor_inertia
""",
    "model/plant": """
import numpy as np
class DoublePendulumPlant:
    def __init__(self, model_pars):
        self.l = model_pars.l
    def forward_kinematics(self, q):
        a, b = q[0], q[0] + q[1]
        first = [self.l[0] * np.sin(a), -self.l[0] * np.cos(a)]
        return [first, [first[0] + self.l[1] * np.sin(b), first[1] - self.l[1] * np.cos(b)]]
""",
    # Each motor turns its own link, one radian a second for 1 Nm: where the arm will be is known.
    "simulation/simulation": """
import numpy as np
class Simulator:
    def __init__(self, plant):
        self.plant, self.x = plant, np.zeros(4)
    def reset(self): pass
    def set_state(self, t, x): self.x = np.copy(x)
    def step(self, tau, dt): self.x = self.x + dt * np.array([tau[0], tau[1], 0, 0])
""",
}


def imported() -> list[str]:
    """The modules of this that are there: ours, and those of a checkout or its stand-in."""
    return [one for one in sys.modules if one == NAME or one.partition(".")[0] == "double_pendulum"]


@pytest.fixture
def olympics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """of_ai_olympics.py with the stand-in for a checkout."""
    root = tmp_path / "src/python/double_pendulum"
    for module, text in PACKAGE.items():
        file = root / f"{module}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.syspath_prepend(root.parent)
    for module in imported():
        monkeypatch.delitem(sys.modules, module)
    found = importlib.import_module(NAME)
    parameters = tmp_path / found.PARAMETERS
    parameters.parent.mkdir(parents=True)
    parameters.write_text("0.2 0.3")
    yield found
    for environment in [one for one in gymnasium.registry if one.startswith("ai_olympics/")]:
        gymnasium.registry.pop(environment)
    for module in imported():
        del sys.modules[module]


def test_a_return_is_how_long_the_tip_has_been_up_when_the_time_is_over(olympics: ModuleType) -> None:
    """Lifted by 3 rad in 3 s, it is above the line until it is turned down and up again."""
    env = olympics.TwoLinks(motor=0)
    env.reset(seed=0)
    env.simulator.set_state(0.0, np.zeros(4))
    torques = [1.0] * 78 + [0.0] * 20 + [-1.0] * 50 + [1.0] * 50 + [0.0] * 52  # 78 periods of .04 s turn it to 3.12
    total, heights = 0.0, []
    for k, torque in enumerate(torques):
        x, reward, terminated, truncated, _ = env.step(np.array([torque], np.float32))
        total += reward
        heights.append(-0.5 * np.cos(x[0]))
        assert (terminated, truncated) == (False, k == 249)
    above = np.array(heights) > 0.45
    assert (above[85], above[140], above[-1]) == (True, False, True)
    assert total == 250 - (np.flatnonzero(~above)[-1] + 1)


@pytest.mark.parametrize("motor", [0, 1])
def test_one_motor_turns_within_its_limit(olympics: ModuleType, motor: int) -> None:
    env = olympics.TwoLinks(motor)
    first, _ = env.reset(seed=3)
    assert 0 < np.abs(first).max() < 6 * olympics.START
    second, *_ = env.step(np.array([100.0], np.float32))
    turned = np.zeros(4)
    turned[motor] = 6 * 0.04
    np.testing.assert_allclose(second - first, turned, atol=1e-9)


def test_the_cost_is_least_upright_and_rising_with_rates() -> None:
    cost = jax.jit(two_links)
    assert cost(jnp.array([np.pi, 0.0, 0, 0])) == pytest.approx(0, abs=1e-6)
    assert cost(jnp.array([-np.pi, 2 * np.pi, 0, 0])) == pytest.approx(0, abs=1e-6)
    assert cost(jnp.array([0.0, 0.0, 0, 0])) > 0.99
    assert cost(jnp.array([np.pi, 0.0, 10.0, 0])) == pytest.approx(1 - np.exp(-0.125), abs=1e-6)
    # The tip beside the shoulder by .3 m and .3 m high: links of .2 and .3 m, the first level.
    at = jnp.array([np.pi / 2, np.pi / 2, 0.0, 0.0])
    assert cost(at) == pytest.approx(1 - np.exp(-0.5 * (1.0**2 + 1.0**2)), abs=1e-5)
