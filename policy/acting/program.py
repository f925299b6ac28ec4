"""Exporting a torch network as an ONNX program: the part of the forward pass that acting needs, without weights.

The weights are inputs of the program, named like the parameters; a runtime binds the weights of a snapshot. So the
program travels once, and every torch module that can be exported runs where torch is not installed.
"""

import io
import warnings
from typing import Any

import torch
from torch import Tensor, nn

from daedalus.policy.acting.runtime import NEXT_STATE, OBSERVATIONS, STATE, OnnxRuntime, PolicyError
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.custom_encoder import CustomEncoder
from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import ArraySpace

_OPSET = 17


class _Acting(nn.Module):
    """A module whose `forward` is the network's `act`; shares the parameters and their names."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self._network = [network]  # in a list, so that it is not registered and parameters keep their names
        for name, child in network.named_children():
            self.add_module(name, child)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        parameters, next_state = self._network[0].act(observations, state)
        return (parameters, next_state) if self._network[0].state_size else parameters


def export_program(network: ActorCritic, observation: ArraySpace) -> bytes:
    """Return the ONNX program of a network.

    Its inputs are `observations` [N, *stacked_shape] and the weights; its output holds the parameters of the action
    distributions [N, P] (`logits` [N, A] for a discrete space). A network with a memory adds the input `state` [N, S]
    and the output `next_state` [N, S]. Raises NetworkError if a user's encoder cannot be exported.
    """
    if not isinstance(network.encoder, CustomEncoder):
        return _export(network, observation)
    try:
        program = _export(network, observation)
        weights = {name: parameter.detach().cpu().numpy() for name, parameter in network.named_parameters()}
        OnnxRuntime(program).load(weights)
    except PolicyError as error:
        raise NetworkError(f"actors cannot run the program of the encoder: {error}") from None
    except Exception as error:  # the exporter calls the user's code, which may raise anything
        first_line = next(iter(str(error).strip().splitlines()), "")
        raise NetworkError(f"the encoder cannot be exported to ONNX: {type(error).__name__}: {first_line}") from error
    return program


def _export(network: ActorCritic, observation: ArraySpace) -> bytes:
    device = next(network.parameters()).device
    observations = torch.zeros((2, *observation.stacked_shape), dtype=getattr(torch, observation.dtype), device=device)
    state = torch.zeros((2, network.state_size), device=device)
    parameters = network.distribution.program_output
    inputs, outputs = [OBSERVATIONS], [parameters]
    if network.state_size:
        inputs, outputs = [OBSERVATIONS, STATE], [parameters, NEXT_STATE]
    program: Any = io.BytesIO()  # torch accepts a file, although its annotation does not
    with warnings.catch_warnings(), torch.no_grad():
        # The TorchScript exporter is deprecated, but takes 0.2 s; its successor takes several times as long.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Acting(network),
            (observations, state),
            program,
            dynamo=False,
            export_params=False,
            # Otherwise the exporter merges parameters with equal values, such as new biases, into one input.
            keep_initializers_as_inputs=True,
            # Folding would turn values computed from weights alone into constants.
            do_constant_folding=False,
            opset_version=_OPSET,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "rows"} for name in inputs + outputs},
        )
    return program.getvalue()
