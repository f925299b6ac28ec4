"""Exporting a torch network as an ONNX program: the part of the forward pass that acting needs, without weights.

The weights are inputs of the program, named like the parameters; a runtime binds the weights of a snapshot. So the
program travels once, and every torch module that can be exported runs where torch is not installed. Sampling is part
of the program: the caller only draws random numbers.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from daedalus.policy.acting.runtime import (
    EPSILON,
    LOG_PROB,
    NEXT_STATE,
    NORMAL,
    STATE,
    UNIFORM,
    OnnxRuntime,
    PolicyError,
    action_name,
    mask_name,
    observation_name,
)
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_code import first_line
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces

_OPSET = 17
_ROWS = 2  # of the example that is traced


class _Acting(nn.Module):
    """A module whose `forward` is the network's `act`; shares the parameters and their names."""

    def __init__(self, network: ActorCritic, spaces: Spaces) -> None:
        super().__init__()
        self._network = [network]  # in a list, so that it is not registered and parameters keep their names
        self._actions = tuple(spaces.actions)
        for name, child in network.named_children():
            self.add_module(name, child)

    def forward(
        self,
        observations: dict[str, Tensor],
        state: Tensor,
        uniform: Tensor,
        normal: Tensor,
        masks: dict[str, Tensor],
        epsilon: Tensor,
    ) -> tuple[Tensor, ...]:
        actions, log_prob, next_state = self._network[0].act(observations, state, uniform, normal, masks, epsilon)
        outputs = (*(actions[name] for name in self._actions), log_prob)
        return (*outputs, next_state) if self._network[0].state_size else outputs


def export_program(network: ActorCritic, spaces: Spaces) -> bytes:
    """Return the ONNX program of a network.

    Inputs, each with N rows: `observations/NAME` [N, *stacked_shape]; `masks/NAME` [N, choices] bool of masked
    actions; `uniform` [N, U] and `normal` [N, G] float32 noise, where U or G is not 0; `epsilon` [N, 1] where actors
    explore; `state` [N, S] with a memory; and the weights. Outputs: `actions/NAME` [N, D], int64 or float32; `log_prob`
    [N]; `next_state` [N, S] with a memory. Raises NetworkError if code of the user cannot be exported.
    """
    try:
        program = _export(network, spaces)
        weights = {name: parameter.detach().cpu().numpy() for name, parameter in network.named_parameters()}
        OnnxRuntime(program).load(weights)
    except PolicyError as error:
        raise NetworkError(f"actors cannot run the program of the policy: {error}") from None
    except Exception as error:  # the exporter calls code of the user, which may raise anything
        raise NetworkError(f"the policy cannot be exported to ONNX: {first_line(error)}") from error
    return program


def _export(network: ActorCritic, spaces: Spaces) -> bytes:
    device = next(network.parameters()).device
    distribution = network.distribution
    observations = {
        name: torch.zeros((_ROWS, *space.stacked_shape), dtype=_dtype(space), device=device)
        for name, space in spaces.observations.items()
    }
    state = torch.zeros((_ROWS, network.state_size), device=device)
    uniform = torch.full((_ROWS, network.uniform_count), 0.5, device=device)
    normal = torch.zeros((_ROWS, distribution.normal_count), device=device)
    masks = {name: torch.ones((_ROWS, size), dtype=torch.bool, device=device) for name, size in spaces.masks.items()}
    inputs = [observation_name(name) for name in observations]
    inputs += [STATE, UNIFORM, NORMAL, *map(mask_name, masks), EPSILON]
    epsilon = torch.zeros((_ROWS, 1), device=device)
    outputs = [*map(action_name, spaces.actions), LOG_PROB, *([NEXT_STATE] if network.state_size else [])]
    program: Any = io.BytesIO()  # torch accepts a file, although its annotation does not
    with warnings.catch_warnings(), torch.no_grad(), _separate_operations():
        # The TorchScript exporter is deprecated, but takes 0.2 s; its successor takes several times as long.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Acting(network, spaces),
            (observations, state, uniform, normal, masks, epsilon),
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


def _dtype(space: ArraySpace | DiscreteSpace) -> torch.dtype:
    return torch.int64 if isinstance(space, DiscreteSpace) else getattr(torch, space.dtype)


@contextmanager
def _separate_operations() -> Iterator[None]:
    """Let torch compute attention in separate operations: without gradients it fuses them, which cannot be exported."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(before)
