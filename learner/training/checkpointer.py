"""Saving of checkpoints beside training. A disk error is logged as a warning and does not end the run.

The thread that trains only copies the state, between two updates. A thread of its own writes: a disk may take minutes,
or never answer. One checkpoint is written at a time, so that there is one copy. Whoever wants another meanwhile asks
again when the thread is idle, and then gets the newest state.
"""

import errno
import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Set
from dataclasses import dataclass, field
from pathlib import Path

from daedalus.learner.run.process_resources import reserved_descriptors
from daedalus.learner.run.run_directory import CONFIG, write_config
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.evaluations import Evaluated
from daedalus.learner.serving.run_context import SLOW_DISK_SECONDS, RunContext
from daedalus.learner.training.checkpoint import EncodedCheckpoint, encode_checkpoint, save_checkpoint
from daedalus.learner.training.learner import Learner
from daedalus.policy.saving.best_checkpoints import TrainingScore
from daedalus.policy.saving.saved_policy import checkpoint_path
from daedalus.policy.user_code import shown_path

_logger = logging.getLogger(__name__)

_FULL = {errno.ENOSPC, errno.EDQUOT}  # errors of a disk or a quota without room
STOP_SECONDS = 20.0  # for the last checkpoint of a learner that is stopped: supervisors kill it after 30 s
_FINISH_SECONDS = 600.0  # for the last checkpoint of a run that has ended by itself
_EVALUATOR_SECONDS = 600.0  # of silence, after which nobody evaluates
_POLL_SECONDS = 0.05


@dataclass(slots=True, eq=False)
class Saving:
    """A checkpoint that is being written, or was."""

    policy_version: int
    env_steps: int
    directory: Path  # its place, where it may not be yet
    last: bool = False  # the last one of this process
    done: threading.Event = field(default_factory=threading.Event)
    is_saved: bool = False
    result: str = ""  # what came of it, when it is done


class Checkpointer:
    """Writer of one learner's checkpoints into its run directory."""

    def __init__(
        self,
        context: RunContext,
        learner: Learner,
        program: bytes,
        begin_replay: Callable[[], Callable[[], None]] = lambda: lambda: None,
    ) -> None:
        """Construct the checkpointer, and start its thread.

        Args:
          context: the counters and settings to save. Checkpoints that are being evaluated are not pruned.
          learner: source of the parameters and the optimiser state.
          program: content of every checkpoint.
          begin_replay: copies what is to be saved of a replay buffer, and returns what writes it: ReplayFiles.begin.
        """
        self._begin_replay = begin_replay
        self._context, self._spec, self._health, self._events = context, context.spec, context.health, context.events
        self._learner, self._program = learner, program
        self.seconds = 0.0  # that the last checkpoint took to be written
        self._newest: tuple[int, Path] | None = None  # policy version and directory of the last checkpoint
        self._env_steps = context.counters.env_steps  # of the last checkpoint; at first, of the one that was restored
        self._advice = ""  # after the last error
        self._unfinished, self._counting = 0, threading.Lock()  # number of jobs
        # Bounded by its users: one checkpoint, the last one, the results of evaluations in progress, and one version of
        # the league.
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        threading.Thread(target=self._work, name="checkpoints", daemon=True).start()  # it may never end: see above

    @property
    def idle(self) -> bool:
        """Whether nothing is being written."""
        return not self._unfinished

    def begin(
        self, *, again: bool = True, last: bool = False, on_end: Callable[[Saving], None] = lambda _: None
    ) -> Saving:
        """Copy the present state, and begin to write it. The caller has checked `idle`, or trains no more.

        Args:
          again: write it even if this policy version is saved already.
          last: it is the last one of this process.
          on_end: called on the thread that writes, when the checkpoint is saved or has failed.
        """
        learner = self._learner
        with self._context.lock:
            counters = self._context.saved(time.monotonic())
            score = self._training_score()
        directory = checkpoint_path(self._context.directory, learner.policy_version)
        saving = Saving(learner.policy_version, counters["env_steps"], directory, last)
        encoded = encode_checkpoint(
            spec=self._spec,
            spaces=learner.spaces,
            policy_version=learner.policy_version,
            program=self._program,
            parameters=learner.weights(),
            state=learner.state(),
            counters=counters,
            score=score,
        )
        # Not with the policies of evaluators, which wait.
        write_replay = self._begin_replay() if again else lambda: None
        # Evaluations that end meanwhile are in it too, and none begins before the thread is idle.
        in_use = self._context.evaluations.checkpoints_in_use

        def save() -> None:
            try:
                if again or self._newest != (saving.policy_version, directory) or not directory.exists():
                    self._save(saving, encoded, in_use, write_replay)
                else:
                    saving.is_saved = True
            finally:
                saving.done.set()
            on_end(saving)

        self.add(save)
        return saving

    def keep(self, evaluated: Evaluated) -> None:
        """Keep the checkpoint of an evaluation if it is among the best, and log the result."""
        league = self._context.league
        plays_itself = league is not None and league.has_begun
        self.add(lambda: _logger.info("%s", evaluated.text if plays_itself else evaluated.keep()))

    def wait(self, saving: Saving, beat: Callable[[], None], *, patient: bool = True) -> bool:
        """Wait until a checkpoint is written, and return whether it is saved. A slow disk ends the wait.

        Args:
          saving: the checkpoint.
          beat: called again and again, to show that this process works.
          patient: wait for `STOP_SECONDS` after the run is stopped.
        """
        began = time.monotonic()
        limit, ending, warned = _FINISH_SECONDS, False, False
        while not saving.done.wait(_POLL_SECONDS):
            waited = time.monotonic() - began
            if self._context.stop.is_set() and not ending:
                limit, ending = min(limit, waited + (STOP_SECONDS if patient else 0.0)), True
            if waited >= limit:
                break
            if waited >= SLOW_DISK_SECONDS and not warned:
                warned = True
                _logger.warning("waiting for the checkpoint: the disk of %s is slow", self._context.directory)
            beat()
        if saving.last and not saving.is_saved:
            self._report_loss(saving, time.monotonic() - began)
        return saving.is_saved

    def _report_loss(self, saving: Saving, waited: float) -> None:
        """Say what a resumed run lacks, because the last checkpoint is not saved."""
        text = f"the last checkpoint, at {saving.env_steps:,} env_steps, "
        if saving.done.is_set():
            text += f"could not be saved: {self._health.save_fault}; {self._advice}, then resume the run"
        else:
            text += f"was not saved within {waited:.0f} s: the disk of {self._context.directory} is slow; "
            lost = saving.env_steps - self._env_steps
            text += f"a resumed run continues from {self._env_steps:,} env_steps, and the last {lost:,} are lost"
        self._events.add("checkpoint", text, level=logging.ERROR)

    def _training_score(self) -> TrainingScore | None:
        """Return the mean return of the newest training episodes, if there are enough of them and nobody evaluates.

        None where the policy plays itself, or lessons make the task harder: its newest version counts as the best.
        """
        if self._spec.lessons:
            return None
        if self._context.league is not None and self._context.league.has_begun:
            return None
        counters = self._context.counters
        mean, episodes = counters.episode_return_mean, counters.target_episodes
        silence = max(_EVALUATOR_SECONDS, 2.0 * (self._spec.evaluation.seconds or 0.0))
        if mean is None or not math.isfinite(mean) or len(counters.returns) < episodes:
            return None
        if time.monotonic() < self._context.evaluations.heard + silence:
            return None
        return TrainingScore(return_mean=mean, episodes=episodes, true_task=self._spec.trains_true_task)

    def add(self, job: Callable[[], None]) -> None:
        """Let the thread that writes do something, after what it was given before."""
        with self._counting:
            self._unfinished += 1
        self._jobs.put(job)

    # ------------------------------------------------------------------------------- on the thread that writes

    def _work(self) -> None:
        while True:
            job = self._jobs.get()
            self._health.saving_since = time.monotonic()
            with reserved_descriptors():
                job()
            self._health.saving_since = None
            with self._counting:
                self._unfinished -= 1

    def _save(
        self, saving: Saving, encoded: EncodedCheckpoint, in_use: Set[Path], write_replay: Callable[[], None]
    ) -> None:
        began, keep = time.monotonic(), self._spec.service.keep_checkpoints
        try:
            if self._newest is not None and not (self._context.directory / CONFIG).exists():
                self._restore_config()
            save_checkpoint(self._context.directory, encoded, keep=keep, also_keep=in_use)
        except OSError as error:
            fault = error.strerror or type(error).__name__
            saving.result = f"checkpoint not saved: {fault}"
            if not self._health.save_fault and not saving.last:
                text = (
                    f"{saving.result}; the previous checkpoint is kept, training continues, "
                    f"and saving is retried every {self._spec.service.checkpoint_seconds:g} s"
                )
                self._events.add("checkpoint", text, level=logging.WARNING)
            self._health.save_fault = fault
            self._advice = "make room" if error.errno in _FULL else "correct this"
            return
        self.seconds = time.monotonic() - began
        if self._health.save_fault:
            _logger.info("checkpoints are saved again")
        saving.is_saved, saving.result = True, f"checkpoint saved at {saving.env_steps:,} env_steps"
        text, level = f"{saving.result}: {shown_path(str(saving.directory))}", logging.INFO
        if self.seconds >= SLOW_DISK_SECONDS:
            text, level = f"{text}, after {self.seconds:.0f} s: the disk is slow", logging.WARNING
        self._events.add("checkpoint", text, level=level)
        self._health.saved, self._health.save_fault = time.monotonic(), ""
        self._newest, self._env_steps = (saving.policy_version, saving.directory), saving.env_steps
        try:
            write_replay()
        except OSError as error:
            text = f"replay buffer not saved: {error.strerror or type(error).__name__}; "
            text += "a resumed run would begin without its newest transitions" if saving.last else "this is retried"
            self._events.add("checkpoint", text, level=logging.WARNING)

    def _restore_config(self) -> None:
        """Write config.toml again, without which nobody can resume the run. Raises OSError."""
        directory = self._context.directory
        directory.mkdir(0o700, parents=True, exist_ok=True)
        try:
            write_config(directory, self._spec)
        except SettingsError as error:
            raise OSError(errno.EIO, str(error)) from None
        text = f"the run directory {directory} was moved or removed: the run continues in a new one of this name"
        self._events.add("checkpoint", text, level=logging.WARNING)
