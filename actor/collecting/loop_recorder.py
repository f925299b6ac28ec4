"""What the loops of clients play, as episodes of a dataset, which a thread of its own writes."""

import logging
import queue
import tempfile
import threading
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.components import leaves, nested, stacked
from daedalus.actor.environments.minari_files import DatasetError, Episode, MinariWriter, new_dataset_folder

_logger = logging.getLogger(__name__)

_BothSpaces = tuple[gymnasium.Space, gymnasium.Space]  # of observations and actions

_MOST_BYTES, _MOST_HELD = 64 << 20, 1 << 30  # of an episode, and of all that are not written yet


class LoopRecorder:
    """Writes the episodes of all agents into one dataset. No call waits for the disk."""

    def __init__(self, name: str) -> None:
        """Begin a dataset; see MinariWriter.

        Raises DatasetError if it exists, or cannot be written, or Minari is not installed.
        """
        folder = new_dataset_folder(name)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:  # now, and not after the first episode
            raise DatasetError(f"dataset {name} cannot be written: {error}") from None
        self._name = name
        self._spaces: _BothSpaces | None = None  # of the first episode
        self._waiting: queue.SimpleQueue[tuple[Episode, int] | None] = queue.SimpleQueue()
        self._held, self._lock = 0, threading.Lock()
        self._complaints = set[str]()
        self._thread: threading.Thread | None = None

    def tape(self, observation_space: gymnasium.Space, action_space: gymnasium.Space) -> "EpisodeTape":
        """Return what records an agent with these spaces, of which no episode may come: a learner may refuse it."""
        return EpisodeTape(self, observation_space, action_space)

    def hold(self, size: int) -> bool:
        """Count bytes of a running episode, or of one that is gone, negative; return whether memory is left."""
        with self._lock:
            self._held += size
            return self._held <= _MOST_HELD

    def add(self, episode: Episode, size: int, spaces: _BothSpaces) -> None:
        """Write an episode, of `size` bytes that are held, soon, unless an earlier one had other spaces."""
        self._spaces = self._spaces or spaces
        if self._spaces != spaces:
            self.warn("its agent has other spaces than the first one")
            self.hold(-size)
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
            self._thread.start()
        self._waiting.put((episode, size))

    def warn(self, reason: str) -> None:
        """Say once why an episode is not recorded."""
        if reason not in self._complaints:
            self._complaints.add(reason)
            _logger.warning("an episode is not recorded: %s; others are not reported again", reason)

    def close(self, seconds: float) -> None:
        """Write what waits, for some seconds at most. Idempotent."""
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join(seconds)

    def _write(self) -> None:
        assert self._spaces is not None
        writer = None
        while (waiting := self._waiting.get()) is not None:
            episode, size = waiting
            try:
                writer = writer or MinariWriter(self._name, *self._spaces, algorithm="a client")
                writer.add(episode)
            except DatasetError as error:
                self.warn(str(error))
            self.hold(-size)
        if writer is not None:
            steps, episodes, folder = writer.steps, writer.episodes, writer.folder
            _logger.info("recorded %s steps in %d episodes: %s", f"{steps:,}", episodes, folder)


class EpisodeTape:
    """The running episode of one agent. For the thread of its loop.

    An episode is handed over when it has ended and the next one begins, because a reward may come after its end.
    """

    def __init__(
        self, recorder: LoopRecorder, observation_space: gymnasium.Space, action_space: gymnasium.Space
    ) -> None:
        """`recorder` takes the episodes."""
        self._recorder, self._observation_space, self._action_space = recorder, observation_space, action_space
        self._bytes = 0
        self._begin()

    def drop(self) -> None:
        """Forget the running episode."""
        self._recorder.hold(-self._bytes)
        self._begin()

    def _begin(self) -> None:
        self._observations: list[Any] = []
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._bytes = 0  # that the recorder holds for it
        self._ended: tuple[bool, bool] | None = None  # terminated, truncated
        self._fault = ""  # why it cannot be recorded

    def act(self, observation: Any, action: Any) -> None:
        """Note the observation of a step and the action that is played in it, by whomever."""
        self.finish()
        if self._fault:
            return
        try:
            played = self._copied(self._action_space, action)
            if not self._action_space.contains(played):
                raise ValueError("an action that was played is outside the action space")
            seen = self._copied(self._observation_space, observation)
        except (ValueError, TypeError) as error:
            self.drop()
            self._fault = str(error)
        else:
            self._observations.append(seen)
            self._actions.append(played)
            self._rewards.append(0.0)

    def _copied(self, space: gymnasium.Space, value: Any) -> Any:
        """Return a value of a space in memory of its own, because loops use arrays again.

        Raises ValueError if it is none, or if too much memory is held.
        """
        parts: dict[tuple[str | int, ...], Any] = {}
        for leaf in leaves(space, "value"):
            try:
                given = leaf.of(value)
            except (TypeError, LookupError):
                raise ValueError(f"an observation or an action that was played lacks {leaf.name!r}") from None
            parts[leaf.path] = copied = given.astype(leaf.space.dtype)[()]
            if copied.dtype.kind in "iub" and not np.array_equal(copied, given):
                raise ValueError(f"a value is none of {leaf.space}")
            self._bytes += copied.nbytes
            if not self._recorder.hold(copied.nbytes) or self._bytes > _MOST_BYTES:
                raise ValueError(
                    f"it has more than {_MOST_BYTES >> 20} MiB, or all that are not written yet have more than "
                    f"{_MOST_HELD >> 20} MiB: end episodes earlier"
                )
        return nested(space, (), parts)

    def reward(self, value: float) -> None:
        """Add to the reward of the last action."""
        if self._rewards:
            self._rewards[-1] += float(value)

    def end(self, observation: Any, *, terminated: bool) -> None:
        """End the episode. Without a last observation, the one before it is its last: nothing follows it."""
        if not (self._rewards or self._fault):
            return
        self._ended = terminated, not terminated
        if self._fault:
            return
        try:
            space = self._observation_space
            last = self._observations[-1] if observation is None else self._copied(space, observation)
            self._observations.append(last)
        except (ValueError, TypeError) as error:
            self._fault = str(error)

    def finish(self) -> None:
        """Hand over the episode if it has ended."""
        if self._ended is None:
            return
        if self._fault:
            self._recorder.warn(self._fault)
        else:
            terminated, truncated = self._ended
            episode = Episode(
                observations=stacked(self._observation_space, self._observations),
                actions=stacked(self._action_space, self._actions),
                rewards=np.array(self._rewards),
                terminated=terminated,
                truncated=truncated,
            )
            size, self._bytes = self._bytes, 0
            self._recorder.add(episode, size, (self._observation_space, self._action_space))
        self.drop()
