"""Torch network -> ONNX program: the acting half of the forward pass, its weights left open.

Weights become inputs of the program, named like the parameters; a runtime binds those of a snapshot. So the
program travels once, and any torch module whose acting half can be exported runs where torch is not
installed.
"""

import io
import warnings
from typing import Any

import torch
from torch import Tensor, nn

from policy.network import ActorCritic
from policy.runtime import LOGITS, OBSERVATIONS
from protocol.spec import ArraySpace

_OPSET = 17


class _Acting(nn.Module):
    """The network, called by its acting half; shares parameters and their names."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self._network = [network]  # in a list, so that parameters keep their own names
        for name, child in network.named_children():
            self.add_module(name, child)

    def forward(self, observations: Tensor) -> Tensor:
        return self._network[0].act(observations)


def export_program(network: ActorCritic, observation: ArraySpace) -> bytes:
    """The program of a network: `observations` [N, *shape] and weights in, `logits` [N, actions] out."""
    example = torch.zeros((2, *observation.shape), dtype=getattr(torch, observation.dtype))
    program: Any = io.BytesIO()  # torch takes a file, whatever its annotation says
    with warnings.catch_warnings(), torch.no_grad():
        # The TorchScript exporter is deprecated, and a fifth of a second; its successor takes several times that.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Acting(network),
            (example,),
            program,
            dynamo=False,
            export_params=False,
            # Without this the exporter makes one input of parameters that hold the same numbers, as new biases do.
            keep_initializers_as_inputs=True,
            opset_version=_OPSET,
            input_names=[OBSERVATIONS],
            output_names=[LOGITS],
            dynamic_axes={OBSERVATIONS: {0: "rows"}, LOGITS: {0: "rows"}},
        )
    return program.getvalue()
