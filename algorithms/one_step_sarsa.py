"""Asynchronous one-step Sarsa: as one_step_q, on the action that the actor took next."""

from torch import Tensor

from daedalus.algorithms.action_values import ActionValues
from daedalus.algorithms.batch import Batch
from daedalus.protocol.algorithms import ALGORITHMS


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
