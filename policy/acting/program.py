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

from daedalus.policy.acting.runtime import LOGITS, NEXT_STATE, OBSERVATIONS, STATE, OnnxRuntime, PolicyError
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.custom_encoder import CustomEncoder
from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import ArraySpace

_OPSET = 17


class _Acting(nn.Module):
    """The network, called by its acting half; shares parameters and their names."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self._network = [network]  # in a list, so that parameters keep their own names
        for name, child in network.named_children():
            self.add_module(name, child)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        logits, next_state = self._network[0].act(observations, state)
        return (logits, next_state) if self._network[0].state_size else logits


def export_program(network: ActorCritic, observation: ArraySpace) -> bytes:
    """The program of a network.

    `observations` [N, *stacked_shape] and weights in, `logits` [N, A] out; with a memory also `state` [N, S] in and
    `next_state` [N, S] out. Raises NetworkError if a user's encoder cannot be exported.
    """
    if not isinstance(network.encoder, CustomEncoder):
        return _export(network, observation)
    try:
        program = _export(network, observation)
        weights = {name: parameter.detach().cpu().numpy() for name, parameter in network.named_parameters()}
        OnnxRuntime(program).load(weights)
    except PolicyError as error:
        raise NetworkError(f"the program made of the encoder is of no use to actors: {error}") from None
    except Exception as error:  # the exporter calls the user's code, and raises whatever that does
        first_line = next(iter(str(error).strip().splitlines()), "")
        raise NetworkError(f"the encoder cannot be exported to ONNX: {type(error).__name__}: {first_line}") from error
    return program


def _export(network: ActorCritic, observation: ArraySpace) -> bytes:
    device = next(network.parameters()).device
    observations = torch.zeros((2, *observation.stacked_shape), dtype=getattr(torch, observation.dtype), device=device)
    state = torch.zeros((2, network.state_size), device=device)
    inputs, outputs = (
        ([OBSERVATIONS, STATE], [LOGITS, NEXT_STATE]) if network.state_size else ([OBSERVATIONS], [LOGITS])
    )
    program: Any = io.BytesIO()  # torch takes a file, whatever its annotation says
    with warnings.catch_warnings(), torch.no_grad():
        # The TorchScript exporter is deprecated, and a fifth of a second; its successor takes several times that.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Acting(network),
            (observations, state),
            program,
            dynamo=False,
            export_params=False,
            # Without this the exporter makes one input of parameters that hold the same numbers, as new biases do.
            keep_initializers_as_inputs=True,
            # It would make weights of its own of what is computed from weights alone.
            do_constant_folding=False,
            opset_version=_OPSET,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "rows"} for name in inputs + outputs},
        )
    return program.getvalue()
