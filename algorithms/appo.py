"""APPO: asynchronous proximal policy optimisation with V-trace targets, several passes over each batch."""

from collections.abc import Iterator

import torch

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import clipped_policy_loss, policy_factors
from daedalus.algorithms.minibatches import Minibatch, minibatches
from daedalus.algorithms.targets import vtrace_corrected_targets
from daedalus.protocol.algorithms import ALGORITHMS


class Appo(Algorithm):
    """PPO for rollouts with policy lag: Schulman et al. (2017), algorithm 1, with V-trace targets.

    The targets of a batch are computed once, before its first pass, and its advantages are normalised as one.
    """

    record = ALGORITHMS["appo"]

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        """Yield the losses of each minibatch of each pass. See Algorithm."""
        with torch.no_grad():
            parameters, values = forward(batch.observations, batch.initial_state, batch.starts)
            log_probs = self.distribution.log_prob(parameters[:-1], batch.actions, batch.masks)
            targets = vtrace_corrected_targets(self.spec, batch, log_probs, values)
            factors = policy_factors(targets, batch.valid, self.spec.normalize_advantages)
        first_pass = FirstPass(
            log_probs, batch.behaviour_log_probs, values[:-1], targets.values, targets.advantages, batch.valid
        )
        for _ in range(self.spec.passes):
            for minibatch in minibatches(batch, log_probs, targets.values, factors, self.spec.minibatches):
                yield self._minibatch_losses(minibatch, forward, first_pass)

    def _minibatch_losses(self, minibatch: Minibatch, forward: Forward, first_pass: FirstPass) -> Losses:
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
            first_pass=first_pass,
        )
