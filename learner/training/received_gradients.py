"""Gradients that actors computed, as the learner uses them. Pure functions."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.diagnostics import BATCH_METRICS
from daedalus.algorithms.gradients import Terms
from daedalus.algorithms.normalization import Moments
from daedalus.protocol.uploads import Gradient


def weights_of(gradients: Sequence[Gradient]) -> list[float]:
    """Return the share of each gradient in all env_steps: each valid row then counts once in the mean."""
    total = max(sum(gradient.env_steps for gradient in gradients), 1)
    return [gradient.env_steps / total for gradient in gradients]


def mean_gradient(gradients: Sequence[Gradient], names: Sequence[str]) -> Tensor:
    """Return the weighted mean of float32 gradients [P], added up in the given order.

    Args:
      gradients: those of one batch.
      names: parameters with gradients, in the order of the vector.
    """
    mean = None
    for gradient, weight in zip(gradients, weights_of(gradients), strict=True):
        vector = np.concatenate([gradient.gradient[name].ravel() for name in names]) * np.float32(weight)
        mean = vector if mean is None else mean + vector
    assert mean is not None
    return torch.from_numpy(mean)


def mean_terms(gradients: Sequence[Gradient], device: torch.device) -> Terms:
    """Return the weighted means of the loss terms, on a device."""
    pairs = list(zip(gradients, weights_of(gradients), strict=True))
    return Terms(
        *(
            torch.tensor(sum(float(each.metrics[name]) * share for each, share in pairs), device=device)
            for name in Terms._fields
        )
    )


def batch_metrics_of(gradient: Gradient) -> Tensor | None:
    """Return BATCH_METRICS [3] of the rollout, nan for those that it does not have; None if it has none."""
    given = [float(gradient.metrics.get(name, np.nan)) for name in BATCH_METRICS]
    return None if np.isnan(given).all() else torch.tensor(given)


def diagnostics_of(gradient: Gradient) -> dict[str, float]:
    """Return the diagnostics of a rollout; empty for a rollout without valid rows."""
    others = (*Terms._fields, *BATCH_METRICS)
    return {name: float(value) for name, value in gradient.metrics.items() if name not in others}


def moments_in(gradient: Gradient) -> dict[str, Moments]:
    """Return the moments of the rollout, by name."""
    return {
        name: Moments(gradient.env_steps, *torch.from_numpy(values.copy())) for name, values in gradient.moments.items()
    }
