"""Checks of a received program before onnxruntime reads it. Pure functions, without the `onnx` package.

A program is an ONNX model, a protobuf message. A network needs arithmetic, not control flow: without loops, every node
of a program runs at most once for each call.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple


class PolicyError(Exception):
    """A program or weights that do not fit together or do not fit the spaces: a fault of the sender."""


MAX_PROGRAM_BYTES = 16 << 20  # the weights are not part of a program
MAX_NODES = 4096

# What torch exports for the layers of networks. All others are refused: control flow (If, Loop, Scan), sequences,
# strings, random numbers, and operators whose time is not in proportion to their inputs and outputs.
_OPERATORS = """
Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh AveragePool BatchNormalization Cast CastLike Ceil Celu
Clip Concat Constant ConstantOfShape Conv ConvTranspose Cos Cosh CumSum DepthToSpace Div Einsum Elu Equal Erf Exp
Expand Flatten Floor GRU Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater
GreaterOrEqual GroupNormalization HardSigmoid HardSwish Identity InstanceNormalization IsInf IsNaN LRN LSTM
LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax LpNormalization LpPool MatMul Max MaxPool Mean Min Mish
Mod Mul Neg Not OneHot Or PRelu Pad Pow RMSNormalization RNN Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum
ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize Round
ScatterElements ScatterND Selu Shape Sigmoid Sign Sin Sinh Size Slice Softmax Softplus Softsign SpaceToDepth Split
Sqrt Squeeze Sub Sum Swish Tan Tanh ThresholdedRelu Tile TopK Transpose Trilu Unsqueeze Where Xor
"""
# onnxruntime computes what depends on constants alone when it loads a program, without a limit on the memory that these
# operators take for themselves.
_HEAVY_OPERATORS = "AveragePool Conv ConvTranspose Einsum GRU LRN LSTM LpPool MaxPool RNN Resize"
_ALLOWED, _HEAVY = frozenset(_OPERATORS.split()), frozenset(_HEAVY_OPERATORS.split())
_SHAPE_OPERATORS = ("Shape", "Size")  # whose results may be constants although their inputs are not
_DOMAINS = ("", "ai.onnx")  # two names of ONNX's own operators

# Field numbers of ONNX's messages (onnx.proto).
_MODEL_GRAPH, _MODEL_TRAINING, _MODEL_FUNCTIONS = 7, 20, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_SPARSE_INITIALIZER = 1, 5, 15
_TENSOR_NAME = 8
_NODE_INPUT, _NODE_OUTPUT, _NODE_OPERATOR, _NODE_ATTRIBUTE, _NODE_DOMAIN = 1, 2, 4, 5, 7
_ATTRIBUTE_REFUSED = (6, 11, 22, 23)  # graphs and sparse tensors
_VARINT, _FIXED_64, _BYTES, _FIXED_32 = 0, 1, 2, 5  # protobuf's wire types
_VARINT_BYTES = 10


def check_program(model: bytes, is_input: Callable[[str], bool]) -> None:
    """Raise PolicyError if a program is too large, malformed, or contains an operator that is not allowed.

    Args:
      model: a serialized ONNX model.
      is_input: whether the input of a name changes from call to call; all others may become constants.
    """
    if len(model) > MAX_PROGRAM_BYTES:
        raise PolicyError(f"the program has {len(model):,} bytes, the limit is {MAX_PROGRAM_BYTES:,}")
    nodes, changing = 0, set[str]()
    for graph in _contents(memoryview(model), _MODEL_GRAPH, refused=(_MODEL_TRAINING, _MODEL_FUNCTIONS)):
        for tensor in _contents(graph, _GRAPH_INITIALIZER):
            if any(is_input(_text(name)) for name in _contents(tensor, _TENSOR_NAME)):
                raise PolicyError("the program has constants in place of its inputs")
        for content in _contents(graph, _GRAPH_NODE, refused=(_GRAPH_SPARSE_INITIALIZER,)):
            node = _read_node(content)
            changes = any(name in changing or is_input(name) for name in node.inputs)
            if changes and node.operator not in _SHAPE_OPERATORS:
                changing.update(node.outputs)
            elif node.operator in _HEAVY:
                raise PolicyError(f"the program computes {node.operator} from constants alone, which is not allowed")
            nodes += 1
    if nodes > MAX_NODES:
        remedy = "declare one MultiDiscrete or Box in place of many components, or take a network of fewer layers"
        raise PolicyError(f"the program has {nodes} nodes, the limit is {MAX_NODES}: {remedy}")


class _Node(NamedTuple):
    operator: str
    inputs: list[str]
    outputs: list[str]


def _read_node(content: memoryview) -> _Node:
    """Return a node of a graph. Raises PolicyError if it is not allowed."""
    node = _Node("", [], [])
    for field, value in _fields(content):
        if field == _NODE_INPUT:
            node.inputs.append(_text(value))
        elif field == _NODE_OUTPUT:
            node.outputs.append(_text(value))
        elif field == _NODE_OPERATOR:
            node = node._replace(operator=_text(value))
            if node.operator not in _ALLOWED:
                raise PolicyError(f"the program uses the operator {node.operator[:64]!r}, which is not allowed")
        elif field == _NODE_DOMAIN and (domain := _text(value)) not in _DOMAINS:
            raise PolicyError(f"the program uses operators of {domain[:64]!r}: only those of ONNX itself are allowed")
        elif field == _NODE_ATTRIBUTE:
            list(_contents(value, None, refused=_ATTRIBUTE_REFUSED))
    return node


def _contents(message: memoryview, wanted: int | None, refused: tuple[int, ...] = ()) -> Iterator[memoryview]:
    """Yield the contents of a field. Raises PolicyError if the message has one of the `refused` fields."""
    for field, content in _fields(message):
        if field in refused:
            raise PolicyError("the program contains functions, nested graphs or sparse tensors, which are not allowed")
        if field == wanted:
            yield content


def _text(content: memoryview) -> str:
    return bytes(content).decode("utf-8", "replace")


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield number and content of each field of bytes of a protobuf message, also of repeated ones.

    Raises PolicyError for what protobuf's own parsers would not accept or could read in another way.
    """
    position = 0
    while position < len(message):
        tag, position = _varint(message, position)
        field, wire_type = tag >> 3, tag & 7
        size = 0
        if wire_type == _VARINT:
            _, position = _varint(message, position)
        elif wire_type == _BYTES:
            size, position = _varint(message, position)
        elif wire_type in (_FIXED_32, _FIXED_64):
            size = 4 if wire_type == _FIXED_32 else 8
        else:
            raise PolicyError(f"the program is not an ONNX model: wire type {wire_type}")
        if tag > 0xFFFFFFFF or size > len(message) - position:
            raise PolicyError("the program is not an ONNX model: a field is longer than its message")
        if wire_type == _BYTES:
            yield field, message[position : position + size]
        position += size


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """Return the integer at a position and the position after it."""
    value = 0
    for index, byte in enumerate(message[position : position + _VARINT_BYTES]):
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, position + index + 1
    raise PolicyError("the program is not an ONNX model: an integer does not end")
