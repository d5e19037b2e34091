"""Cosines and sines that are observed become angles: the same task as with observed angles, found by no accident."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pegasus_jax
from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.gym_plant import resets_of
from pegasus_envs.swimmer.plant import swimmer
from pegasus_jax import tasks
from pegasus_jax.assembly.searchers import start
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config
from pegasus_jax.math import circles
from pegasus_jax.runs import config_io, store
from pegasus_jax.runs.evaluation import evaluate_run
from pegasus_jax.runs.train import train
from pegasus_jax.tasks import circled
from pegasus_jax.types import Cost
from probes import PLAIN, cart, dial, tiny

PAIRS = st.permutations(range(7)).flatmap(
    lambda order: st.integers(0, 3).map(lambda count: tuple((order[2 * i], order[2 * i + 1]) for i in range(count)))
)


def upright(x: Any) -> Any:
    return 1 - jnp.exp(-((x[0] - 1) ** 2 + x[1] ** 2))


def upright_angle(x: Any) -> Any:
    return upright(jnp.stack([jnp.cos(x[0]), jnp.sin(x[0]), x[1]]))


class Angle(gymnasium.ObservationWrapper):
    """Pendulum-v1 whose observation is [angle, rate]."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("Pendulum-v1"))
        self.observation_space = gymnasium.spaces.Box(-10, 10, (2,))

    def observation(self, observation: Any) -> Any:
        return np.array([np.arctan2(observation[1], observation[0]), observation[2]], np.float32)


gymnasium.register("PendulumAngle-v0", Angle)


@given(PAIRS, st.integers(0, 2**31))
def test_there_and_back_is_the_same_state(pairs: circles.Circles, seed: int) -> None:
    x = np.random.default_rng(seed).uniform(-3, 3, (5, 7 - len(pairs)))
    seen = circles.to_observation(x, pairs)
    for cosine, sine in pairs:
        np.testing.assert_allclose(seen[:, cosine] ** 2 + seen[:, sine] ** 2, 1)
    np.testing.assert_allclose(circles.to_state(seen, pairs), x, atol=1e-12)
    np.testing.assert_allclose(circles.to_state(jnp.asarray(seen, jnp.float32), pairs), x, atol=2e-6)
    others = [i for i in range(7) if i not in sum(pairs, ())]
    np.testing.assert_array_equal(seen[:, others], x[:, circles.places(others, 7, pairs)])


@given(PAIRS, st.integers(0, 2**31))
def test_every_pair_is_found_and_nothing_else(pairs: circles.Circles, seed: int) -> None:
    """Among other entries: noise, one that never changes, one that repeats another."""
    noise = np.random.default_rng(seed)
    seen = circles.to_observation(noise.normal(0, 0.3, (100, 7 - len(pairs))), pairs).astype(np.float32)
    seen = np.column_stack([seen, np.ones(100), np.zeros(100), seen[:, 0]])
    ordered = {tuple(sorted(pair)) for pair in pairs}
    assert {tuple(sorted(pair)) for pair in circles.find(seen[:, :9])} == ordered
    assert not circles.find(seen[:99])
    assert not circles.find(seen, others=range(7))
    entries = [entry for pair in circles.find(seen) for entry in pair]
    assert len(entries) == len({*entries}) == 2 * len(pairs)
    off = seen + 1e-4 * noise.normal(size=seen.shape)
    assert not circles.find(off)


@pytest.mark.parametrize("plant", [cartpole, double_cartpole, *(lambda n=n: swimmer("belly_up", n) for n in (2, 6))])
def test_none_is_found_where_there_is_none(plant: Any) -> None:
    made = plant()
    draws = np.random.default_rng(0).normal(made.start_mean, made.start_std, (100, len(made.start_mean)))
    assert circles.find(draws) == ()


@pytest.mark.parametrize(
    ("env", "pairs"),
    [
        ("Pendulum-v1", ((0, 1),)),
        ("InvertedDoublePendulum-v5", ((1, 3), (2, 4))),
        ("Reacher-v5", ((0, 2), (1, 3))),
        ("InvertedPendulum-v5", ()),
        ("HalfCheetah-v5", ()),
        ("MountainCarContinuous-v0", ()),
    ],
)
def test_on_plants_of_gymnasium(
    env: str, pairs: circles.Circles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file there
    config = Config(task="gym", env=env, cost=f"{__name__}:upright", horizon=5)
    known = tasks.resolve(config)
    assert known.circles == pairs
    assert tasks.resolve(replace(config, circles=())).circles == ()
    task = tasks.of_config(known)
    seen = resets_of(env)
    assert seen.shape == (100, len(task.state_names) + len(pairs))
    np.testing.assert_allclose(circles.to_observation(np.asarray(task.starts), pairs), seen, atol=1e-6)
    drawn = np.asarray(jax.vmap(lambda key: start(key, task=task))(jax.random.split(jax.random.key(0), 20)))
    assert all(np.abs(task.starts - x).max(1).min() < 1e-6 for x in drawn)
    x = jnp.asarray(task.starts[3], float)
    np.testing.assert_allclose(task.cost.of_state(x), upright(jnp.asarray(seen[3])), atol=1e-5)


def test_what_names_entries_of_the_observation_is_carried_over() -> None:
    five = cart()._replace(
        state_names=("x0", "x1", "x2", "x3", "x4", "x5"),
        angles=(3,),
        rates=(4, 5),
        start_mean=np.array([9.0, 0.0, -1.0, 2.0, 3.0, 4.0]),
        start_std=np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
        cost=Cost(lambda x: x[1] + 10 * x[2] + 100 * x[3]),
        stop=lambda x: x[5] > 1,
    )
    task = circled.of_angles(five, ((2, 1),))
    assert task.state_names == ("x0", "atan2(x1, x2)", "x3", "x4", "x5")
    assert (task.angles, task.rates) == ((1, 2), (3, 4))
    np.testing.assert_allclose(task.start_mean, [9, np.pi, 2, 3, 4])
    np.testing.assert_allclose(task.start_std, [0.1, 0.2, 0.4, 0.5, 0.6])  # at 180 degrees only the sine moves
    x = jnp.array([9.0, 0.7, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(task.cost.of_state(x), np.sin(0.7) + 10 * np.cos(0.7) + 200, rtol=1e-6)
    assert task.stop is not None
    assert bool(task.stop(x))
    for pairs, says in ((((0, 6),), "circles=6 is not an entry"), (((3, 1),), "circles and angles both name 3")):
        with pytest.raises(ConfigError, match=says):
            circled.of_angles(five, pairs)


def test_starts_that_hang_are_not_torn_at_the_seam() -> None:
    hanging = circles.to_state(
        circles.to_observation(np.random.default_rng(0).normal([np.pi, 0], 0.1, (100, 2)), ((0, 1),)), ((0, 1),)
    )
    assert np.std(hanging[:, 0]) > 3
    task = circled.start_moments(dial()._replace(starts=hanging))
    np.testing.assert_allclose(task.start_std, 0.1, rtol=0.2)
    assert np.abs(task.start_mean[0]) == pytest.approx(np.pi, abs=0.05)
    np.testing.assert_allclose(np.cos(task.starts[:, 0]), np.cos(hanging[:, 0]))


def learned(folder: Path, env: str, cost: str, **given: Any) -> Path:
    config = tiny(trials=2, search__steps=5, fit__steps=20, eval_episodes=2, **PLAIN)
    config = replace(config, task="gym", env=env, cost=f"{__name__}:{cost}", horizon=6, **given)
    known = tasks.resolve(config)
    train(known, store.create(folder))
    return folder


@pytest.mark.slow
def test_a_plant_seen_by_cosine_and_sine_is_learned_as_if_seen_by_its_angle(tmp_path: Path) -> None:
    """The same data to the last bit, and costs, searches and controls but for rounding. The folder keeps both."""
    first = learned(tmp_path / "circle", "Pendulum-v1", "upright")
    second = learned(tmp_path / "angle", "PendulumAngle-v0", "upright_angle", angles=(0,))
    for one, two in zip(store.trials(first), store.trials(second), strict=True):
        numbers = {name: value for name, value in two.items() if isinstance(value, float)}
        assert {name: one[name] for name in numbers} == pytest.approx(numbers, rel=1e-3)
    one, two = (ran.trajectory for run in (first, second) if (ran := store.load_episode(run, 1)))
    np.testing.assert_array_equal(one.x, two.x)
    np.testing.assert_array_equal(one.u, two.u)
    control, expected = pegasus_jax.controller(first), pegasus_jax.controller(second)
    for angle, rate in ((0.3, 1.0), (-3.0, -2.0)):
        pair = np.array([np.cos(angle), np.sin(angle), rate], np.float32)
        np.testing.assert_allclose(control(pair), expected([np.arctan2(pair[1], pair[0]), rate]), rtol=1e-3)
    with pytest.raises(ValueError, match="3 finite numbers"):
        control([0.0, 1.0])
    with np.load(first / "episodes" / "0001.npz") as file:
        seen, x = file["observation"], file["x"]
    np.testing.assert_allclose(seen, np.stack([np.cos(x[:, 0]), np.sin(x[:, 0]), x[:, 1]], -1), rtol=1e-6)
    assert json.loads((first / "run.json").read_text())["task"]["circles"] == [[0, 1]]
    assert store.task_of(first).circles == ((0, 1),)
    # The folder says all: who goes on, or evaluates, looks for no circles again.
    kept = config_io.load(first / "config.yaml")
    assert (kept.circles, len(kept.starts)) == (((0, 1),), 100)
    train(replace(kept, trials=3), first, resume=True)
    assert len(store.trials(first)) == 3
    assert evaluate_run(first, 2, 0, 3)["trial"] == 3
