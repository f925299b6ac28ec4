"""Learning of action values: one_step_q, one_step_sarsa and n_step_q. Mnih et al. (2016), section 4."""

from collections.abc import Iterator

import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.losses import shares_of
from daedalus.algorithms.returns import lambda_returns
from daedalus.policy.network.distributions import without_illegal
from daedalus.protocol.algorithms import ALGORITHMS


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


class OneStepQ(ActionValues):
    """Mnih et al. (2016), algorithm 1: the target is r_t + d_t max_a Q-(s_{t+1}, a).

    In the paper a thread accumulates the gradients of several steps for each update. Here they are the rows of a
    rollout, whose mean gradient makes one update. Each row has a one-step target.
    """

    record = ALGORITHMS["one_step_q"]


class OneStepSarsa(ActionValues):
    """Mnih et al. (2016), section 4.2: the target is r_t + d_t Q-(s_{t+1}, a_{t+1}).

    a_{t+1} is the action of the behaviour policy, whose exploration the values therefore include. The next action of
    the last row of a rollout is in the next rollout: such a row is not learned from, unless its episode terminated.
    """

    record = ALGORITHMS["one_step_sarsa"]

    def next_values(self, values: Tensor, batch: Batch) -> Tensor:
        """See ActionValues. At the end of an episode, a_{t+1} was chosen from the final observation, and not taken."""
        (actions,) = batch.actions.values()
        return values.gather(-1, actions[1:]).squeeze(-1)


class NStepQ(ActionValues):
    """Mnih et al. (2016), algorithm S2: the target of row t is the return to the end of the rollout.

    The paper's rollout ends with an episode; here it goes on with the next one.

        G_t = r_t + d_t (max_a Q-(s_{t+1}, a) if truncated_t or t = T-1 else G_{t+1})

    The actions in between are those of the behaviour policy, and are not corrected for. With `training.trace_lambda`
    below 1, the returns are mixed over all horizons: Peng & Williams (1996), Q(lambda).
    """

    record = ALGORITHMS["n_step_q"]

    @property
    def trace_lambda(self) -> float:
        """See ActionValues."""
        return self.spec.trace_lambda
