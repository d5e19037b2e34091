"""A controller as one Python module of plain NumPy, its weights inside."""

import base64
import runpy
import textwrap
from pathlib import Path

import numpy as np

from pegasus_jax.exports.layers import Dense, Features, Kernels, Layer, Limit, Recall, Squash, Standardize, layers_of
from pegasus_jax.exports.learned import Learned, for_comment

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


{controller}
    x = np.asarray(observation, np.{dtype})
    if x.shape != ({observations},) or not np.isfinite(x).all():
        raise ValueError(f"an observation is {observations} finite numbers, not {{x}}")
{code}


def _array(dtype, shape, text):
    return np.frombuffer(base64.b64decode(text), dtype).reshape(shape)


# Numbers, to the last bit.
{arrays}
'''


FORGETFUL = '''\
class Controller:
    """Call it with an observation [{observations}], in the order of OBSERVATION, for the control [{controls}]."""

    def reset(self):
        """Forget the episode so far: there is nothing to forget."""

    def __call__(self, observation):
        return act(observation)


def act(observation):
    """The control [{controls}] for an observation [{observations}]. Raises ValueError unless all of it is finite."""'''

REMEMBERING = '''\
class Controller:
    """Call it with each observation [{observations}], in the order of OBSERVATION, for the control [{controls}]."""

    def __init__(self):
        self.reset()

    def reset(self):
        """Forget the episode so far: what is remembered begins with the next observation."""
        self.memory = None

    def __call__(self, observation):
        control, self.memory = act(observation, self.memory)
        return control


def act(observation, memory=None):
    """The control [{controls}] for an observation [{observations}], and what is remembered until the next one.

    Without a memory an episode begins. Raises ValueError unless all of the observation is finite.
    """'''


def write(learned: Learned, name: str) -> bytes:
    """The module's text. Raises ConfigError for a policy that is no list of layers."""
    code, arrays, sizes = [], {}, (len(learned.observation), len(learned.task.control_names))
    layers = layers_of(learned, "numpy")
    remembers = any(isinstance(layer, Recall) for layer in layers)
    for number, layer in enumerate(layers):
        lines, used = _printed(layer, number)
        code += lines
        arrays |= used
    code += REMEMBERED if remembers else ["return control"]
    text = MODULE.format(
        title=for_comment(learned.title),
        name=name,
        observations=sizes[0],
        controls=sizes[1],
        controller=(REMEMBERING if remembers else FORGETFUL).format(observations=sizes[0], controls=sizes[1]),
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
        case Recall():
            return _recalled(layer)
        case Features(plain, angles):
            entries = [_entry(pair) for pair in angles]
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
            limited = "control = np.minimum(np.maximum(MIDDLE + HALF * v, LOW), HIGH)"
            return [*squash, limited], {"LOW": low, "HIGH": high, "MIDDLE": layer.middle, "HALF": layer.half}
        case Limit(change):
            size = len(change)
            limited = f"np.minimum(np.maximum(control, past[:{size}] - CHANGE), past[:{size}] + CHANGE)"
            return [f"control = {limited}"], {"CHANGE": change}


REMEMBERED = [
    "past = np.concatenate([control, past])[: past.size]",
    "rows = np.concatenate([q, rows])[: rows.size]",
    "return control, (past, rows, q, rate)",
]


def _recalled(layer: Recall) -> tuple[list[str], dict[str, np.ndarray]]:
    """The lines that make what the policy sees of x, and of what is remembered: x from now on."""
    turn = f"change[{list(layer.turning)}]"
    lines = [
        f"q = np.array([{', '.join(map(_entry, layer.state))}], x.dtype)",
        "if memory is None:",
        f"    memory = np.tile(REST, {layer.controls}), np.tile(q, {layer.rows}), q, np.zeros_like(q)",
        "past, rows, before, rate = memory",
    ]
    if layer.rates:
        lines.append("change = q - before")
        lines += [f"{turn} = np.arctan2(np.sin({turn}), np.cos({turn}))"] if layer.turning else []
        lines.append(f"rate = rate + x.dtype.type({layer.weight!r}) * (change / x.dtype.type({layer.dt!r}) - rate)")
    asked = f", x[{list(layer.asked)}]" if layer.asked else ""
    lines.append(f"x = np.concatenate([q, past, rows{', rate' * layer.rates}{asked}])")
    return lines, {"REST": layer.rest}


def _entry(entries: tuple[int, ...]) -> str:
    """An entry of the state, of one or two of the observation."""
    return f"x[{entries[0]}]" if len(entries) == 1 else f"np.arctan2(x[{entries[1]}], x[{entries[0]}])"


def _stored(name: str, array: np.ndarray) -> str:
    """The lines that define an array, little end first."""
    little = array.astype(array.dtype.newbyteorder("<"))
    lines = textwrap.wrap(base64.b64encode(little.tobytes()).decode(), 112)
    return "\n".join(
        [f'{name} = _array("{little.dtype.str}", {array.shape},', *(f'    "{line}"' for line in lines), ")"]
    )


def run(path: Path, observations: np.ndarray, episode: int) -> np.ndarray:
    """What the module at `path` does for observations [N, O], of so many an episode: controls [N, U]."""
    control, found = runpy.run_path(str(path))["Controller"](), []
    for number, x in enumerate(observations):
        if number % episode == 0:
            control.reset()
        found.append(control(x))
    return np.stack(found)
