"""Rollouts from a loop that the caller owns: rows are written as the loop reports observations and rewards."""

import copy
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.collecting.client_rows import ClientRows, check_run
from daedalus.actor.collecting.rollout_writer import RolloutWriter
from daedalus.actor.environments.masks import mask_of_one
from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_MAX_FULL_ROLLOUTS = 8  # that the service has not taken yet; beyond that the oldest is dropped
_NO_IDENTITY = RolloutIdentity(actor="", incarnation=0, sequence=0, learner_epoch=0)  # `collect` replaces it


class ClientCollector:
    """A Collector between two threads: the caller's, which acts, and the service's, which sends the rollouts."""

    def __init__(self, observation_space: gymnasium.Space, action_space: gymnasium.Space, example_mask: Any) -> None:
        """Construct the collector.

        Args:
          observation_space, action_space: those of the caller's loop.
          example_mask: a mask, or a map of masks by action component, if the loop has masks; else None.
        """
        self._observation_space, self._action_space = observation_space, action_space
        self._example_mask = example_mask
        self.policy_loaded = threading.Event()  # the caller may act
        self.on_rollout: Callable[[], None] = lambda: None  # called on the caller's thread when a rollout is full
        self._transforms: Transforms | None = None  # of the run that is being joined
        self._lock = threading.Lock()  # guards the next four
        self.dropped = 0  # rollouts that were replaced by newer ones before the service took them
        self._next_policy: tuple[PolicyRuntime, ClientRows] | None = None  # begun, and not acting yet
        self._snapshot: Snapshot | None = None  # the newest
        self._full: deque[Rollout] = deque(maxlen=_MAX_FULL_ROLLOUTS)
        # For the caller's thread only:
        self._policy: tuple[PolicyRuntime, ClientRows] | None = None
        self._loaded: Snapshot | None = None  # in the runtime

    # -------------------------------------------------------------------------------- on the service's thread

    def prepare(self, spec: RunSpec) -> tuple[Spaces, int]:
        """See Collector."""
        check_run(spec)
        example = None if self._example_mask is None else mask_of_one(self._example_mask)
        self._transforms = Transforms(spec.environment, self._observation_space, self._action_space, example)
        return self._transforms.spaces, 1

    def begin(self, runtime: PolicyRuntime, spec: RunSpec, seed: int, epsilon: float = 0.0) -> None:
        """See Collector. Discard the rollouts of the previous policy."""
        assert self._transforms is not None
        writer = RolloutWriter(
            self._transforms.spaces,
            1,
            runtime,
            spec.environment,
            rollout_length=spec.collection.rollout_length,
            random=np.random.default_rng(seed),
            epsilon=epsilon,
        )
        rows = ClientRows(
            self._transforms,
            writer,
            example_mask=self._example_mask,
            bootstrap_terminations=spec.environment.bootstrap_terminations,
            on_full=self._keep,
        )
        with self._lock:
            self._next_policy, self._snapshot = (runtime, rows), None
            self._full.clear()

    def load(self, snapshot: Snapshot) -> None:
        """See Collector."""
        with self._lock:
            self._snapshot = snapshot
        self.policy_loaded.set()

    def has_rollout(self) -> bool:
        """See Collector."""
        return bool(self._full)

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout | None:
        """See Collector. Return the oldest full rollout. `on_row` has no effect: the caller's loop makes the rows."""
        with self._lock:
            return replace(self._full.popleft(), identity=identity) if self._full else None

    def close(self) -> None:
        """See Collector. There is nothing to release."""

    # --------------------------------------------------------------------------------- on the caller's thread

    def act(self, observation: Any, action_mask: Any = None) -> Any:
        """Return the action for an observation, which the last action, or the last episode's end, led to."""
        self._switch_policy()
        assert self._policy is not None  # the service waits for `policy_loaded`
        runtime, rows = self._policy
        rows.observe(observation, action_mask)
        while True:
            if rows.is_between_rollouts:
                self._load_newest(runtime)
            if (actions := rows.choose()) is not None:
                return rows.env_action(actions)

    def reward(self, value: float) -> None:
        """Add to the reward of the last action."""
        if self._policy is None:
            raise ValueError("a reward came before any action: call act() first")
        self._policy[1].reward(value)

    def end_episode(self, observation: Any, *, terminated: bool) -> None:
        """End the episode with the last action; `observation` is the one that it led to, or None if unknown."""
        if self._policy is None:
            raise ValueError("the episode ended without any action: call act() first")
        self._policy[1].end_episode(observation, terminated=terminated)

    def _switch_policy(self) -> None:
        """Continue with a policy that has begun meanwhile; discard the unfinished rollout of the previous one."""
        with self._lock:
            if self._next_policy is None or self._snapshot is None:
                return
            self._policy, self._next_policy = self._next_policy, None
        self._loaded = None

    def _load_newest(self, runtime: PolicyRuntime) -> None:
        with self._lock:
            snapshot = self._snapshot
        if snapshot is not None and snapshot is not self._loaded:
            runtime.load(snapshot.weights)
            self._loaded = snapshot

    def _keep(self, writer: RolloutWriter) -> None:
        """Keep a full rollout for the service."""
        assert self._loaded is not None
        rollout = copy.deepcopy(writer.finish(_NO_IDENTITY, self._loaded.policy_version))
        with self._lock:
            if self._next_policy is None:  # otherwise the rollout is meant for a previous learner
                self.dropped += len(self._full) == _MAX_FULL_ROLLOUTS
                self._full.append(rollout)
        self.on_rollout()
