"""The rows of a loop that somebody else owns, under one learner. State without threads or I/O."""

import copy
import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from daedalus.actor.collecting.client_seats import MatchSeat
from daedalus.actor.collecting.episode_lessons import LessonDraws
from daedalus.actor.collecting.rollout_writer import RolloutWriter, RowInputs
from daedalus.actor.environments.components import numbered
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.environments.vector_environments import Observed
from daedalus.actor.errors import ActorError
from daedalus.policy.acting.runtime import Choice, PolicyRuntime
from daedalus.protocol.lessons import LessonPlan, Parameters
from daedalus.protocol.spec import ActorSpec, EnvironmentSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_logger = logging.getLogger(__name__)

_NO_IDENTITY = RolloutIdentity(actor="", incarnation=0, sequence=0, learner_epoch=0)
_LARGEST_REWARD = float(np.finfo(np.float32).max)  # rollouts have float32


class ClientRows:
    """What the loop reports, written row by row, with E = 1.

    For each action call `observe`, then `choose` until it returns actions. After that the loop reports rewards, and
    perhaps the end of the episode. Where one call of the policy chooses for several clients, call `begin_row` and
    `take_choice` in place of `choose`.
    """

    def __init__(
        self,
        spec: ActorSpec,
        transforms: Transforms,
        runtime: PolicyRuntime,
        random: np.random.Generator,
        *,
        on_full: Callable[["ClientRows"], None],
        has_masks: bool = False,
        epsilon: float = 0.0,
        seat: MatchSeat | None = None,
    ) -> None:
        """Construct the rows. Raises PolicyError if the program cannot explore as it must.

        Args:
          spec: of the run.
          transforms: of the loop's spaces to the run's.
          runtime: the policy.
          random: draws the noise of the policy.
          on_full: called when the rollout is full: it must call `finished_copy`.
          has_masks: whether the loop has masks.
          epsilon: final probability of a random action.
          seat: of a match whose seats the loop hosts; None: of none.
        """
        self._spec, self._transforms, self._has_masks, self._on_full = spec, transforms, has_masks, on_full
        self._writer = RolloutWriter(
            transforms.spaces,
            1,
            runtime,
            spec.environment,
            rollout_length=spec.collection.rollout_length,
            random=random,
            epsilon=epsilon,
        )
        self.draws = LessonDraws(spec, random) if spec.environment.parameters else None
        self._drawn: Parameters | None = None  # of the next episode, if somebody has asked for them
        self._playing: Parameters = {}  # of the episode of the last action
        self.seat = seat
        self._last: Observed | None = None  # the newest observation
        self._acted = False  # the current row has an action and no outcome yet
        self._idle = False  # the row that has begun is not written
        self._overridden = False  # another action than the policy's is played in it
        self._warned = False
        self._played: dict[str, np.ndarray] | None = None  # that action, if the learner learns from it
        self._ending = False  # the episode ends with the current row, which late rewards may still change
        self._episode_ended = False  # the next row is a reset row
        self._cut: Literal["", "resets", "restarts"] = ""  # after `cut`: what the next observation does to the row
        self._reward, self._terminated, self._truncated = 0.0, False, False  # of the current row
        self._is_step = False  # whether the current row is the first to learn from in a step of the match
        self._game_steps = 0  # of this rollout

    @property
    def in_episode(self) -> bool:
        """Whether the last action has no outcome yet: the episode has not ended."""
        return self._acted and not self._ending

    @property
    def is_between_rollouts(self) -> bool:
        """Whether the next row is the first of a rollout: only then may another policy version choose."""
        return self._writer.is_between_rollouts

    @property
    def parameters(self) -> Parameters:
        """The parameters of the running episode, or those that the next one is to be played with."""
        if self.in_episode or self.draws is None:
            return self._playing
        if self._drawn is None:
            self._drawn = self.draws.draw()
        return self._drawn

    def take_over(self, rows: "ClientRows", reward: float = 0.0) -> None:
        """Go on with the running episode of rows under another learner, its return and its parameters, or with the
        parameters of the next.

        `reward` is added to that of its last action. Raises ValueError for one that `reward` would refuse.
        """
        if rows.in_episode:
            self._writer.go_on(rows._writer, np.array([rows._with(reward)]))
        known = rows._playing if rows.in_episode else rows._drawn
        if self.draws is not None and known is not None and known.keys() == self.draws.true_task.keys():
            self._drawn = known

    def use(self, runtime: PolicyRuntime, plan: LessonPlan | None = None) -> None:
        """Let a runtime with other weights choose the actions, and episodes begin by a plan. Only between rollouts."""
        self._writer.use(runtime)
        if self.draws is not None and plan is not None:
            self.draws.plan = plan

    def observe(self, observation: Any, action_mask: Any = None, reward: float = 0.0) -> None:
        """Note an observation to act on, which the last action, or the last episode's end, led to.

        Adds `reward`, if there is one, to the reward of the last action. Raises ValueError if the observation, the mask
        or the reward does not fit, or if an episode begins and its parameters were not asked for; nothing has changed
        then.
        """
        if self.draws is not None and self._drawn is None and not self.in_episode:
            names = ", ".join(self.draws.true_task)
            raise ValueError(
                f"this run sets parameters of the environment ({names}): ask for `parameters` before the first act "
                "of each episode, and play with them"
            )
        if action_mask is None and self._has_masks:
            raise ValueError("this client was constructed with an action_mask: pass one to every act()")
        if action_mask is not None and not self._has_masks:
            raise ValueError(
                "this client was constructed without an action_mask: construct it with an example of one, or act() "
                "would choose illegal actions"
            )
        observed = self._observed(observation, action_mask, needed=True)
        if reward:
            self.reward(reward)
        self.complete_episode()
        if self._last is None:
            self._writer.start(observed)
        elif self._cut == "restarts":
            self._writer.restart(observed)
        elif self._acted or self._cut == "resets":
            self._record(observed)
        self._last, self._cut = observed, ""

    def choose(self, *, override: Any = None, idle: bool = False) -> dict[str, np.ndarray] | None:
        """Return the policy's actions {name: [1, D]}; None after a reset row, whose action has no effect.

        Args:
          override: the action that is played in place of the policy's; None: the policy's is.
          idle: drop the rows of the unfinished rollout and this one; the memory of the policy still goes on.
        """
        self._begin_row(override=override, idle=idle)
        actions = self._writer.act()
        return actions if self._has_acted() else None

    def begin_row(self, *, override: Any = None, idle: bool = False) -> RowInputs:
        """Return what the policy chooses from: see RolloutWriter. The arguments are those of `choose`."""
        self._begin_row(override=override, idle=idle)
        return self._writer.begin_row()

    def _begin_row(self, *, override: Any, idle: bool) -> None:
        if idle:
            self._discard()
        self._overridden, self._played = override is not None, self._to_learn_from(override)
        # No rollout begins with a row that nobody learns from: in each there is one to learn from.
        unlearned = self._overridden and self._played is None
        only_resets = self._episode_ended and self._spec.collection.rollout_length == 1
        self._idle = idle or (self.is_between_rollouts and (unlearned or only_resets))

    def _to_learn_from(self, override: Any) -> dict[str, np.ndarray] | None:
        """Return the action that is played as the policy would have chosen it; None if it could not, or nobody learns
        from it."""
        if override is None or not self._spec.algorithm.learns_overrides:
            return None
        try:
            return self._transforms.policy_action(override)
        except ValueError as error:
            if not self._warned:
                self._warned = True
                _logger.warning("an override is played and not learned from, because %s", error)
            return None

    def take_choice(self, choice: Choice) -> bool:
        """Write a choice; return False if it was for a reset row, whose action has no effect: choose once more."""
        self._writer.take_choice(choice)
        return self._has_acted()

    def _has_acted(self) -> bool:
        if self._episode_ended:
            self._episode_ended = False
            assert self._last is not None
            self._record(self._last)
            return False
        self._acted = True
        if self.draws is not None and self._drawn is not None:
            self._playing, self._drawn = self._drawn, None
            self._writer.play(0, self.draws.with_lessons(self._playing))
        if self._overridden:
            self._writer.override(self._played)
        if self.seat is not None and self.seat.steps is not None:
            self.seat.steps.act(self.seat.number)
            self._is_step = not self._idle and not self._overridden and self.seat.steps.count()
        return True

    def env_action(self, actions: dict[str, np.ndarray]) -> Any:
        """Return the loop's action for the policy's {name: [1, D]}."""
        return self._transforms.env_action(actions)

    def reward(self, value: float) -> None:
        """Add to the reward of the last action, also after the end of its episode.

        Raises ValueError before an episode's first action.
        """
        if not self._acted:
            raise ValueError("a reward came before any action of this episode: call act() first")
        self._reward = self._with(value)

    def _with(self, value: float) -> float:
        """Return the reward of the last action with another one. Raises ValueError if rollouts cannot have it."""
        total = self._reward + float(value)
        if not abs(total) <= _LARGEST_REWARD:  # false for NaN too
            raise ValueError(f"the reward is {total}: it must be finite, and a number of 32 bits holds it")
        return total

    def end_episode(self, observation: Any, *, terminated: bool, reward: float = 0.0) -> None:
        """End the episode with the last action; `observation` is the one that it led to, or None if unknown.

        Adds `reward`, if there is one, to the reward of the last action. Raises ValueError if the observation or the
        reward does not fit, or if an observation is needed; nothing has changed then.
        """
        if not self.in_episode:
            raise ValueError("the episode ended without any action: call act() first")
        last = self._last
        if observation is not None:
            last = self._observed(observation, self._open_masks(), needed=False)
        elif not terminated:
            raise ValueError("a truncated episode needs its last observation for the bootstrap value: pass it")
        elif self._spec.environment.bootstrap_terminations:
            raise ValueError(
                "this run bootstraps terminated episodes too (environment.bootstrap_terminations): "
                "pass the last observation"
            )
        if reward:
            self.reward(reward)
        self._last = last
        self._terminated, self._truncated, self._ending = terminated, not terminated, True
        self._end_step()

    def _end_step(self) -> None:
        if self.seat is not None and self.seat.steps is not None:
            self.seat.steps.end()

    def _observed(self, observation: Any, action_mask: Any, *, needed: bool) -> Observed:
        if self._spec.environment.agent_ids and self.seat is not None:
            observation = numbered(observation, self.seat.number)
        return self._transforms.observe_one(observation, action_mask, needed=needed)

    def _open_masks(self) -> dict[str, np.ndarray] | None:
        """Return masks that allow every choice, as an observation without a mask of its own has; None without masks."""
        if not self._has_masks:
            return None
        return {name: np.ones(choices, np.bool_) for name, choices in self._transforms.spaces.masks.items()}

    def complete_episode(self) -> None:
        """Complete the last row of an episode that has ended: no more rewards come for it. Idempotent."""
        if self._ending:
            assert self._last is not None
            self._record(self._last)
            self._ending, self._episode_ended = False, True

    def cut(self) -> None:
        """End the episode as truncated at the newest observation: the loop was interrupted.

        What followed the last action is not known, so its row is not learned from. The next `observe` begins another
        episode.
        """
        self.complete_episode()
        if self._last is None or self._episode_ended or self._cut:
            return
        if not self._writer.cut():
            self._cut = "restarts"
        elif self._acted:
            self._cut = "resets"
        else:
            self._episode_ended = True
        self._acted, self._reward, self._is_step = False, 0.0, False
        self._end_step()

    def _discard(self) -> None:
        self._writer.discard()
        self._game_steps = 0

    def _record(self, observed: Observed) -> None:
        """Complete the row of the last action."""
        full = self._writer.record(
            observed, np.array([self._reward]), np.array([self._terminated]), np.array([self._truncated])
        )
        self._game_steps += self._is_step
        self._acted, self._reward, self._terminated, self._truncated = False, 0.0, False, False
        self._is_step = False
        if self._idle:
            self._discard()
        elif full:
            self._on_full(self)

    def finished_copy(self, policy_version: int) -> Rollout:
        """Return the full rollout in memory of its own. Whoever sends it replaces its identity."""
        rollout = copy.deepcopy(self._writer.finish(_NO_IDENTITY, policy_version))
        steps, self._game_steps = self._game_steps, 0
        if self.seat is None or self.seat.steps is None:
            return rollout
        return replace(rollout, game_steps=steps)


def check_run(spec: ActorSpec) -> None:
    """Raise ActorError if a loop that somebody else owns cannot take part in a run."""
    if spec.uploads_gradients:
        raise ActorError(
            "this run takes gradients (collection.upload), and a client sends rollouts: set collection.upload=rollouts"
        )
    _refuse_unapplied_settings(spec.environment)


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
