"""Returns and lengths of the running episodes of E environments. Pure state."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedEpisodes:
    """K episodes, in the order in which they ended."""

    returns: np.ndarray  # [K] float64, undiscounted and unscaled
    lengths: np.ndarray  # [K] int32, env_steps


class EpisodeCounter:
    """The running returns and lengths of E environments' episodes, and those of the episodes that ended."""

    def __init__(self, count: int) -> None:
        self._returns = np.zeros(count, np.float64)
        self._lengths = np.zeros(count, np.int32)
        self._ended = np.zeros(count, np.bool_)
        self._finished: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def valid(self) -> np.ndarray:
        """[E] bool: whether the next step is a real one and not the reset after an episode's end."""
        return ~self._ended

    def step(self, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> None:
        """Count one row: unscaled rewards [E], terminated [E], truncated [E]."""
        self._returns += rewards
        self._lengths += ~self._ended
        self._ended = terminated | truncated
        if self._ended.any():
            self._finished.append((self._returns[self._ended], self._lengths[self._ended]))
            self._returns[self._ended] = 0.0
            self._lengths[self._ended] = 0

    def cut(self) -> None:
        """Note that all episodes ended with the row that was counted last."""
        self._finished.append((self._returns.copy(), self._lengths.copy()))
        self.restart()
        self._ended[:] = True

    def restart(self) -> None:
        """Forget the running episodes: others begin."""
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._ended[:] = False

    def take_finished(self) -> FinishedEpisodes:
        """Return the episodes that ended since the last call."""
        finished, self._finished = self._finished, []
        returns, lengths = zip(*finished, strict=True) if finished else ((), ())
        return FinishedEpisodes(
            returns=np.concatenate([np.zeros(0), *returns]),
            lengths=np.concatenate([np.zeros(0, np.int32), *lengths]),
        )
