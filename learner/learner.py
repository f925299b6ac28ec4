"""One update at a time: owns the parameters, the optimiser and the policy version. No threads, no I/O."""

import numpy as np
import torch
from torch import Tensor

from learner.batch import Batch
from learner.losses import explained_variance, masked_mean, normalized, policy_gradient_loss, value_loss
from learner.optimizers import Adam, FlatParameters, Optimizer, RmsProp
from learner.returns import Targets, actor_critic_targets, vtrace_targets
from policy.distributions import categorical_log_probs
from policy.network import ActorCritic
from policy.program import export_program
from protocol.spec import PolicySpec, Spaces, TrainingSpec

METRICS = (
    "policy_loss",
    "value_loss",
    "entropy",
    "explained_variance",
    "gradient_norm",
    "value_mean",
    "advantage_std",
)


class Learner:
    """Turns batches into new policy versions.

    `a2c` and `a3c` differ in when batches come, not in what is done with them; `impala` corrects for lag.
    """

    def __init__(self, spec: TrainingSpec, policy: PolicySpec, spaces: Spaces) -> None:
        torch.manual_seed(spec.seed)
        torch.set_num_threads(spec.threads)
        self._spec = spec
        self._spaces = spaces
        self._network = ActorCritic(policy, spaces)
        self._parameters = dict(self._network.named_parameters())
        self._flat = FlatParameters(self._parameters.values())
        self._optimizer = _optimizer(spec, len(self._flat.values))
        self.policy_version = 0
        self._metric_sums = torch.zeros(len(METRICS))
        self._metric_count = 0

    def step(self, batch: Batch, progress: float) -> None:
        """One update from one batch. `progress`, the share of the budget that is used up, anneals the rates."""
        loss, metrics = self._loss(batch, progress)
        self._flat.gradients.zero_()
        loss.backward()
        norm = self._flat.clip_gradients(self._spec.max_gradient_norm)
        self._optimizer.step(self._flat.values, self._flat.gradients, self.learning_rate(progress))
        self.policy_version += 1
        metrics[METRICS.index("gradient_norm")] = norm
        self._metric_sums += torch.stack(metrics)
        self._metric_count += 1

    def _loss(self, batch: Batch, progress: float) -> tuple[Tensor, list[Tensor]]:
        rows, environments = batch.actions.shape
        logits, values = self._network(batch.observations.flatten(0, 1))  # [(T+1) * B, A], [(T+1) * B]
        logits = logits.unflatten(0, (rows + 1, environments))[:-1]  # [T, B, A]
        values = values.unflatten(0, (rows + 1, environments))  # [T+1, B]
        log_probs, entropies = categorical_log_probs(logits, batch.actions)
        with torch.no_grad():
            targets = self._targets(batch, log_probs, values)
            advantages = targets.advantages
            if self._spec.normalize_advantages:
                advantages = normalized(advantages, batch.valid)
        policy_term = policy_gradient_loss(log_probs, advantages, batch.valid)
        value_term = value_loss(values[:-1], targets.values, batch.valid, self._spec.value_loss)
        entropy = masked_mean(entropies, batch.valid)
        loss = policy_term + self._spec.value_coefficient * value_term - self.entropy_bonus(progress) * entropy
        with torch.no_grad():
            centred = targets.advantages - masked_mean(targets.advantages, batch.valid)
            metrics = [
                policy_term.detach(),
                value_term.detach(),
                entropy.detach(),
                explained_variance(values[:-1], targets.values, batch.valid),
                torch.zeros(()),  # the gradient's norm, once there is one
                masked_mean(values[:-1], batch.valid),
                masked_mean(centred.square(), batch.valid).sqrt(),
            ]
        return loss, metrics

    def _targets(self, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
        spec = self._spec
        discounts = spec.discount_factor * (~batch.terminated)
        if spec.algorithm == "impala":
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

    # ------------------------------------------------------------------------------------- going outside

    def program(self) -> bytes:
        """The policy program (policy/program.py)."""
        return export_program(self._network, self._spaces.observation)

    def weights(self) -> dict[str, np.ndarray]:
        """All parameters as numpy arrays that share their memory: copy or encode them before the next step."""
        return {name: parameter.detach().numpy() for name, parameter in self._parameters.items()}

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


def _annealed(first: float, final: float | None, progress: float) -> float:
    return first if final is None else first + (final - first) * min(max(progress, 0.0), 1.0)


def _optimizer(spec: TrainingSpec, size: int) -> Optimizer:
    if spec.optimizer == "adam":
        return Adam(size, spec.optimizer_epsilon)
    return RmsProp(size, spec.optimizer_epsilon, spec.rmsprop_decay)
