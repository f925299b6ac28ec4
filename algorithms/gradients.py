"""Gradients of the updates of a batch, at the current parameters of the network. The caller applies them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Losses, MinibatchLosses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.forward import FlatParameters, Forward
from daedalus.algorithms.losses import mean, value_loss
from daedalus.algorithms.own_algorithm import build_algorithm, check_updates
from daedalus.algorithms.recording import OperationRecorder
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.algorithms import is_own
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import LossSpec


def is_mixed(precision: Literal["auto", "float32", "bfloat16"], device: torch.device, convolutional: bool) -> bool:
    """Return whether forward passes compute in bfloat16: if it is requested or known to be faster.

    "auto" means bfloat16 for a convolutional network on a device that multiplies bfloat16 in hardware.
    """
    return precision == "bfloat16" or (precision == "auto" and convolutional and _multiplies_bfloat16(device))


def _multiplies_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    try:
        flags = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags


_MOST_ROWS = 32  # of a recorded sequence: a memory takes long to record, 5 ms for each row, and gains little


class Terms(NamedTuple):
    """Loss terms and statistics of one update: scalars without gradients."""

    policy_loss: Tensor
    value_loss: Tensor
    entropy: Tensor
    clipped_fraction: Tensor


class Then(Protocol):
    """What follows each gradient of a batch, as operations on tensors that read no value."""

    changed: Sequence[Tensor]  # what `clip` changes in place, besides the gradient

    def clip(self, terms: Terms) -> None:
        """Clip the gradient. It may be recorded with the computation of the gradient."""
        ...

    def apply(self) -> None:
        """Apply the gradient. TorchScript would leave out the kernel of an optimiser, which has no result."""
        ...


class GradientComputer:
    """Gradient computation of one algorithm for one network."""

    def __init__(self, spec: LossSpec, network: ActorCritic, spaces: Spaces, modules: UserModules = NO_MODULES) -> None:
        """Raise AlgorithmError if the user's own algorithm cannot be used; `modules` may be imported for it."""
        self._spec, self._network = spec, network
        self.algorithm = build_algorithm(spec, network.distribution, modules)
        self.parameters = FlatParameters(network.learned_parameters())
        self.forward = Forward(
            network,
            self.parameters,
            has_target=self.algorithm.record.target_network,
            is_mixed=is_mixed(spec.precision, self.parameters.values.device, network.convolutional),
        )
        # A recording saves what Python costs: much with small layers, little with convolutions.
        on_cpu = self.parameters.values.device.type == "cpu"
        self._records = on_cpu and not network.convolutional and not network.has_user_modules
        self._recorder = OperationRecorder()
        self._first_pass: FirstPass | None = None  # of the newest batch
        if is_own(spec.algorithm):
            device, attributes = self.parameters.values.device, dict(vars(self.algorithm))
            check_updates(
                spec,
                lambda batch: self.compute(batch.to(device), spec.entropy_bonus),
                self._try_after_update,
                spaces,
                network.state_size,
            )
            vars(self.algorithm).update(attributes)  # the run begins with those before the trial
            self._first_pass = None

    def compute(self, batch: Batch, entropy_bonus: float | Tensor, then: Then | None = None) -> Iterator[Terms]:
        """Write the gradient of each update of a batch to `parameters.gradients`, and yield its loss terms.

        Without `then`, the caller applies the gradient before it asks for the next update.

        Args:
          batch: on the device of the parameters.
          entropy_bonus: weight of the entropy in the loss; a number, or a scalar on the device.
          then: what follows each gradient.
        """
        # The statistics of observations do not change within a batch: prepare them once for all passes.
        batch = replace(batch, observations=self._network.prepare(batch.observations))
        bonus = torch.as_tensor(entropy_bonus, device=batch.valid.device)
        for losses in self.algorithm.losses(batch, self.forward):
            if not isinstance(losses, Losses | MinibatchLosses):
                raise TypeError(f"losses() gives {type(losses).__name__}: it must yield Losses or MinibatchLosses")
            self._first_pass = losses.first_pass
            if isinstance(losses, MinibatchLosses):
                terms = Terms(*self._of_minibatch(losses, bonus, then))
            else:
                terms = Terms(*self._differentiated(losses, bonus, then))
            if then is not None:
                then.apply()
            yield terms

    def no_update(self) -> Terms:
        """Write a gradient of 0 and return terms of 0: for a batch of which an own algorithm makes no update."""
        self.parameters.gradients.zero_()
        return Terms(*self.parameters.gradients.new_zeros(len(Terms._fields)))

    def _of_minibatch(self, losses: MinibatchLosses, bonus: Tensor, then: Then | None) -> tuple[Tensor, ...]:
        """Return the terms of the losses of a minibatch, by a recording if it is worth one. See `compute`."""
        function, minibatch, _ = losses
        if not (self._records and len(minibatch.shares) <= _MOST_ROWS):
            return self._differentiated(function(minibatch, self.forward), bonus, then)

        def update(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
            *parts, bonus = tensors
            return self._differentiated(function(minibatch.with_tensors(parts), self.forward), bonus, then)

        changed = [self.parameters.gradients, *(() if then is None else then.changed)]
        # The spaces, and the number of rows and environments, decide the shapes of everything else.
        name = (function, then is None, minibatch.shares.shape, *self._kept_by_recording())
        return self._recorder.call(name, update, [*minibatch.tensors(), bonus], changed, tells_shapes=True)

    def _kept_by_recording(self) -> Iterator[object]:
        """Yield what a recording of an algorithm of the user's own keeps: its numbers, and where its tensors are."""
        if is_own(self._spec.algorithm):
            for value in (*vars(self.algorithm).values(), *self.algorithm.statistics.values()):
                if isinstance(value, Tensor):
                    yield value.data_ptr()
                elif isinstance(value, int | float | str):
                    yield value

    def _differentiated(self, losses: Losses, bonus: Tensor, then: Then | None) -> tuple[Tensor, ...]:
        """Write the gradient [P] of the weighted sum of losses. Return their Terms."""
        _check_shapes(losses)
        value_term = losses.value_loss
        if value_term is None:
            value_term = value_loss(losses.values, losses.targets, losses.shares, self._spec.value_loss)
        entropy = mean(losses.entropies, losses.shares)
        loss = losses.policy_loss + self._spec.value_coefficient * value_term - bonus * entropy
        clipped = entropy.new_zeros(()) if losses.clipped_fraction is None else losses.clipped_fraction
        terms = Terms(losses.policy_loss.detach(), value_term.detach(), entropy.detach(), clipped)
        self.parameters.differentiated(loss, out=self.parameters.gradients)
        if then is not None:
            then.clip(terms)
        return terms

    def take_first_pass(self) -> FirstPass | None:
        """Return the first pass of the newest batch, once; None without a batch since the last call.

        It is valid until the memory of the batch is used for the next one.
        """
        first_pass, self._first_pass = self._first_pass, None
        return first_pass

    def after_update(self, policy_version: int) -> None:
        """Let the algorithm do what follows an update, whose gradient the caller has applied."""
        self.algorithm.after_update(policy_version, self.forward)

    def _try_after_update(self) -> None:
        before = {name: values.clone() for name, values in self.statistics.items()}
        self.after_update(1)
        for name, values in self.statistics.items():
            values.copy_(before[name])

    @property
    def own_statistics(self) -> dict[str, Tensor]:
        """Tensors that the algorithm itself changes after an update, by name; not those of the target network."""
        return {f"algorithm/{name}": values for name, values in self.algorithm.statistics.items()}

    @property
    def statistics(self) -> dict[str, Tensor]:
        """Tensors of the algorithm that a checkpoint saves, by name, and restores in place."""
        statistics = self.own_statistics
        if self.algorithm.record.target_network:
            statistics["target_network"] = self.forward.target_values
        return statistics


def _check_shapes(losses: Losses) -> None:
    """Raise TypeError or ValueError for terms that are no tensors, or that torch would take in another shape."""
    for name in ("policy_loss", "entropies", "values", "targets", "shares"):
        if not isinstance(term := getattr(losses, name), Tensor):
            zero = "torch.zeros(())" if name == "policy_loss" else "torch.zeros_like(shares)"
            raise TypeError(f"{name} is {type(term).__name__}: it must be a tensor; zero is {zero}")
    if losses.value_loss is not None and not isinstance(losses.value_loss, Tensor):
        raise TypeError(f"value_loss is {type(losses.value_loss).__name__}: it must be a tensor, or None")
    for name in ("policy_loss", "value_loss"):
        term = getattr(losses, name)
        if term is not None and term.shape:
            raise ValueError(f"{name} has shape {tuple(term.shape)}: it must be a scalar")
    shapes = [tuple(each.shape) for each in (losses.entropies, losses.values, losses.targets, losses.shares)]
    if len(set(shapes)) > 1:
        raise ValueError(f"the shapes of entropies, values, targets and shares differ: {shapes}")
