"""What the parts of one learner process share: the run, how far it has come, its actors and its health. No I/O."""

import threading
import time
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from daedalus.learner.league.ratings import LeagueState
from daedalus.learner.league.run_league import League
from daedalus.learner.reporting.thinning import MetricsHistory
from daedalus.learner.run.counters import Annealing, RunCounters, lesson_states
from daedalus.learner.run.lesson_progress import LessonProgress
from daedalus.learner.run.run_directory import run_name
from daedalus.learner.serving.evaluations import Evaluations
from daedalus.learner.serving.events import EventLog
from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.messages import new_epoch
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import listed

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint

# Without an update for so long, or for so many batches, the service has a problem. What actors say of themselves counts
# up to an hour.
_STALLED_SECONDS, _STALLED_BATCHES, _MOST_EXPECTED_SECONDS = 60.0, 3.0, 3600.0
_REMEMBERED = 0.8  # of the longest wait for a batch, at each batch
_FAR_SECONDS = 60.0  # so long after a rollout far outside what others send, its sender is a problem
SLOW_DISK_SECONDS = 10.0  # in which a disk has written a checkpoint, or a row of metrics
_NO_ACTOR_SECONDS = 10.0  # without a live actor for so long, the service has a problem


@dataclass(slots=True)
class Health:
    """Health of the learner process. Times are on the monotonic clock, in seconds."""

    started: float
    updated: float  # time of the last update, or the start
    actor_seen: float  # last time with a live actor, or the start
    awaited_since: float = 0.0  # `updated`, or the last time without a live actor if that is later
    batch_seconds: float = 0.0  # the longest of the last waits from one update to the next
    directory: str = ""  # of the run, as the problems name it
    saved: float | None = None  # time of the last checkpoint
    saving_since: float | None = None  # since when a checkpoint is being written, if one is
    save_fault: str = ""  # error of the last checkpoint, if it failed
    left_out: Set[str] = frozenset()  # names of the live actors that no batch waits for
    # By actor whose rollouts were left out because their numbers are far outside: which numbers, and the last time.
    far_outside: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    gradient_fault: bool = False  # whether the last update was skipped
    # Since when metrics and events are being written, or None if they are not.
    recording_since: Callable[[], float | None] = lambda: None
    # Days until the certificate of this process expires, or None without one.
    certificate_days_left: Callable[[], float | None] = lambda: None

    def __post_init__(self) -> None:
        self.awaited_since = max(self.awaited_since, self.updated)

    def note_far_outside(self, components: Mapping[str, str], now: float) -> None:
        """Note actors whose rollouts were left out because numbers are far outside, and their components."""
        recent = {name: each for name, each in self.far_outside.items() if now - each[1] < _FAR_SECONDS}
        self.far_outside = recent | {name: (component, now) for name, component in components.items()}

    def note_update(self, now: float) -> None:
        """Note that a batch was trained on."""
        self.batch_seconds = max(now - self.awaited_since, _REMEMBERED * self.batch_seconds)
        self.updated = self.actor_seen = self.awaited_since = now

    def note_actors(self, live: int, now: float) -> None:
        """Note how many actors are live."""
        if live:
            self.actor_seen = now
        else:
            self.awaited_since = now

    def is_stalled(self, now: float, expected: float) -> bool:
        """Return whether no update has come for much longer than usual.

        Args:
          now: time on the monotonic clock, in seconds.
          expected: how long the live actors take for a batch, in seconds, as far as they say; else 0.
        """
        usual = max(self.batch_seconds, min(expected, _MOST_EXPECTED_SECONDS))
        return now - self.awaited_since > max(_STALLED_SECONDS, _STALLED_BATCHES * usual)

    def problems(self, now: float, live: int, expected: float = 0.0) -> tuple[str, ...]:
        """Return descriptions of the problems, most severe first; empty if the service is healthy.

        Args:
          now: time on the monotonic clock, in seconds.
          live: number of live actors.
          expected: see `is_stalled`.
        """
        found = []
        if not live and now - self.actor_seen > _NO_ACTOR_SECONDS:
            found.append(f"no live actor for {now - self.actor_seen:.0f} s")
        elif self.is_stalled(now, expected):
            found.append(f"no update for {now - self.updated:.0f} s")
        if self.left_out:
            who = listed(sorted(self.left_out), 5)
            found.append(f"batches do not wait for {who}: connected, but far slower than the others, or hung")
        far = {name: each for name, (each, last) in self.far_outside.items() if now - last < _FAR_SECONDS}
        if far:
            names = [f"{name} ({component})" for name, component in sorted(far.items())]
            found.append(f"rollouts with numbers far outside those of other actors: {listed(names, 5)}")
        if self.gradient_fault:
            found.append("updates are skipped: the gradient is not finite")
        if self.save_fault:
            found.append(f"checkpoints cannot be saved: {self.save_fault}")
        for what, since in (("the checkpoint has", self.saving_since), ("metrics have", self.recording_since())):
            if since is not None and now - since > SLOW_DISK_SECONDS:
                waited = f"{what} been writing for {now - since:.0f} s"
                found.append(f"{waited}: the disk of {self.directory} is slow; training continues")
        return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunContext:
    """One run in one learner process. Its parts change, but not which they are."""

    directory: Path  # of the run
    name: str  # of the run, in all keys
    spec: RunSpec
    starts: int  # learner processes that the run has had, with this one
    learner_epoch: int  # of this process
    start_version: int  # policy version of the checkpoint that the run continues from, else 0
    started: float  # on the monotonic clock, in seconds
    other_episodes: bool  # whether episodes have another limit since a resume: earlier returns do not compare
    stop: threading.Event  # ends the run
    lock: threading.Condition  # guards the fleet, the counters and the state shared with other parts
    fleet: Fleet
    counters: RunCounters
    annealing: Annealing
    evaluations: Evaluations
    health: Health
    events: EventLog
    history: MetricsHistory
    league: League | None  # of a game
    lessons: LessonProgress

    @classmethod
    def begin(
        cls,
        directory: Path,
        spec: RunSpec,
        stop: threading.Event,
        *,
        started: float | None = None,
        spaces: Spaces | None = None,
        restored: "Checkpoint | None" = None,
    ) -> Self:
        """Begin a run, or continue it.

        Args:
          directory: of the run; its name is the name of the run.
          spec: specification of the run.
          stop: event that ends the run.
          started: start of the process on the monotonic clock, in seconds; None: now.
          spaces: spaces that all actors must have, if they are known; those of a checkpoint have precedence.
          restored: checkpoint to continue from, perhaps of other settings.
        """
        started = time.monotonic() if started is None else started
        training, counters = spec.training, RunCounters(spec.training.target_episodes)
        starts, version, annealing, other_episodes = 1, 0, Annealing(budget=training.env_steps), False
        league_state, lessons = None, LessonProgress(spec)
        if restored is not None:
            saved, before = restored.counters, restored.policy.spec
            starts, version, spaces = saved.get("starts", 0) + 1, restored.policy.policy_version, restored.policy.spaces
            other_episodes = before.environment.max_episode_steps != spec.environment.max_episode_steps
            counters.restore(saved)
            counters.forget_target(before, spec)
            if other_episodes:
                counters.forget_returns()
                counters.seconds_to_target = None
            annealing = Annealing(**saved.get("annealing", {"budget": before.training.env_steps}))  # not in early ones
            annealing = annealing.resumed(counters.env_steps, training.env_steps)
            if saved.get("league") is not None:  # absent in early ones
                league_state = LeagueState.model_validate(saved["league"])
            lessons = LessonProgress(spec, lesson_states(saved))
        epoch = new_epoch(starts)
        return cls(
            directory=directory,
            name=run_name(directory),
            spec=spec,
            starts=starts,
            learner_epoch=epoch,
            start_version=version,
            started=started,
            other_episodes=other_episodes,
            stop=stop,
            lock=threading.Condition(),
            fleet=Fleet(training.seed, spaces, training.epsilons, spec.collection.envs_per_actor),
            counters=counters,
            annealing=annealing,
            evaluations=Evaluations(counters),
            health=Health(started=started, updated=started, actor_seen=started, directory=str(directory)),
            events=EventLog(),
            history=MetricsHistory(),
            league=League(directory, spec, epoch, league_state) if spec.environment.is_game else None,
            lessons=lessons,
        )

    @property
    def progress(self) -> float:
        """Progress of the annealed settings, from 0 to 1."""
        return self.annealing.at(self.counters.env_steps)

    @property
    def expected_batch_seconds(self) -> float:
        """How long the live actors take for a batch, in seconds, as far as they say; else 0. Needs the lock."""
        return self.fleet.batch_seconds(self.spec.batch_rollouts, together=self.spec.algorithm.synchronous)

    @property
    def is_finished(self) -> bool:
        """Whether the run has used its budget, or reached a target at which it stops."""
        training, solved = self.spec.training, self.counters.seconds_to_target is not None
        return self.counters.env_steps >= training.env_steps or (solved and training.stop_when_solved)

    def wall_seconds(self, now: float) -> float:
        """Return the duration of the run in seconds, including the processes before a resume."""
        return self.counters.wall_seconds + now - self.started

    def saved(self, now: float) -> dict[str, Any]:
        """Return the counters in the form that a checkpoint stores."""
        counters = self.counters.state(self.wall_seconds(now))
        state = None if self.league is None else self.league.state()
        league = {} if state is None else {"league": state.model_dump(mode="json")}
        lessons = {"lessons": states} if (states := self.lessons.states()) else {}
        return {**counters, "annealing": self.annealing.model_dump(), "starts": self.starts, **league, **lessons}
