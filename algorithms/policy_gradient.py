"""The algorithms that follow the gradient of the policy: a2c, a3c and impala with one update a batch, and appo."""

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses, MinibatchLosses
from daedalus.algorithms.batch import Batch, Pass
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import (
    policy_factors,
    policy_gradient_loss,
    shares_of,
    surrogate_policy_loss,
    value_loss,
)
from daedalus.algorithms.minibatches import Minibatch, draw_pass, minibatches
from daedalus.algorithms.returns import Targets, lambda_targets, vtrace_corrected_targets
from daedalus.protocol.algorithms import ALGORITHMS


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
            factors = policy_factors(self.spec, targets, batch.valid)
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


class A2c(PolicyGradient):
    """Synchronous form of Mnih et al. (2016), algorithm S3. There is no policy lag, so no correction is needed."""

    record = ALGORITHMS["a2c"]


class A3c(PolicyGradient):
    """Asynchronous advantage actor-critic: Mnih et al. (2016), algorithm S3.

    In the paper a worker computes the gradient at the weights that chose the actions, and only the application of the
    gradient is delayed. So it is with `collection.upload = "gradients"`. With rollouts, the learner computes the
    gradient at its newest weights, from a rollout of older weights, and does not correct for the policy lag.
    """

    record = ALGORITHMS["a3c"]


class Impala(PolicyGradient):
    """Actor-critic with V-trace targets: Espeholt et al. (2018), section 4."""

    record = ALGORITHMS["impala"]

    def targets(self, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
        """See PolicyGradient."""
        return vtrace_corrected_targets(self.spec, batch, log_probs, values)


class Appo(Algorithm):
    """PPO for rollouts with policy lag: Schulman et al. (2017), algorithm 1, run asynchronously as by Petrenko et al.
    (2020).

    The clip keeps the policy near the proximal policy: the newest before the batch, or the behaviour policy. Hilton et
    al. (2022), section 3, separate the two, with an average of past policies as the proximal policy. The lambda-returns
    are not corrected for the policy lag: V-trace learns worse (docs/results.md, "Policy lag with appo").

    Where actors explore, the weights of lambda_targets correct for their random actions, and the proximal policy is the
    newest, because a behaviour policy with random actions would keep the policy random.

    The targets of a batch are computed once, before its first pass, and its advantages are normalised as one.
    """

    record = ALGORITHMS["appo"]

    def losses(self, batch: Batch, forward: Forward) -> Iterator[MinibatchLosses]:
        """Yield the losses of each minibatch of each pass. See Algorithm."""
        with torch.no_grad():
            parameters, values = forward(batch.observations, batch.initial_state, batch.starts)
            log_probs = self.distribution.log_prob(parameters[:-1], batch.actions, batch.masks)
            targets = lambda_targets(self.spec, batch, log_probs, values)
            factors = policy_factors(self.spec, targets, batch.valid)
        first_pass = FirstPass(
            log_probs, batch.behaviour_log_probs, values[:-1], targets.values, targets.advantages, batch.valid
        )
        behaviour = self.spec.proximal_policy == "behaviour" and not self.spec.explores
        proximal = batch.behaviour_log_probs if behaviour else log_probs
        of_rows = batch, proximal, values[:-1], targets.values, factors
        for drawn in batch.passes or self.drawn(batch.valid.cpu(), has_memory=batch.initial_state.shape[1] > 0):
            drawn = Pass(*(part.to(batch.valid.device) for part in drawn))
            for minibatch in minibatches(*of_rows, self.spec.minibatches, drawn):
                yield MinibatchLosses(self._minibatch_losses, minibatch, first_pass)

    def drawn(self, valid: Tensor, *, has_memory: bool) -> list[Pass]:
        """See Algorithm."""
        draw = partial(draw_pass, valid, self.spec.minibatches, has_memory=has_memory)
        return [draw() for _ in range(self.spec.passes)]

    def _minibatch_losses(self, minibatch: Minibatch, forward: Forward) -> Losses:
        parameters, values = forward(minibatch.observations, minibatch.initial_state, minibatch.starts)
        log_probs, entropies = self.distribution.log_prob_and_entropy(parameters, minibatch.actions, minibatch.masks)
        log_ratios = log_probs - minibatch.log_probs
        shares = minibatch.shares
        policy_loss, outside = surrogate_policy_loss(
            log_ratios, minibatch.factors, shares, self.spec.clip_range, self.spec.surrogate
        )
        return Losses(
            policy_loss=policy_loss,
            entropies=entropies,
            values=values,
            targets=minibatch.targets,
            shares=shares,
            clipped_fraction=outside,
            value_loss=self.value_loss(minibatch, values),
        )

    def value_loss(self, minibatch: Minibatch, values: Tensor) -> Tensor:
        """Return the value loss of a minibatch, a scalar: the one that `training.value_loss` names.

        For subclasses, which may replace it or add to it.

        Args:
          minibatch: has the values of the network before the first pass, and the value targets, [R, B].
          values: [R, B], those of the network now.
        """
        return value_loss(values, minibatch.targets, minibatch.shares, self.spec.value_loss)
