"""One update at a time: owns the parameters, the optimiser and the policy version. No threads, no I/O."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch, BatchAssembler
from daedalus.algorithms.losses import (
    clipped_fraction,
    clipped_policy_loss,
    explained_variance,
    masked_mean,
    normalized,
    policy_gradient_loss,
    value_loss,
)
from daedalus.algorithms.minibatches import Minibatch, minibatches
from daedalus.algorithms.returns import Targets, actor_critic_targets, vtrace_targets
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.optimizers import Adam, FlatParameters, Optimizer, RmsProp
from daedalus.learner.training.precision import autocast
from daedalus.policy.acting.program import export_program
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.distributions import categorical_log_probs
from daedalus.protocol.messages import Rollout
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec


class Estimates(NamedTuple):
    """What the losses and the metrics are made of, all [R, B]."""

    entropies: Tensor
    values: Tensor
    targets: Tensor
    advantages: Tensor
    valid: Tensor


METRICS = (
    "policy_loss",
    "value_loss",
    "entropy",
    "explained_variance",
    "gradient_norm",
    "value_mean",
    "advantage_std",
    "clipped_fraction",
)


class Learner:
    """Turns batches into new policy versions.

    `a2c` and `a3c` differ in when batches come, not in what is done with them; `impala` corrects for lag; `appo` does
    too, and goes over each batch several times.
    """

    def __init__(self, spec: TrainingSpec, policy: PolicySpec, spaces: Spaces) -> None:
        """Raises SettingsError if the device is not there, NetworkError if the policy is not for such spaces."""
        if spec.device == "cuda" and not torch.cuda.is_available():
            raise SettingsError(
                "training.device is cuda, but torch sees none here: install a torch built for CUDA and the driver, "
                "or set training.device=cpu"
            )
        torch.manual_seed(spec.seed)
        torch.set_num_threads(spec.threads)
        self._spec = spec
        self._spaces = spaces
        self._device = torch.device(spec.device)
        self._network = ActorCritic(policy, spaces).to(self._device)
        self._parameters = dict(self._network.named_parameters())
        self._flat = FlatParameters(self._parameters.values())
        self._optimizer = _optimizer(spec, self._flat.values)
        self._assembler = BatchAssembler(spaces.observation, self._device)
        self.policy_version = 0
        self.updates_skipped = 0  # whose gradient was not finite: versions that are the same as those before them
        self._metric_sums = torch.zeros(len(METRICS), device=self._device)
        self._metric_count = 0
        self._seen: Tensor | None = None
        self._action_counts = torch.zeros(spaces.action.count, dtype=torch.int64, device=self._device)

    @property
    def state_size(self) -> int:
        """S, how many numbers the policy remembers from row to row."""
        return self._network.state_size

    def step(self, rollouts: Sequence[Rollout], progress: float) -> None:
        """All updates from one batch. `progress`, the share of the budget that is used up, anneals the rates."""
        batch = self._assembler.join(rollouts).to(self._device)
        if self._spec.algorithm == "appo":
            self._learn_in_passes(batch, progress)
        else:
            self._learn_once(batch, progress)
        self._seen = batch.observations[0, 0]
        chosen = torch.bincount(batch.actions.flatten(), batch.valid.flatten(), len(self._action_counts))
        self._action_counts += chosen.to(torch.int64)

    def _forward(self, observations: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        with autocast(self._spec.precision, self._device, self._network.convolutional):
            return self._network(observations, state, starts)

    def _learn_once(self, batch: Batch, progress: float) -> None:
        logits, values = self._forward(batch.observations, batch.initial_state, batch.starts)  # [T+1, B, ...]
        log_probs, entropies = categorical_log_probs(logits[:-1], batch.actions)
        with torch.no_grad():
            targets = self._targets(batch, log_probs, values)
        self._update(
            policy_gradient_loss(log_probs, self._weights_of(targets.advantages, batch.valid), batch.valid),
            Estimates(entropies, values[:-1], targets.values, targets.advantages, batch.valid),
            torch.zeros((), device=self._device),
            progress,
        )

    def _learn_in_passes(self, batch: Batch, progress: float) -> None:
        with torch.no_grad():
            logits, values = self._forward(batch.observations, batch.initial_state, batch.starts)
            log_probs, _ = categorical_log_probs(logits[:-1], batch.actions)
            targets = self._targets(batch, log_probs, values)
        for _ in range(self._spec.passes):
            for sample in minibatches(batch, log_probs, targets, self._spec.minibatches):
                self._learn_minibatch(sample, progress)

    def _learn_minibatch(self, sample: Minibatch, progress: float) -> None:
        if not sample.actions.numel():  # fewer rows than minibatches
            self.policy_version += 1
            return
        logits, values = self._forward(sample.observations, sample.initial_state, sample.starts)
        log_probs, entropies = categorical_log_probs(logits, sample.actions)
        log_ratios = log_probs - sample.log_probs
        advantages = self._weights_of(sample.advantages, sample.valid)
        self._update(
            clipped_policy_loss(log_ratios, advantages, sample.valid, self._spec.clip_range),
            Estimates(entropies, values, sample.targets, sample.advantages, sample.valid),
            clipped_fraction(log_ratios.detach(), sample.valid, self._spec.clip_range),
            progress,
        )

    def _update(self, policy_term: Tensor, estimates: "Estimates", clipped: Tensor, progress: float) -> None:
        """One optimiser step down the sum of the losses."""
        spec = self._spec
        entropies, values, targets, advantages, valid = estimates
        value_term = value_loss(values, targets, valid, spec.value_loss)
        entropy = masked_mean(entropies, valid)
        loss = policy_term + spec.value_coefficient * value_term - self.entropy_bonus(progress) * entropy
        self._flat.gradients.zero_()
        loss.backward()
        norm = self._flat.clip_gradients(spec.max_gradient_norm)
        self.policy_version += 1
        if not math.isfinite(norm):  # one such step would end the run: no number comes back from nan
            self.updates_skipped += 1
            return
        self._optimizer.step(self._flat.values, self._flat.gradients, self.learning_rate(progress))
        with torch.no_grad():
            centred = advantages - masked_mean(advantages, valid)
            metrics = [
                policy_term,
                value_term,
                entropy,
                explained_variance(values, targets, valid),
                norm,
                masked_mean(values, valid),
                masked_mean(centred.square(), valid).sqrt(),
                clipped,
            ]
            self._metric_sums += torch.stack(metrics)
        self._metric_count += 1

    def _targets(self, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
        spec = self._spec
        discounts = spec.discount_factor * (~batch.terminated)
        if spec.algorithm in ("impala", "appo"):
            return vtrace_targets(
                log_probs - batch.behaviour_log_probs,
                batch.rewards,
                discounts,
                values[:-1],
                values[1:],
                batch.truncated,
                spec.trace_lambda,
                spec.rho_clip,
                spec.trace_clip,
            )
        return actor_critic_targets(
            batch.rewards, discounts, values[:-1], values[1:], batch.truncated, spec.trace_lambda
        )

    def _weights_of(self, advantages: Tensor, valid: Tensor) -> Tensor:
        return normalized(advantages, valid) if self._spec.normalize_advantages else advantages

    def learning_rate(self, progress: float) -> float:
        """The optimiser's rate at a share of the budget."""
        return _annealed(self._spec.learning_rate, self._spec.learning_rate_final, progress)

    def entropy_bonus(self, progress: float) -> float:
        """The entropy's weight in the loss at a share of the budget."""
        return _annealed(self._spec.entropy_bonus, self._spec.entropy_bonus_final, progress)

    def take_metrics(self) -> dict[str, float]:
        """Means over the updates since the last call; empty if there were none."""
        if not self._metric_count:
            return {}
        means = (self._metric_sums / self._metric_count).tolist()
        self._metric_sums.zero_()
        self._metric_count = 0
        return dict(zip(METRICS, means, strict=True))

    def take_action_counts(self) -> list[int]:
        """How often each action was chosen in the batches since the last call."""
        counts = self._action_counts.tolist()
        self._action_counts.zero_()
        return counts

    def take_observation_image(self) -> np.ndarray | None:
        """What the network saw at a row of the newest batch, its stack side by side: uint8 [H, W] or [H, W, 3].

        None where observations are no images, or there was no batch since the last call.
        """
        seen, self._seen = self._seen, None
        return None if seen is None else _picture(seen, self._spaces.observation)

    # ------------------------------------------------------------------------------------- going outside

    def program(self) -> bytes:
        """The policy program (policy/acting/program.py)."""
        return export_program(self._network, self._spaces.observation)

    def weights(self) -> dict[str, np.ndarray]:
        """All parameters as numpy arrays that share their memory: copy or encode them before the next step."""
        return {name: parameter.detach().cpu().numpy() for name, parameter in self._parameters.items()}

    def state(self) -> dict[str, Tensor]:
        """Everything beyond the parameters that decides the next update: optimiser statistics, random state."""
        kind = self._spec.optimizer
        statistics = {f"{kind}/{name}": value for name, value in self._optimizer.statistics.items()}
        return {"torch_random_state": torch.get_rng_state(), **statistics}

    def restore(self, version: int, parameters: dict[str, np.ndarray], state: dict[str, Tensor]) -> None:
        """Continues exactly where `weights` and `state` were taken.

        Raises ValueError if they are another network's.
        """
        shapes = {name: tuple(array.shape) for name, array in parameters.items()}
        expected = {name: tuple(parameter.shape) for name, parameter in self._parameters.items()}
        if shapes != expected:
            raise ValueError("the checkpoint holds the parameters of another network")
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                parameter.copy_(torch.from_numpy(parameters[name].copy()))
        for name, statistic in self._optimizer.statistics.items():
            saved = state.get(f"{self._spec.optimizer}/{name}")
            if saved is None or saved.shape != statistic.shape:
                raise ValueError("the checkpoint holds the statistics of another optimiser")
            statistic.copy_(saved)
        torch.set_rng_state(state["torch_random_state"])
        self.policy_version = version


def _picture(observation: Tensor, space: ArraySpace) -> np.ndarray | None:
    colours = space.shape[2:] in ((1,), (3,))
    if space.dtype != "uint8" or not (len(space.shape) == 2 or colours):
        return None
    frames = observation.cpu().numpy().reshape(space.frames, *space.shape)
    side_by_side = np.concatenate(list(frames), axis=1)  # [H, k * W, ...]
    return side_by_side[..., 0] if space.shape[2:] == (1,) else side_by_side


def _annealed(first: float, final: float | None, progress: float) -> float:
    return first if final is None else first + (final - first) * min(max(progress, 0.0), 1.0)


def _optimizer(spec: TrainingSpec, values: Tensor) -> Optimizer:
    if spec.optimizer == "adam":
        return Adam(values, spec.optimizer_epsilon)
    return RmsProp(values, spec.optimizer_epsilon, spec.rmsprop_decay)
