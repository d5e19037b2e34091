"""An environment of one's own: the names that it gives its entries, or that words give them, and films of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v2 as imageio
import numpy as np
import pytest

from folders import TINY, a_run
from pegasus_envs.gym_plant import env_spec, make_env, named, picture, render_modes
from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.exports.write import contract_of, export
from pegasus_jax.runs import config_io
from pegasus_jax.runs.check import report
from pegasus_jax.task import Task
from pegasus_jax.viz import run_plots
from pegasus_jax.viz.video import HEIGHT, STRIP, WIDTH, film, fitted

ROBOT = """
import gymnasium, jax.numpy as jnp, numpy as np

class Named(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    dt, state_names, control_names = 0.02, ("cos", "sin", "rate [rad/s]"), ["torque [N m]"]

    def __init__(self, render_mode=None, breaks=-1):
        self.render_mode, self.breaks = render_mode, breaks

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.count = self.np_random.uniform(-3, 3), 0
        return self.seen(), {}

    def seen(self):
        rate = np.nan if self.count == self.breaks else 0.0
        return np.array([np.cos(self.angle), np.sin(self.angle), rate])

    def step(self, control):
        self.angle, self.count = self.angle + 0.1, self.count + 1
        return self.seen(), 0.0, self.count == 7, False, {}

    def render(self):
        assert self.render_mode == "rgb_array"
        return np.full((30, 50, 3), 20 * self.count, np.uint8)

class Blind(Named):
    metadata = {"render_modes": ["human"]}
    def __init__(self, **given):
        raise OSError("opened")

class Dark(Named):
    def render(self):
        return None

class Nameless(Named):
    def __getattribute__(self, name):
        if name in ("state_names", "control_names"):
            raise AttributeError(name)
        return super().__getattribute__(name)

class Half(gymnasium.ObservationWrapper):
    state_names = ("rate [rad/s]",)
    def __init__(self, **given):
        super().__init__(Named(**given))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    def observation(self, x):
        return x[2:]

for kind in (Named, Blind, Dark, Nameless, Half):
    gymnasium.register(f"{kind.__name__}-v0", kind)

def cost(x):
    return 1 - jnp.exp(-(x[0] ** 2))
"""
WORDS = {"task": "gym", "env": "named_robot:Named-v0", "cost": "named_robot:cost", "horizon": "10"}
WORDS |= {"eval_episodes": "0", "start_mean": "[1,0,0]", "circles": "[[0,1]]"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A folder from which the robot's module is imported."""
    home = tmp_path_factory.mktemp("robot")
    (home / "named_robot.py").write_text(ROBOT)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(home))
        yield home
        tasks.close_environments()


@pytest.fixture(scope="module")
def run(home: Path) -> Path:
    config = tasks.resolve(config_io.parse({**TINY, **WORDS}))
    run = a_run(home / "run", trials=2, made=tasks.of_config(config), **WORDS)
    config_io.save(config, run / "config.yaml")
    return run


@pytest.fixture(autouse=True)
def closed() -> Any:
    yield
    tasks.close_environments()


def made(**words: str) -> Task:
    return tasks.of_config(config_io.parse({**TINY, **WORDS, **words}))


def test_names_are_the_environments_or_those_of_words_or_numbers(home: Path) -> None:
    assert made().state_names == ("atan2(sin, cos)", "rate [rad/s]")
    assert made().control_names == ("torque [N m]",)
    assert made(circles="[]").state_names == ("cos", "sin", "rate [rad/s]")
    words = made(state_names='["c","s","v [rad/s]"]', control_names='["volts [V]"]')
    assert (words.state_names, words.control_names) == (("atan2(s, c)", "v [rad/s]"), ("volts [V]",))
    nameless = made(env="named_robot:Nameless-v0")
    assert (nameless.state_names, nameless.control_names) == (("atan2(x1, x0)", "x2"), ("u0",))
    wrapped = made(env="named_robot:Half-v0", circles="[]", start_mean="[0]")
    assert (wrapped.state_names, wrapped.control_names) == (("rate [rad/s]",), ("torque [N m]",))


def test_plants_of_ours_have_names_as_environments(home: Path) -> None:
    known = env_spec("pegasus_envs:pegasus/CartPoleSwingUp-v0", start_mean=[0.0] * 4)
    assert known.state_names == ("x [m]", "x' [m/s]", "theta' [rad/s]", "theta [rad]")
    assert known.control_names == ("force [N]",)


def test_a_run_keeps_them_and_nothing_opens_the_robot_again(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_io.load(run / "config.yaml")
    assert config.state_names == ("cos", "sin", "rate [rad/s]")
    monkeypatch.setattr(gymnasium, "make", None)
    file = export(run, overwrite=True)
    said = json.loads(contract_of(file).read_bytes())
    assert [(entry["name"], entry["unit"]) for entry in said["observation"]] == [
        ("cos", None),
        ("sin", None),
        ("rate", "rad/s"),
    ]
    assert (said["control"][0]["name"], said["control"][0]["unit"]) == ("torque", "N m")
    titles: list[str] = []
    monkeypatch.setattr(run_plots, "_save", lambda figure, path: titles.extend(a.get_title() for a in figure.axes))
    task, fan = (
        tasks.of_config(config),
        {"x": np.zeros((11, 4, 2)), "u": np.zeros((10, 4, 1)), "cost": np.zeros((10, 4))},
    )
    run_plots.trajectories(run, 1, fan, task, run / "picture.png")
    assert titles[:4] == ["atan2(sin, cos)", "rate [rad/s]", "torque [N m]", "cost"]


def test_checks_and_errors_say_them(home: Path) -> None:
    said = "\n".join(report(config_io.parse({**TINY, **WORDS, "start_mean": "[]", "circles": "null"})))
    assert "atan2(sin, cos), rate [rad/s]" in said
    assert "torque [N m] from -2 to 2" in said
    assert "cos and sin are cosine and sine of one angle" in said
    assert "resets: rate [rad/s];" in said
    task = made(**{"env_args.breaks": "1"})
    task.environment.reset(0)
    with pytest.raises(ValueError, match=r"entry 2 of its observation, rate \[rad/s\], is nan"):
        task.environment.step(np.zeros(1))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"state_names": "[a,b]"}, "state_names has 2 entries, a, b; expected 3"),
        ({"control_names": "[a,b]"}, "control_names has 2 entries, a, b; expected 1"),
        ({"state_names": "[a,b,a]"}, "state_names has a twice; each entry needs a name of its own"),
        ({"state_names": '[a,b," "]'}, r"not a tuple of texts such as 'angle \[rad\]'; or give state_names="),
        ({"state_names": "[angle [rad],b,c]"}, r"""as in 'state_names=\["a \[m\]","b"\]'"""),
        ({"state_names": "angle"}, "state_names=angle is not a list of words"),
        ({"task": "cartpole", "state_names": "[a]"}, "state_names=.a. is of no use with task=cartpole"),
    ],
)
def test_names_that_cannot_be_are_one_line(home: Path, words: dict[str, str], says: str) -> None:
    with pytest.raises(ConfigError, match=says) as refused:
        tasks.of_config(config_io.parse({**(TINY if "task" in words else TINY | WORDS), **words}))
    assert "\n" not in str(refused.value)


def test_an_environments_own_attribute_may_be_wrong_too() -> None:
    class Other:
        def get_wrapper_attr(self, name: str) -> Any:
            return "angle"

    with pytest.raises(ValueError, match="its state_names are 'angle', not a tuple of texts"):
        named(Other(), "state_names", (), 5)


# Films


def test_a_film_shows_what_the_environment_renders(run: Path) -> None:
    path = film(run, episodes=2, seed=1)
    reader = imageio.get_reader(path)
    seen = [frame.astype(int) for frame in reader]
    assert reader.get_meta_data()["fps"] == 25  # every second of 7 periods of .02 s, and the end
    assert len(seen) == 8
    assert {frame.shape for frame in seen} == {(HEIGHT + STRIP, WIDTH, 3)}
    middle = np.array([frame[HEIGHT // 2, WIDTH // 2, 0] for frame in seen])
    np.testing.assert_allclose(middle, [40, 80, 120, 140] * 2, atol=8)  # a video's colors are not exact
    assert ("named_robot:Named-v0", ()) not in opened()


def opened() -> dict[Any, Any]:
    from pegasus_envs import gym_plant

    return gym_plant._opened


def test_pictures_of_any_shape_fill_a_frame() -> None:
    drawn = fitted(np.full((10, 40, 3), 200, np.uint8))
    assert drawn.shape == (HEIGHT, WIDTH, 3)
    assert drawn[HEIGHT // 2].min() == 200
    assert drawn[0].max() == drawn[-1].max() == 0


def test_who_says_that_he_cannot_be_filmed_is_not_even_opened(home: Path) -> None:
    """He may be a robot; and there, making him would raise OSError."""
    says = r"Blind-v0 cannot be filmed: 'rgb_array' is not among its metadata's render_modes, \['human'\]$"
    with pytest.raises(ConfigError, match=says):
        tasks.camera(config_io.parse({**WORDS, "env": "named_robot:Blind-v0"}))
    assert not opened()


def test_what_does_not_render_is_one_line(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    look = tasks.camera(config_io.parse({**WORDS, "env": "named_robot:Dark-v0"}))
    make_env("named_robot:Dark-v0").reset(seed=0)
    monkeypatch.setattr(tasks, "camera", lambda config: look)
    with pytest.raises(RunError, match=r"its render returned NoneType; expected uint8 \[height, width, 3\]") as refused:
        film(run, episodes=1, seed=0)
    assert "\n" not in str(refused.value)
    assert "kept" not in str(refused.value)


@pytest.mark.slow
def test_gymnasiums_own_are_filmed_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    config = config_io.parse({"task": "gym", "env": "InvertedPendulum-v5"})
    look = tasks.camera(config)
    make_env("InvertedPendulum-v5").reset(seed=0)
    assert look().std() > 0
    assert render_modes("InvertedPendulum-v5") is not None
    monkeypatch.delenv("MUJOCO_GL", raising=False)


def test_a_picture_is_checked() -> None:
    class Env:
        def render(self) -> Any:
            return np.zeros((3, 3, 4), np.uint8)

    with pytest.raises(ValueError, match=r"an array of uint8 \(3, 3, 4\)"):
        picture(Env())  # type: ignore[arg-type]
