"""How far a run has come: annealed settings, and counters and newest episodes, which checkpoints save."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import BaseModel, Field, TypeAdapter

from daedalus.learner.league.ratings import LeagueState
from daedalus.learner.run.lesson_progress import LessonState
from daedalus.protocol.spec import RunSpec, TrainingSpec
from daedalus.protocol.uploads import MAX_INFO_NAMES, Rollout, Upload, mean_return


class Annealing(BaseModel, frozen=True, strict=True, extra="forbid"):
    """Progress of the annealed settings over the budget of a run, from 0 to 1.

    The progress grows linearly from `progress` at `env_steps` to 1 at `budget`. A new run begins at 0. A run that is
    resumed with another budget goes on from the progress that it had, so that no setting jumps back.
    """

    budget: int  # env_steps
    env_steps: int = 0
    progress: float = 0.0

    def at(self, env_steps: int) -> float:
        """Return the progress after so many env_steps of the run."""
        remaining = self.budget - self.env_steps
        if env_steps >= self.budget or remaining <= 0:
            return 1.0
        return self.progress + (1.0 - self.progress) * ((env_steps - self.env_steps) / remaining)

    def resumed(self, env_steps: int, budget: int) -> "Annealing":
        """Return the annealing of a run that is resumed after `env_steps` with a budget."""
        if budget == self.budget:
            return self
        return Annealing(budget=budget, env_steps=env_steps, progress=self.at(env_steps))


def updates_of(training: TrainingSpec, uploads: Sequence[Upload], *, memory: bool) -> int:
    """Return the number of policy versions that a batch of these uploads makes; `memory`: the policy has one."""
    if memory:  # gradients make one, whatever their number
        return training.updates_from(sum(upload.environments for upload in uploads if isinstance(upload, Rollout)))
    return training.updates_from(sum(upload.agent_steps for upload in uploads))


_SAVED = (
    "env_steps",
    "agent_steps",
    "updates",
    "updates_skipped",
    "episodes",
    "rollouts_accepted",
    "rollouts_trained",
    "rollout_bytes",
    "accepted_env_steps",
    "policy_lag_sum",
    "policy_lag_max",
    "snapshots_published",
)
_Count = Annotated[int, Field(ge=0, lt=2**63)]
_COUNTS = TypeAdapter(dict[str, _Count], config={"strict": True})  # of _SAVED


_LESSONS = TypeAdapter(dict[str, LessonState])


class _State(BaseModel, strict=True):
    """The other values of RunCounters.state, and what RunContext.saved adds."""

    rollouts_rejected: dict[str, _Count]
    best_evaluation: float | None = None  # absent in checkpoints of earlier releases
    wall_seconds: Annotated[float, Field(ge=0)]
    seconds_to_target: float | None = None  # absent in checkpoints of earlier releases
    returns: list[float]
    lengths: list[int]
    annealing: Annealing | None = None  # absent in checkpoints of earlier releases
    starts: _Count = 0  # absent in checkpoints of earlier releases


def check_counters(state: Any) -> dict[str, Any]:
    """Return counters that were read, if they can be restored. Raises KeyError or ValueError if they cannot."""
    _State.model_validate(state)
    if state.get("league") is not None:
        LeagueState.model_validate(state["league"])
    lesson_states(state)
    _COUNTS.validate_python({name: state[name] for name in _SAVED if name in state or name == "env_steps"})
    return state


def lesson_states(state: dict[str, Any]) -> dict[str, LessonState]:
    """Return the states of lessons in what RunContext.saved returned. Raises ValueError."""
    return _LESSONS.validate_python(state.get("lessons", {}))  # absent in checkpoints of earlier releases


@dataclass(slots=True)
class RunCounters:
    """Counts over the whole run, including the processes before a resume."""

    target_episodes: int  # number of newest episodes in the mean return
    env_steps: int = 0  # environment steps that were trained on
    agent_steps: int = 0  # of the agents in them
    updates: int = 0
    updates_skipped: int = 0  # updates without an optimiser step, because the gradient was not finite
    episodes: int = 0
    rollouts_accepted: int = 0
    rollouts_rejected: Counter[str] = field(default_factory=Counter)  # by cause
    rollouts_trained: int = 0
    rollout_bytes: int = 0  # of accepted rollouts, compressed
    accepted_env_steps: int = 0
    policy_lag_sum: int = 0
    policy_lag_max: int = 0
    snapshots_published: int = 0
    best_evaluation: float | None = None  # the highest mean return of an evaluation
    wall_seconds: float = 0.0  # of the learner processes before this one
    seconds_to_target: float | None = None  # duration of the run until the target was reached; None if it was not
    returns: deque[float] = field(init=False)
    lengths: deque[int] = field(init=False)
    learning_seconds: float = 0.0  # that this process computed updates; not saved
    decoding_seconds: float = 0.0  # that it decoded rollouts; not saved
    info: dict[str, deque[float]] = field(default_factory=dict)  # newest scalars of the environment; not saved

    def __post_init__(self) -> None:
        self.returns = deque(maxlen=self.target_episodes)
        self.lengths = deque(maxlen=self.target_episodes)

    def accepted(self, rollout: Upload, size: int) -> None:
        """Count an accepted rollout that came in a message of `size` bytes."""
        self.rollouts_accepted += 1
        self.rollout_bytes += size
        self.accepted_env_steps += rollout.env_steps

    def trained(self, rollouts: Sequence[Upload], policy_version: int, updates: int) -> None:
        """Count a batch that the learner is about to train on.

        Args:
          rollouts: the rollouts of the batch.
          policy_version: newest policy version; the policy lag is relative to it.
          updates: number of updates that the batch makes.
        """
        for rollout in rollouts:
            lag = policy_version - rollout.policy_version
            self.policy_lag_sum += lag
            self.policy_lag_max = max(self.policy_lag_max, lag)
            self.returns.extend(rollout.episode_returns.tolist())
            self.lengths.extend(rollout.episode_lengths.tolist())
            self.episodes += len(rollout.episode_returns)
            self.env_steps += rollout.env_steps
            self.agent_steps += rollout.agent_steps
            self._add_info(rollout)
        self.rollouts_trained += len(rollouts)
        self.updates += updates

    def _add_info(self, rollout: Upload) -> None:
        for name, values in rollout.episode_info.items():
            if name in self.info or len(self.info) < MAX_INFO_NAMES:
                self.info.setdefault(name, deque(maxlen=self.target_episodes)).extend(values.tolist())

    def evaluated(self, mean: float) -> None:
        """Count an evaluation with this mean return."""
        self.best_evaluation = mean if self.best_evaluation is None else max(mean, self.best_evaluation)

    @property
    def episode_return_mean(self) -> float | None:
        """Mean return of the newest `target_episodes` training episodes; None before the first episode."""
        return mean_return(self.returns) if self.returns else None

    @property
    def policy_lag_mean(self) -> float:
        """Mean policy lag of the rollouts that were trained on, in updates."""
        return self.policy_lag_sum / max(self.rollouts_trained, 1)

    def reached(self, target: float | None) -> bool:
        """Return whether there are `target_episodes` episodes and their mean return is at least the target."""
        mean = self.episode_return_mean
        return target is not None and mean is not None and len(self.returns) == self.target_episodes and mean >= target

    def is_solved(self, spec: RunSpec) -> bool:
        """Return whether the target was reached.

        Where actors explore and do worse, also by an evaluation; only by one where training plays another task.
        """
        target, best = spec.training.target_return, self.best_evaluation
        evaluated = target is not None and best is not None and best >= target
        if not spec.trains_true_task:
            return evaluated
        return (spec.training.explores and evaluated) or self.reached(target)

    def forget_returns(self) -> None:
        """Forget the newest episodes and the best evaluation, so that the target has to be reached again."""
        self.returns.clear()
        self.lengths.clear()
        self.best_evaluation = None

    def forget_target(self, before: RunSpec, spec: RunSpec) -> None:
        """Forget when the target was reached, where it has to be reached again under the settings of a resumed run.

        Only a target at which training does not end, and which is the same as before, stays reached.
        """
        same = (before.target, before.training.target_episodes) == (spec.target, spec.training.target_episodes)
        if spec.training.stop_when_solved or not same:
            self.seconds_to_target = None

    def state(self, wall_seconds: float) -> dict[str, Any]:
        """Return all counters as plain JSON values; `wall_seconds` is the duration of the whole run so far."""
        return {
            **{name: getattr(self, name) for name in _SAVED},
            "rollouts_rejected": dict(self.rollouts_rejected),
            "best_evaluation": self.best_evaluation,
            "wall_seconds": wall_seconds,
            "seconds_to_target": self.seconds_to_target,
            "returns": list(self.returns),
            "lengths": list(self.lengths),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the counters from a result of `state`."""
        for name in _SAVED:
            setattr(self, name, state.get(name, 0))  # absent in checkpoints of earlier releases
        self.rollouts_rejected = Counter(state["rollouts_rejected"])
        self.best_evaluation = state.get("best_evaluation")  # absent in checkpoints of earlier releases
        self.wall_seconds = state["wall_seconds"]
        self.seconds_to_target = state.get("seconds_to_target")  # absent in checkpoints of earlier releases
        self.returns.extend(state["returns"])
        self.lengths.extend(state["lengths"])
