"""task=mjcf: a MuJoCo file that was not written for us becomes a task by a line on the command line and a cost."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pegasus_envs import mjcf_check, mjcf_plant
from pegasus_envs.render import frames
from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config, label
from pegasus_jax.runs import config_io, store

TINY = ["model.hidden=[8]", "policy.hidden=[8]", "search.steps=5", "fit.steps=5", "search.particles=16", "trials=2"]
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
    program = [sys.executable, "-P", "-c", "from pegasus_jax.cli.main import train; train()"]
    return subprocess.run([*program, *map(str, words)], cwd=cwd, capture_output=True, text=True, check=False)


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
        ({"mjcf": None}, "needs mjcf=, cost=, dt= and horizon="),
        ({"dt": None}, "needs mjcf=, cost=, dt= and horizon="),
        ({"mjcf": "nowhere.xml"}, "there is no such file"),
        ({"dt": 0.05}, "not a whole number of its time steps of 0.02 s; try 0.04"),
        ({"observe": ("qpos.2",)}, "choose from qpos.0 to qpos.1 or qvel.0 to qvel.1"),
        ({"observe": ("tip",)}, "choose from qpos.0"),
        ({"control_low": (1.0, 2.0)}, "control_low has 2 entries; expected 1"),
        ({"control_low": (5.0,)}, "control_low=5 must be less than control_high=3"),
        ({"dt": 2000.0}, "dt=2000 is 100000 of its time steps; the most is dt=200"),
        ({"start_mean": (0.1,)}, "start_mean has 1 entries; expected 4"),
        ({"start_mean": (1.0, 2.0)}, "start_mean has 2 entries; expected 4"),
        ({"angles": (4,)}, "choose from 0 to 3"),
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
        ({"motor": '<motor joint="elbow"/>'}, "actuator 0 has no ctrlrange"),
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
