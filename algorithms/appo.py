"""APPO: asynchronous proximal policy optimisation, several passes over each batch."""

from collections.abc import Iterator

import torch

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses, MinibatchLosses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import clipped_policy_loss, policy_factors
from daedalus.algorithms.minibatches import Minibatch, minibatches
from daedalus.algorithms.targets import lambda_targets
from daedalus.protocol.algorithms import ALGORITHMS


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
            factors = policy_factors(targets, batch.valid, self.spec.normalize_advantages)
        first_pass = FirstPass(
            log_probs, batch.behaviour_log_probs, values[:-1], targets.values, targets.advantages, batch.valid
        )
        behaviour = self.spec.proximal_policy == "behaviour" and not self.spec.explores
        proximal = batch.behaviour_log_probs if behaviour else log_probs
        for _ in range(self.spec.passes):
            for minibatch in minibatches(batch, proximal, targets.values, factors, self.spec.minibatches):
                yield MinibatchLosses(self._minibatch_losses, minibatch, first_pass)

    def _minibatch_losses(self, minibatch: Minibatch, forward: Forward) -> Losses:
        parameters, values = forward(minibatch.observations, minibatch.initial_state, minibatch.starts)
        log_probs, entropies = self.distribution.log_prob_and_entropy(parameters, minibatch.actions, minibatch.masks)
        log_ratios = log_probs - minibatch.log_probs
        shares = minibatch.shares
        policy_loss, clipped = clipped_policy_loss(log_ratios, minibatch.factors, shares, self.spec.clip_range)
        return Losses(
            policy_loss=policy_loss,
            entropies=entropies,
            values=values,
            targets=minibatch.targets,
            shares=shares,
            clipped_fraction=clipped,
        )
