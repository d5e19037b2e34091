"""The suite of plants that nobody here wrote: what its user wrote is true of them, and one seed goes through it."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import pegasus_envs  # noqa: F401 (registers the cart-pole)
from benchmarks.plants_suite import batched, native, picture
from benchmarks.plants_suite.__main__ import main, share, table
from benchmarks.plants_suite.native import returns
from benchmarks.plants_suite.plants import PLANTS
from pegasus_jax.checks import ConfigError
from pegasus_jax.runs import config_io
from pegasus_jax.tasks import user_code


def function(name: str, setting: str) -> Any:
    """What a plant's words name for `cost` or `stop`; None where they name nothing."""
    words = dict(word.split("=", 1) for word in PLANTS[name].words)
    return jax.jit(user_code.load(setting, words[setting])) if setting in words else None


# Controls that end an episode where random ones do not: force along the rate.
ENDED_BY = {"MountainCarContinuous-v0": lambda x: np.sign(x[1:])}


@pytest.mark.parametrize("name", [name for name in PLANTS if function(name, "stop") is not None])
def test_episodes_end_where_their_user_says(name: str) -> None:
    stop, env = function(name, "stop"), gymnasium.make(PLANTS[name].env)
    env.action_space.seed(0)
    ends = 0
    for seed in range(20):
        x, _ = env.reset(seed=seed)
        for _ in range(200):
            control = ENDED_BY[name](x) if name in ENDED_BY else env.action_space.sample()
            x, _, terminated, truncated, _ = env.step(control)
            assert (stop(jnp.asarray(x)) > 0.5) == terminated, x
            if terminated or truncated:
                ends += terminated
                break
    assert ends == 20


@pytest.mark.parametrize(
    ("name", "goal"),
    [
        ("Pendulum-v1", [1, 0, 0]),
        ("InvertedPendulum-v5", [0, 0, 0, 0]),
        ("InvertedDoublePendulum-v5", [0, 0, 0, 1, 1, 0, 0, 0, 0]),
        ("CartPole", [0, 0, 0, np.pi]),
        ("MountainCarContinuous-v0", [0.45, 0]),
        ("Quadrotor", [0, 0, 0, 0, 0, 0]),
        ("BallOnBeam", [0, 0, 0, 0]),
        ("FourTanks", [12, 14, 0, 0]),
        ("Car", [0, 0, 0, 0]),
    ],
)
def test_a_cost_is_least_at_the_goal(name: str, goal: list[float]) -> None:
    cost, env = function(name, "cost"), gymnasium.make(PLANTS[name].env)
    assert cost(jnp.array(goal, float)) == pytest.approx(0, abs=1e-6)
    starts = [cost(jnp.asarray(env.reset(seed=seed)[0], float)) for seed in range(5)]
    assert 0 < min(starts) <= max(starts) <= 1


def driven(name: str, start: list[float], control: list[float], periods: int) -> np.ndarray:
    """The state [D] of a plant that is written by hand, after so many periods of one control."""
    env = gymnasium.make(PLANTS[name].env)
    env.reset(seed=0)
    plant: Any = env.unwrapped
    plant.s = np.array(start, float)
    for _ in range(periods):
        _, reward, *_ = env.step(np.array(control, np.float32))
        assert reward == pytest.approx(1 - float(function(name, "cost")(jnp.asarray(plant.s))), abs=1e-5)
    return plant.s


def test_a_quadrotor_hovers_under_its_weight_and_falls_without() -> None:
    np.testing.assert_allclose(driven("Quadrotor", [0.0] * 6, [0.5 * 9.81 / 2] * 2, 20), 0, atol=1e-5)
    assert driven("Quadrotor", [0.0] * 6, [0.0, 0.0], 20)[1] == pytest.approx(-9.81 / 2, rel=1e-4)


def test_a_ball_begins_to_roll_as_on_a_slope_and_stops_at_the_beams_end() -> None:
    """5 / 7 of what would slide; nothing holds the beam, so only the first period is a slope's."""
    assert driven("BallOnBeam", [0.0, 0.1, 0.0, 0.0], [0.0], 1)[2] == pytest.approx(
        -5 / 7 * 9.81 * np.sin(0.1) * 0.05, rel=0.02
    )
    assert driven("BallOnBeam", [0.0, 0.1, 0.0, 0.0], [0.0], 60)[[0, 2]] == pytest.approx([-0.5, 0])


def test_four_tanks_rest_where_their_paper_says() -> None:
    """The operating point of Johansson (2000): 12.4, 12.7, 1.8 and 1.4 cm at 3 V, rounded."""
    np.testing.assert_allclose(
        driven("FourTanks", [12.4, 12.7, 1.8, 1.4], [3.0, 3.0], 100), [12.4, 12.7, 1.8, 1.4], rtol=0.1
    )


def test_a_car_drives_on_a_circle() -> None:
    """Of .5 m / tan(steering), around a place beside it; without gas only friction changes its speed."""
    x, y, heading, speed = driven("Car", [0.0, 0.0, 0.0, 1.0], [0.0, 0.3], 10)
    radius = 0.5 / np.tan(0.3)
    np.testing.assert_allclose([x, y], [radius * np.sin(heading), radius * (1 - np.cos(heading))], atol=1e-4)
    assert speed == pytest.approx(np.exp(-0.1 * 2), rel=1e-4)


def test_the_cart_pole_is_the_projects_own() -> None:
    cost, env = function("CartPole", "cost"), gymnasium.make(PLANTS["CartPole"].env)
    env.reset(seed=0)
    for u in np.linspace(-10, 10, 8, dtype=np.float32):
        *_, info = env.step(u[None])
        assert cost(jnp.asarray(info["x"])) == pytest.approx(info["cost"], abs=1e-5)


def test_reachers_cost_is_of_what_its_reward_takes_off() -> None:
    """From the angles and the target alone, in any posture: the distance that the plant itself observes."""
    cost, env = function("Reacher-v5", "cost"), gymnasium.make("Reacher-v5")
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(20):
        u = env.action_space.sample()
        x, *_ = env.step(u)
        lost = np.hypot(x[8], x[9]) + np.sum(u**2)
        assert cost(jnp.asarray(x[:8], float), jnp.asarray(u)) == pytest.approx(lost / 2.42, abs=1e-3)
    goal = jnp.array([1, 1, 0, 0, 0.21, 0, 0, 0], float)
    assert cost(goal, jnp.zeros(2)) == pytest.approx(0, abs=1e-3)  # rounded, so that the slope is finite there


def test_native_returns_are_those_of_the_environment() -> None:
    """A controller that does nothing, against the environment's own reward, again with the same resets."""
    env = gymnasium.make("Pendulum-v1")
    totals, lengths = returns(lambda x: np.zeros(1), env, 2, 2)
    assert lengths == [200, 200]
    env.reset(seed=10_001)
    assert totals[1] == pytest.approx(sum(env.step(np.zeros(1, np.float32))[1] for _ in range(200)), abs=1e-3)


def test_shares_count_the_newest_policy_of_each_seed() -> None:
    def run(*native: float) -> dict[str, Any]:
        rows = [{"native": value, "plant_seconds": 2.0 * trial} for trial, value in enumerate(native, start=1)]
        return {"plant": "Pendulum-v1", "trials": rows}

    runs = [run(-900, -100), run(-100, -900), run(-100), run()]
    assert [share(runs, -200, until) for until in (1, 2, 4)] == [0, 0.5, 0.5]
    assert "Pendulum-v1" in table(runs)


def test_a_pictures_shares_are_those_of_the_table() -> None:
    def run(*native: float, until: int = 9) -> dict[str, Any]:
        rows = [{"native": value, "plant_seconds": 2.0 * trial} for trial, value in enumerate(native, start=1)]
        return {"plant": "Pendulum-v1", "trials": rows[:until]}

    runs = [run(-900, -100, -900), run(-100, -900), run(-100, -100, -100), run(-900, -900, -100, until=1)]
    times, newest, ever = picture.shares(runs, -200)
    assert [*times] == [2, 4, 6]
    assert [*newest] == [share(runs, -200, until) for until in times] == [0.5, 0.5, 0.25]
    assert [*ever] == [0.5, 0.75, 0.75]


def test_a_picture_has_a_panel_for_each_plant_and_refuses_other_files(tmp_path: Path) -> None:
    file, other = tmp_path / "suite.json", tmp_path / "other.json"
    rows = [{"native": -100.0, "plant_seconds": 2.0}]
    runs = [{"plant": name, "trials": rows} for name in ("Pendulum-v1", "Car", "Quadrotor", "CartPole", "Reacher-v5")]
    file.write_text(json.dumps({"runs": runs}))
    other.write_text("[]")
    picture.main([str(file), f"out={tmp_path / 'suite.png'}"])
    height, width, _ = plt.imread(tmp_path / "suite.png").shape
    assert height / width == pytest.approx(2 * 2.2 / (4 * 2.8), abs=0.01)  # two rows
    with pytest.raises(ConfigError, match=r"other.json is not what python -m benchmarks.plants_suite writes"):
        picture.main([str(other)])
    with pytest.raises(ConfigError, match="format= is not a word of this"):
        picture.main(["format=svg"])


def test_a_policy_that_was_kept_or_came_back_is_judged_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its row is that of the trial that learned it; one of a random episode, which learned none, is of that trial."""
    rows = [
        {"trial": trial, "plant_seconds": 2.0 * trial, "policy": 0, "episode_cost": 0.5, "objective_fresh": 0.5}
        | {"policy_next": learned}
        for trial, learned in enumerate([None, 2, 2, 4, 2], start=1)
    ]
    asked = []

    def of_trial(run: Path, trial: int) -> Any:
        asked.append(trial)
        return lambda x: np.full(1, trial / 10)

    monkeypatch.setattr(native.config_io, "load", lambda path: config_io.parse({"task": "gym", "env": "Pendulum-v1"}))
    monkeypatch.setattr(native.store, "trials", lambda run: rows)
    monkeypatch.setattr(native.checkpoint, "available", lambda run: [1, 2, 3, 4, 5])
    monkeypatch.setattr(native, "controller", of_trial)
    found = [row["returns"] for row in native.scores(tmp_path, "Pendulum-v1", 10)]
    assert asked == [1, 2, 4]
    assert found[1] == found[2] == found[4]
    assert len({tuple(returns) for returns in found}) == 3
    assert len(found[0]) == 10


def test_a_plant_that_is_not_there_is_one_line() -> None:
    with pytest.raises(ConfigError, match="plants=Pendulum is unknown; did you mean"):
        main(["plants=[Pendulum]"])


def test_results_that_would_have_the_name_of_their_runs_folder_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"is a folder's name; expected that of a file: out=.*suite\.json"):
        main(["plants=[Pendulum-v1]", f"out={tmp_path / 'suite'}"])
    assert not [*tmp_path.iterdir()]


@pytest.mark.campaign
def test_one_seed_of_one_plant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fit.steps=5", "search.steps=5", "model.hidden=[8]", "policy.hidden=[8]", "trials=1"]
    main(["plants=[Pendulum-v1]", "seeds=[100]", "jobs=1", f"out={tmp_path / 'suite.json'}", *words])
    (run,) = json.loads((tmp_path / "suite.json").read_text())["runs"]
    assert (run["plant"], run["seed"], run["error"]) == ("Pendulum-v1", 100, None)
    (row,) = run["trials"]
    assert row["native"] == pytest.approx(np.mean(row["returns"]), abs=1e-3)
    assert len(row["returns"]) == 50
    assert row["plant_seconds"] == pytest.approx(2)
    assert "Pendulum-v1" in capsys.readouterr().out


@pytest.mark.slow
def test_a_plant_whose_rate_is_small_is_learned_in_three_episodes(tmp_path: Path) -> None:
    """The car's is .01 m a step: a policy that cannot see it pushes forever, and the return stays below 0."""
    out = tmp_path / "suite.json"
    main(["plants=[MountainCarContinuous-v0]", "seeds=[100]", "jobs=1", "episodes=10", "trials=3", f"out={out}"])
    (run,) = json.loads(out.read_text())["runs"]
    assert max(row["native"] for row in run["trials"]) >= PLANTS["MountainCarContinuous-v0"].bar


AWAY = {  # for each plant of joints: a goal, and what is far from it
    "pendulum": ([0.0, 0.0], [np.pi, 0.0]),
    "inverted_pendulum": ([0.0] * 4, [0.0, 0.3, 0.0, 0.0]),
    "inverted_double_pendulum": ([0.0] * 6, [0.0, 1.5, 0.0, 0.0, 0.0, 0.0]),
    "reacher": ([0.0, 0.0, 0.21, 0.0, 0.0, 0.0], [0.0, 0.0, -0.1, 0.2, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", [*batched.PLANTS])
def test_a_plant_of_joints_is_one_to_study(name: str) -> None:
    """Its words make a task of an MJCF file, whose cost tells the goal from what is far, where its episodes end."""
    config = config_io.parse(config_io.split(["task=mjcf", *batched.PLANTS[name]], ())[1])
    assert Path(config.mjcf or "").exists()
    cost = user_code.load("cost", config.cost or "")
    goal, far = (jnp.array(x) for x in AWAY[name])
    assert float(cost(goal)) < 1e-5
    assert float(cost(far)) > 0.8
    if config.stop:
        stop = user_code.load("stop", config.stop)
        assert float(stop(goal)) < 0.01
        assert float(stop(far)) > 0.99
