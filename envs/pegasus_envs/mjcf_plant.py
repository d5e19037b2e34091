"""Any MJCF file as a plant: MJX's own step, contacts and constraints included; pure, so it can be vmapped."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings and MJX's data classes declare few of their names.)

import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from pegasus_envs.plant import FRAME, draw_start, filled
from pegasus_envs.quiet import mjx

_ENTRY = re.compile(r"(qpos|qvel)\.(\d+)")
LONGEST = 10_000  # time steps of a control period
# Flags that only ask for numbers that nobody here reads; MJX refuses them.
_HARMLESS = int(mujoco.mjtEnableBit.mjENBL_ENERGY) | int(mujoco.mjtEnableBit.mjENBL_FWDINV)
NAMED = 12  # joints, or entries, of which a message names each; of more it says the first and the last
_UNITS = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}


class Moving(NamedTuple):
    """What MuJoCo's next step depends on."""

    qpos: Array
    """[nq]"""
    qvel: Array
    """[nv]"""
    act: Array
    """[na] of actuators that have a state"""
    warmstart: Array
    """[nv] acceleration of the step before, from which the constraint solver starts"""
    time: Array
    """[] [s]"""


class Mechanism(NamedTuple):
    """A plant without a goal. D observed entries, U actuators; the functions are those of `plant.Plant`."""

    reset: Callable[[Array], Moving]
    step: Callable[[Moving, Array], Moving]
    substates: Callable[[Moving, Array], Moving]
    """(state, control [U]) -> the states [n, ...] on the way, about one each `FRAME` seconds, for films"""
    observe: Callable[[Moving], Array]
    state_from_observation: Callable[[Array], Moving]
    control_low: np.ndarray
    control_high: np.ndarray
    dt: float
    start_mean: np.ndarray
    start_std: np.ndarray
    state_names: tuple[str, ...]
    control_names: tuple[str, ...]
    model: Any
    qpos: Callable[[Moving], Array]
    rates: tuple[int, ...]
    hinges: tuple[int, ...]
    """the observed entries that are positions of hinges [rad]"""


def mechanism(
    model: mujoco.MjModel,
    dt: float,
    *,
    observe: Sequence[str] = (),
    control_low: Sequence[float] = (),
    control_high: Sequence[float] = (),
    start_mean: Sequence[float] = (),
    start_std: Sequence[float] = (0.1,),
) -> Mechanism:
    """The model's mechanism, driven through its actuators. Raises ValueError, in one line, for what cannot be.

    Args:
        model: as `read` returns it
        dt: control period, a whole number of the model's time steps [s]
        observe: entries such as `qpos.0` and `qvel.3`; all of them, positions first, when empty
        control_low, control_high: limits, one an actuator; the file's `ctrlrange` when empty
        start_mean: of the observed entries; the file's pose at rest when empty. What is not observed starts there.
        start_std: of the observed entries; one number is for all of them
    """
    entries = _entries(model, observe)
    low, high = _limits(model, control_low, control_high)
    count = round(dt / model.opt.timestep)
    if count < 1 or abs(count * model.opt.timestep - dt) > 1e-6 * dt:
        near = max(count, 1) * model.opt.timestep
        raise ValueError(f"dt={dt:g} is not a whole number of its time steps of {model.opt.timestep:g} s; try {near:g}")
    if count > LONGEST:
        raise ValueError(f"dt={dt:g} is {count} of its time steps; the most is dt={LONGEST * model.opt.timestep:g}")
    rest = np.concatenate([model.qpos0, np.zeros(model.nv)])
    mean = filled("start_mean", start_mean, len(entries), rest[entries], each=True)
    std = filled("start_std", start_std, len(entries), np.zeros(len(entries)))
    device, blank = _on_device(model)

    def state_from_observation(x: Array) -> Moving:
        full = jnp.asarray(rest, x.dtype).at[entries].set(x)
        zeros = jnp.zeros(model.nv, x.dtype)
        return Moving(full[: model.nq], full[model.nq :], jnp.zeros(model.na, x.dtype), zeros, jnp.zeros((), x.dtype))

    def advance(steps: int, state: Moving, control: Array) -> Moving:
        data = blank.replace(qpos=state.qpos, qvel=state.qvel, act=state.act, time=state.time)
        data = data.replace(qacc_warmstart=state.warmstart, ctrl=jnp.clip(control, low, high).astype(state.qpos.dtype))
        data, _ = jax.lax.scan(lambda data, _: (mjx.step(device, data), None), data, None, length=steps)
        return Moving(data.qpos, data.qvel, data.act, data.qacc_warmstart, data.time)

    between = max(n for n in range(1, count + 1) if count % n == 0 and (n == 1 or n * model.opt.timestep <= FRAME))

    def substates(state: Moving, control: Array) -> Moving:
        def frame(state: Moving, _: None) -> tuple[Moving, Moving]:
            following = advance(between, state, control)
            return following, following

        return jax.lax.scan(frame, state, None, length=count // between)[1]

    made = Mechanism(
        reset=lambda key: state_from_observation(draw_start(key, mean, std)),
        step=lambda state, control: advance(count, state, control),
        substates=substates,
        observe=lambda state: jnp.concatenate([state.qpos, state.qvel])[entries],
        state_from_observation=state_from_observation,
        control_low=low,
        control_high=high,
        dt=dt,
        start_mean=mean,
        start_std=std,
        state_names=tuple(full_state_names(model)[entry] for entry in entries),
        control_names=tuple(_control(model, i) for i in range(model.nu)),
        model=model,
        qpos=lambda state: state.qpos,
        rates=_rates(model, entries),
        hinges=tuple(map(int, np.flatnonzero(np.isin(entries, _hinges(model))))),
    )
    try:
        jax.eval_shape(made.step, jax.eval_shape(made.reset, jax.random.key(0)), jnp.zeros(model.nu))
    except NotImplementedError as error:
        raise ValueError(f"MJX cannot simulate it: {error}") from error
    return made


def read(path: Path) -> mujoco.MjModel:
    """The model of an MJCF file. Raises ValueError, in one line, when MJX has no such model or gets it wrong."""
    if not path.is_file():
        raise ValueError("there is no such file")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read it: {' '.join(str(error).split())}") from error
    if not model.nu:
        raise ValueError("it has no actuators, so there is nothing to control")
    for what in ignored(model):
        raise ValueError(f"MJX ignores {what}")
    model.opt.enableflags &= ~_HARMLESS
    return model


def ignored(model: mujoco.MjModel) -> list[str]:
    """What of a model MJX passes over without a word, and what to do about it."""
    found = {
        "fluidshape='ellipsoid'; leave it out for the drag on inertia boxes": np.any(model.geom_fluid[:, 0] > 0)
        and (model.opt.density > 0 or model.opt.viscosity > 0),
        "plugins; leave them out": model.nplugin,
        "delay of an actuator; leave it out, and let dt= be no shorter": np.any(model.actuator_delay),
        "actuatorgroupdisable; leave the actuators out": model.opt.disableactuator,
        "noslip_iterations; leave them out": model.opt.noslip_iterations,
    }
    return [what for what, there in found.items() if there]


def digest(model: mujoco.MjModel) -> str:
    """SHA-256 of a compiled model, whatever files it was made of."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


def _on_device(model: mujoco.MjModel) -> tuple[Any, Any]:
    try:
        with jax.ensure_compile_time_eval():  # so that a plant may be built inside jit
            return mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    except NotImplementedError as error:
        raise ValueError(f"MJX cannot simulate it: {error}") from error


def _entries(model: mujoco.MjModel, observe: Sequence[str]) -> np.ndarray:
    """Indices into positions followed by velocities."""
    sizes, found = {"qpos": model.nq, "qvel": model.nv}, []
    for word in observe:
        match = _ENTRY.fullmatch(word)
        if not match or int(match[2]) >= sizes[match[1]]:
            raise ValueError(f"observe={word} is not an entry of its state; choose from {_choices(model)}")
        found.append(int(match[2]) + (model.nq if match[1] == "qvel" else 0))
    return np.array(found, int) if found else np.arange(model.nq + model.nv)


def _choices(model: mujoco.MjModel) -> str:
    """The entries of a state, each with its joint, unless there are many."""
    rates = _span("qvel", 0, model.nv)
    if model.njnt > NAMED:
        return f"{_span('qpos', 0, model.nq)} or {rates}"
    positions = _of_joints("qpos", model.jnt_qposadr, model.nq, model)
    if model.nq != model.nv:  # a free joint or a ball: the numbers of velocities are others
        return f"{positions}, {_of_joints('qvel', model.jnt_dofadr, model.nv, model)}"
    return f"{positions} or, as rates, {rates}"


def _of_joints(word: str, first: np.ndarray, size: int, model: mujoco.MjModel) -> str:
    """As "qpos.0 to qpos.6 root, qpos.7 knee": the entries of each joint, of which these are the first."""
    ends = [*map(int, first[1:]), size]
    spans = [_span(word, start, end) for start, end in zip(map(int, first), ends, strict=True)]
    return ", ".join(f"{span} {_joint(model, i)}" for i, span in enumerate(spans))


def _span(word: str, start: int, end: int) -> str:
    """As "qpos.0 to qpos.6": the entries from `start` up to `end`, which is none of them."""
    return f"{word}.{start}" if end == start + 1 else f"{word}.{start} to {word}.{end - 1}"


def _joint(model: mujoco.MjModel, i: int) -> str:
    """A joint's name, or its number."""
    return model.joint(i).name or f"joint {i}"


def _hinges(model: mujoco.MjModel) -> np.ndarray:
    """The positions that are angles."""
    return model.jnt_qposadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)]


def orientations(model: mujoco.MjModel, observe: Sequence[str] = ()) -> dict[str, list[str]]:
    """Of each free joint ("root, a free joint") or ball the observed entries of its quaternion."""
    observed, found = _entries(model, observe), {}
    kinds = {int(mujoco.mjtJoint.mjJNT_FREE): ("a free joint", 3), int(mujoco.mjtJoint.mjJNT_BALL): ("a ball joint", 0)}
    for i, (kind, first) in enumerate(zip(model.jnt_type, model.jnt_qposadr, strict=True)):
        called, behind = kinds.get(int(kind), ("", 0))
        entries = range(int(first) + behind, int(first) + behind + 4)
        if called and (seen := [f"qpos.{entry}" for entry in observed if entry in entries]):
            found[f"{_joint(model, i)}, {called}"] = seen
    return found


def _rates(model: mujoco.MjModel, entries: np.ndarray) -> tuple[int, ...]:
    """Which of the observed entries are the others' rates, in their order; () if some have none, as a free joint's."""
    place = {int(entry): i for i, entry in enumerate(entries)}
    partners = [place.get(int(entry) + model.nq) for entry in entries if entry < model.nq]
    paired = model.nq == model.nv and len(place) == len(entries) == 2 * len(partners)
    return tuple(i for i in partners if i is not None) if paired and None not in partners else ()


def _limits(model: mujoco.MjModel, low: Sequence[float], high: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest controls [U], and where neither the user nor the file names them, a refusal."""
    bottom, top = _ranges(model)
    lows = filled("control_low", low, model.nu, bottom)
    highs = filled("control_high", high, model.nu, top)
    if len(low) and len(high) and len(low) != len(high):
        raise ValueError(
            f"control_low has {len(low)} and control_high has {len(high)} numbers; expected {model.nu} in both, or one"
            " for all in both"
        )
    for i, (least, greatest) in enumerate(zip(lows, highs, strict=True)):
        if not (np.isfinite(least) and np.isfinite(greatest)):
            name = _control(model, i)
            raise ValueError(f"actuator {name} has no ctrlrange; give control_low= and control_high=, one an actuator")
        if not least < greatest:
            raise ValueError(f"control_low={least:g} must be less than control_high={greatest:g}")
    return lows, highs


def within_range(model: mujoco.MjModel, low: np.ndarray, high: np.ndarray) -> None:
    """Raises ValueError for limits [U] of which an actuator has narrower ones: MuJoCo would use those, and not say so.

    This is of the plant alone: a prior has the limits of the task, whatever its own file says.
    """
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL):
        return
    bottom, top = _ranges(model)
    for i in map(int, np.flatnonzero((low < bottom) | (high > top))):
        raise ValueError(
            f"actuator {_control(model, i)}: controls from {low[i]:g} to {high[i]:g} are beyond its"
            f" limits, from {bottom[i]:g} to {top[i]:g}"
        )


def _control(model: mujoco.MjModel, i: int) -> str:
    """An actuator's name, or what checks, logs and pictures call one without."""
    return model.actuator(i).name or f"u{i}"


def _ranges(model: mujoco.MjModel) -> np.ndarray:
    """The least and the greatest controls [2, U] that a file gives its actuators, infinite where it gives none."""
    return np.where(model.actuator_ctrllimited > 0, model.actuator_ctrlrange.T, [[-np.inf], [np.inf]])


def full_state_names(model: mujoco.MjModel) -> list[str]:
    """Names of positions, then velocities: a joint's where it is a hinge or a slide, else the entry's."""
    positions, rates = [f"qpos.{i}" for i in range(model.nq)], [f"qvel.{i}" for i in range(model.nv)]
    for i in range(model.njnt):
        if unit := _UNITS.get(int(model.jnt_type[i])):
            name = _joint(model, i)
            positions[model.jnt_qposadr[i]] = f"{name} [{unit}]"
            rates[model.jnt_dofadr[i]] = f"{name}' [{unit}/s]"
    return positions + rates
