"""Torch network -> ONNX program: the acting half of the forward pass, its weights left open.

A program travels once, and any torch module whose acting half can be exported runs where torch is not installed.
How its weights are bound depends on what is faster (policy/runtime.py): those of a small network are inputs of the
program, named like the parameters; those of a convolutional one are constants, all zero, in whose place a runtime
writes a snapshot's. The program's metadata says where in its bytes each begins, and its shape.
"""

import io
import json
import math
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from policy.network import ActorCritic
from policy.runtime import LOGITS, NEXT_STATE, OBSERVATIONS, STATE, WEIGHTS
from protocol.spec import ArraySpace

_OPSET = 17


class _Acting(nn.Module):
    """The network, called by its acting half; shares parameters and their names."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self._network = [network]  # in a list, so that parameters keep their own names
        for name, child in network.named_children():
            self.add_module(name, child)

    def forward(self, observations: Tensor, state: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        network = self._network[0]
        if state is None:
            return network.act(observations, torch.zeros(0))[0]
        return network.act(observations, state)


def export_program(network: ActorCritic, space: ArraySpace) -> bytes:
    """The program of a network.

    In: `observations` [N, *stacked_shape], where it has a memory also `state` [N, S], and the weights where they are
    inputs. Out: `logits` [N, actions], where it has a memory also `next_state` [N, S].
    """
    device = next(network.parameters()).device
    inputs = {OBSERVATIONS: torch.zeros((2, *space.stacked_shape), dtype=getattr(torch, space.dtype), device=device)}
    outputs = [LOGITS]
    if network.state_size:
        inputs[STATE] = torch.zeros((2, network.state_size), device=device)
        outputs.append(NEXT_STATE)
    program: Any = io.BytesIO()  # torch takes a file, whatever its annotation says
    with warnings.catch_warnings(), torch.no_grad():
        # The TorchScript exporter is deprecated, and a fifth of a second; its successor takes several times that.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Acting(network),
            tuple(inputs.values()),
            program,
            dynamo=False,
            export_params=False,
            # Without this the exporter makes one input of parameters that hold the same numbers, as new biases do.
            keep_initializers_as_inputs=True,
            do_constant_folding=False,  # what is made of a weight would be folded, and the weight lost
            opset_version=_OPSET,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_axes={name: {0: "rows"} for name in (*inputs, *outputs)},
        )
    return _with_constant_weights(program.getvalue()) if network.convolutional else program.getvalue()


def _with_constant_weights(program: bytes) -> bytes:
    """The same program, its weights constants; zeros stand for them, which take no room on the wire."""
    import onnx  # at the learner only, and only for images

    model = onnx.load_from_string(program)
    entries = [entry for entry in model.graph.input if entry.name not in (OBSERVATIONS, STATE)]
    random = np.random.default_rng(0)
    marks: list[bytes] = []
    for entry in entries:
        shape = [side.dim_value for side in entry.type.tensor_type.shape.dim]
        marks.append(random.bytes(4 * math.prod(shape)))
        constant = onnx.TensorProto(name=entry.name, data_type=onnx.TensorProto.FLOAT, dims=shape, raw_data=marks[-1])
        model.graph.initializer.append(constant)
        model.graph.input.remove(entry)
    data = bytearray(model.SerializeToString(deterministic=True))
    places: dict[str, tuple[int, list[int]]] = {}
    start = 0
    for constant, mark in zip(model.graph.initializer, marks, strict=True):
        start = data.index(mark, start)  # they were written in this order
        places[constant.name] = start, list(constant.dims)
        data[start : start + len(mark)] = bytes(len(mark))
        start += len(mark)
    # Messages of this format are joined by writing one behind the other.
    listed = onnx.StringStringEntryProto(key=WEIGHTS, value=json.dumps(places))
    return bytes(data) + onnx.ModelProto(metadata_props=[listed]).SerializeToString()
