"""A controller as one Python module of plain NumPy, its weights inside."""

import base64
import runpy
import textwrap
from pathlib import Path

import numpy as np

from pegasus_jax.exports.layers import Dense, Features, Kernels, Layer, Squash, Standardize, layers_of
from pegasus_jax.exports.learned import Learned, said

MODULE = '''\
"""{title}, as written by pegasus-export.

It needs NumPy and nothing else:

    from {name} import Controller

    control = Controller()
    control.reset()       # before every episode
    u = control(x)        # an observation [{observations}] -> a control [{controls}] within its limits

Written by a program: change the run, and export it again.
"""

import base64

import numpy as np

OBSERVATION = {observation!r}
CONTROL = {control!r}
PERIOD = {period!r}  # [s] from one control to the next


class Controller:
    """Call it with an observation [{observations}], in the order of OBSERVATION, for the control [{controls}]."""

    def reset(self):
        """Forget the episode so far. It remembers nothing; a controller that filters its sensors will."""

    def __call__(self, observation):
        return act(observation)


def act(observation):
    """The control [{controls}] for an observation [{observations}]. Raises ValueError unless all of it is finite."""
    x = np.asarray(observation, np.{dtype})
    if x.shape != ({observations},) or not np.isfinite(x).all():
        raise ValueError(f"an observation is {observations} finite numbers, not {{x}}")
{code}


def _array(dtype, shape, text):
    return np.frombuffer(base64.b64decode(text), dtype).reshape(shape)


# Numbers, to the last bit.
{arrays}
'''


def write(learned: Learned, name: str) -> bytes:
    """The module's text. Raises ConfigError for a policy that is no list of layers."""
    code, arrays = [], {}
    for number, layer in enumerate(layers_of(learned, "numpy")):
        lines, used = _printed(layer, number)
        code += lines
        arrays |= used
    text = MODULE.format(
        title=said(learned.title),
        name=name,
        observations=len(learned.observation),
        controls=len(learned.task.control_names),
        observation=learned.observation,
        control=tuple(learned.task.control_names),
        period=float(learned.task.dt),
        dtype=learned.dtype.name,
        code=textwrap.indent("\n".join(code), "    "),
        arrays="\n".join(_stored(key, value) for key, value in arrays.items()),
    )
    return text.encode()


def _printed(layer: Layer, i: int) -> tuple[list[str], dict[str, np.ndarray]]:
    """The lines of a layer, v to v, and the arrays that they name."""
    match layer:
        case Features(plain, angles):
            entries = [
                f"x[{pair[0]}]" if len(pair) == 1 else f"np.arctan2(x[{pair[1]}], x[{pair[0]}])" for pair in angles
            ]
            angle = [f"angle = np.array([{', '.join(entries)}], x.dtype)"] if angles else []
            parts = [f"x[{list(plain)}]"] * bool(plain) + ["np.sin(angle)", "np.cos(angle)"] * bool(angles)
            return [*angle, f"v = np.concatenate([{', '.join(parts)}])"], {}
        case Standardize(mean, scale):
            return [f"v = (v - MEAN_{i}) / SCALE_{i}"], {f"MEAN_{i}": mean, f"SCALE_{i}": scale}
        case Dense(kernel, bias, relu):
            line = f"KERNEL_{i} @ v + BIAS_{i}"
            return [f"v = np.maximum({line}, 0)" if relu else f"v = {line}"], {
                f"KERNEL_{i}": kernel.T,
                f"BIAS_{i}": bias,
            }
        case Kernels(centers, lengthscales, weights):
            lines = [
                f"squares = ((v - CENTERS_{i}) / LENGTHSCALES_{i}[:, None]) ** 2",
                f"v = (WEIGHTS_{i} * np.exp(-0.5 * squares.sum(-1))).sum(-1).astype(x.dtype)",
            ]
            return lines, {f"CENTERS_{i}": centers, f"LENGTHSCALES_{i}": lengthscales, f"WEIGHTS_{i}": weights}
        case Squash(kind, low, high):
            squash = ["v = np.tanh(v)"] if kind == "tanh" else ["s = np.sin(v)", "v = (3 * s - s**3) / 2"]
            limited = "return np.minimum(np.maximum(MIDDLE + HALF * v, LOW), HIGH)"
            return [*squash, limited], {"LOW": low, "HIGH": high, "MIDDLE": layer.middle, "HALF": layer.half}


def _stored(name: str, array: np.ndarray) -> str:
    """The lines that define an array, little end first."""
    little = array.astype(array.dtype.newbyteorder("<"))
    lines = textwrap.wrap(base64.b64encode(little.tobytes()).decode(), 112)
    return "\n".join(
        [f'{name} = _array("{little.dtype.str}", {array.shape},', *(f'    "{line}"' for line in lines), ")"]
    )


def run(path: Path, observations: np.ndarray) -> np.ndarray:
    """What the module at `path` does for observations [N, O]: controls [N, U]."""
    act = runpy.run_path(str(path))["act"]
    return np.stack([act(x) for x in observations])
