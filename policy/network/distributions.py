"""Action distributions in torch, for learning. policy/acting/sampling.py draws actions from them in numpy.

To add a distribution: a class here, its choice in `distribution_for`, and its sampler in policy/acting/sampling.py.
"""

from typing import Protocol

from torch import Tensor

from daedalus.policy.acting.sampling import LOGITS
from daedalus.protocol.spaces import DiscreteSpace


class ActionDistribution(Protocol):
    """Family of distributions over the actions of one space; the policy head computes the parameters of one of them."""

    @property
    def parameter_count(self) -> int:
        """P, the number of outputs of the policy head."""
        ...

    @property
    def program_output(self) -> str:
        """Name of the program's output that holds the parameters; a key of `SAMPLERS` in policy/acting/sampling.py."""
        ...

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-probability (or log-density) of actions, and the entropy of their distributions.

        Args:
          parameters: [..., P].
          actions: [...].

        Returns: log pi(a | s) [...] and H(pi(. | s)) [...], in nats.
        """
        ...


class Categorical:
    """Softmax policies over the actions of a DiscreteSpace; the parameters are logits."""

    program_output = LOGITS

    def __init__(self, space: DiscreteSpace) -> None:
        self.parameter_count = space.count

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-probability of the actions taken, and the entropy, of softmax policies.

        Args:
          parameters: logits [..., A].
          actions: [...] int64, from 0 to A - 1.

        Returns: log pi(a | s) [...] and H(pi(. | s)) = - sum_a pi(a | s) log pi(a | s) [...], in nats.
        """
        log_probs = parameters.log_softmax(-1)
        chosen = log_probs.gather(-1, actions.unsqueeze(-1)).squeeze(-1)
        return chosen, -(log_probs.exp() * log_probs).sum(-1)


def distribution_for(space: DiscreteSpace) -> ActionDistribution:
    """Return the family of distributions over the actions of a space."""
    return Categorical(space)
