"""The ONNX file of a policy, for use without this package: a program with its weights, and what surrounds it.

The program (policy/acting/program.py) is taken as it is. Around it, the environment's side
(actor/environments/transforms.py) adds nodes for its transforms. Needs the `onnx` package; imports no torch.
"""

import tempfile
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import onnxruntime

from daedalus.policy.acting.noise import Noise, NoiseSize
from daedalus.policy.acting.runtime import EPSILON, NEXT_STATE, NORMAL, STATE, UNIFORM
from daedalus.policy.user_code import message_line

if TYPE_CHECKING:
    import onnx

# onnxruntime reads these since 1.14, and the program has no operators of a later set.
_IR_VERSION, _OPSET = 8, 17
MEMORY, FRAMES, STARTED, NOISE = "memory", "frames/", "started", "noise/uniform"
_OURS = "export/"
_IN_FULL = (_OURS, "/normalizer")  # nodes that keep float32: of the environment's transforms, and of large means
_LARGEST_UNIFORM = 1.0 - 2.0**-24  # a random number below 1 may be 1 in float32
_SMALLEST_UNIFORM = 2.0**-24
Quantization = Literal["float16", "int8"]


class ExportError(Exception):
    """A policy that cannot be exported as asked."""


class _State(NamedTuple):
    """What the caller keeps from one step to the next."""

    shape: tuple[int, ...]
    dtype: type
    following: str  # value in the graph


class OnnxGraph:
    """An ONNX graph under construction. Its values are known by their names; each has a first axis of rows."""

    def __init__(self, rows: int | None) -> None:
        """Begin an empty graph. `rows`: observations of each call; None: any number."""
        try:
            import onnx
        except ImportError as error:
            raise ExportError(
                f'the export needs a package that is not installed ({error}): pip install "daedalus-rl[export]"'
            ) from None
        self._onnx, self._rows = onnx, rows
        self._nodes: list[Any] = []
        self._initializers: list[Any] = []
        self._inputs: dict[str, Any] = {}
        self._outputs: dict[str, tuple[str, Any]] = {}
        self.states: dict[str, _State] = {}

    def input(self, name: str, dtype: type, shape: tuple[int, ...]) -> str:
        """Add an input [rows, *shape], and return its value."""
        self._inputs[name] = self._declared(name, dtype, shape)
        return name

    def output(self, name: str, value: str, dtype: type, shape: tuple[int, ...]) -> None:
        """Make a value [rows, *shape] an output. If an input has its name, it is called actions/NAME."""
        name = f"actions/{name}" if name in self._inputs else name
        self._outputs[name] = self.add("Identity", self.reshaped(value, shape)), self._declared(name, dtype, shape)

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node, and return its value."""
        value = f"{_OURS}{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, list(inputs), [value], name=value, **attributes))
        return value

    def constant(self, values: Any, dtype: type = np.float32) -> str:
        """Return the value of a constant."""
        name = f"{_OURS}constant_{len(self._initializers)}"
        self._initializers.append(self._onnx.numpy_helper.from_array(np.asarray(values, dtype), name))
        return name

    def cast(self, value: str, dtype: type) -> str:
        """Convert a value to another dtype."""
        return self.add("Cast", value, to=self._onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def reshaped(self, value: str, shape: tuple[int, ...]) -> str:
        """Reshape a value to [rows, *shape]."""
        return self.add("Reshape", value, self.constant([self._rows or -1, *shape], np.int64))

    def sliced(self, value: str, axis: int, start: int, end: int) -> str:
        """Return a part of a value."""
        places = (self.constant([place], np.int64) for place in (start, end, axis))
        return self.add("Slice", value, *places)

    def stacked(self, name: str, frame: str, shape: tuple[int, ...], dtype: type, depth: int) -> str:
        """Stack the newest frames as protocol/frames.py does: [rows, *shape] -> [rows, depth, *shape].

        The frames before are a state. While the state `started` is 0, the first frame stands in their place.
        """
        frame = self.add("Unsqueeze", frame, self.constant([1], np.int64))
        before = self._state(FRAMES + name, (depth - 1, *shape), dtype)
        if STARTED not in self.states:
            started = self._state(STARTED, (1,), np.float32)
            self._keep(STARTED, self.add("Max", started, self.constant([1.0])))
        started = self.cast(self.reshaped(f"state/{STARTED}", (1,) * (len(shape) + 1)), np.bool_)
        stack = self.add("Concat", self.add("Where", started, before, frame), frame, axis=1)
        self._keep(FRAMES + name, self.sliced(stack, 1, 1, depth))
        return stack

    def _state(self, name: str, shape: tuple[int, ...], dtype: type) -> str:
        self.states[name] = _State(shape, dtype, "")
        return self.input(f"state/{name}", dtype, shape)

    def _keep(self, name: str, value: str) -> None:
        self.states[name] = self.states[name]._replace(following=value)

    def include(
        self,
        program: bytes,
        weights: Mapping[str, np.ndarray],
        inputs: Mapping[str, str],
        size: NoiseSize,
        *,
        sampled: bool,
    ) -> dict[str, str]:
        """Add a program with its weights.

        Args:
          program: an exported program, which has been checked.
          weights: its weights.
          inputs: values of its observations and masks, by their names in the program.
          size: of its noise.
          sampled: whether the noise is an input; else it is that of greedy actions.

        Returns: values of the program's outputs, by their names.
        """
        graph = self._onnx.load_model_from_string(program).graph
        declared = {entry.name: entry.type.tensor_type.shape for entry in graph.input}
        values = {name: value for name, value in inputs.items() if name in declared}
        values |= self._noise(next(iter(inputs.values())), size, sampled=sampled)
        if EPSILON in declared:
            values[EPSILON] = self._for_each_row(next(iter(inputs.values())), np.zeros(1))
        if STATE in declared:
            values[STATE] = self._state(MEMORY, (declared[STATE].dim[1].dim_value,), np.float32)
        for name in declared.keys() - values.keys():
            values[name] = self.constant(weights[name])
        for constant in graph.initializer:
            values[constant.name] = f"policy/{constant.name}"
            constant.name = values[constant.name]
            self._initializers.append(constant)
        for node in graph.node:
            node.input[:] = [values.get(name, name) for name in node.input]  # an optional input has an empty name
            values |= {name: f"policy/{name}" for name in node.output if name}
            node.output[:] = [values.get(name, name) for name in node.output]
            self._nodes.append(node)
        if NEXT_STATE in values:
            self._keep(MEMORY, values[NEXT_STATE])
        return {entry.name: values[entry.name] for entry in graph.output}

    def _noise(self, like: str, size: NoiseSize, *, sampled: bool) -> dict[str, str]:
        """Return the noise of a program; `like` is a value with as many rows."""
        if not sampled:
            neutral = {UNIFORM: np.full(size.uniform, 0.5), NORMAL: np.zeros(size.normal)}
            return {name: self._for_each_row(like, values) for name, values in neutral.items() if len(values)}
        given = self.input(NOISE, np.float32, (uniform_count(size),))
        given = self.add("Clip", given, self.constant(_SMALLEST_UNIFORM), self.constant(_LARGEST_UNIFORM))
        first, last = size.uniform + size.normal, uniform_count(size)
        logarithm = self.add("Log", self.sliced(given, 1, size.uniform, first))
        radius = self.add("Sqrt", self.add("Mul", logarithm, self.constant(-2.0)))
        angle = self.add("Mul", self.sliced(given, 1, first, last), self.constant(2.0 * np.pi))
        values = {UNIFORM: self.sliced(given, 1, 0, size.uniform)} if size.uniform else {}
        return values | ({NORMAL: self.add("Mul", radius, self.add("Cos", angle))} if size.normal else {})

    def _for_each_row(self, like: str, values: np.ndarray) -> str:
        """Return constant values [rows, len(values)]; `like` is a value with as many rows."""
        if self._rows is not None:
            return self.constant(np.tile(values, (self._rows, 1)))
        rows = self.sliced(self.add("Shape", like), 0, 0, 1)
        shape = self.add("Concat", rows, self.constant([len(values)], np.int64), axis=0)
        return self.add("Expand", self.constant(values), shape)

    @property
    def output_names(self) -> dict[str, str]:
        """The names of the outputs by the names that were asked for."""
        return {name.removeprefix("actions/"): name for name in self._outputs if not name.startswith("next_state/")}

    def model(self, version: str) -> "onnx.ModelProto":
        """Return the model. Constants are computed, and what no output needs is left out."""
        helper = self._onnx.helper
        for name, state in self.states.items():
            self.output(f"next_state/{name}", state.following, state.dtype, state.shape)
        ends = [helper.make_node("Identity", [value], [name]) for name, (value, _) in self._outputs.items()]
        graph = helper.make_graph(
            _needed([*self._nodes, *ends], self._outputs),
            "policy",
            list(self._inputs.values()),
            [declared for _, declared in self._outputs.values()],
            self._initializers,
        )
        opsets = [helper.make_opsetid("", _OPSET)]
        model = _folded(helper.make_model(graph, opset_imports=opsets, ir_version=_IR_VERSION).SerializeToString())
        model.producer_name, model.producer_version = "daedalus", version
        return model

    def _declared(self, name: str, dtype: type, shape: tuple[int, ...]) -> Any:
        kind = self._onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        return self._onnx.helper.make_tensor_value_info(name, kind, [self._rows or "rows", *shape])


def uniform_count(size: NoiseSize) -> int:
    """Return how many uniform random numbers the file takes: a normal one is made from two (Box and Muller 1958)."""
    return size.uniform + 2 * size.normal


def noise_of(uniform: np.ndarray, size: NoiseSize) -> Noise:
    """Return the noise that the file makes from uniform random numbers [rows, K]."""
    given = np.clip(uniform, _SMALLEST_UNIFORM, _LARGEST_UNIFORM).astype(np.float32)
    own, radius, angle = np.split(given, [size.uniform, size.uniform + size.normal], axis=1)
    normal = np.sqrt(np.float32(-2.0) * np.log(radius)) * np.cos(angle * np.float32(2.0 * np.pi))
    return Noise(uniform=own, normal=normal)


def _needed(nodes: list[Any], outputs: Iterable[str]) -> list[Any]:
    """Return the nodes that the outputs depend on, such as not those of the log-probability."""
    wanted, kept = set(outputs), []
    for node in reversed(nodes):
        if wanted & set(node.output):
            wanted |= set(node.input)
            kept.append(node)
    return kept[::-1]


def _folded(model: bytes) -> "onnx.ModelProto":
    """Return the model with everything computed that does not depend on inputs, by onnxruntime's basic rules."""
    import onnx

    with tempfile.TemporaryDirectory(prefix="daedalus-export-") as folder:
        path = Path(folder) / "model.onnx"
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(path)
        options.log_severity_level = 4
        onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        folded = onnx.load(path)
    folded.ir_version = _IR_VERSION
    del folded.opset_import[1:]  # onnxruntime lists its own sets, too, whether they are used or not
    return folded


def quantized(model: "onnx.ModelProto", quantization: Quantization | None, metadata: Mapping[str, str]) -> bytes:
    """Return an ONNX file with smaller numbers, or as it is, and with metadata. Inputs and outputs stay as they are.

    Raises ExportError for an operator that cannot be converted.
    """
    import onnx

    if quantization is not None:
        try:
            model = _in_float16(model) if quantization == "float16" else _in_int8(model)
        except Exception as error:  # of onnxruntime's tools, which share no base
            raise ExportError(f"the policy cannot be converted to {quantization}: {message_line(error)}") from None
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _in_float16(model: "onnx.ModelProto") -> "onnx.ModelProto":
    from onnxruntime.quantization.onnx_model import ONNXModel
    from onnxruntime.transformers.float16 import convert_float_to_float16

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # each number that is rounded to the next that float16 has
        converted = ONNXModel(convert_float_to_float16(model, keep_io_types=True, node_block_list=_in_full(model)))
    graph = converted.model.graph
    # A value that several nodes take in float32 is cast for each, under one name.
    nodes = list({tuple(node.output): node for node in graph.node}.values())
    _skip_rounding(nodes)
    _replace(graph.node, nodes)
    converted.topological_sort()
    _replace(graph.node, _needed(list(graph.node), [output.name for output in graph.output]))
    return converted.model


def _replace(nodes: Any, others: list[Any]) -> None:
    del nodes[:]
    nodes.extend(others)


def _skip_rounding(nodes: list[Any]) -> None:
    """Let values go from one node to another in float32, where both keep it: the converter rounds them in between."""
    exact = {
        node.output[0]: node.input[0]
        for node in nodes
        if node.name.startswith("graph_input_cast") or node.name.endswith("_cast_to_fp16_node")
    }
    for node in nodes:
        if node.name.startswith("graph_output_cast") or node.name.endswith("_cast_to_fp32_node"):
            node.input[0] = exact.get(node.input[0], node.input[0])


def _in_int8(model: "onnx.ModelProto") -> "onnx.ModelProto":
    """Return the model with weights of 8 bits; layers quantize their inputs for each call."""
    import onnx
    from onnxruntime.quantization import QuantType, quantize_dynamic

    onnx.helper.set_model_props(model, {"onnx.quant.pre_process": "onnxruntime.quant"})  # done; else it warns
    with tempfile.TemporaryDirectory(prefix="daedalus-export-") as folder:
        path = Path(folder) / "model.onnx"
        quantize_dynamic(
            model,
            path,
            weight_type=QuantType.QUInt8,
            op_types_to_quantize=["MatMul", "Gemm", "Conv"],
            nodes_to_exclude=_in_full(model),
        )
        return onnx.load(path)


def _in_full(model: "onnx.ModelProto") -> list[str]:
    """Return the nodes that keep their numbers."""
    return [node.name for node in model.graph.node if node.name.startswith(_IN_FULL)]
