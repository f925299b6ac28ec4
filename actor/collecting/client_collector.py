"""Rollouts from a loop that the caller owns: rows are written as the loop reports observations and rewards."""

import copy
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.collecting.rollout_writer import RolloutWriter
from daedalus.actor.environments.interface import Observed
from daedalus.actor.environments.masks import mask_of_one
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.session.learner_queries import ActorError
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

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
        self._lock = threading.Lock()  # guards the next six
        self.dropped = 0  # rollouts that were replaced by newer ones before the service took them
        self._transforms: Transforms | None = None
        self._bootstrap_terminations = False
        self._next_policy: tuple[PolicyRuntime, RolloutWriter] | None = None  # begun, and not acting yet
        self._snapshot: Snapshot | None = None  # the newest
        self._full: deque[Rollout] = deque(maxlen=_MAX_FULL_ROLLOUTS)
        # For the caller's thread only:
        self._policy: tuple[PolicyRuntime, RolloutWriter] | None = None
        self._loaded: Snapshot | None = None  # in the runtime
        self._last: Observed | None = None  # the newest observation
        self._acted = False  # the current row has an action and no outcome yet
        self._episode_ended = False  # the next row is a reset row
        self._reward, self._terminated, self._truncated = 0.0, False, False  # of the current row

    # -------------------------------------------------------------------------------- on the service's thread

    def prepare(self, spec: RunSpec) -> tuple[Spaces, int]:
        """See Collector."""
        if spec.algorithm.synchronous:
            raise ActorError(
                f"a run with {spec.training.algorithm} makes its actors wait for each update, but a client cannot "
                "wait: use another algorithm"
            )
        if spec.uploads_gradients:
            raise ActorError(
                "this run takes gradients (collection.upload), and a client sends rollouts: set "
                "collection.upload=rollouts"
            )
        _refuse_unapplied_settings(spec.environment)
        with self._lock:
            self._bootstrap_terminations = spec.environment.bootstrap_terminations
            example = None if self._example_mask is None else mask_of_one(self._example_mask)
            self._transforms = Transforms(spec.environment, self._observation_space, self._action_space, example)
            return self._transforms.spaces, 1

    def begin(self, runtime: PolicyRuntime, spec: RunSpec, seed: int) -> None:
        """See Collector. Discard the rollouts of the previous policy."""
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
            self._next_policy, self._snapshot = (runtime, writer), None
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
        if action_mask is None and self._example_mask is not None:
            raise ValueError("this client was constructed with an action_mask: pass one to every act()")
        if action_mask is not None and self._example_mask is None:
            raise ValueError(
                "this client was constructed without an action_mask: construct it with an example of one, or act() "
                "would choose illegal actions"
            )
        observed = self._observe(observation, action_mask, needed=True)
        self._switch_policy(observed)
        assert self._policy is not None
        if self._acted:
            self._record(observed)
        if self._episode_ended:  # write the reset row, whose action has no effect
            self._choose()
            self._episode_ended = False
            self._record(observed)
        self._acted = True
        assert self._transforms is not None
        return self._transforms.env_action(self._choose())

    def reward(self, value: float) -> None:
        """Add to the reward of the last action."""
        if not self._acted:
            raise ValueError("a reward came before any action of this episode: call act() first")
        if not np.isfinite(value):
            raise ValueError(f"the reward is {value}: it must be finite")
        self._reward += float(value)

    def end_episode(self, observation: Any, *, terminated: bool) -> None:
        """End the episode with the last action; `observation` is the one that it led to, or None if unknown."""
        if not self._acted:
            raise ValueError("the episode ended without any action: call act() first")
        if observation is not None:
            self._last = self._observe(observation, self._example_mask, needed=False)
        elif not terminated:
            raise ValueError("a truncated episode needs its last observation for the bootstrap value: pass it")
        elif self._bootstrap_terminations:
            raise ValueError(
                "this run bootstraps terminated episodes too (environment.bootstrap_terminations): "
                "pass the last observation"
            )
        self._terminated, self._truncated = terminated, not terminated
        assert self._last is not None
        self._record(self._last)
        self._episode_ended = True

    def _observe(self, observation: Any, action_mask: Any, *, needed: bool) -> Observed:
        """Return a checked observation as the run has it."""
        assert self._transforms is not None
        return self._transforms.observe_one(observation, action_mask, needed)

    def _switch_policy(self, observed: Observed) -> None:
        """Continue with a policy that has begun meanwhile; discard the unfinished rollout of the previous one."""
        self._last = observed
        with self._lock:
            if self._next_policy is None or self._snapshot is None:
                return
            self._policy, self._next_policy = self._next_policy, None
        self._acted = self._episode_ended = False
        self._reward, self._terminated, self._truncated, self._loaded = 0.0, False, False, None
        self._policy[1].start(observed)

    def _choose(self) -> dict[str, np.ndarray]:
        """Return the actions {name: [1, D]} of the next row; load the newest weights first if it begins a rollout."""
        assert self._policy is not None
        runtime, writer = self._policy
        if writer.is_between_rollouts:
            with self._lock:
                snapshot = self._snapshot
            if snapshot is not None and snapshot is not self._loaded:
                runtime.load(snapshot.weights)
                self._loaded = snapshot
        return writer.act()

    def _record(self, observed: Observed) -> None:
        """Complete the row of the last action."""
        assert self._policy is not None
        assert self._loaded is not None
        writer = self._policy[1]
        full = writer.record(
            observed, np.array([self._reward]), np.array([self._terminated]), np.array([self._truncated])
        )
        self._acted, self._reward, self._terminated, self._truncated = False, 0.0, False, False
        if not full:
            return
        rollout = copy.deepcopy(writer.finish(_NO_IDENTITY, self._loaded.policy_version))
        with self._lock:
            if self._next_policy is None:  # otherwise the rollout is meant for a previous learner
                self.dropped += len(self._full) == _MAX_FULL_ROLLOUTS
                self._full.append(rollout)
        self.on_rollout()


def _refuse_unapplied_settings(spec: EnvironmentSpec) -> None:
    """Raise ActorError for settings about stepping and wrapping environments: here the loop belongs to the caller."""
    defaults = {"wrap": None, "action_repeat": 1, "no_reward_limit": None, "max_episode_steps": None}
    changed = [
        f"environment.{name}={getattr(spec, name)}"
        for name, default in defaults.items()
        if getattr(spec, name) != default
    ]
    if changed:
        raise ActorError(
            f"this run sets {' and '.join(changed)}, which a client does not apply: its own loop wraps its "
            "environment, repeats actions and ends episodes; start the run without these settings"
        )
