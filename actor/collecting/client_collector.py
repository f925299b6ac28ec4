"""Rollouts from a loop that the caller owns: rows are written as the loop reports observations and rewards."""

import copy
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.collecting.client_rows import ClientRows, check_run
from daedalus.actor.collecting.policy_guard import PolicyGuard
from daedalus.actor.collecting.rollout_writer import RolloutWriter
from daedalus.actor.environments.masks import mask_of_one
from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_MAX_FULL_ROLLOUTS = 8  # that the service has not taken yet; beyond that the oldest is dropped
_NO_IDENTITY = RolloutIdentity(actor="", incarnation=0, sequence=0, learner_epoch=0)  # `collect` replaces it


class ClientCollector:
    """A Collector between two threads: the caller's, which acts, and the service's, which sends the rollouts.

    Neither waits for the other. A rollout is played with one policy version. In a run whose actors wait for each
    update, the caller goes on with the last policy meanwhile, and those rows are not written.
    """

    def __init__(
        self,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        example_mask: Any,
        guard: PolicyGuard | None = None,
    ) -> None:
        """Construct the collector.

        Args:
          observation_space, action_space: those of the caller's loop.
          example_mask: a mask, or a map of masks by action component, if the loop has masks; else None.
          guard: decides when the safe action is played; None: never.
        """
        self._observation_space, self._action_space = observation_space, action_space
        self._example_mask = example_mask
        self.guard = guard or PolicyGuard(action_space, None, None, untrained=False)
        self.policy_loaded = threading.Event()  # the caller may act
        self.on_rollout: Callable[[], None] = lambda: None  # called on the caller's thread when a rollout is full
        # For the service's thread only:
        self._transforms: Transforms | None = None  # of the run that is being joined
        self._program: OnnxRuntime | None = None
        self._synchronous = False  # actors wait for each update
        self._lock = threading.Lock()  # guards the next six
        self.dropped = 0  # rollouts, finished or not, that the service never took
        self._next_rows: ClientRows | None = None  # of a policy that has begun, and does not act yet
        self._newest: tuple[Snapshot, OnnxRuntime] | None = None  # the newest weights, loaded
        self._confirmed_at = -math.inf  # the monotonic time at which the newest snapshot was the learner's newest
        self._full: deque[Rollout] = deque(maxlen=_MAX_FULL_ROLLOUTS)
        self._may_begin = True  # whether the next row may begin a rollout
        # For the caller's thread only:
        self._rows: ClientRows | None = None
        self._loaded: Snapshot | None = None  # that acts
        self.overridden_actions = self.safe_actions = 0

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
        assert isinstance(runtime, OnnxRuntime)  # a client has no other
        self._program, self._synchronous = runtime, spec.algorithm.synchronous
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
            self._next_rows, self._newest = rows, None
            self._may_begin = not self._synchronous
            self.dropped += len(self._full)
            self._full.clear()

    def load(self, snapshot: Snapshot) -> None:
        """See Collector. Loading takes long for a large network: it is done here and not in the caller's loop."""
        assert self._program is not None
        runtime = self._program.fork()
        runtime.load(snapshot.weights)
        with self._lock:
            self._newest = snapshot, runtime

    def confirm(self, at: float) -> None:
        """See Collector."""
        with self._lock:
            self._confirmed_at = at
        self.policy_loaded.set()

    def has_rollout(self) -> bool:
        """See Collector."""
        return bool(self._full)

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout | None:
        """See Collector. Return the oldest full rollout. `on_row` has no effect: the caller's loop makes the rows."""
        with self._lock:
            if self._full:
                return replace(self._full.popleft(), identity=identity)
            self._may_begin = True
            return None

    def close(self) -> None:
        """See Collector. There is nothing to release."""

    # --------------------------------------------------------------------------------- on the caller's thread

    def act(self, observation: Any, action_mask: Any = None, override: Any = None) -> Any:
        """Return the action for an observation, which the last action, or the last episode's end, led to."""
        self._switch_policy()
        rows = self._rows
        assert rows is not None  # the service waits for `policy_loaded`
        rows.observe(observation, action_mask)
        while True:
            if rows.is_between_rollouts:
                self._load_newest()
            policy_acts = self._policy_may_act()
            actions = rows.choose(overridden=override is not None, idle=self._is_idle(rows, policy_acts=policy_acts))
            if actions is not None:
                break
        if override is not None:
            self.overridden_actions += 1
            return override
        if not policy_acts:
            self.safe_actions += 1
            return self.guard.action(observation)
        return rows.env_action(actions)

    def reward(self, value: float) -> None:
        """Add to the reward of the last action."""
        if self._rows is None:
            raise ValueError("a reward came before any action: call act() first")
        self._rows.reward(value)

    def end_episode(self, observation: Any, *, terminated: bool) -> None:
        """End the episode with the last action; `observation` is the one that it led to, or None if unknown."""
        if self._rows is None:
            raise ValueError("the episode ended without any action: call act() first")
        self._rows.end_episode(observation, terminated=terminated)

    def _switch_policy(self) -> None:
        """Continue with a policy that has begun meanwhile; discard the unfinished rollout of the previous one."""
        with self._lock:
            if self._next_rows is None or self._newest is None:
                return
            self.dropped += self._rows is not None and not self._rows.is_between_rollouts
            self._rows, self._next_rows = self._next_rows, None
        self._loaded = None

    def _load_newest(self) -> None:
        """Let the newest weights act."""
        with self._lock:
            newest, switching = self._newest, self._next_rows is not None
        if newest is None or switching or newest[0] is self._loaded:
            return  # weights of a policy that begins are not for the rows of the previous one
        assert self._rows is not None
        self._loaded = newest[0]
        self._rows.use(newest[1])

    def _policy_may_act(self) -> bool:
        """Return whether the policy may act now, and not the safe action."""
        assert self._loaded is not None
        with self._lock:
            age = time.monotonic() - self._confirmed_at
        return self.guard.allows(self._loaded.policy_version, age)

    def _is_idle(self, rows: ClientRows, *, policy_acts: bool) -> bool:
        """Return whether the next row is not written. Count the unfinished rollout that this drops."""
        with self._lock:
            if policy_acts:
                return rows.is_between_rollouts and not self._may_begin
            self.dropped += not rows.is_between_rollouts
            return True

    def _keep(self, writer: RolloutWriter) -> None:
        """Keep a full rollout for the service."""
        assert self._loaded is not None
        rollout = copy.deepcopy(writer.finish(_NO_IDENTITY, self._loaded.policy_version))
        with self._lock:
            self._may_begin = not self._synchronous
            if self._next_rows is None:  # otherwise the rollout is meant for a previous learner
                self.dropped += len(self._full) == _MAX_FULL_ROLLOUTS
                self._full.append(rollout)
            else:
                self.dropped += 1
        self.on_rollout()
