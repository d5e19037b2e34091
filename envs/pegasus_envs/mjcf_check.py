"""Whether MJX simulates an MJCF file as C MuJoCo does: what it does not know it passes over without a word."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings and MJX's data classes declare few of their names.)

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pegasus_envs import mjcf_plant

PERIODS = 20  # of one random episode
# Of an entry's change in a control period. Most of Gymnasium's files stay within 1e-5 in single precision; drag of
# another kind than MJX's, a delay of one period and an actuator that is switched off are beyond.
TOLERANCE = 2e-2
MOST = 0.8  # of the periods: contacts alone made 3 in 10 differ, of an ant
SMALL = 1e-2  # a change that is less is not judged: there the solvers' own tolerances are


def compare(made: mjcf_plant.Mechanism) -> None:
    """Raises ValueError, in one line, where MJX's physics of a mechanism is not that of C MuJoCo, or not finite.

    Each control period of one episode of random controls is done twice from C MuJoCo's state, so that chaos has no time
    to grow: a period differs where the change of an entry does, by more than TOLERANCE of that entry's greatest change,
    or of SMALL. Contacts differ in some periods, because MJX finds other points; other forces do in most.
    """
    draws, count = np.random.default_rng(0), round(made.dt / made.model.opt.timestep)
    data, step = mujoco.MjData(made.model), jax.jit(made.step)
    first = made.reset(jax.random.key(0))
    data.qpos[:], data.qvel[:] = first.qpos, first.qvel
    off, change = [], []
    mujoco.set_mju_user_warning(lambda text: None)  # else it is on stderr, and in a file in the working folder
    for period in range(PERIODS):
        now = (data.qpos, data.qvel, data.act, data.qacc_warmstart, data.time)
        state = mjcf_plant.Moving(*(jnp.array(part, first.qpos.dtype) for part in now))
        before, control = np.concatenate([data.qpos, data.qvel]), draws.uniform(made.control_low, made.control_high)
        data.ctrl[:] = control
        mujoco.mj_step(made.model, data, count)
        following = step(state, jnp.asarray(control, first.qpos.dtype))
        after, found = np.concatenate([data.qpos, data.qvel]), np.concatenate([following.qpos, following.qvel])
        if not np.isfinite(found).all() or _unstable(data):
            raise ValueError(
                f"its simulation is not stable: it breaks down in period {period + 1} of a random episode; try a"
                " smaller timestep, or a softer servo"
            )
        off.append(np.abs(found - after))
        change.append(np.abs(after - before))
    greatest = np.maximum(np.max(change, axis=0), SMALL)
    differs = np.max(np.array(off) / greatest, axis=1) > TOLERANCE
    if differs.mean() > MOST:
        worst = mjcf_plant.full_state_names(made.model)[int(np.argmax(np.median(np.array(off) / greatest, axis=0)))]
        raise ValueError(
            f"MJX does not simulate it as MuJoCo does: {worst} differs in {differs.sum()} of {PERIODS} control periods;"
            " leave out what MJX does not know"
        )


def _unstable(data: mujoco.MjData) -> bool:
    """Whether C MuJoCo has given up a state and begun again."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(data.warning[int(kind)].number for kind in bad)
