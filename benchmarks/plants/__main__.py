"""What each plant costs to simulate, and how far single-precision MJX strays from C MuJoCo in double precision.

    python -m benchmarks.plants          (on one core: taskset -c 0 python -m benchmarks.plants)

Writes benchmarks/results/plants.json (plants-one-core.json on one core) and prints it. Costs: seconds to compile, and
to run one, 10 and 100 episodes as one program, by the clock and of CPU time, beside C MuJoCo's own loop.
Accuracy: 20 s under random controls, 8 seeds. Energy: 10 s without friction and force.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from benchmarks import RESULTS, command, none
from benchmarks.plants.in_c import Drive, held, in_c, stroke
from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.physics import Motion
from pegasus_envs.plant import Plant, simulate
from pegasus_envs.swimmer.plant import HIPS, swimmer
from pegasus_envs.swimmer.rotations import angles_of
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about, cpus

SECONDS, SEEDS, TIMES = 20.0, 8, (0.5, 1, 2, 3, 5, 10, 20)
BATCHES = (1, 10, 100)
PLANTS: dict[str, tuple[Plant, Callable[[Plant], Drive]]] = {
    "cartpole": (cartpole(), held),
    "double_cartpole": (double_cartpole(), held),
    "swimmer, 2 legs": (swimmer("knife_edge", 2), lambda plant: stroke(2)),
    "swimmer, 6 legs": (swimmer("knife_edge", 6), lambda plant: stroke(6)),
}


def random_controls(plant: Plant, episodes: int, horizon: int) -> np.ndarray:
    """[N, H, U], uniform between the limits."""
    shape = (episodes, horizon, len(plant.control_low))
    return np.random.default_rng(0).uniform(plant.control_low, plant.control_high, shape).astype(np.float32)


def starts(plant: Plant, episodes: int) -> Any:
    """States [N, ...]."""
    return jax.vmap(plant.reset)(jax.random.split(jax.random.key(0), episodes))


def timed(function: Callable[[], Any], repeats: int = 3) -> tuple[float, float]:
    """Least seconds by the clock and of CPU time."""
    clock, processor = [], []
    for _ in range(repeats):
        began, used = time.perf_counter(), time.process_time()
        function()
        clock.append(time.perf_counter() - began)
        processor.append(time.process_time() - used)
    return min(clock), min(processor)


def cost(plant: Plant, drive: Drive) -> dict[str, Any]:
    """Seconds of one episode of the plant's own length, in batches, and in C."""
    row: dict[str, Any] = {"episode_s": plant.dt * plant.horizon}
    for batch in BATCHES:
        states, controls = starts(plant, batch), random_controls(plant, batch, plant.horizon)
        one = lambda state, controls: simulate(plant, state, controls)  # noqa: E731
        if batch == 1:
            states, controls = jax.tree.map(lambda leaf: leaf[0], states), controls[0]
        began = time.perf_counter()
        run = jax.jit(one if batch == 1 else jax.vmap(one)).lower(states, controls).compile()
        compiled = time.perf_counter() - began
        jax.block_until_ready(run(states, controls))
        clock, processor = timed(lambda: jax.block_until_ready(run(states, controls)))  # noqa: B023
        row[str(batch)] = {"compile_s": compiled, "clock_s": clock, "processor_s": processor}
    row["ratio_clock"] = row["100"]["clock_s"] / row["1"]["clock_s"]
    row["ratio_processor"] = row["100"]["processor_s"] / row["1"]["processor_s"]
    commands = np.concatenate([list(drive(control)) for control in random_controls(plant, 1, plant.horizon)[0]])
    data = mujoco.MjData(plant.model)
    state = np.zeros(mujoco.mj_stateSize(plant.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(plant.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    row["c_clock_s"], row["c_processor_s"] = timed(
        lambda: rollout.rollout(plant.model, [data], state[None], commands[None])
    )
    return row


def strays(plant: Plant, drive: Callable[[Plant], Drive]) -> dict[str, Any]:
    """Errors of each state against C over 20 s, and how the largest grows: medians and worst of the seeds."""
    horizon = round(SECONDS / plant.dt)
    states, controls = starts(plant, SEEDS), random_controls(plant, SEEDS, horizon)
    xs = np.asarray(jax.jit(jax.vmap(lambda s, c: simulate(plant, s, c)))(states, controls), float)[:, 1:]
    errors = []
    for seed in range(SEEDS):
        qpos, qvel, within = in_c(plant, states.qpos[seed], states.qvel[seed], controls[seed], drive(plant))
        error = xs[seed] - observed(plant, qpos, qvel, within)
        turn = list(plant.angles)
        error[:, turn] = (error[:, turn] + np.pi) % (2 * np.pi) - np.pi
        errors.append(np.abs(error))
    errors = np.stack(errors)  # [S, H, D]
    ends = [round(t / plant.dt) for t in TIMES if t >= plant.dt]
    so_far = np.maximum.accumulate(errors, axis=1)
    return {
        "times_s": [t for t in TIMES if t >= plant.dt],
        "median": [float(np.median(so_far[:, end - 1].max(axis=1))) for end in ends],
        "worst": [float(so_far[:, end - 1].max()) for end in ends],
        "states_median": dict(zip(plant.state_names, np.median(so_far[:, -1], axis=0).tolist(), strict=True)),
        "states_worst": dict(zip(plant.state_names, so_far[:, -1].max(axis=0).tolist(), strict=True)),
    }


def observed(plant: Plant, qpos: np.ndarray, qvel: np.ndarray, within: np.ndarray) -> np.ndarray:
    """x [H, D] of C MuJoCo's states; the swimmer's gyro is averaged over the last stroke, of 25 time steps."""
    if plant.model.nq == plant.model.nv:
        return np.asarray(jax.vmap(plant.observe)(Motion(jnp.asarray(qpos), jnp.asarray(qvel))), float)
    attitude = np.asarray(jax.vmap(angles_of)(jnp.asarray(qpos[:, 3:7])), float)
    parts = [attitude, -qpos[:, 2:3], within[:, -25:, 3:6].mean(axis=1), qpos[:, HIPS]]
    return np.hstack(parts)[:, : len(plant.start_mean)]


def energy_drift(plant: Plant) -> float:
    """Largest change over 10 s from a tilt of 1 rad, as a part of what there is above the hanging rest."""
    x = jnp.asarray(plant.start_mean).at[np.array(plant.angles)].add(1.0)
    still = jnp.zeros((round(10.0 / plant.dt), len(plant.control_low)))
    states = [
        plant.state_from_observation(x)
        for x in jax.jit(lambda x: simulate(plant, plant.state_from_observation(x), still))(x)
    ]
    rest = mechanical(plant, plant.state_from_observation(jnp.asarray(plant.start_mean)))
    energy = np.array([mechanical(plant, state) for state in states]) - rest
    return float(np.abs(energy - energy[0]).max() / energy[0])


def mechanical(plant: Plant, state: Motion) -> float:
    """Kinetic and potential energy [J], as MuJoCo counts them."""
    data = mujoco.MjData(plant.model)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    mujoco.mj_forward(plant.model, data)
    mujoco.mj_energyPos(plant.model, data)
    mujoco.mj_energyVel(plant.model, data)
    return float(data.energy.sum())


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The rows as text."""
    lines = [f"{'':18s}{'compile':>9s}{'one':>9s}{'10':>9s}{'100':>9s}{'100/one':>9s}{'(cpu)':>9s}{'C':>9s}   [s]"]
    for name, row in rows.items():
        cells = [row["cost"]["1"]["compile_s"], *(row["cost"][str(batch)]["clock_s"] for batch in BATCHES)]
        cells += [row["cost"][key] for key in ("ratio_clock", "ratio_processor", "c_clock_s")]
        lines.append(f"{name:18s}" + "".join(f"{cell:9.4f}" if cell < 1 else f"{cell:9.2f}" for cell in cells))
    for name, row in rows.items():
        far = row["strays"]
        lines.append(f"\n{name}: largest error of any state after a time [s], median and worst of {SEEDS} seeds")
        lines.append("  " + "  ".join(f"{t:g}: {m:.1e} {w:.1e}" for t, m, w in zip(
            far["times_s"], far["median"], far["worst"], strict=True)))  # fmt: skip
        lines += [f"  {state:18s} 20 s: median {error:.1e}, worst {far['states_worst'][state]:.1e}"
                  for state, error in far["states_median"].items()]  # fmt: skip
        if "energy_drift" in row:
            lines.append(f"  energy drift in 10 s without friction and force: {row['energy_drift']:.1e}")
    return "\n".join(lines)


def main(words: list[str]) -> None:
    """The command line of this module. Raises ConfigError for any word."""
    none(words)
    cores = cpus()
    rows = {name: {"cost": cost(plant, drive(plant)), "strays": strays(plant, drive)}
            for name, (plant, drive) in PLANTS.items()}  # fmt: skip
    rows["cartpole"]["energy_drift"] = energy_drift(cartpole(friction=0.0))
    rows["double_cartpole"]["energy_drift"] = energy_drift(double_cartpole(friction=0.0))
    print(table(rows))
    command = "python -m benchmarks.plants"
    path = RESULTS / ("plants-one-core.json" if cores == 1 else "plants.json")
    write_json(path, {"cores": cores, "rows": rows, "about": about(command)})


if __name__ == "__main__":
    command(main, __doc__)
