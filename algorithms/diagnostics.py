"""Diagnostics of a batch before its first update: how far the behaviour policy is, and how wrong the critic. Pure."""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.losses import explained_variance, mean, shares_of, variance
from daedalus.protocol.spaces import Spaces


class ActionCounts:
    """Counts over batches, on a device."""

    def __init__(self, spaces: Spaces, device: torch.device) -> None:
        discrete = spaces.discrete_actions.items()
        self._counts = {name: torch.zeros(space.choices, dtype=torch.int64, device=device) for name, space in discrete}
        self._first_choices = {  # of each variable among all choices of its component
            name: torch.tensor([0, *itertools.accumulate(space.counts[:-1])], device=device) for name, space in discrete
        }

    def add(self, batch: Batch) -> None:
        """Count the actions of the valid rows of a batch."""
        for name, counts in self._counts.items():
            choices = batch.actions[name].to(counts.device) + self._first_choices[name]  # [T, B, D]
            weights = batch.valid.to(counts.device).unsqueeze(-1).expand(choices.shape)
            counts += torch.bincount(choices.flatten(), weights.flatten(), len(counts)).to(torch.int64)

    def merge(self, counts: dict[str, torch.Tensor]) -> None:
        """Add counts by component, [choices] int64."""
        for name, own in self._counts.items():
            own += counts[name].to(own.device)

    def take(self) -> dict[str, list[int]]:
        """Return the counts by component since the last call."""
        taken = {name: counts.tolist() for name, counts in self._counts.items()}
        for counts in self._counts.values():
            counts.zero_()
        return taken


BATCH_METRICS = ("explained_variance", "value_mean", "advantage_std")
VALUE_ERROR_QUANTILES = {"value_error_p05": 0.05, "value_error_p50": 0.5, "value_error_p95": 0.95}


class FirstPass(NamedTuple):
    """A batch as the network saw it before its first update. All [T, B], without gradients."""

    log_probs: Tensor | None  # log pi(a_t | s_t) of the target policy; None for action values: it is greedy
    behaviour_log_probs: Tensor  # log mu(a_t | s_t)
    values: Tensor  # V(s_t), or Q(s_t, a_t)
    targets: Tensor  # value targets
    advantages: Tensor  # before they are normalised
    valid: Tensor  # float32, 1 or 0


def batch_metrics(first: FirstPass) -> Tensor:
    """Return BATCH_METRICS [3] of a batch."""
    shares = shares_of(first.valid)
    return torch.stack(
        [
            explained_variance(first.values, first.targets, shares),
            mean(first.values, shares),
            variance(first.advantages, shares).sqrt(),
        ]
    )


def diagnostics(first: FirstPass, rho_clip: float | None) -> dict[str, float]:
    """Return the diagnostics of a batch by name; empty for a batch without valid rows.

    `rho_clip` is V-trace's bound of rho, or None for an algorithm that does not correct for the policy lag.
    """
    rows = first.valid > 0.0
    errors = (first.targets - first.values)[rows]  # [N]
    if not len(errors):
        return {}
    measured: dict[str, Tensor] = {}
    if first.log_probs is not None:
        log_ratios = (first.log_probs - first.behaviour_log_probs)[rows]  # [N]
        ratios = log_ratios.exp()
        measured["behaviour_kl"] = behaviour_kl(log_ratios)
        measured["rho_mean"] = ratios.mean()
        measured["rho_effective_share"] = effective_sample_share(log_ratios)
        if rho_clip is not None:
            measured["rho_clipped_fraction"] = (ratios > rho_clip).float().mean()
    quantiles = torch.quantile(errors, errors.new_tensor(list(VALUE_ERROR_QUANTILES.values())))
    measured.update(zip(VALUE_ERROR_QUANTILES, quantiles, strict=True))
    return {name: float(value) for name, value in measured.items()}


def behaviour_kl(log_ratios: Tensor) -> Tensor:
    """Return an estimate of KL(mu || pi) in nats: the mean of rho - 1 - log rho.

    It is unbiased, never negative, and needs no probabilities of the actions that were not chosen.
    Schulman (2020), "Approximating KL divergence", the estimator k3.

    Args:
      log_ratios: [N], log rho = log pi(a | s) - log mu(a | s) of actions of the behaviour policy mu.
    """
    return (log_ratios.exp() - 1.0 - log_ratios).mean()


def effective_sample_share(log_ratios: Tensor) -> Tensor:
    """Return the effective sample size of the weights rho, as a share of the N rows.

        (sum rho)^2 / (N sum rho^2)

    It is 1 on-policy, and 1/N if one row outweighs all others. Owen (2013), "Monte Carlo theory, methods and examples",
    equation 9.13. The largest weight is divided out first, so that no square overflows.

    Args:
      log_ratios: [N], log rho.
    """
    weights = (log_ratios - log_ratios.max()).exp()
    return weights.sum().square() / (len(weights) * weights.square().sum())
