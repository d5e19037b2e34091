"""task=mjcf: a MuJoCo file that was not written for us becomes a task by a line on the command line and a cost."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import forked
import pegasus_jax as pg
from pegasus_envs import mjcf_check, mjcf_plant
from pegasus_envs.render import frames
from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import build
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config, label
from pegasus_jax.runs import check, config_io, store
from pegasus_jax.tasks import assumed
from probes import TINY_WORDS

TINY = [*TINY_WORDS, "trials=2"]
PENDULUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "inverted_pendulum.xml"
COSTS = "import jax.numpy as jnp\ndef upright(x):\n    return 1 - jnp.exp(-(x[0] ** 2 + x[1] ** 2))\n"
ARM = """<mujoco><option density="{density}"/><worldbody><body><joint name="elbow" type="hinge" axis="0 1 0"/>
<geom type="box" size=".1 .1 .3" {geom}/></body></worldbody><actuator>{motor}</actuator></mujoco>"""
MOTOR = '<motor joint="elbow" ctrllimited="true" ctrlrange="-1 1"/>'


@pytest.fixture(scope="module")
def pendulum() -> mjcf_plant.Mechanism:
    return mjcf_plant.mechanism(mjcf_plant.read(PENDULUM), 0.04, start_std=[0.05])


def config(path: Path | str = PENDULUM, **changes: object) -> Config:
    return Config(**({"task": "mjcf", "mjcf": str(path), "cost": "math:sin", "dt": 0.04, "horizon": 8} | changes))  # type: ignore[arg-type]


def rotations(made: Config) -> list[str]:
    return assumed.rotations(made, tasks.of_config(made))


def test_follows_c_through_limits_and_is_pure(pendulum: mjcf_plant.Mechanism) -> None:
    """Two episodes at once, each against C MuJoCo: the cart hits the ends of its rail, which are constraints."""
    controls = np.random.default_rng(0).uniform(-3, 3, (2, 50, 1)).astype(np.float32)
    controls[1] = 3.0

    def run(state: mjcf_plant.Moving, controls: jax.Array) -> jax.Array:
        def step(state: mjcf_plant.Moving, control: jax.Array) -> tuple[mjcf_plant.Moving, jax.Array]:
            state = pendulum.step(state, control)
            return state, pendulum.observe(state)

        return jax.lax.scan(step, state, controls)[1]

    starts = jax.vmap(pendulum.reset)(jax.random.split(jax.random.key(0), 2))
    xs = np.asarray(jax.jit(jax.vmap(run))(starts, controls))
    for start, us, x in zip(range(2), controls, xs, strict=True):
        data, exact = mujoco.MjData(pendulum.model), []
        data.qpos[:], data.qvel[:] = starts.qpos[start], starts.qvel[start]
        for u in us:
            data.ctrl[:] = u
            for _ in range(2):
                mujoco.mj_step(pendulum.model, data)
            exact.append([*data.qpos, *data.qvel])
        np.testing.assert_allclose(x[:25], exact[:25], atol=2e-3)
    assert xs[1, :, 0].max() > 0.95
    assert not np.allclose(xs[0], xs[1])


def test_what_is_observed_is_placed(pendulum: mjcf_plant.Mechanism) -> None:
    some = mjcf_plant.mechanism(
        pendulum.model, 0.04, observe=["qvel.1", "qpos.1"], start_mean=[1.0, 0.2], start_std=[0.0]
    )
    state = some.reset(jax.random.key(0))
    np.testing.assert_allclose(some.observe(state), [1.0, 0.2])
    np.testing.assert_allclose((state.qpos, state.qvel), ([0, 0.2], [0, 1.0]))
    assert some.state_names == ("hinge' [rad/s]", "hinge [rad]")
    assert pendulum.state_names == ("slider [m]", "hinge [rad]", "slider' [m/s]", "hinge' [rad/s]")
    np.testing.assert_allclose((some.control_low, some.control_high), ([-3.0], [3.0]))
    assert (pendulum.rates, some.rates) == ((2, 3), (0,))
    assert mjcf_plant.mechanism(pendulum.model, 0.04, observe=["qpos.0", "qpos.1", "qvel.1"]).rates == ()
    narrow = mjcf_plant.mechanism(pendulum.model, 0.04, control_low=[-1.0], control_high=[0.5])
    np.testing.assert_allclose((narrow.control_low, narrow.control_high), ([-1.0], [0.5]))


def test_is_drawn_without_a_camera_of_its_own(pendulum: mjcf_plant.Mechanism) -> None:
    one, two = frames(
        pendulum, [pendulum.state_from_observation(jnp.array([0.0, a, 0.0, 0.0])) for a in (0.0, 0.5)], 160, 120
    )
    assert np.abs(one.astype(int) - two).max() > 50


def command(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    (cwd / "costs.py").write_text(COSTS)
    return forked.command("train", *words, cwd=cwd)


@pytest.mark.slow
def test_learns_and_resumes_from_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "cart.xml").write_text(PENDULUM.read_text())
    words = ["task=mjcf", "mjcf=cart.xml", "cost=costs:upright", "dt=0.04", "horizon=8", "angles=[1]", *TINY]
    done = command(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs" / "mjcf-cart-seed0"
    assert [row["random"] for row in store.trials(run)] == [True, False]
    assert config_io.load(run / "config.yaml").mjcf == str(tmp_path / "cart.xml")
    ran = store.load_episode(run, 2)
    assert ran is not None
    assert (ran.trajectory.x.shape, ran.trajectory.u.shape) == ((9, 4), (8, 1))
    assert np.all(np.abs(ran.trajectory.u) <= 3)
    (tmp_path / "cart.xml").write_text(PENDULUM.read_text().replace("9.81", "1.6"))
    again = command(f"resume={run}", "trials=3", cwd=tmp_path)
    assert again.returncode == 2, again.stderr
    said = (
        f"pegasus: the task of {run / 'config.yaml'} is not that of run.json, with which it began: its mjcf_digest was"
    )
    assert again.stderr.splitlines()[-1].startswith(said)


def test_a_file_is_known_by_its_content(tmp_path: Path) -> None:
    (tmp_path / "other.xml").write_text(PENDULUM.read_text().replace("9.81", "1.6"))
    (tmp_path / "same.xml").write_text(PENDULUM.read_text() + "\n")
    here, same, other = (
        tasks.of_config(config(path)) for path in (PENDULUM, tmp_path / "same.xml", tmp_path / "other.xml")
    )
    assert tasks.mjcf_digest(here) == tasks.mjcf_digest(same)
    assert tasks.mjcf_digest(here) not in (None, tasks.mjcf_digest(other))
    assert tasks.mjcf_digest(tasks.make("cartpole")) is None


def test_folders_tell_tasks_apart() -> None:
    labels = [
        label(made)
        for made in (
            config("some/arm.xml"),
            Config(task="gym", env="package:ns/Pendulum-v1"),
            Config(task="swimmer_belly_up", legs=6),
            Config(),
        )
    ]
    assert labels == ["mjcf-arm", "gym-package-ns-Pendulum-v1", "swimmer_belly_up-legs6", "cartpole"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mjcf": None}, "task=mjcf needs mjcf=; for example mjcf=arm.xml"),
        ({"dt": None, "horizon": None}, "task=mjcf needs dt= and horizon=; for example dt=0.05 horizon=40"),
        ({"mjcf": None, "cost": None, "dt": None}, "needs mjcf=, cost= and dt=; for example mjcf=arm.xml cost=my"),
        ({"mjcf": "nowhere.xml"}, "there is no such file"),
        ({"dt": 0.05}, "not a whole number of its time steps of 0.02 s; try 0.04"),
        ({"observe": ("qpos.2",)}, "choose from qpos.0 slider, qpos.1 hinge or, as rates, qvel.0 to qvel.1"),
        (
            {"observe": ("hinge",)},
            "observe=hinge is not an entry of its state; choose from qpos.0 slider, qpos.1 hinge",
        ),
        ({"control_low": (1.0, 2.0)}, "control_low has 2 entries; expected 1"),
        ({"control_low": (5.0,)}, "control_low=5 must be less than control_high=3"),
        ({"control_low": (-4.0,)}, "actuator slide: controls from -4 to 3 are beyond its limits, from -3 to 3"),
        ({"control_high": (3.5,)}, "actuator slide: controls from -3 to 3.5 are beyond its limits, from -3 to 3"),
        ({"dt": 2000.0}, "dt=2000 is 100000 of its time steps; the most is dt=200"),
        ({"start_mean": (0.1,)}, "start_mean has 1 entries; expected 4"),
        ({"start_mean": (1.0, 2.0)}, "start_mean has 2 entries; expected 4"),
        ({"angles": (4,)}, "angles=4 is not an entry of the observation"),
        (
            {"angles": (1, 0)},
            "angles=0 is slider [m], and only positions of hinges are angles; choose from 1 hinge [rad]",
        ),
        ({"angles": (3,)}, "angles=3 is hinge' [rad/s], and only positions of hinges are angles; choose from 1 hinge"),
        (
            {"angles": (0,), "observe": ("qpos.0",)},
            "angles=0 is slider [m], and only positions of hinges are angles; leave",
        ),
        ({"cost": "math:nothing"}, "cost=math:nothing cannot be imported"),
    ],
)
def test_bad_settings_are_one_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        tasks.of_config(config(**changes))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"motor": ""}, "it has no actuators"),
        ({"motor": '<motor joint="elbow"/>'}, "actuator u0 has no ctrlrange"),
        ({"geom": 'fluidshape="ellipsoid"'}, "MJX ignores fluidshape"),
        ({"motor": MOTOR + "<nonsense/>"}, "MuJoCo cannot read it"),
        ({"density": '1000" integrator="implicit'}, "MJX cannot simulate it"),
        ({"density": '1000" noslip_iterations="3'}, "MJX ignores noslip_iterations"),
        ({"density": '1000" actuatorgroupdisable="0'}, "MJX ignores actuatorgroupdisable"),
        ({"motor": MOTOR.replace("/>", ' delay="0.05" nsample="20"/>')}, "MJX ignores delay of an actuator"),
    ],
)
def test_files_that_cannot_be_are_one_line(parts: dict[str, str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(**{"density": "1000", "geom": "", "motor": MOTOR} | parts))
    with pytest.raises(ConfigError) as caught:
        tasks.of_config(config(path, dt=0.02))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def arm(path: Path, **parts: str) -> mjcf_plant.Mechanism:
    """The arm of a file with these parts, whatever MJX ignores of it."""
    path.write_text(ARM.format(**{"density": "1000", "geom": "", "motor": MOTOR} | parts))
    return mjcf_plant.mechanism(mujoco.MjModel.from_xml_path(str(path)), 0.02, start_std=[0.1])


def test_flags_that_change_nothing_are_cleared(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        ARM.format(
            density='1000"><flag energy="enable" fwdinv="enable"/></option><option density="1000', geom="", motor=MOTOR
        )
    )
    assert mjcf_plant.read(path).opt.enableflags == 0


@pytest.mark.slow
def test_what_mjx_simulates_as_mujoco_does_is_let_through(pendulum: mjcf_plant.Mechanism, tmp_path: Path) -> None:
    mjcf_check.compare(pendulum)
    mjcf_check.compare(arm(tmp_path / "arm.xml"))


@pytest.mark.parametrize(
    "parts",
    [
        {"motor": MOTOR.replace("/>", ' delay="0.02" nsample="20"/>')},
        {"density": '1000" actuatorgroupdisable="0'},
        {
            "geom": 'fluidshape="ellipsoid" density="100"',
            "density": '1000" viscosity="5',
            "motor": MOTOR.replace("-1 1", "-50 50"),
        },
    ],
)
def test_another_physics_is_seen_by_comparing(parts: dict[str, str], tmp_path: Path) -> None:
    """Also without knowing what it is that MJX ignores."""
    made = arm(tmp_path / "arm.xml", **parts)
    assert mjcf_plant.ignored(made.model)
    with pytest.raises(ValueError, match=r"does not simulate it as MuJoCo does: elbow.* differs in \d+ of 20"):
        mjcf_check.compare(made)


def test_a_simulation_that_breaks_down_is_not_learned_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    motor = '<position joint="elbow" kp="1e7" ctrllimited="true" ctrlrange="-1 1"/>'
    with pytest.raises(ValueError, match=r"not stable: it breaks down in period \d+ of"):
        mjcf_check.compare(arm(tmp_path / "arm.xml", motor=motor, density='0" timestep="0.02'))
    assert not Path("MUJOCO_LOG.TXT").exists()


TWO = """<mujoco><option timestep="0.02"/><worldbody><body>{first}<geom type="box" size=".1 .1 .3"/><body pos="0 0 .3">
<joint name="wheel" axis="0 1 0" damping=".1"/><geom type="box" size=".1 .1 .3"/></body></body></worldbody>
<actuator>{motors}</actuator></mujoco>"""
FIRST = {
    "hinge": '<joint name="base" axis="0 1 0"/>',
    "free": '<freejoint name="root"/>',
    "ball": '<joint name="neck" type="ball"/>',
}
LIMITED = '<motor name="spin" joint="wheel" ctrllimited="true" ctrlrange="-1 1"/>'
UNLIMITED = '<motor name="pull" joint="wheel"/>'


def two(path: Path, first: str, motors: str = LIMITED) -> Path:
    """A file of two joints, of which the second is a hinge."""
    path.write_text(TWO.format(first=FIRST[first], motors=motors))
    return path


def test_limits_are_asked_for_where_the_file_has_none_and_one_list_is_as_long_as_the_other(tmp_path: Path) -> None:
    path = two(tmp_path / "two.xml", "hinge", LIMITED + UNLIMITED)
    given = tasks.of_config(config(path, control_low=(-1.0, -9.0), control_high=(0.5, 9.0)))
    np.testing.assert_allclose((given.control_low, given.control_high), ([-1, -9], [0.5, 9]))
    one = tasks.of_config(config(path, control_low=(-0.5,), control_high=(0.5,)))
    np.testing.assert_allclose((one.control_low, one.control_high), ([-0.5] * 2, [0.5] * 2))
    with pytest.raises(ConfigError, match="actuator pull has no ctrlrange"):
        tasks.of_config(config(path))
    with pytest.raises(ConfigError, match="actuator spin: controls from -9 to 9 are beyond its limits, from -1 to 1"):
        tasks.of_config(config(path, control_low=(-9.0,), control_high=(9.0,)))
    prior = mjcf_plant.mechanism(mjcf_plant.read(path), 0.04, control_low=[-9.0], control_high=[9.0])  # has the task's
    np.testing.assert_allclose((prior.control_low, prior.control_high), ([-9] * 2, [9] * 2))
    for low, high in (((-1.0,), (1.0, 1.0)), ((-1.0, -1.0), (1.0,))):
        told = (
            rf"control_low has {len(low)} and control_high has {len(high)} numbers; expected 2 in both, or one for all"
        )
        with pytest.raises(ConfigError, match=told):
            tasks.of_config(config(path, control_low=low, control_high=high))


def test_a_range_that_is_switched_off_limits_nothing(tmp_path: Path) -> None:
    path = two(tmp_path / "two.xml", "hinge")
    path.write_text(path.read_text().replace("/>", '><flag clampctrl="disable"/></option>', 1))
    given = tasks.of_config(config(path, control_low=(-9.0,), control_high=(9.0,)))
    np.testing.assert_allclose((given.control_low, given.control_high), ([-9], [9]))


@pytest.mark.parametrize(
    ("first", "of", "others", "angle", "choices"),
    [
        (
            "free",
            "root, a free joint: ",
            (3, 7),
            7,
            "qpos.0 to qpos.6 root, qpos.7 wheel, qvel.0 to qvel.5 root, qvel.6",
        ),
        (
            "ball",
            "neck, a ball joint: ",
            (0, 4),
            4,
            "qpos.0 to qpos.3 neck, qpos.4 wheel, qvel.0 to qvel.2 neck, qvel.3",
        ),
    ],
)
def test_a_quaternion_is_no_angle_and_is_told(
    first: str, of: str, others: tuple[int, int], angle: int, choices: str, tmp_path: Path
) -> None:
    path = two(tmp_path / "two.xml", first)
    (note,) = rotations(config(path))
    assert note.startswith(
        f"{of}{', '.join(f'qpos.{i}' for i in range(*others))} are of a quaternion, which is learned"
    )
    assert rotations(config(path, observe=(f"qpos.{angle}", f"qvel.{angle - 1}"))) == []
    assert tasks.of_config(config(path, angles=(angle,))).angles == (angle,)
    with pytest.raises(ConfigError, match=rf"angles=0 is qpos.0, and only .*; choose from {angle} wheel \[rad\]$"):
        tasks.of_config(config(path, angles=(0,)))
    with pytest.raises(ConfigError, match=choices):
        tasks.of_config(config(path, observe=("wheel",)))
    assert rotations(config(two(path, "hinge"))) == []


def test_of_many_joints_the_first_and_the_last_are_told(tmp_path: Path) -> None:
    path, more = tmp_path / "many.xml", '<joint name="{}" axis="0 1 0"/>'
    names = [f"j{i}" for i in range(13)]
    body = "".join(f'<body>{more.format(name)}<geom size=".1"/>' for name in names) + "</body>" * len(names)
    path.write_text(
        f"<mujoco><worldbody>{body}</worldbody><actuator>{LIMITED.replace('wheel', 'j0')}</actuator></mujoco>"
    )
    model = mjcf_plant.read(path)
    with pytest.raises(ValueError, match=r"choose from qpos\.0 to qpos\.12 or qvel\.0 to qvel\.12$"):
        mjcf_plant.mechanism(model, 0.02, observe=["tip"])


SENSORS: dict[str, dict[str, Any]] = {
    "late": {"sensors.delay": 2, "control_rate": [5.0], "starts": [[0.3, 0.0], [-0.3, 0.0]]},
    "filter": {"sensors.measured": [0], "sensors.velocity": "filter", "sensors.delay": 1},
    "history": {"sensors.measured": [0], "history": 2, "sensors.delay": 1},
    "goals": {"goal_low": [-1.0], "goal_high": [1.0], "sensors.delay": 1},
}


def turned(x: jax.Array) -> jax.Array:
    return 1 - jnp.exp(-((x[0] - 1) ** 2))


def turned_to(x: jax.Array, goal: jax.Array) -> jax.Array:
    return 1 - jnp.exp(-((x[0] - goal[0]) ** 2))


def settings(folder: Path, sensors: str) -> dict[str, Any]:
    """Of an arm with these sensors."""
    (folder / "arm.xml").write_text(ARM.format(density="1000", geom="", motor=MOTOR))
    plant = {"mjcf": str(folder / "arm.xml"), "dt": 0.04, "horizon": 5, "angles": [0]}
    return plant | {"cost": turned_to if sensors == "goals" else turned} | SENSORS[sensors]


@pytest.mark.parametrize("sensors", SENSORS)
def test_the_check_compares_the_plant_behind_any_sensors(sensors: str, tmp_path: Path) -> None:
    made = pg.preset("mjcf", settings=settings(tmp_path, sensors))
    check.before_training(made, build(made).task)


def test_another_physics_is_seen_behind_a_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = pg.preset("mjcf", settings=settings(tmp_path, "late"))
    task = tasks.of_config(made)
    monkeypatch.setattr(mjcf_check, "TOLERANCE", -1.0)
    with pytest.raises(ConfigError, match="MJX does not simulate it as MuJoCo does"):
        tasks.compared(made, task)


@pytest.mark.campaign
def test_an_arm_learns_behind_late_sensors(tmp_path: Path) -> None:
    tiny = {"model.hidden": [4], "policy.hidden": [4], "search.particles": 16, "search.steps": 2, "fit.steps": 3}
    words = settings(tmp_path, "goals") | tiny | {"trials": 2, "eval_episodes": 1}
    run = pg.train("mjcf", out=tmp_path / "run", settings=words)
    assert [row["random"] for row in store.trials(run)] == [True, False]
    assert all(np.isfinite(row["episode_cost"]) for row in store.trials(run))
