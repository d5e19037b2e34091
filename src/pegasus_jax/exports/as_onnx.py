"""A controller as an ONNX graph, of a batch of observations [batch, O] to controls [batch, U].

That of one that remembers takes a memory [batch, M] too and returns the next one; zeros begin an episode.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pegasus_jax.checks import ConfigError
from pegasus_jax.exports.layers import (
    Dense,
    Features,
    Kernels,
    Layer,
    Limit,
    Recall,
    Squash,
    Standardize,
    layers_of,
)
from pegasus_jax.exports.learned import Learned, driven

OPSET, IR = 17, 8  # of 2022: runtimes of today and of some years ago read them
INPUT, OUTPUT, MEMORY, NEXT = "observation", "control", "memory", "next_memory"


def imported(name: str) -> Any:
    """A package of the extra `export`. Raises ConfigError where it is missing."""
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"{name} is missing: pip install 'pegasus-jax[export]'; format=numpy and format=c need nothing"
        ) from error


class Graph:
    """Nodes and constants, in order; every function returns the name of a value."""

    def __init__(self) -> None:
        self.onnx = imported("onnx")
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.kept: dict[str, str] = {}  # the parts of the memory, see `Recall.parts`

    def constant(self, values: Any, dtype: Any = None) -> str:
        self.constants.append(self.onnx.numpy_helper.from_array(np.array(values, dtype), f"c{len(self.constants)}"))
        return self.constants[-1].name

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        name = f"v{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, inputs, [name], **attributes))
        return name

    def columns(self, value: str, places: Sequence[int]) -> str:
        return self.node("Gather", value, self.constant(places, np.int64), axis=1)

    def joined(self, *values: str) -> str:
        return self.node("Concat", *values, axis=1)


def write(learned: Learned, name: str) -> bytes:
    """The model, checked. Raises ConfigError for a policy that is no list of layers, or without the package."""
    graph = Graph()
    helper, real = graph.onnx.helper, graph.onnx.helper.np_dtype_to_tensor_dtype(learned.dtype)
    value, layers, memory = INPUT, layers_of(learned, "onnx"), len(learned.remembered)
    for layer in layers:
        value = _added(graph, layer, value, learned.dtype)
    values = {OUTPUT: value}
    for layer in layers:
        if isinstance(layer, Recall):
            values[NEXT] = _remembered(graph, layer, value, learned.dtype)
    graph.nodes += [helper.make_node("Identity", [value], [end]) for end, value in values.items()]
    sizes = {INPUT: len(learned.observation), MEMORY: memory, OUTPUT: len(learned.task.control_names), NEXT: memory}
    ends = [helper.make_tensor_value_info(end, real, ["batch", size]) for end, size in sizes.items() if size]
    made = helper.make_graph(graph.nodes, name, ends[: len(ends) // 2], ends[len(ends) // 2 :], graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(made, opset_imports=opset, ir_version=IR, producer_name="pegasus_jax")
    model.doc_string = learned.title
    graph.onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _added(graph: Graph, layer: Layer, v: str, dtype: np.dtype) -> str:
    """Add the nodes of a layer, v to the value that is returned."""
    node, constant = graph.node, graph.constant
    match layer:
        case Recall():
            return _recalled(graph, layer, v, dtype)
        case Features(plain, angles):
            waves = [_waves(graph, v, pair, dtype) for pair in angles]
            parts = [graph.columns(v, plain)] if plain else []
            return graph.joined(*parts, *(wave[which] for which in ("sine", "cosine") for wave in waves))
        case Standardize(mean, scale):
            return node("Div", node("Sub", v, constant(mean)), constant(scale))
        case Dense(kernel, bias, relu):
            v = node("Gemm", v, constant(kernel), constant(bias))
            return node("Max", v, constant(0, dtype)) if relu else v
        case Kernels(centers, lengthscales, weights):
            types = graph.onnx.TensorProto.DOUBLE, graph.onnx.helper.np_dtype_to_tensor_dtype(dtype)
            v = node("Unsqueeze", node("Cast", v, to=types[0]), constant([1, 2], np.int64))  # [batch, 1, 1, F]
            v = node("Div", node("Sub", v, constant(centers)), constant(lengthscales[:, None]))  # [batch, U, n, F]
            squares = node("ReduceSum", node("Mul", v, v), constant([3], np.int64), keepdims=0)
            v = node("Mul", node("Exp", node("Mul", squares, constant(-0.5))), constant(weights))
            return node("Cast", node("ReduceSum", v, constant([2], np.int64), keepdims=0), to=types[1])
        case Squash(kind, low, high):
            v = node("Tanh", v) if kind == "tanh" else _sine(graph, v, dtype)
            v = node("Add", node("Mul", v, constant(layer.half)), constant(layer.middle))
            return node("Min", node("Max", v, constant(low)), constant(high))
        case Limit(change):
            past = graph.columns(graph.kept["past"], range(len(change)))
            least, most = (node(way, past, constant(change)) for way in ("Sub", "Add"))
            return node("Min", node("Max", v, least), most)


def _recalled(graph: Graph, layer: Recall, x: str, dtype: np.dtype) -> str:
    """Add what makes v of x, and of the memory, whose parts are in `graph.kept` then: of the state, the new ones."""
    node, constant, n = graph.node, graph.constant, len(layer.state)
    state = graph.joined(*(_angle(graph, x, entries, dtype) for entries in layer.state))
    within, kept, end = node("Greater", graph.columns(MEMORY, [0]), constant(0, dtype)), graph.kept, 1
    begun = {
        "past": lambda: constant(np.tile(layer.rest, (1, layer.controls))),
        "rows": lambda: graph.joined(*[state] * layer.rows),
        "before": lambda: state,
        "rate": lambda: constant(np.zeros((1, n)), dtype),
    }
    for name, size in layer.parts.items():
        if size:
            kept[name] = node("Where", within, graph.columns(MEMORY, range(end, end + size)), begun[name]())
            end += size
    seen = [state, *(kept[name] for name in ("past", "rows") if name in kept)]
    if layer.rates:
        change = node("Sub", state, kept["before"])
        turn = np.where(np.isin(np.arange(n), layer.turning), 2 * np.pi, 0)  # whole ones are taken off angles
        turns = node("Round", node("Div", change, constant(2 * np.pi, dtype)))
        rate = node("Div", node("Sub", change, node("Mul", turns, constant(turn, dtype))), constant(layer.dt, dtype))
        if old := kept.get("rate"):
            rate = node("Add", old, node("Mul", constant(layer.weight, dtype), node("Sub", rate, old)))
        kept["rate"] = rate
        seen.append(rate)
    kept["before"] = state
    return graph.joined(*seen, *([graph.columns(x, layer.asked)] if layer.asked else []))


def _remembered(graph: Graph, layer: Recall, control: str, dtype: np.dtype) -> str:
    """Add what makes the next memory of the control, and of what was recalled."""
    parts, newest = graph.kept, {"past": control, "rows": graph.kept["before"]}
    for name in newest.keys() & parts.keys():
        parts[name] = graph.columns(graph.joined(newest[name], parts[name]), range(layer.parts[name]))
    within = graph.node("Max", graph.columns(MEMORY, [0]), graph.constant(1, dtype))
    return graph.joined(within, *(parts[name] for name, size in layer.parts.items() if size))


def _angle(graph: Graph, x: str, entries: tuple[int, ...], dtype: np.dtype) -> str:
    """An entry of the state, of one or two of the observation. ONNX has no arctangent of two arguments."""
    if len(entries) == 1:
        return graph.columns(x, entries)
    node, constant, types = graph.node, graph.constant, graph.onnx.TensorProto
    wave = _waves(graph, x, entries, dtype)
    cosine, sine = wave["cosine"], wave["sine"]
    limited = node("Min", node("Max", cosine, constant(-1, dtype)), constant(1, dtype))
    angle = node("Acos", node("Cast", limited, to=types.FLOAT))  # runtimes have it in single precision only
    angle = node("Cast", angle, to=graph.onnx.helper.np_dtype_to_tensor_dtype(dtype))
    angle = node("Where", node("Less", sine, constant(0, dtype)), node("Neg", angle), angle)
    for _ in range(2):  # it is 4e-4 off at most, near 0 and half a turn; of that each step leaves the third power
        off = node("Sub", node("Mul", sine, node("Cos", angle)), node("Mul", cosine, node("Sin", angle)))
        angle = node("Add", angle, off)
    return angle


def _sine(graph: Graph, v: str, dtype: np.dtype) -> str:
    """s (3 - s^2) / 2 of s = sin v."""
    s = graph.node("Sin", v)
    rest = graph.node("Sub", graph.constant(3, dtype), graph.node("Mul", s, s))
    return graph.node("Mul", graph.node("Mul", s, rest), graph.constant(0.5, dtype))


def _waves(graph: Graph, x: str, pair: tuple[int, ...], dtype: np.dtype) -> dict[str, str]:
    """Sine and cosine of an angle. ONNX has no arctangent of two arguments: a pair is brought to the unit circle."""
    node = graph.node
    cosine, *sine = (graph.columns(x, [entry]) for entry in pair)
    if not sine:
        return {"sine": node("Sin", cosine), "cosine": node("Cos", cosine)}
    # Divided by the larger of both first: no square is too large or too small.
    largest = node("Max", node("Abs", cosine), node("Abs", sine[0]))
    one, nothing = graph.constant(1, dtype), node("Equal", largest, graph.constant(0, dtype))  # 0, 0 is the angle 0
    divisor = node("Where", nothing, one, largest)
    cosine = node("Where", nothing, one, node("Div", cosine, divisor))
    sined = node("Div", sine[0], divisor)
    length = node("Sqrt", node("Add", node("Mul", cosine, cosine), node("Mul", sined, sined)))
    return {"sine": node("Div", sined, length), "cosine": node("Div", cosine, length)}


def run(path: Path, observations: np.ndarray, episode: int) -> np.ndarray:
    """What onnxruntime makes of the file at `path` for observations [N, O], of so many an episode: controls [N, U]."""
    runtime = imported("onnxruntime")
    session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    if len(session.get_inputs()) == 1:
        return session.run([OUTPUT], {INPUT: observations})[0]

    def act(x: np.ndarray, memory: np.ndarray) -> list[np.ndarray]:
        return [value[0] for value in session.run([OUTPUT, NEXT], {INPUT: x[None], MEMORY: memory[None]})]

    return driven(act, observations, session.get_inputs()[1].shape[1], episode)
