"""Turning the weight inputs of a program into constants, without the `onnx` package, which an actor does not have.

A program declares its weights as inputs. If they are constants, onnxruntime arranges convolution kernels for the
processor when it loads the program: convolutions are then nearly twice as fast, at a cost of milliseconds for each
snapshot. onnxruntime's `add_initializer` does not help: it arranges the values in the model, not the added ones.
"""

import numpy as np

# Field numbers of ONNX's messages (onnx.proto). A field of bytes is its tag, the number of bytes and the bytes.
_MODEL_IR_VERSION, _MODEL_GRAPH, _GRAPH_INITIALIZER = 1, 7, 5
_TENSOR_DIMS, _TENSOR_DATA_TYPE, _TENSOR_NAME, _TENSOR_RAW_DATA = 1, 2, 8, 9
_FLOAT = 1
_VARINT, _BYTES = 0, 2  # protobuf's wire types
# Before IR version 4 an initializer with the name of an input is that input's value; from 4 on only its default.
_IR_VERSION = 3


def with_initializers(model: bytes, weights: dict[str, np.ndarray]) -> bytes:
    """Return the program with constants for some of its inputs.

    Concatenating two serialized protobuf messages merges them: repeated fields are joined, other fields overwritten.

    Args:
      model: a serialized ONNX model.
      weights: float32 arrays of the inputs' shapes, by the inputs' names.
    """
    tensors = [_chunk(_GRAPH_INITIALIZER, _tensor(name, array)) for name, array in weights.items()]
    graph = [part for tensor in tensors for part in tensor]
    return b"".join([model, *_number(_MODEL_IR_VERSION, _IR_VERSION), *_chunk(_MODEL_GRAPH, graph)])


def _tensor(name: str, array: np.ndarray) -> list[bytes]:
    dimensions = [part for side in array.shape for part in _number(_TENSOR_DIMS, side)]
    data = array.astype("<f4", copy=False).tobytes()
    return [
        *dimensions,
        *_number(_TENSOR_DATA_TYPE, _FLOAT),
        *_chunk(_TENSOR_NAME, [name.encode()]),
        *_chunk(_TENSOR_RAW_DATA, [data]),
    ]


def _chunk(field: int, parts: list[bytes]) -> list[bytes]:
    """Encode a field of bytes or of a message, in parts, so that weights are copied only once."""
    return [_varint(field << 3 | _BYTES), _varint(sum(map(len, parts))), *parts]


def _number(field: int, value: int) -> list[bytes]:
    return [_varint(field << 3 | _VARINT), _varint(value)]


def _varint(value: int) -> bytes:
    """Encode an integer with seven bits a byte, lowest first; the top bit marks that more bytes follow."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
