"""Asynchronous n-step Q-learning. The paper's rollout ends with an episode; here it goes on with the next one."""

from daedalus.algorithms.action_values import ActionValues
from daedalus.protocol.algorithms import ALGORITHMS


class NStepQ(ActionValues):
    """Mnih et al. (2016), algorithm S2: the target of row t is the return to the end of the rollout.

        G_t = r_t + d_t (max_a Q-(s_{t+1}, a) if truncated_t or t = T-1 else G_{t+1})

    The actions in between are those of the behaviour policy, and are not corrected for. With `training.trace_lambda`
    below 1, the returns are mixed over all horizons: Peng & Williams (1996), Q(lambda).
    """

    record = ALGORITHMS["n_step_q"]

    @property
    def trace_lambda(self) -> float:
        """See ActionValues."""
        return self.spec.trace_lambda
