"""Learning of action values, shared by one_step_q, one_step_sarsa and n_step_q: Mnih et al. (2016), section 4."""

from collections.abc import Iterator

import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import shares_of
from daedalus.algorithms.returns import lambda_returns
from daedalus.policy.network.distributions import without_illegal


class ActionValues(Algorithm):
    """Regression of Q(s_t, a_t) on returns that the target network bootstraps, with one update for each batch.

    The target network is copied from the network every `training.target_period` updates.

    A rollout has neither the action nor the mask of the observation after its last row. Where the targets need one of
    them, the last row bootstraps the rows before it and is itself learned from only if it ended in a termination. After
    a truncation, the mask of the final observation is the environment's; all actions are legal if it gives none.
    """

    def next_values(self, values: Tensor, batch: Batch) -> Tensor:
        """Return the values that rows bootstrap from, of the observations from row 1 on.

        Args:
          values: [R, B, choices], Q of the target network, R being T or T-1. Those of illegal actions are -1e30.
          batch: T rows of B environments.

        Returns: [R, B].
        """
        return values.amax(-1)

    @property
    def trace_lambda(self) -> float:
        """Lambda of the returns: 0 for one-step targets, 1 for n-step targets."""
        return 0.0

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        """Yield the loss of the only update. See Algorithm."""
        (name,) = batch.actions
        arguments = batch.observations, batch.initial_state, batch.starts
        values, _ = forward(*arguments)  # [T+1, B, choices]
        chosen = values[:-1].gather(-1, batch.actions[name]).squeeze(-1)  # [T, B]
        with torch.no_grad():
            following, _ = forward.target(*arguments)
            targets, learned = self._targets(following[1:], batch)
        shares = shares_of(learned)
        predicted = chosen.detach()
        yield Losses(
            policy_loss=chosen.new_zeros(()),
            entropies=torch.zeros_like(chosen),
            values=chosen,
            targets=targets,
            shares=shares,
            first_pass=FirstPass(None, batch.behaviour_log_probs, predicted, targets, targets - predicted, learned),
        )

    def _targets(self, following: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the targets [T, B], and the rows to learn from [T, B] float32, 1 or 0.

        `following` [T, B, choices] is Q of the target network at the observations of rows 1 to T.
        """
        ends, learned = batch.truncated, batch.valid
        if self.record.next_action or batch.masks:
            # The last row has no next value. Its own return is known only where it terminated.
            known = batch.terminated[-1]
            ends, learned = ends.clone(), learned.clone()
            ends[-2:-1] |= ~known
            learned[-1] *= known
            following = following[:-1]
        for mask in batch.masks.values():
            following = without_illegal(following, mask[1:])
        next_values = torch.zeros_like(batch.rewards)
        next_values[: len(following)] = self.next_values(following, batch)
        discounts = self.spec.discount_factor * (~batch.terminated)
        return lambda_returns(batch.rewards, discounts, next_values, ends, self.trace_lambda), learned

    def after_update(self, policy_version: int, forward: Forward) -> None:
        """See Algorithm: copy the network to the target network every `training.target_period` updates."""
        if policy_version % self.spec.target_period == 0:
            forward.update_target()
