"""Running statistics of observations and returns, and the normalisation of rewards. State; no I/O, no threads."""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.running_returns import RunningReturns
from daedalus.policy.network.layers import OneHotCodes
from daedalus.policy.network.observation_normalizer import ObservationNormalizer
from daedalus.protocol.keys import first_of_largest_owner, owner
from daedalus.protocol.uploads import Rollout

_LARGEST_REWARD = 10.0  # normalised rewards are clipped to +- this value
_LARGEST_MEAN = 5.0  # of the scaled returns: that of episodes of a thousand equal rewards, at a discount factor of 0.99
_PART_NUMBERS = 4 << 20  # numbers whose moments are computed at a time
_MOST_VALUES = 1_000_000.0  # that running moments stand for: older ones fade
_VOTES, _MANY_VOTES = 8, 64  # of each actor: on components of many numbers, and of few
_FEW_VOTES = 3  # of other actors, until a vote can be far outside theirs
_VOTE_NUMBERS = 4 << 20  # numbers in the votes of all actors on one component
_LARGEST_RATIO = 10.0  # of a vote that counts in full, to what is confirmed
_FAR = 1e5  # ratio of a vote that is far outside, to all that other actors have shown
_CONSTANT = 1e-9  # ratio of the deviation of a constant to its size: rounding
_RECENT = 4  # times the rows of all votes: moments of no more may be forgotten
_ESTABLISHED = 8192.0  # values, from which on moments are a witness of their own
_NO_SQUARES = torch.zeros((), dtype=torch.float64)
_LOADED_COUNT = 100_000  # how many observations loaded statistics stand for: new ones change them slowly


class Moments(NamedTuple):
    """Number, mean and sum of squared deviations of some values, in float64."""

    number: int | Tensor  # of values, or their weights [*shape]
    mean: Tensor  # [*shape]
    squares: Tensor  # [*shape]


def moments_of(values: Tensor) -> Moments:
    """Return the moments of values [N, *shape]; those of no values are 0."""
    rows = max(_PART_NUMBERS // max(values[:1].numel(), 1), 1)
    if len(values) > rows:  # in float64 all of them, such as a batch of images, could take gigabytes
        merged = RunningMoments(tuple(values.shape[1:]), most=math.inf)
        for part in values.split(rows):
            merged.add(part)
        return Moments(len(values), merged.mean, merged.squares)
    values = values.to("cpu", torch.float64)
    mean = values.mean(0) if len(values) else values.new_zeros(values.shape[1:])
    return Moments(len(values), mean, (values - mean).square().sum(0))


class RunningMoments:
    """Mean and variance of all values seen, in float64.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1979). Each value has the same weight until
    there are `most`; from then on the older ones fade, as if only the newest `most` had been seen.
    """

    def __init__(self, shape: tuple[int, ...], *, most: float = _MOST_VALUES) -> None:
        self.mean = torch.zeros(shape, dtype=torch.float64)
        self.squares = torch.zeros(shape, dtype=torch.float64)  # sum of squared deviations from the mean
        self.count = torch.zeros(shape, dtype=torch.float64)
        self._most = most

    @property
    def variance(self) -> Tensor:
        """Variance [*shape]; 1 before any value was seen."""
        return torch.where(self.count > 0, self.squares / self.count.clamp(min=1e-300), 1.0)

    def add(self, values: Tensor) -> None:
        """Add values [N, *shape]."""
        self.merge(moments_of(values))

    def merge(self, others: Moments) -> None:
        """Add the values that the moments are of."""
        number = torch.as_tensor(others.number, dtype=torch.float64)
        kept = ((self._most - number) / self.count.clamp(min=1.0)).clamp(0.0, 1.0)
        self.count *= kept
        self.squares *= kept
        total, difference = (self.count + number).clamp(min=1e-300), others.mean - self.mean
        self.squares += others.squares + difference.square() * self.count * number / total
        self.mean += difference * number / total
        self.count += number

    def forget(self, which: Tensor) -> None:
        """Forget all that was seen in some of the numbers, a mask [*shape]."""
        for values in (self.mean, self.squares, self.count):
            values.masked_fill_(which, 0.0)

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint."""
        return {"mean": self.mean, "squares": self.squares, "count": self.count}


class ConfirmedRange:
    """The range of the numbers of one component, by the word of more than one rollout and more than one actor.

    Running moments weigh every value equally, so that a single rollout of 1e15 would fix them for the rest of a run.
    Here each rollout is a *vote*: in each number, its mean m, its deviation s and its magnitude (m^2 + s^2)^(1/2). An
    actor has its newest 8 votes, 64 of components with few numbers, and an *owner* (protocol/keys.py) those of its
    actors. Of the votes of an actor, and of the actors of an owner, the largest one does not count; of the owners the
    largest eighth, rounded up. What is left is *confirmed*. (One vote, actor or owner alone counts.) With

        c = the median of the owners' medians of m
        d = ((m - c)^2 + s^2)^(1/2), of each vote
        R = the confirmed d; max(1, |c|) in a number that was constant

    a vote counts with f = min(1, 10 R / d): its n values as f n, their distances from c multiplied by f. So its weight
    falls as its size grows, and nothing adds more than 10 R to a deviation. Within 10 R, which means in nearly all of
    training, nothing is changed. Numbers that grow are followed as soon as they are confirmed: by a second owner, or by
    the second rollout of the only actor.

    Moments ten times above all that an actor has ever shown twice (of more than two owners: that two have shown), or
    1e5 times above what the present votes confirm, are of a past that nothing confirms, such as a bad first rollout.
    They are forgotten, unless they are of far more rows than the votes. And a vote 1e5 times above everything that any
    *other* actor has ever shown, and above 1, is far outside: it is none, and its rollout has nothing to learn from. A
    single actor has no others. Unless most of the other owners have shown such a size too, or been far outside with it:
    then it is rare, and real.

    The votes are not saved: after a resume, the restored moments stand in for them until an actor has 8 votes or there
    is a second one.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        numbers = max(math.prod(shape), 1)
        self._votes = min(max(_MANY_VOTES * 16 // numbers, _VOTES), _MANY_VOTES)  # of each actor
        self._most_voters = min(max(_VOTE_NUMBERS // (2 * self._votes * numbers), 2), 64)
        self._voters: dict[str, _Voter] = {}  # by actor, the one that was heard last at the end
        self._heard = 0  # votes so far
        self._far: dict[str, np.ndarray] = {}  # largest magnitudes [*shape] that were far outside, by owner
        self._summary: _Summary | None = None

    def add(self, actor: str, vote: "_Vote") -> None:
        """Add a rollout's vote of its actor."""
        if not math.isfinite(vote.largest):
            return
        voter = self._voters.pop(actor, None) or _Voter(self._votes, vote.mean.shape)
        self._heard += 1
        voter.add(vote, self._heard)
        self._voters[actor] = voter
        silent = self._heard - 32 * len(self._voters)
        while self._voters[oldest := next(iter(self._voters))].heard < silent:
            self.forget(oldest)
        if len(self._voters) > self._most_voters:
            self.forget(first_of_largest_owner(self._voters))
        if self._summary is not None and self._heard >= self._summary.heard + len(self._voters):
            self._summary = None  # in a large fleet it is computed after many votes

    def forget(self, actor: str) -> None:
        """Forget all votes of an actor."""
        if self._voters.pop(actor, None) is not None:
            self._summary = None

    def is_far(self, actor: str, vote: "_Vote") -> bool:
        """Return whether a vote is far outside all that the other actors have shown."""
        if not vote.largest > _FAR:
            return False
        magnitude = vote.magnitude
        others = [voter for name, voter in self._voters.items() if name != actor]
        if sum(voter.number for voter in others) < _FEW_VOTES:
            return False
        largest = np.max([voter.largest for voter in others], 0).clip(min=1.0)
        if not (magnitude > _FAR * largest).any():
            return False
        known = self._shown_by_most(owner(actor))
        claimed = np.maximum(magnitude, self._far.pop(owner(actor), magnitude))
        self._far[owner(actor)] = claimed
        if len(self._far) > self._most_voters:
            del self._far[next(iter(self._far))]
        return bool((magnitude > np.maximum(_FAR * largest, _LARGEST_RATIO * known)).any())

    def _shown_by_most(self, but: str) -> np.ndarray:
        """Return the magnitude that more than half of the owners but one have shown, in votes or far outside."""
        shown = {name: value for name, value in self._far.items() if name != but}
        for name, voter in self._voters.items():
            if owner(name) != but:
                shown[owner(name)] = np.maximum(voter.largest, shown.get(owner(name), voter.largest))
        return np.sort(list(shown.values()), 0)[(len(shown) - 1) // 2] if shown else np.zeros(())

    def forget_unconfirmed(self, moments: RunningMoments) -> None:
        """Forget running moments that are far above all votes, if these are of enough rows to say so."""
        if not self._voters:
            return
        summary = self._summarized()
        mean, variance, count = moments.mean.numpy(), moments.variance.numpy(), moments.count.numpy()
        magnitude = np.sqrt(mean**2 + variance)
        unconfirmed = (magnitude > np.minimum(_LARGEST_RATIO * summary.shown, _FAR * summary.recent)) & (count > 0)
        if unconfirmed.any():
            moments.forget(torch.from_numpy(np.asarray(unconfirmed & (summary.rows >= count / _RECENT))))

    def shares(self, moments: Moments, past: RunningMoments | None) -> tuple[np.ndarray, np.ndarray]:
        """Return c and f of the moments of a rollout, each [*shape]; `past`: what they are about to be added to."""
        mean = moments.mean.numpy()
        if not self._voters or not moments.number:
            return mean, np.ones_like(mean)
        summary = self._summarized()
        center, most = summary.center, summary.most
        if past is not None and (summary.is_even or summary.is_few):  # the past decides between two halves
            known, past_mean = past.count.numpy() >= _ESTABLISHED, past.mean.numpy()
            decided = past_mean if summary.is_few else _median([*summary.centers, past_mean])
            scale = summary.scale
            if (known & (decided != center)).any():
                center = np.where(known, decided, center)
                scale = self._scale(center)
            if summary.is_few:
                scale = np.where(known, np.minimum(scale, past.variance.sqrt().numpy()), scale)
            most = _most(center, scale)
        distance = np.sqrt((mean - center) ** 2 + _variance(moments))
        return center, most / np.maximum(distance, most)

    def moderated(self, moments: Moments, past: RunningMoments | None = None) -> Moments:
        """Return the moments of a rollout as they count; see the class."""
        center, shares = self.shares(moments, past)
        if (shares == 1.0).all():
            return moments
        share, middle = torch.from_numpy(np.asarray(shares)), torch.from_numpy(np.asarray(center))
        mean = torch.where(share < 1.0, middle + share * (moments.mean - middle), moments.mean)
        # Squares are a sum over the rows, which are fewer as well.
        return Moments(moments.number * share, mean, share**3 * moments.squares)

    def _summarized(self) -> "_Summary":
        if self._summary is None:
            voters = list(self._voters.values())
            centers = self._of_owners(_median, lambda voter: _median(voter.means))
            recent = self._of_owners(_confirmed, lambda voter: _confirmed(voter.magnitudes))
            shown = self._of_owners(lambda values: np.max(values, 0), lambda voter: voter.second)
            apart = _VOTES if len(centers) > 2 else 0  # of two owners, either may be right
            center = _median(centers)
            scale = self._scale(center)
            self._summary = _Summary(
                heard=self._heard,
                centers=centers,
                center=center,
                scale=scale,
                most=_most(center, scale),
                recent=_confirmed(recent, most=apart).clip(min=1.0),
                shown=_confirmed(shown, most=apart).clip(min=1.0),
                rows=sum(sum(voter.rows) for voter in voters),
                is_few=len(voters) == 1 and voters[0].number < _VOTES,
            )
        return self._summary

    def _scale(self, center: np.ndarray) -> np.ndarray:
        """Return R [*shape], 0 in a number that was constant."""

        def of_voter(voter: _Voter) -> np.ndarray:
            return _confirmed(np.sqrt((voter.means - center) ** 2 + voter.variances))

        return _confirmed(self._of_owners(_confirmed, of_voter), most=_VOTES)

    def _of_owners(
        self, together: Callable[[list[np.ndarray]], np.ndarray], each: Callable[["_Voter"], np.ndarray]
    ) -> list[np.ndarray]:
        """Return what each owner's actors show together."""
        of_owners: dict[str, list[np.ndarray]] = {}
        for name, voter in self._voters.items():
            of_owners.setdefault(owner(name), []).append(each(voter))
        return [together(values) for values in of_owners.values()]


class _Vote(NamedTuple):
    """The moments of a rollout; arrays [*shape]."""

    rows: int
    mean: np.ndarray
    variance: np.ndarray
    magnitude: np.ndarray
    largest: float  # magnitude


def _vote(moments: Moments) -> _Vote:
    mean, variance = moments.mean.numpy(), _variance(moments)
    magnitude = np.sqrt(mean**2 + variance)
    return _Vote(int(moments.number), mean, variance, magnitude, float(magnitude.max(initial=0.0)))


class _Voter:
    """The newest votes of one actor."""

    def __init__(self, votes: int, shape: tuple[int, ...]) -> None:
        self._means, self._variances = np.empty((2, votes, *shape))
        self.rows: deque[int] = deque(maxlen=votes)
        self.largest = self.second = np.zeros(())  # largest magnitudes [*shape] that it has ever shown
        self.number = 0  # of its votes that are kept
        self.heard = 0
        self._next = 0  # where the next vote is written

    def add(self, vote: _Vote, heard: int) -> None:
        self._means[self._next], self._variances[self._next] = vote.mean, vote.variance
        self._next = (self._next + 1) % len(self._means)
        self.rows.append(vote.rows)
        self.number = len(self.rows)
        twice = np.minimum(vote.magnitude, self.largest)
        self.second = np.maximum(self.second, twice) if self.heard else vote.magnitude
        if self.number == 2:  # the first vote was the only one
            self.second = twice
        self.largest = np.maximum(vote.magnitude, self.largest)
        self.heard = heard

    @property
    def means(self) -> np.ndarray:
        """Means of the votes [votes, *shape]."""
        return self._means[: self.number]

    @property
    def variances(self) -> np.ndarray:
        """Variances of the votes [votes, *shape]."""
        return self._variances[: self.number]

    @property
    def magnitudes(self) -> np.ndarray:
        """Magnitudes of the votes [votes, *shape]."""
        return np.sqrt(self.means**2 + self.variances)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Summary:
    """What the votes say together; arrays [*shape]."""

    heard: int  # votes when it was made
    centers: list[np.ndarray]  # of the owners
    center: np.ndarray  # c
    scale: np.ndarray  # R, 0 in a number that was constant
    most: np.ndarray  # distance from c within which a vote counts in full
    recent: np.ndarray  # magnitude that the votes of one actor confirm, at least 1
    shown: np.ndarray  # magnitude that one actor has ever shown twice, at least 1
    rows: int  # of all votes
    is_few: bool  # one actor, with few votes

    @property
    def is_even(self) -> bool:
        return len(self.centers) % 2 == 0


def _most(center: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the distance from c within which a vote counts in full, by R."""
    size = np.abs(center).clip(min=1.0)
    return _LARGEST_RATIO * np.where(scale > _CONSTANT * size, scale, size)


def _confirmed(values: Sequence[np.ndarray] | np.ndarray, most: int = 1) -> np.ndarray:
    """Return the largest of values [N, *shape] without the largest eighth, rounded up to at most `most`; of one, it."""
    number = len(values)
    if number == 1:
        return values[0]
    last = number - 1 - min((number + 6) // 8, most)
    return np.partition(np.asarray(values), last, 0)[last]


def _median(values: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Return the median of values [N, *shape]; of the two in the middle the one nearer to 0."""
    if len(values) == 1:
        return np.array(values[0])  # a copy: votes are overwritten
    ordered = np.sort(np.asarray(values), 0)
    lower, upper = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return np.where(np.abs(lower) <= np.abs(upper), lower, upper)


def _variance(moments: Moments) -> np.ndarray:
    return moments.squares.numpy() / float(moments.number)


class ConfirmedRanges:
    """The ranges of all components that actors send numbers of, by name. State; no I/O."""

    def __init__(self) -> None:
        self._ranges: dict[str, ConfirmedRange] = {}

    def vote(self, actor: str, moments: Mapping[str, Moments]) -> str:
        """Add the moments of a rollout as votes of its actor, and return an empty string.

        If one of them is far outside, return the name of its component instead, and forget all votes of the actor.
        """
        for name, each in moments.items():
            if name not in self._ranges:
                self._ranges[name] = ConfirmedRange(tuple(each.mean.shape))
        votes = {name: _vote(each) for name, each in moments.items() if each.number}
        far = next((name for name, vote in votes.items() if self._ranges[name].is_far(actor, vote)), "")
        for name, each in self._ranges.items():
            if far and name in moments:
                each.forget(actor)
            elif name in votes:
                each.add(actor, votes[name])
        return far

    def merge(self, name: str, moments: Sequence[Moments], into: RunningMoments) -> None:
        """Add the moments of rollouts to running ones, each as it counts. Call after `vote`."""
        self._ranges[name].forget_unconfirmed(into)
        for each in moments:
            into.merge(self._ranges[name].moderated(each, into))

    def share(self, name: str, moments: Moments) -> float:
        """Return with how much of their size the numbers of a rollout count, from 0 to 1. Call after `vote`."""
        return float(self._ranges[name].shares(moments, None)[1].min())

    def moderated(self, name: str, number: float) -> float:
        """Return a number that an actor states of a rollout, as it counts. Call after `vote`."""
        return float(self._ranges[name].moderated(one(number)).mean)


def one(number: float) -> Moments:
    """Return the moments of one number, with which an actor votes on it."""
    return Moments(1, torch.tensor(number, dtype=torch.float64), _NO_SQUARES)


def observations_name(component: str) -> str:
    """Return the name of the moments of an observation component, in gradients and events."""
    return f"observations/{component}"


class ObservationStatistics:
    """The statistics of a network's ObservationNormalizer, updated from batches."""

    def __init__(self, normalizer: ObservationNormalizer, codes: OneHotCodes) -> None:
        self._normalizer, self._codes = normalizer, codes
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

    def moments_of(self, batch: Batch, columns: slice = slice(None)) -> dict[str, Moments]:
        """Return the moments of the observations of the valid rows of some environments, by component."""
        rows = batch.valid[:, columns].bool()
        return self._moments_of({name: batch.observations[name][:-1, columns][rows] for name in self.moments})

    def _moments_of(self, observations: Mapping[str, Tensor]) -> dict[str, Moments]:
        encoded = self._codes({name: observations[name] for name in self.moments})
        return {name: moments_of(values) for name, values in encoded.items()}

    def merge(self, parts: Mapping[str, Sequence[Moments]], ranges: ConfirmedRanges) -> None:
        """Add observations by the moments of their rollouts, by component, and set the normaliser's statistics.

        Call after the updates of the batch: they learn with the statistics that the actors acted with.
        """
        for name, moments in self.moments.items():
            ranges.merge(observations_name(name), parts[name], moments)
            self._normalizer.set_statistics(name, moments.mean, moments.variance)

    def add(self, observations: Mapping[str, Tensor]) -> None:
        """Add observations that nobody doubts, by component [N, *stacked_shape], and set the statistics."""
        for name, others in self._moments_of(observations).items():
            moments = self.moments[name]
            moments.merge(others)
            self._normalizer.set_statistics(name, moments.mean, moments.variance)

    def reset(self) -> None:
        """Forget all observations."""
        for name, moments in self.moments.items():
            moments.forget(moments.count > 0)
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

    def moments_of(self, rollouts: Sequence[Rollout]) -> Moments:
        """Return the moments of the returns of the rows to learn from. Call it once for each rollout, in order.

        A return that goes on into the next rollout counts with at most ten times the size of those seen so far: one
        false reward must not spoil all later rollouts of the episode.
        """
        seen_before = float((self.moments.mean.square() + self.moments.variance).sqrt())
        largest = _LARGEST_RATIO * max(seen_before, 1.0) if self.moments.count > 0 else math.inf
        seen = [self._returns.add(rollout, largest)[rollout.learned] for rollout in rollouts]
        return moments_of(torch.from_numpy(np.concatenate(seen)))

    @property
    def divisor(self) -> float:
        """The number that rewards are divided by."""
        return max(float(self.moments.variance.sqrt()), abs(float(self.moments.mean)) / _LARGEST_MEAN, 1e-8)

    def scale(self, batch: Batch) -> None:
        """Scale the rewards of a batch in place."""
        batch.rewards.div_(self.divisor).clamp_(-_LARGEST_REWARD, _LARGEST_REWARD)

    def reset(self) -> None:
        """Forget all returns."""
        self.moments.forget(self.moments.count > 0)
