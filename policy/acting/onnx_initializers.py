"""Weights made constants of a program, without the `onnx` package, which an actor does not have.

A program declares its weights as inputs. onnxruntime lays constant kernels out for the processor before it runs, which
makes convolutions nearly twice as fast, and takes milliseconds for each snapshot. Its own `add_initializer` will not
do: the layout is then that of the numbers that stand in the model, and not of those that were added.
"""

import numpy as np

# Field numbers of ONNX's messages (onnx.proto); bytes that follow a field's tag are preceded by their number.
_MODEL_IR_VERSION, _MODEL_GRAPH, _GRAPH_INITIALIZER = 1, 7, 5
_TENSOR_DIMS, _TENSOR_DATA_TYPE, _TENSOR_NAME, _TENSOR_RAW_DATA = 1, 2, 8, 9
_FLOAT = 1
_VARINT, _BYTES = 0, 2  # protobuf's wire types
# In models before version 4 an initializer of an input's name is that input's value; from 4 on merely its default.
_IR_VERSION = 3


def with_initializers(model: bytes, weights: dict[str, np.ndarray]) -> bytes:
    """The program with these of its inputs set for good: float32 arrays of the inputs' shapes.

    Two serialized protobuf messages in a row are their merger: repeated fields add up, of others the last one counts.
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
    """A field of bytes, or of a message; in parts, so that weights are copied once."""
    return [_varint(field << 3 | _BYTES), _varint(sum(map(len, parts))), *parts]


def _number(field: int, value: int) -> list[bytes]:
    return [_varint(field << 3 | _VARINT), _varint(value)]


def _varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first; the top bit says that more follow."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
