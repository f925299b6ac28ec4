"""Policy gradient with one update for each batch, shared by a2c, a3c and impala."""

from collections.abc import Iterator

import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import policy_factors, policy_gradient_loss, shares_of
from daedalus.algorithms.returns import Targets
from daedalus.algorithms.targets import lambda_targets


class PolicyGradient(Algorithm):
    """Actor-critic algorithm with a single pass over each batch."""

    def targets(self, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
        """Return value targets and advantages; arguments as for lambda_targets."""
        return lambda_targets(self.spec, batch, log_probs, values)

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        """Yield the losses of the only update. See Algorithm."""
        parameters, values = forward(batch.observations, batch.initial_state, batch.starts)  # [T+1, B, ...]
        log_probs, entropies = self.distribution.log_prob_and_entropy(parameters[:-1], batch.actions, batch.masks)
        with torch.no_grad():
            targets = self.targets(batch, log_probs, values)
            shares = shares_of(batch.valid)
            factors = policy_factors(targets, batch.valid, self.spec.normalize_advantages)
        yield Losses(
            policy_loss=policy_gradient_loss(log_probs, factors, shares),
            entropies=entropies,
            values=values[:-1],
            targets=targets.values,
            shares=shares,
            first_pass=FirstPass(
                log_probs.detach(),
                batch.behaviour_log_probs,
                values[:-1].detach(),
                targets.values,
                targets.advantages,
                batch.valid,
            ),
        )
