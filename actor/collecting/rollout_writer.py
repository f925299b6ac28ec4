"""Rollouts, written row by row: actions from a policy, outcomes from the caller. No network, no threads."""

import logging
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from daedalus.actor.collecting.episode_lessons import lesson_arrays
from daedalus.actor.collecting.lineup import Lineup
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.vector_environments import Observed
from daedalus.policy.acting.noise import Noise, draw_noise
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import Choice, PolicyRuntime
from daedalus.protocol.frames import ObservationStacks
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_MOST_SKIPPED = 100  # rows of a rollout that are played and not written, for each that is

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedEpisodes:
    """K episodes, in the order in which they ended."""

    returns: np.ndarray  # [K] float64, undiscounted and unscaled
    lengths: np.ndarray  # [K] int32, env_steps
    parameters: list[Parameters]  # of each, those that have a lesson; empty in a run without parameters


class EpisodeCounter:
    """The running returns and lengths of E environments' episodes, and those of the episodes that ended.

    Attributes:
      parameters: of the running episodes, those that have a lesson, by environment; empty in a run without parameters.
    """

    def __init__(self, count: int) -> None:
        self.parameters: list[Parameters] = []
        self._played: list[Parameters] = []  # by the episodes that ended
        self._returns = np.zeros(count, np.float64)
        self._lengths = np.zeros(count, np.int32)
        self.ended = np.zeros(count, np.bool_)  # [E] whether the next step is the reset after an episode's end
        self._finished: list[tuple[np.ndarray, np.ndarray]] = []

    def step(self, rewards: np.ndarray, valid: np.ndarray, ended: np.ndarray) -> None:
        """Count one row: unscaled rewards, whether it is no reset row, and whether the episode ends; all [E]."""
        self._returns += rewards
        self._lengths += valid
        self.ended = ended
        if np.count_nonzero(self.ended):
            self._finished.append((self._returns[self.ended], self._lengths[self.ended]))
            if self.parameters:
                self._played += [self.parameters[index] for index in np.flatnonzero(self.ended).tolist()]
            self._returns[self.ended] = 0.0
            self._lengths[self.ended] = 0

    def step_seats(self, seen: np.ndarray, rewards: np.ndarray, ended: np.ndarray, counted: np.ndarray) -> None:
        """Count a step of the seats that have `seen` something, with their rewards, and whether their episodes `ended`.

        All are [E]. `counted`: whose episodes are reported.
        """
        valid = seen & ~self.ended
        self._returns[valid] += rewards[valid]
        self._lengths += valid
        finished = valid & ended
        if np.count_nonzero(finished):
            reported = finished & counted
            self._finished.append((self._returns[reported], self._lengths[reported]))
            self._returns[finished] = 0.0
            self._lengths[finished] = 0
        self.ended = np.where(seen, ended, self.ended)  # a match may also end before a seat has acted in it

    def abandon(self, seats: slice) -> None:
        """Forget the running episodes of seats, whose next step is a reset."""
        self._returns[seats], self._lengths[seats], self.ended[seats] = 0.0, 0, True

    def cut(self) -> None:
        """Note that all episodes ended with the row that was counted last."""
        self._finished.append((self._returns.copy(), self._lengths.copy()))
        self._played += self.parameters
        self.restart()
        self.ended[:] = True

    def go_on(self, before: "EpisodeCounter", rewards: np.ndarray) -> None:
        """Go on with the running episodes of another counter, after one more row of theirs with these rewards [E]."""
        self._returns, self._lengths = before._returns + rewards, before._lengths + 1

    def restart(self) -> None:
        """Forget the running episodes: others begin."""
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self.ended[:] = False

    def take_finished(self) -> FinishedEpisodes:
        """Return the episodes that ended since the last call."""
        finished, self._finished = self._finished, []
        played, self._played = self._played, []
        returns, lengths = zip(*finished, strict=True) if finished else ((), ())
        return FinishedEpisodes(
            returns=np.concatenate([np.zeros(0), *returns]),
            lengths=np.concatenate([np.zeros(0, np.int32), *lengths]),
            parameters=played,
        )


def make_learnable(spec: EnvironmentSpec, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> None:
    """Clip and scale rewards, and bootstrap terminations, as `spec` says, in place."""
    if spec.reward_clip is not None:
        rewards.clip(-spec.reward_clip, spec.reward_clip, out=rewards)
    rewards *= np.float32(spec.reward_scale)
    if spec.bootstrap_terminations:
        # Without a limit of rewards, both flags are a termination at the time limit.
        given_up = terminated & truncated & (spec.no_reward_limit is not None)
        truncated |= terminated
        terminated[:] = given_up


class RowInputs(NamedTuple):
    """What a policy chooses one row's actions from."""

    observations: dict[str, np.ndarray]  # of each component [E, *stacked_shape]
    state: np.ndarray  # [E, S] float32, the policy's memory before the row
    masks: dict[str, np.ndarray]  # of the masked actions [E, choices] bool
    epsilon: np.ndarray  # [E, 1] float32, the final epsilon of the actor
    noise: Noise  # of the actor's own random numbers


class RolloutWriter:
    """The state that E environments carry from row to row, and the arrays that every rollout is written into.

    Call `start` once; then for each row `act`, step the environments, and `record`. After a `record` that returns True
    call `finish`.
    """

    def __init__(
        self,
        spaces: Spaces,
        count: int,
        runtime: PolicyRuntime,
        spec: EnvironmentSpec,
        *,
        rollout_length: int,
        random: np.random.Generator,
        epsilon: float = 0.0,
    ) -> None:
        """Allocate the arrays of a rollout.

        Args:
          spaces: of one environment, after the run's transforms.
          count: E, the number of environments.
          runtime: chooses the actions.
          spec: how rewards are clipped and scaled, and whether terminations are bootstrapped.
          rollout_length: T, the number of rows.
          random: source of the sampled actions.
          epsilon: the actor's, from the learner's Welcome.

        Raises PolicyError if the actor is to explore and the policy cannot.
        """
        if epsilon > 0.0 and not runtime.explores:
            raise PolicyError(
                f"the learner asks this actor to explore with epsilon {epsilon:g}, but its program has no input "
                "'epsilon': use the same release of daedalus-rl for the learner and the actors"
            )
        rows = rollout_length
        self._runtime = runtime
        self._spec = spec
        self._random, self._count = random, count
        self._epsilon = np.full((count, 1), epsilon, np.float32)
        self._episodes = EpisodeCounter(count)
        self._stacks = ObservationStacks(spaces, count)
        self._current_masks: dict[str, np.ndarray] = {}  # of the newest observations
        self._state = np.zeros((count, runtime.state_size), np.float32)
        self._next_state = self._state
        self._row = 0

        self._frames = {name: _frames(space, rows, count) for name, space in spaces.observations.items()}
        self._depths = {name: space.frames for name, space in spaces.observations.items()}
        self._initial_state = np.zeros_like(self._state)
        self._actions = {
            name: np.zeros((rows, count, space.size), space.dtype) for name, space in spaces.actions.items()
        }
        self._masks = {name: np.ones((rows, count, size), np.bool_) for name, size in spaces.masks.items()}
        self._log_probs = np.zeros((rows, count), np.float32)
        self._rewards = np.zeros((rows, count), np.float32)
        self._terminated = np.zeros((rows, count), np.bool_)
        self._truncated = np.zeros((rows, count), np.bool_)
        self._valid = np.zeros((rows, count), np.bool_)
        self._overridden = np.zeros((rows, count), np.bool_)
        self._taught = np.zeros((rows, count), np.bool_)

    @property
    def is_between_rollouts(self) -> bool:
        """Whether the next row is the first of a rollout: only then may the runtime load other weights."""
        return self._row == 0

    def use(self, runtime: PolicyRuntime) -> None:
        """Let another runtime of the same program choose the actions. Call only between rollouts."""
        self._runtime = runtime

    @property
    def resets(self) -> np.ndarray:
        """Of which environments the next row is the reset after an episode's end, [E] bool."""
        return self._episodes.ended

    def play(self, index: int, parameters: Parameters) -> None:
        """Note the parameters with lessons of an environment's next episode. Call it before the row of its reset."""
        if not self._episodes.parameters:
            self._episodes.parameters = [{}] * self._count
        self._episodes.parameters[index] = parameters

    def start(self, observed: Observed) -> None:
        """Begin with the first observations of all environments."""
        self._stacks.push(observed.frames, np.ones(self._count, np.bool_))
        self._current_masks = observed.masks

    def go_on(self, before: "RolloutWriter", rewards: np.ndarray) -> None:
        """Count the episodes of another writer on, whose last row, with these rewards [E], it has not recorded."""
        self._episodes.go_on(before._episodes, rewards)

    def act(self) -> dict[str, np.ndarray]:
        """Return the actions {name: [E, D]} that the policy chooses for the next row."""
        inputs = self.begin_row()
        choice = self._runtime.act(inputs.observations, inputs.state, inputs.noise, inputs.masks, inputs.epsilon)
        self.take_choice(choice)
        return choice.actions

    def begin_row(self) -> "RowInputs":
        """Return what the policy chooses the next row's actions from. Call `take_choice` next, or `act` for both."""
        if self._row == 0:
            for name, frames in self._stacks.frames.items():
                self._frames[name][: self._depths[name]] = frames.swapaxes(0, 1)
            self._initial_state[:] = self._state
        noise = draw_noise(self._runtime.noise_size, self._count, self._random)
        return RowInputs(self._stacks.observations, self._state, self._current_masks, self._epsilon, noise)

    def take_choice(self, choice: Choice) -> None:
        """Write what a policy chose from the inputs of this row."""
        row = self._row
        self._log_probs[row], self._next_state = choice.log_probs, choice.state
        for name, actions in self._actions.items():
            actions[row] = choice.actions[name]
        for name, masks in self._masks.items():
            masks[row] = self._current_masks[name]
        self._overridden[row] = self._taught[row] = False

    def override(self, played: dict[str, np.ndarray] | None = None) -> None:
        """Note that other actions than the policy's are played in the row that has begun.

        `played` are these actions {name: [E, D]}, to learn from; None: nobody learns from the row.
        """
        self._overridden[self._row] = True
        self._taught[self._row] = played is not None
        for name, actions in (played or {}).items():
            self._actions[name][self._row] = actions

    def record(self, observed: Observed, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> bool:
        """Write what VectorEnvironment.step returned for those actions; return whether the rollout is full."""
        row, resets = self._row, self._episodes.ended
        valid = ~resets
        for name, frames in self._frames.items():
            frames[self._depths[name] + row] = observed.frames[name]
        self._rewards[row] = rewards
        self._terminated[row] = terminated
        self._truncated[row] = truncated
        self._valid[row] = valid
        # The row after a reset row is the first of its episode: its frame stack and memory begin anew.
        self._stacks.push(observed.frames, resets)
        self._current_masks = observed.masks
        if self._state.size:
            # A state that is not finite begins anew, too, for it would stay so. The learner refuses this rollout.
            goes_on = valid & np.isfinite(self._next_state).all(axis=1)
            self._state = np.where(goes_on[:, None], self._next_state, np.float32(0.0))
        self._episodes.step(rewards, valid, self._terminated[row] | self._truncated[row])
        self._row += 1
        return self._row == len(self._rewards)

    def discard(self) -> None:
        """Drop the rows so far: the next row is the first of a rollout. The episodes and the memory go on."""
        self._row = 0
        self._episodes.take_finished()

    def cut(self) -> bool:
        """End the episodes as truncated at the newest observations; return False if this rollout has no row of them.

        The row that has begun is then a reset row: complete it with `record`, with the first observations of the next
        episodes. After False call `restart`.
        """
        if not self._row or not self._valid[self._row - 1].all():
            return False
        self._truncated[self._row - 1] = True
        self._overridden[self._row] = self._taught[self._row] = False
        self._episodes.cut()
        return True

    def restart(self, observed: Observed) -> None:
        """Begin the row again, as the first of other episodes. See `start`."""
        for name, frames in self._frames.items():
            frames[self._depths[name] + self._row - 1] = observed.frames[name]
        self._episodes.restart()
        self._state = np.zeros_like(self._state)
        self.start(observed)

    def finish(
        self,
        identity: RolloutIdentity,
        policy_version: int,
        episode_info: dict[str, np.ndarray] | None = None,
    ) -> Rollout:
        """Return the full rollout. Its arrays are views: encode or copy it before the next `act`.

        `episode_info` is that of the environments (VectorEnvironment.take_episode_info).
        """
        self._row = 0
        make_learnable(self._spec, self._rewards, self._terminated, self._truncated)
        finished = self._episodes.take_finished()
        return Rollout(
            identity=identity,
            policy_version=policy_version,
            frames=self._frames,
            initial_state=self._initial_state,
            actions=self._actions,
            masks=self._masks,
            behaviour_log_probs=self._log_probs,
            rewards=self._rewards,
            terminated=self._terminated,
            truncated=self._truncated,
            valid=self._valid,
            # Seats that play on without rows may end more episodes than a rollout can report: the newest.
            episode_returns=finished.returns[-self._rewards.size :],
            episode_lengths=finished.lengths[-self._rewards.size :],
            episode_info=episode_info or {},
            lessons=lesson_arrays(finished.parameters[-self._rewards.size :]),
            overridden=self._overridden if self._overridden.any() else None,
            taught=self._taught if self._taught.any() else None,
        )


class SeatWriter(RolloutWriter):
    """A RolloutWriter of the seats of games, each with rows of its own: see Observed.acting.

    A row goes from an action of the seat to its next observation, however many steps of the game that takes. A column
    whose rows are full is not written until those of all columns are full, while its seat plays on. Only the seats of
    the newest policy have columns, and not always the same ones: see Lineup.
    """

    def __init__(self, spaces: Spaces, lineup: Lineup, seats: int, *arguments: Any, **options: Any) -> None:
        """Construct the writer of all `seats` of each game; for the other arguments see RolloutWriter."""
        super().__init__(spaces, lineup.columns, *arguments, **options)
        self._lineup, self._seats = lineup, seats
        total = len(lineup.column)
        # Of each column:
        self._rows = np.zeros(self._count, np.int64)  # that are written
        self._writing = np.zeros(self._count, np.bool_)  # whether the row that its seat has begun is written
        self._resets = np.zeros(self._count, np.bool_)  # whether that row only resets
        # Of each seat:
        self._stacks, self._episodes = ObservationStacks(spaces, total), EpisodeCounter(total)
        self._epsilon = np.full((total, 1), options.get("epsilon", 0.0), np.float32)
        self._state = np.zeros((total, self._runtime.state_size), np.float32)
        self._next_state = np.zeros_like(self._state)
        self._acting = np.zeros(total, np.bool_)  # has something new
        self._deciding = np.zeros(0, np.int64)  # the seats that the newest policy acts for in this row
        self._chosen = {
            name: np.zeros((total, *actions.shape[2:]), actions.dtype) for name, actions in self._actions.items()
        }
        self._over = np.ones(total // seats, np.bool_)  # of each copy: whether its next step is a reset
        self._env_steps = self._skipped = 0  # of this rollout; rows that were not written
        self._warned = self._warned_of_steps = False

    def start(self, observed: Observed) -> None:
        """See RolloutWriter."""
        assert observed.acting is not None
        self._take_seats(observed)
        self._episodes.ended[:] = True
        self._show(observed)
        self._episodes.ended = ~observed.acting  # what the others see first is the beginning of their episodes

    def act(self) -> dict[str, np.ndarray]:
        """See RolloutWriter. Only those of the acting seats have an effect."""
        inputs = self.begin_row()
        if len(self._deciding):
            choice = self._runtime.act(inputs.observations, inputs.state, inputs.noise, inputs.masks, inputs.epsilon)
            self.take_choice(choice)
        self._lineup.act(self._acting & ~self._episodes.ended, self._stacks, self._current_masks, self._chosen)
        return self._chosen

    def begin_row(self) -> RowInputs:
        """See RolloutWriter. The inputs are those of the acting seats of the newest policy."""
        seats = self._deciding = (self._acting & self._lineup.is_newest).nonzero()[0]
        columns = self._lineup.column[seats]
        learned = columns >= 0
        if not learned.all():
            seats, columns = seats[learned], columns[learned]
        rows = self._rows[columns]
        writes = rows < len(self._rewards)
        self._writing[columns] = writes
        self._resets[columns] = self._episodes.ended[seats]
        first = rows == 0
        if np.count_nonzero(first):
            for name, frames in self._stacks.frames.items():
                self._frames[name][: self._depths[name], columns[first]] = frames[seats[first]].swapaxes(0, 1)
            self._initial_state[columns[first]] = self._state[seats[first]]
        self._env_steps += self._steps_that_count(seats[writes & ~self._episodes.ended[seats]])
        self._skipped += len(writes) - int(np.count_nonzero(writes))
        self._refuse_absent_seats()
        seats = self._deciding
        return RowInputs(
            {name: values[seats] for name, values in self._stacks.observations.items()},
            self._state[seats],
            {name: masks[seats] for name, masks in self._current_masks.items()},
            self._epsilon[seats],
            self._lineup.noise(self._runtime.noise_size, seats, self._random),
        )

    def _steps_that_count(self, written: np.ndarray) -> int:
        """Return in how many copies this step counts.

        It does where a row of a seat in `written` begins that is learned from, and where an opponent acts in a match
        that such rows are written of.
        """
        copies = np.zeros(len(self._over), np.bool_)
        copies[written // self._seats] = True
        if opposed := self._lineup.against_opponents:
            first = opposed.start * self._seats
            learned = self._rows[first:] < len(self._rewards)
            if len(learned) > len(opposed):
                learned = learned.reshape(len(opposed), -1).any(axis=1)
            learned &= ~self._over[opposed.start : opposed.stop]
            others = (self._acting & (self._lineup.column < 0))[first : opposed.stop * self._seats].nonzero()[0]
            others //= self._seats
            copies[opposed.start + others[learned[others]]] = True
        return int(np.count_nonzero(copies))

    def take_choice(self, choice: Choice) -> None:
        """See RolloutWriter."""
        seats = self._deciding
        columns = self._lineup.column[seats]
        chosen = columns >= 0
        chosen[chosen] = self._writing[columns[chosen]]  # of the choices: those that are written
        columns = columns[chosen]
        rows = self._rows[columns]
        self._log_probs[rows, columns] = choice.log_probs[chosen]
        self._next_state[seats] = choice.state
        for name, actions in self._actions.items():
            actions[rows, columns] = choice.actions[name][chosen]
            self._chosen[name][seats] = choice.actions[name]
        for name, masks in self._masks.items():
            masks[rows, columns] = self._current_masks[name][seats[chosen]]

    def record(self, observed: Observed, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> bool:
        """See RolloutWriter."""
        assert observed.acting is not None
        assert observed.over is not None
        was_over = self._over
        self._take_seats(observed)
        resets = self._episodes.ended
        # A column may go on with another seat after a row that resets.
        seats = (observed.acting & (self._lineup.column >= 0)).nonzero()[0]
        columns = self._lineup.column[seats]
        # An episode that ends before its first action has no rows: the row that resets goes on to the next one.
        written = self._writing[columns] & ~(self._resets[columns] & (terminated | truncated)[seats])
        seats, columns = seats[written], columns[written]
        rows, valid = self._rows[columns], ~self._resets[columns]
        for name, frames in self._frames.items():
            frames[self._depths[name] + rows, columns] = observed.frames[name][seats]
        self._rewards[rows, columns] = np.where(valid, rewards[seats], 0.0)
        self._terminated[rows, columns] = terminated[seats] & valid
        self._truncated[rows, columns] = truncated[seats] & valid
        self._valid[rows, columns] = valid
        self._rows[columns] += 1
        self._writing[columns] = False
        if self._state.size:
            goes_on = ~resets & np.isfinite(self._next_state).all(axis=1)
            state = np.where(goes_on[:, None], self._next_state, np.float32(0.0))
            self._state = np.where(observed.acting[:, None], state, self._state)
        self._show(observed)
        counted = self._lineup.column >= 0
        abandoned = self._lineup.step(rewards, (observed.over & ~was_over).nonzero()[0].tolist())
        # Also those that are not written: the agents who act most often would have too few results in the mean.
        self._episodes.step_seats(observed.acting, rewards, terminated | truncated, counted)
        for copy in abandoned:
            self._over[copy] = True
            self._episodes.abandon(slice(copy * self._seats, (copy + 1) * self._seats))
        return bool((self._rows == len(self._rewards)).all())

    def finish(
        self,
        identity: RolloutIdentity,
        policy_version: int,
        episode_info: dict[str, np.ndarray] | None = None,
    ) -> Rollout:
        """See RolloutWriter."""
        rollout = super().finish(identity, policy_version, episode_info)
        if not self._warned and self._skipped > self._rewards.size:
            self._warned = True
            _logger.warning(
                "more than half of the agents' steps are not learned from, for some agents act much more often than "
                "others: each has as many rows in a rollout (environment.agents chooses the agents)"
            )
        most = rollout.agent_steps * self._lineup.sides  # the learner takes no more
        if self._env_steps > most and not self._warned_of_steps:
            self._warned_of_steps = True
            _logger.warning(
                "opponents act much more often than the policy: of %d env_steps only %d are counted for a rollout, its "
                "rows times the number of sides",
                self._env_steps,
                most,
            )
        rollout = replace(rollout, game_steps=min(self._env_steps, most), matches=self._lineup.take_matches())
        self._rows[:] = 0
        self._env_steps = self._skipped = 0
        return rollout

    def _take_seats(self, observed: Observed) -> None:
        """Let the players of matches that have begun take their seats."""
        assert observed.over is not None
        began = self._over & ~observed.over
        if np.count_nonzero(began):
            self._lineup.seat(np.flatnonzero(began).tolist())
        self._over = observed.over

    def _show(self, observed: Observed) -> None:
        """Take what the seats show after a reset or a step."""
        assert observed.acting is not None
        self._stacks.push(observed.frames, observed.acting & self._episodes.ended, observed.acting)
        self._current_masks, self._acting = observed.masks, observed.acting

    def _refuse_absent_seats(self) -> None:
        if self._skipped <= _MOST_SKIPPED * self._rewards.size:
            return
        column = int(np.argmin(self._rows))
        seat = int(np.argmax(self._lineup.column == column)) % self._seats
        raise EnvironmentSetupError(
            f"agent number {seat} of the game hardly ever acts: the others took {self._skipped:,} steps that are not "
            "learned from, while its rows of one rollout were not full; leave it out with environment.agents"
        )


def _frames(space: ArraySpace | DiscreteSpace, rows: int, environments: int) -> np.ndarray:
    """Return an array for a rollout's frames [k-1 + T+1, E, *frame_shape].

    Images are stored environment by environment, as they are sent: consecutive images are alike and compress well.
    """
    length = space.frames + rows
    if len(space.shape) >= 2:
        return np.zeros((environments, length, *space.shape), space.dtype).swapaxes(0, 1)
    return np.zeros((length, environments, *space.shape), space.dtype)
