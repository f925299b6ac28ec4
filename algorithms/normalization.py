"""Running statistics of observations and returns, and the normalisation of rewards. State; no I/O, no threads."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.running_returns import RunningReturns
from daedalus.policy.network.normalization import ObservationNormalizer
from daedalus.protocol.uploads import Rollout

_LARGEST_REWARD = 10.0  # normalised rewards are clipped to +- this value
_LARGEST_MEAN = 5.0  # of the scaled returns: that of episodes of a thousand equal rewards, at a discount factor of 0.99
_PART_NUMBERS = 4 << 20  # numbers whose moments are computed at a time
_LOADED_COUNT = 100_000  # how many observations loaded statistics stand for: new ones change them slowly


class Moments(NamedTuple):
    """Number, mean and sum of squared deviations of some values, in float64."""

    number: int
    mean: Tensor  # [*shape]
    squares: Tensor  # [*shape]


def moments_of(values: Tensor) -> Moments:
    """Return the moments of values [N, *shape]; those of no values are 0."""
    rows = max(_PART_NUMBERS // max(values[:1].numel(), 1), 1)
    if len(values) > rows:  # in float64 all of them, such as a batch of images, could take gigabytes
        merged = RunningMoments(tuple(values.shape[1:]))
        for part in values.split(rows):
            merged.add(part)
        return Moments(len(values), merged.mean, merged.squares)
    values = values.to("cpu", torch.float64)
    mean = values.mean(0) if len(values) else values.new_zeros(values.shape[1:])
    return Moments(len(values), mean, (values - mean).square().sum(0))


class RunningMoments:
    """Mean and variance of all values seen, each value weighted equally, in float64.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1979).
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mean = torch.zeros(shape, dtype=torch.float64)
        self.squares = torch.zeros(shape, dtype=torch.float64)  # sum of squared deviations from the mean
        self.count = torch.zeros((), dtype=torch.float64)

    @property
    def variance(self) -> Tensor:
        """Variance [*shape]; 1 before any value was seen."""
        return self.squares / self.count if self.count > 0 else torch.ones_like(self.squares)

    def add(self, values: Tensor) -> None:
        """Add values [N, *shape]."""
        self.merge(moments_of(values))

    def merge(self, others: Moments) -> None:
        """Add the values that the moments are of."""
        number = others.number
        if not number:
            return
        total, difference = self.count + number, others.mean - self.mean
        self.squares += others.squares + difference.square() * self.count * number / total
        self.mean += difference * number / total
        self.count += number

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint."""
        return {"mean": self.mean, "squares": self.squares, "count": self.count}


class ObservationStatistics:
    """The statistics of a network's ObservationNormalizer, updated from batches."""

    def __init__(self, normalizer: ObservationNormalizer) -> None:
        self._normalizer = normalizer
        self.moments = {
            name: RunningMoments(tuple(scale.shape))
            for name, scale in zip(normalizer.names, normalizer.scales, strict=True)
        }

    def take_from_network(self) -> None:
        """Continue from the normaliser's statistics, which came with weights, as if they were of many observations."""
        for name, moments in self.moments.items():
            mean, variance = self._normalizer.statistics(name)
            moments.mean.copy_(mean)
            moments.squares.copy_(variance * _LOADED_COUNT)
            moments.count.fill_(_LOADED_COUNT)

    def add(self, batch: Batch) -> None:
        """Add the observations of the valid rows, and set the normaliser's statistics.

        Call after the updates of the batch: they learn with the statistics that the actors acted with.
        """
        self.merge([self.moments_of(batch)])

    def moments_of(self, batch: Batch) -> dict[str, Moments]:
        """Return the moments of the observations of the valid rows, by component."""
        rows = batch.valid.bool()
        return {name: moments_of(batch.observations[name][:-1][rows]) for name in self.moments}

    def merge(self, parts: Sequence[dict[str, Moments]]) -> None:
        """Add observations by their moments, and set the normaliser's statistics. See `add`."""
        for name, moments in self.moments.items():
            for part in parts:
                moments.merge(part[name])
            self._normalizer.set_statistics(name, moments.mean, moments.variance)


class RewardNormalizer:
    """Division of rewards by the running standard deviation of the discounted return, or a fifth of its mean.

    The return of row t is G_t = r_t + discount_factor * G_{t-1}, which begins at 0 with each episode: a sum over the
    past, whose deviation is that of the values to within the mean (Engstrom et al. 2020, section 3). It runs on from
    rollout to rollout (algorithms/running_returns.py). The mean counts where it is large beside the deviation, such as
    with episodes of one step whose rewards are 100 and 101: divided by their deviation, all would be clipped to the
    same value.
    """

    def __init__(self, discount_factor: float, *, synchronous: bool = False) -> None:
        """Construct the normaliser. `synchronous`: whether the run makes its actors wait for each update."""
        self.moments = RunningMoments(())
        self._returns = RunningReturns(discount_factor, synchronous=synchronous)

    def add(self, rollouts: Sequence[Rollout]) -> None:
        """Add the returns of rollouts to the statistics."""
        self.moments.merge(self.moments_of(rollouts))

    def moments_of(self, rollouts: Sequence[Rollout]) -> Moments:
        """Return the moments of the returns of the rows to learn from. Call it once for each rollout, in order."""
        seen = [self._returns.add(rollout)[rollout.learned] for rollout in rollouts]
        return moments_of(torch.from_numpy(np.concatenate(seen)))

    def scale(self, batch: Batch) -> None:
        """Scale the rewards of a batch in place."""
        deviation, mean = float(self.moments.variance.sqrt()), float(self.moments.mean)
        divisor = max(deviation, abs(mean) / _LARGEST_MEAN, 1e-8)
        batch.rewards.div_(divisor).clamp_(-_LARGEST_REWARD, _LARGEST_REWARD)
