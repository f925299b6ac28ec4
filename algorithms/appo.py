"""APPO: asynchronous proximal policy optimisation with V-trace targets, several passes over each batch."""

from collections.abc import Iterator

import torch

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import clipped_fraction, clipped_policy_loss, policy_weights
from daedalus.algorithms.minibatches import Minibatch, minibatches
from daedalus.algorithms.targets import vtrace_corrected_targets
from daedalus.protocol.algorithms import ALGORITHMS


class Appo(Algorithm):
    """PPO for rollouts with policy lag: Schulman et al. (2017), algorithm 1, with V-trace targets.

    The targets of a batch are computed once, before its first pass.
    """

    record = ALGORITHMS["appo"]

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        """Yield the losses of each minibatch of each pass. See Algorithm."""
        with torch.no_grad():
            parameters, values = forward(batch.observations, batch.initial_state, batch.starts)
            log_probs = self.distribution.log_prob(parameters[:-1], batch.actions, batch.masks)
            targets = vtrace_corrected_targets(self.spec, batch, log_probs, values)
        first_pass = FirstPass(log_probs, batch.behaviour_log_probs, values[:-1], targets.values, batch.valid)
        for _ in range(self.spec.passes):
            for minibatch in minibatches(batch, log_probs, targets, self.spec.minibatches):
                yield self._minibatch_losses(minibatch, forward, first_pass)

    def _minibatch_losses(self, minibatch: Minibatch, forward: Forward, first_pass: FirstPass) -> Losses:
        parameters, values = forward(minibatch.observations, minibatch.initial_state, minibatch.starts)
        log_probs, entropies = self.distribution.log_prob_and_entropy(parameters, minibatch.actions, minibatch.masks)
        log_ratios = log_probs - minibatch.log_probs
        clip_range, valid = self.spec.clip_range, minibatch.valid
        factors = policy_weights(minibatch.advantages, minibatch.weights, valid, self.spec.normalize_advantages)
        return Losses(
            policy_loss=clipped_policy_loss(log_ratios, factors, valid, clip_range),
            entropies=entropies,
            values=values,
            targets=minibatch.targets,
            advantages=minibatch.advantages,
            valid=valid,
            clipped_fraction=clipped_fraction(log_ratios.detach(), valid, clip_range),
            first_pass=first_pass,
        )
