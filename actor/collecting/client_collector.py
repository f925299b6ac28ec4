"""The player whose loop is somebody else's: rows are written down as that loop tells of them."""

import copy
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.collecting.collector import Wait
from daedalus.actor.collecting.rollout_writer import RolloutWriter
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.session.learner_queries import ActorError
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_HELD_ROLLOUTS = 8  # that are full and not yet taken by the service; the oldest gives way
_REFRESH_SECONDS = 0.2  # how soon newer weights are noticed while a rollout fills
_NOBODY = RolloutIdentity(actor="", incarnation=0, sequence=0, learner_epoch=0)  # the service knows better


class ClientPlayer:
    """Between two threads: the user's, which acts, and the service's, which sends what came of it."""

    def __init__(self, observation_space: gymnasium.Space, action_space: gymnasium.Space) -> None:
        self._spaces = observation_space, action_space
        self._lock = threading.Lock()  # guards the next five
        self._transforms: Transforms | None = None
        self._fresh: RolloutWriter | None = None  # of a policy that has come and does not act yet
        self._weights: Snapshot | None = None
        self._full: deque[Rollout] = deque(maxlen=_HELD_ROLLOUTS)
        self.dropped = 0  # rollouts that nobody took in time
        self.ready = threading.Event()  # a policy is there
        self.on_full: Callable[[], None] = lambda: None  # called when a rollout may be collected
        # The user's thread only:
        self._writer: RolloutWriter | None = None
        self._version = -1
        self._loaded: Snapshot | None = None
        self._acted = self._ended = False
        self._reward, self._terminated, self._truncated = 0.0, False, False

    # ---------------------------------------------------------------------------------- the service's thread

    def prepare(self, spec: RunSpec) -> tuple[Spaces, int]:
        """See Player."""
        if spec.synchronous:
            raise ActorError(
                "a run with a2c has its actors wait for each update, a client cannot: use another algorithm"
            )
        with self._lock:
            self._transforms = Transforms(spec.environment, *self._spaces)
            return self._transforms.spaces, 1

    def begin(self, runtime: PolicyRuntime, spec: RunSpec, seed: int) -> None:
        """See Player. What was written down with another policy is given up."""
        assert self._transforms is not None
        writer = RolloutWriter(
            self._transforms.spaces,
            1,
            runtime,
            spec.environment,
            rollout_length=spec.collection.rollout_length,
            random=np.random.default_rng(seed),
        )
        with self._lock:
            self._fresh, self._weights = writer, None
            self._full.clear()

    def load(self, snapshot: Snapshot) -> None:
        """See Player."""
        with self._lock:
            self._weights = snapshot
        self.ready.set()

    def collect(self, identity: RolloutIdentity, wait: Wait, newest: Callable[[], Snapshot]) -> Rollout:
        """See Player."""
        while True:
            if wait(lambda: bool(self._full), _REFRESH_SECONDS):
                with self._lock:
                    if self._full:
                        return replace(self._full.popleft(), identity=identity)
            self.load(newest())

    def close(self) -> None:
        """See Player."""

    # ------------------------------------------------------------------------------------- the user's thread

    def act(self, observation: Any) -> Any:
        """The action for an observation, which is what the last action, or the last episode's end, led to."""
        frame = self._frame(observation)
        self._adopt(frame)
        writer = self._writer
        assert writer is not None
        if self._acted:
            self._record(frame)
        if self._ended:  # the row that only resets: nothing comes of its action
            self._choose(writer)
            self._ended = False
            self._record(frame)
        self._acted = True
        assert self._transforms is not None
        return self._transforms.env_actions(self._choose(writer))[0]

    def reward(self, value: float) -> None:
        """Adds to what the last action earned."""
        if not self._acted:
            raise ValueError("a reward before any action of this episode: call act() first")
        if not np.isfinite(value):
            raise ValueError(f"the reward is {value}: it must be finite")
        self._reward += float(value)

    def end_episode(self, observation: Any, *, terminated: bool) -> None:
        """Ends the episode with the last action's outcome; `observation` is what it led to, if it is known."""
        if not self._acted:
            raise ValueError("an episode without any action: call act() first")
        if observation is not None:
            self._last = self._frame(observation)
        elif not terminated:
            raise ValueError("an episode that is cut goes on unseen: give its last observation")
        self._terminated, self._truncated = terminated, not terminated
        self._record(self._last)
        self._ended = True

    def _frame(self, observation: Any) -> np.ndarray:
        space = self._spaces[0]
        frame = np.asarray(observation, space.dtype)
        if frame.shape != space.shape:
            raise ValueError(f"the observation has shape {frame.shape}, its space {space.shape}")
        if frame.dtype.kind == "f" and not np.isfinite(frame).all():
            raise ValueError("the observation has a value that is not finite")
        assert self._transforms is not None
        return self._transforms.frames(frame[None])

    def _adopt(self, frame: np.ndarray) -> None:
        """Goes over to a policy that has come since: what was being written down is given up."""
        self._last = frame
        with self._lock:
            if self._fresh is None or self._weights is None:
                return
            self._writer, self._fresh = self._fresh, None
        self._acted = self._ended = False
        self._reward, self._terminated, self._truncated, self._loaded = 0.0, False, False, None
        self._writer.start(frame)

    def _choose(self, writer: RolloutWriter) -> np.ndarray:
        """The actions of the next row, by the newest weights where a rollout begins with it."""
        if writer.is_between_rollouts:
            with self._lock:
                snapshot = self._weights
            if snapshot is not None and snapshot is not self._loaded:
                writer.load(snapshot.weights)
                self._loaded, self._version = snapshot, snapshot.policy_version
        return writer.act()

    def _record(self, frame: np.ndarray) -> None:
        """Completes the row of the last action."""
        assert self._writer is not None
        full = self._writer.record(
            frame, np.array([self._reward]), np.array([self._terminated]), np.array([self._truncated])
        )
        self._acted, self._reward, self._terminated, self._truncated = False, 0.0, False, False
        if not full:
            return
        rollout = copy.deepcopy(self._writer.finish(_NOBODY, self._version))
        with self._lock:
            if self._fresh is None:  # else it is another learner's by now
                self.dropped += len(self._full) == _HELD_ROLLOUTS
                self._full.append(rollout)
        self.on_full()
