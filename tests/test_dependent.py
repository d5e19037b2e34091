"""Observations that follow from each other, never change or are very large are learned from, not stumbled over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import forked
from pegasus_jax.runs import store

ROBOT = """
import gymnasium, numpy as np, jax.numpy as jnp

def cost(x): return 1 - jnp.exp(-2 * (1 - jnp.cos(x[0])))

class Tip(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (6,), np.float64)
    dt = 0.05
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.array([np.pi, 0.0]) + self.np_random.normal(0, 0.05, 2)
        return self.seen(), {}
    def seen(self):
        angle, rate = self.x
        return np.array([angle, rate, 0.5 * np.cos(angle), np.rad2deg(angle), 0.7, 1e4])
    def step(self, control):
        for _ in range(5):
            self.x[1] += 0.01 * (15 * np.sin(self.x[0]) + 5 * float(control[0]))
            self.x[0] += 0.01 * self.x[1]
        return self.seen(), 0.0, False, False, {}

gymnasium.register("Tip-v0", Tip)
"""
WORDS = "task=gym env=robot:Tip-v0 cost=robot:cost angles=[0] horizon=40 trials=4 eval_episodes=0 fit.steps=100"
TINY = "success=2 search.steps=20 search.particles=30 model.hidden=[20] policy.hidden=[20] out=run"


@pytest.mark.slow
def test_every_update_is_finite(tmp_path: Path) -> None:
    """An angle, its tip's height, the angle in degrees, a constant and 1e4: each update of fit and search counts."""
    (tmp_path / "robot.py").write_text(ROBOT)
    done = forked.command("train", *WORDS.split(), *TINY.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for row in store.trials(tmp_path / "run"):
        assert row["skipped_updates"] == 0
        assert np.isfinite([row["fit_loss"], row["objective_first"], row["objective_last"]]).all()
        assert row["objective_last"] < 1
        # With success=2 every episode is one: the third search after one of a policy's only refines.
        assert row["iterations"] == (10 if row["trial"] == 4 else 20)
