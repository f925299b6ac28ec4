"""Curiosity: a reward for observations that are new in their episode. State; no threads."""

import logging
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.normalization import RewardNormalizer
from daedalus.algorithms.running_returns import Streams
from daedalus.protocol.uploads import Rollout

METRICS = ("first_visit_fraction", "curiosity_reward_mean")
_MOST_OBSERVATIONS = 2_000_000  # of all running episodes together, about 200 MB
_SIZE = 8  # of the set of an episode itself, in observations
_JUDGED_ROWS = 4096  # the first ones
_LARGEST = 10.0  # reward at a weight of 1, as that of normalised rewards
_EPISODES = 100
_FEWEST_EPISODES = 20  # whose totals say something
_DROP = 0.5  # of the mean return below its best, in deviations of returns, at which nothing is rewarded
_DEVIATION = 0.25  # of the totals, below which the reward shrinks
_MOST_NEW = 0.95  # share of first visits, above which observations do not come back, and nothing is rewarded

_logger = logging.getLogger(__name__)


class FirstVisits:
    """The observations that the running episodes have had, and so which rows lead to one that is new in its episode.

    Two observations are the same if their newest frames have the same bytes. An episode whose earlier rollouts were
    dropped, or came before a restart of the learner, begins without observations.
    """

    def __init__(self, *, synchronous: bool = False) -> None:
        """Construct it. `synchronous`: whether the run makes its actors wait for each update."""
        self._streams = Streams[list[set[int]]](synchronous=synchronous, most=_MOST_OBSERVATIONS)
        self.totals = deque[int](maxlen=_EPISODES)  # different observations of each of the newest episodes that ended
        self._has_warned = False

    def add(self, rollout: Rollout) -> np.ndarray:
        """Return 1 where the next observation is new in its episode, else 0: [T, E]. Call once a rollout, in order."""
        seen = self._streams.take(rollout)
        if seen is None or len(seen) != rollout.environments:
            seen = [set[int]() for _ in range(rollout.environments)]
        codes = _codes(rollout)
        first = np.zeros(rollout.rewards.shape, np.float32)
        for environment, known in enumerate(seen):
            known.add(codes[0][environment])
            for row in range(rollout.rows):
                code = codes[row + 1][environment]
                if not rollout.valid[row, environment]:  # the next observation is the first of another episode
                    self.totals.append(len(known))
                    known.clear()
                elif code not in known:
                    first[row, environment] = 1.0
                known.add(code)
        self._streams.put(rollout, seen, size=sum(map(len, seen)) + _SIZE * len(seen))
        if self._streams.has_forgotten and not self._has_warned:
            self._has_warned = True
            _logger.warning(
                "curiosity remembers at most %s observations of all running episodes, and has forgotten those of some "
                "environments: their next rollouts are rewarded as if their episodes began there",
                f"{_MOST_OBSERVATIONS:,}",
            )
        return first


def _codes(rollout: Rollout) -> list[list[int]]:
    """Return a checksum of the newest frames of each row and environment, [T+1][E]."""
    rows = rollout.rows + 1
    codes = [[0] * rollout.environments for _ in range(rows)]
    for frames in rollout.frames.values():
        for row, newest in zip(codes, frames[len(frames) - rows :], strict=True):
            for environment, frame in enumerate(newest):
                row[environment] = zlib.crc32(frame.tobytes(), row[environment])
    return codes


class Curiosity:
    """Rewards for first visits, which the learner adds to those of the environment.

        b_t = w min(1 / d, 10) min(4 v, 1) max(1 - 2 f, 0) if s_{t+1} is new in its episode, else 0

    w is the weight, and d the running deviation of the discounted sum of first visits, or a fifth of its mean, as for
    the rewards of the environment (RewardNormalizer). v is the deviation of the number of different observations of an
    episode, over the newest 100: where it is 0, no way to act finds more. f is how far the mean return of the newest
    100 episodes is below its best, in deviations of the returns at that time; after Chen et al. (2022), "Redeeming
    Intrinsic Rewards via Constrained Optimization". Where nearly every observation is new, b would reward long episodes
    alone: after the first rows it is 0, until a resume. Where each episode has another map, prediction errors add
    nothing: Wang et al. (2023), "Revisiting Intrinsic Reward for Exploration in Procedurally Generated Environments".
    """

    def __init__(self, discount_factor: float, *, synchronous: bool = False) -> None:
        """Construct it. `synchronous`: whether the run makes its actors wait for each update."""
        self._visits = FirstVisits(synchronous=synchronous)
        self._scale = RewardNormalizer(discount_factor, synchronous=synchronous)
        self._newest: dict[Rollout, np.ndarray] = {}  # first visits of the newest batch
        self._factor = 0.0  # of the newest batch
        self._rows = self._new = 0  # among the first rows; it has judged them if there are enough
        self._rewards = True
        self._returns = deque[float](maxlen=_EPISODES)  # of the environment, of the newest episodes
        self._best = torch.zeros(3, dtype=torch.float64)  # 1 once there is one, the best mean return, its deviation
        self._ended = 0  # episodes since the last look at their mean

    @property
    def statistics(self) -> dict[str, Tensor]:
        """The running scale and the best mean return, for a checkpoint, by name; restored in place."""
        return {**self._scale.moments.state(), "best": self._best}

    def look(self, rollouts: Sequence[Rollout], weight: float) -> None:
        """Look at the rollouts of a new batch, in order. Their rewards are kept until the next call."""
        self._newest = {each: self._visits.add(each) for each in rollouts}
        counted = [replace(each, rewards=first) for each, first in self._newest.items()]
        self._scale.moments.merge(self._scale.moments_of(counted))
        if self._rows < _JUDGED_ROWS:
            self._judge()
        self._follow(rollouts)
        scale = min(1.0 / self._scale.divisor, _LARGEST)
        self._factor = weight * scale * self._choice() * self._harmless() if self._rewards else 0.0

    def add_to(self, batch: Batch, rollouts: Sequence[Rollout]) -> None:
        """Add the rewards of rollouts to those of their batch in place. Rollouts not looked at have none."""
        column = 0
        for rollout in rollouts:
            if (first := self._newest.get(rollout)) is not None:
                batch.rewards[:, column : column + rollout.environments] += torch.from_numpy(first) * self._factor
            column += rollout.environments

    def metrics(self) -> dict[str, float]:
        """Return METRICS, means over the rows to learn from of the newest batch; empty without such rows."""
        learned = [first[each.learned] for each, first in self._newest.items()]
        if not sum(map(len, learned)):
            return {}
        share = float(np.concatenate(learned).mean())
        return dict(zip(METRICS, (share, share * self._factor), strict=True))

    def _choice(self) -> float:
        """Return the part of the reward that is given, from 0 to 1: how much the episodes differ in what they find."""
        totals = self._visits.totals
        return min(float(np.std(totals)) / _DEVIATION, 1.0) if len(totals) >= _FEWEST_EPISODES else 1.0

    def _follow(self, rollouts: Sequence[Rollout]) -> None:
        """Take note of the returns of the episodes that ended, and of the best mean of as many as are looked at."""
        for each in rollouts:
            self._returns.extend(each.episode_returns.tolist())
            self._ended += len(each.episode_returns)
        if self._ended >= _EPISODES:
            self._ended = 0
            known, best, _ = self._best.tolist()
            if (mean := float(np.mean(self._returns))) > best or not known:
                self._best.copy_(torch.from_numpy(np.array([1.0, mean, np.std(self._returns)])))

    def _harmless(self) -> float:
        """Return the part of the reward that is given, from 0 to 1: less the further the mean return has fallen."""
        known, best, spread = self._best.tolist()
        drop = best - float(np.mean(self._returns)) if known and len(self._returns) == _EPISODES else 0.0
        return 1.0 if drop <= 0.0 else max(1.0 - drop / max(_DROP * spread, 1e-12), 0.0)

    def _judge(self) -> None:
        """Stop rewarding, after enough rows, if observations do not come back."""
        self._rows += sum(int(each.learned.sum()) for each in self._newest)
        self._new += sum(int(first[each.learned].sum()) for each, first in self._newest.items())
        if self._rows >= _JUDGED_ROWS and self._new > _MOST_NEW * self._rows:
            self._rewards = False
            _logger.warning(
                "training.curiosity stops: %.0f %% of the rows lead to an observation that is new in its episode, so "
                "that it would reward little but long episodes. To keep it, let environment.wrap round the "
                "observations or leave out what always changes, such as a clock",
                100.0 * self._new / self._rows,
            )
