"""State of a run that the parts of a learner process share. No I/O."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from daedalus.learner.run.counters import Annealing, RunCounters
from daedalus.learner.run.health import Health
from daedalus.learner.run.run_directory import run_name
from daedalus.learner.serving.evaluations import Evaluations
from daedalus.protocol.messages import new_epoch
from daedalus.protocol.spec import RunSpec


class RunState:
    """How far one run has come, and how its learner process is.

    Attributes:
      directory: the run directory.
      name: name of the run, in all keys.
      spec: specification of the run.
      learner_epoch: epoch of this learner process.
      counters: the lock of the actor server guards them.
      annealing: progress of the annealed settings.
      evaluations: evaluations in progress, and the newest result.
      health: what the status reports as problems.
    """

    def __init__(
        self,
        directory: Path,
        spec: RunSpec,
        started: float,
        certificate_days_left: Callable[[], float | None] = lambda: None,
        starts_before: int = 0,
    ) -> None:
        """Begin a run, or continue it.

        Args:
          directory, spec: see RunState.
          started: on the monotonic clock, in seconds.
          certificate_days_left: see Health.
          starts_before: learner processes that the run had before, from the checkpoint that it continues from.
        """
        self.directory, self.name, self.spec, self._started = directory, run_name(directory), spec, started
        self._starts = starts_before + 1
        self.learner_epoch = new_epoch(self._starts)
        self.other_episodes = False  # episodes have another limit since a resume: earlier returns do not compare
        self.counters = RunCounters(spec.training.target_episodes)
        self.annealing = Annealing(budget=spec.training.env_steps)
        self.evaluations = Evaluations(self.learner_epoch, self.counters)
        self.health = Health(
            started=started,
            updated=started,
            actor_seen=started,
            directory=str(directory),
            certificate_days_left=certificate_days_left,
        )

    @property
    def progress(self) -> float:
        """Progress of the annealed settings, from 0 to 1."""
        return self.annealing.at(self.counters.env_steps)

    @property
    def is_finished(self) -> bool:
        """Whether the run has used its budget, or reached a target at which it stops."""
        training, solved = self.spec.training, self.counters.seconds_to_target is not None
        return self.counters.env_steps >= training.env_steps or (solved and training.stop_when_solved)

    def wall_seconds(self, now: float) -> float:
        """Return the duration of the run in seconds, including the processes before a resume."""
        return self.counters.wall_seconds + now - self._started

    def saved(self, now: float) -> dict[str, Any]:
        """Return the counters in the form that a checkpoint stores."""
        counters = self.counters.state(self.wall_seconds(now))
        return {**counters, "annealing": self.annealing.state(), "starts": self._starts}

    def restore(self, saved: dict[str, Any], before: RunSpec) -> None:
        """Continue from a result of `saved`, perhaps with other settings than those of the run `before`."""
        self.counters.restore(saved)
        self.counters.forget_target(before.training, self.spec.training)
        if before.environment.max_episode_steps != self.spec.environment.max_episode_steps:
            self.other_episodes = True
            self.counters.forget_returns()
            self.counters.seconds_to_target = None
        annealing = Annealing(**saved.get("annealing", {"budget": before.training.env_steps}))  # absent in early ones
        self.annealing = annealing.resumed(self.counters.env_steps, self.spec.training.env_steps)
