"""A controller as an ONNX graph, of a batch of observations [batch, O] to controls [batch, U]."""

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
    forgetful,
    layers_of,
)
from pegasus_jax.exports.learned import Learned

OPSET, IR = 17, 8  # of 2022: runtimes of today and of some years ago read them
INPUT, OUTPUT = "observation", "control"


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

    def constant(self, values: Any, dtype: Any = None) -> str:
        self.constants.append(self.onnx.numpy_helper.from_array(np.array(values, dtype), f"c{len(self.constants)}"))
        return self.constants[-1].name

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        name = f"v{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, inputs, [name], **attributes))
        return name


def write(learned: Learned, name: str) -> bytes:
    """The model, checked. Raises ConfigError for a policy that is no list of layers, or without the package."""
    forgetful(learned, "onnx")
    graph = Graph()
    helper, real = graph.onnx.helper, graph.onnx.helper.np_dtype_to_tensor_dtype(learned.dtype)
    value = INPUT
    for layer in layers_of(learned, "onnx"):
        value = _added(graph, layer, value, learned.dtype)
    graph.nodes.append(helper.make_node("Identity", [value], [OUTPUT]))
    sizes = {INPUT: len(learned.observation), OUTPUT: len(learned.task.control_names)}
    ends = [helper.make_tensor_value_info(end, real, ["batch", size]) for end, size in sizes.items()]
    made = helper.make_graph(graph.nodes, name, ends[:1], ends[1:], graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(made, opset_imports=opset, ir_version=IR, producer_name="pegasus_jax")
    model.doc_string = learned.title
    graph.onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _added(graph: Graph, layer: Layer, v: str, dtype: np.dtype) -> str:
    """Add the nodes of a layer, v to the value that is returned."""
    node, constant = graph.node, graph.constant
    match layer:
        case Recall() | Limit():
            raise AssertionError("a graph remembers nothing")
        case Features(plain, angles):
            waves = [_waves(graph, v, pair, dtype) for pair in angles]
            parts = [node("Gather", v, constant(plain, np.int64), axis=1)] if plain else []
            parts += [wave[which] for which in ("sine", "cosine") for wave in waves]
            return node("Concat", *parts, axis=1)
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


def _sine(graph: Graph, v: str, dtype: np.dtype) -> str:
    """s (3 - s^2) / 2 of s = sin v."""
    s = graph.node("Sin", v)
    rest = graph.node("Sub", graph.constant(3, dtype), graph.node("Mul", s, s))
    return graph.node("Mul", graph.node("Mul", s, rest), graph.constant(0.5, dtype))


def _waves(graph: Graph, x: str, pair: tuple[int, ...], dtype: np.dtype) -> dict[str, str]:
    """Sine and cosine of an angle. ONNX has no arctangent of two arguments: a pair is brought to the unit circle."""
    node = graph.node
    cosine, *sine = (node("Gather", x, graph.constant([entry], np.int64), axis=1) for entry in pair)
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


def run(path: Path, observations: np.ndarray) -> np.ndarray:
    """What onnxruntime makes of the file at `path` for observations [N, O]: controls [N, U]."""
    runtime = imported("onnxruntime")
    session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    return session.run([OUTPUT], {INPUT: observations})[0]
