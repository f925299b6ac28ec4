"""Softmax policies over discrete actions."""

import torch
from torch import Tensor

from daedalus.policy.network.choices import variables_and_values
from daedalus.policy.network.distributions.distribution import Distribution
from daedalus.protocol.spaces import DiscreteSpace

_SMALLEST = 1e-30  # of uniform noise: at 0 a legal choice would be less probable than one that is not
_ABSENT = -1e30  # logit of a choice that a variable does not have, or that is not legal: its probability is exactly 0


class Categorical(Distribution):
    """D independent softmax policies, one for each variable of a DiscreteSpace; the parameters are all their logits.

    Samples by the Gumbel-max trick: the largest of log pi(a) - log(-log u_a) has the distribution pi (Gumbel 1954).
    """

    def __init__(self, space: DiscreteSpace) -> None:
        super().__init__()
        self._counts = space.counts
        self._equal = len(set(space.counts)) == 1
        self._columns, self._missing = _padded(space.counts)  # [D, A] index into the logits, [D, A] bool
        self.parameter_count = self.uniform_count = space.choices

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution."""
        gumbel = -torch.log(-torch.log(uniform.clamp(min=_SMALLEST)))
        return (self._by_variable(parameters) + self._by_variable(gumbel)).argmax(-1)  # [N, D]

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log pi_d(a_d | s)."""
        return _chosen(self._log_probs(parameters), actions)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: - sum_d sum_a pi_d(a | s) log pi_d(a | s)."""
        return _entropy(self._log_probs(parameters))

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See Distribution."""
        log_probs = self._log_probs(parameters)
        return _chosen(log_probs, actions), _entropy(log_probs)

    def _log_probs(self, parameters: Tensor) -> Tensor:
        return self._by_variable(parameters).log_softmax(-1)  # [..., D, A]

    def _by_variable(self, values: Tensor) -> Tensor:
        """Arrange values of all choices [..., P] by variable [..., D, A], A being the largest number of choices."""
        if self._equal:
            return values.unflatten(-1, (len(self._counts), self._counts[0]))
        columns, missing = self._columns.to(values.device), self._missing.to(values.device)
        arranged = values.index_select(-1, columns).unflatten(-1, missing.shape)
        return arranged.masked_fill(missing, _ABSENT)


def without_illegal(logits: Tensor, mask: Tensor) -> Tensor:
    """Return logits [..., P] whose softmax gives probability 0 where `mask` [..., P] bool is False."""
    return logits.masked_fill(~mask, _ABSENT)


def _chosen(log_probs: Tensor, actions: Tensor) -> Tensor:
    return log_probs.gather(-1, actions.unsqueeze(-1)).squeeze(-1).sum(-1)


def _entropy(log_probs: Tensor) -> Tensor:
    return -(log_probs.exp() * log_probs).sum(-1).sum(-1)


def _padded(counts: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return, for each variable and choice, its index among all choices [D * A], and where there is none [D, A]."""
    variables, values = variables_and_values(counts)
    columns = torch.zeros((len(counts), max(counts)), dtype=torch.int64)
    missing = torch.ones_like(columns, dtype=torch.bool)
    columns[variables, values] = torch.arange(len(variables))
    missing[variables, values] = False
    return columns.flatten(), missing
