"""task=gym: environments that were not written for us become tasks by a line on the command line and a cost."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import jax
import numpy as np
import pytest

from pegasus_envs.guest import guest
from pegasus_jax import program, record, settings
from pegasus_jax.build import build, compose
from pegasus_jax.config import Config, Search
from probes import cart, tiny

TINY = ["model.hidden=[8]", "policy.hidden=[8]", "search.steps=5", "fit.steps=5", "search.particles=16", "trials=2"]
COSTS = """
import jax.numpy as jnp

def upright(x):  # Pendulum-v1: cos, sin, rate
    return (1 - x[0]) / 2

def balanced(x):  # InvertedDoublePendulum-v5: cart, sin x2, cos x2, rates, force
    return 1 - jnp.exp(-(x[1] ** 2 + x[2] ** 2 + (x[3] - 1) ** 2 + (x[4] - 1) ** 2))
"""


def train(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    (cwd / "costs.py").write_text(COSTS)
    program = [sys.executable, "-P", "-c", "from pegasus_jax.cli import train; train()", "task=gym"]
    return subprocess.run([*program, *map(str, words)], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("env", "cost", "states", "limit"),
    [("Pendulum-v1", "costs:upright", 3, 2.0), ("InvertedDoublePendulum-v5", "costs:balanced", 9, 1.0)],
)
def test_an_environment_not_written_for_us(env: str, cost: str, states: int, limit: float, tmp_path: Path) -> None:
    """What the run stored is what Gymnasium says: the same controls from the same start give the same observations."""
    done = train(f"env={env}", f"cost={cost}", "horizon=8", *TINY, "out=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = record.trials(tmp_path / "run")
    assert [row["random"] for row in rows] == [True, False]
    assert all(np.isfinite(row["mean_cost"]) for row in rows)
    for trial in (1, 2):
        episode = record.load_episode(tmp_path / "run", trial)
        assert episode is not None
        assert (episode.x.shape, episode.u.shape) == ((9, states), (8, 1))
        assert np.all(np.abs(episode.u) <= limit)
    assert settings.load(tmp_path / "run" / "config.yaml").env == env


def test_a_guest_obeys_gymnasium() -> None:
    """Reset by key is reset by a seed, and steps come in order, in compiled code."""
    plant = guest("Pendulum-v1", 3)
    controls = np.linspace(-2, 2, 12, dtype=np.float32)[:, None]

    @jax.jit
    def run(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(x: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
            x = plant.step(x, u)
            return x, x

        x = plant.reset(key)
        return x, jax.lax.scan(step, x, controls)[1]

    first, xs = run(jax.random.key(4))
    env = gymnasium.make("Pendulum-v1")
    x, _ = env.reset(seed=int(jax.random.randint(jax.random.key(4), (), 0, 2**31 - 1)))
    np.testing.assert_allclose(first, x, atol=1e-6)
    np.testing.assert_allclose(xs, [env.step(u)[0] for u in controls], atol=1e-6)
    np.testing.assert_array_equal(run(jax.random.key(4))[1], xs)


class Fragile(gymnasium.Env):
    """Counts its steps, ends at the third, and breaks when it is stepped on."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self.count = 0
        return np.zeros(1), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert self.count < 3, "stepped after its end"
        self.count += 1
        return np.full(1, self.count), 0.0, self.count == 3, False, {}


def test_an_environment_rests_once_it_has_ended() -> None:
    gymnasium.register("Fragile-v0", Fragile)
    plant = guest("Fragile-v0", 1)

    @jax.jit
    def run(key: jax.Array) -> jax.Array:
        step = lambda x, _: (plant.step(x, jax.numpy.zeros(1)),) * 2  # noqa: E731
        return jax.lax.scan(step, plant.reset(key), None, length=6)[1][:, 0]

    for seed in range(2):  # a reset begins anew
        np.testing.assert_array_equal(run(jax.random.key(seed)), [1, 2, 3, 3, 3, 3])


def test_an_environment_is_never_asked_for_two_episodes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU evaluates a plant in JAX twenty times side by side."""
    config = Config(
        task="gym", env="Pendulum-v1", cost="math:cos", start_mean=(0.0, 0.0, 0.0), search=Search(widen=1.0)
    )
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(program, "compiler_options", lambda _: {})
    assert not program.Program(build(config), 1).side_by_side
    assert program.Program(compose(tiny(), cart()), 1).side_by_side


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "task=gym needs env= and cost="),
        (["env=Pendulum-v1"], "task=gym needs env= and cost="),
        (["env=Pendulumm-v1", "cost=costs:upright"], "Pendulum"),
        (["env=CartPole-v1", "cost=costs:upright"], "its controls are Discrete(2), not a vector"),
        (["env=Pendulum-v1", "cost=costs:down"], "cost=costs:down cannot be imported"),
        (["env=Pendulum-v1", "cost=nowhere:down"], "no module named 'nowhere' in"),
        (["env=Pendulum-v1", "cost=costs"], "expected cost=module:function"),
        (["env=Pendulum-v1", "cost=costs:upright", "angles=[3]"], "choose from 0 to 2"),
        (["env=Pendulum-v1", "cost=costs:upright", "horizon=0"], "the nearest is 1"),
    ],
)
def test_bad_input_is_one_clear_line(words: list[str], message: str, tmp_path: Path) -> None:
    done = train(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert message in done.stderr
