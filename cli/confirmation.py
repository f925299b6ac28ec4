"""Confirmation of a solved run: new sampled episodes with the policy at which training stopped.

Training stops as soon as the mean of the newest episodes reaches the target. This is more probable in a lucky moment,
so the mean of that moment is too high on average. New episodes have no such bias.
"""

import math
from statistics import NormalDist
from typing import Any

from daedalus.protocol.spec import RunSpec

_SEEDS = 2**34  # added to the seed of the run: no other evaluation of the run and no training uses these seeds


def confirmation_arguments(spec: RunSpec) -> list[str]:
    """Return the options of `daedalus evaluate` that confirm the newest policy of a run, without its directory."""
    training = spec.training
    options = ["--newest", "--actions", "sampled", "--backend", spec.environment.backend]
    return [*options, "--episodes", str(training.target_episodes), "--seed", str(training.seed + _SEEDS)]


def confirmation(result: dict[str, Any]) -> dict[str, Any]:
    """Return the result of `daedalus evaluate` with `interval`, the 95 % interval of the mean (None of one episode)."""
    return {**result, "interval": mean_interval(result["return_mean"], result["return_std"], result["episodes"])}


def mean_interval(mean: float, std: float, count: int) -> tuple[float, float] | None:
    """Return the 95 % interval of a mean over `count` values, or None for a single value.

        mean +- t s / sqrt(n),  s^2 = n / (n - 1) std^2

    with the 97.5 % quantile t of Student's distribution, n - 1 degrees of freedom.

    Args:
      mean, std: of the values; std is that of the values themselves, with n in the denominator.
    """
    if count < 2:
        return None
    error = _t_quantile(count - 1) * std / math.sqrt(count - 1)
    return mean - error, mean + error


def _t_quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t. Exact for 1 and 2 degrees of freedom, within 0.5 % for more.

    Abramowitz & Stegun (1964), equation 26.7.5.
    """
    if freedom <= 2:
        return (12.7062, 4.3027)[freedom - 1]
    z = NormalDist().inv_cdf(0.975)
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
    )
    return sum(term / freedom**power for power, term in enumerate(terms))
