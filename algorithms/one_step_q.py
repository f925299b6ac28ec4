"""Asynchronous one-step Q-learning.

In the paper a thread accumulates the gradients of several steps for each update. Here they are the rows of a rollout,
whose mean gradient makes one update. Each row has a one-step target.
"""

from daedalus.algorithms.action_values import ActionValues
from daedalus.protocol.algorithms import ALGORITHMS


class OneStepQ(ActionValues):
    """Mnih et al. (2016), algorithm 1: the target is r_t + d_t max_a Q-(s_{t+1}, a)."""

    record = ALGORITHMS["one_step_q"]
