"""Saving of checkpoints during training. A disk error is logged as a warning and does not end the run."""

import errno
import logging
import threading
import time
from pathlib import Path

from daedalus.learner.run.run_directory import CONFIG, write_config
from daedalus.learner.run.run_state import RunState
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.events import EventLog
from daedalus.learner.training.checkpoint import save_checkpoint
from daedalus.learner.training.learner import Learner
from daedalus.protocol.spaces import Spaces

_logger = logging.getLogger(__name__)

_FULL = {errno.ENOSPC, errno.EDQUOT}  # errors of a disk or a quota without room


class Checkpointer:
    """Writer of one learner's checkpoints into its run directory."""

    def __init__(
        self,
        state: RunState,
        learner: Learner,
        program: bytes,
        spaces: Spaces,
        *,
        events: EventLog,
        lock: threading.Condition,
    ) -> None:
        """Construct the checkpointer.

        Args:
          state: the counters and settings to save. Checkpoints that are being evaluated are not pruned.
          learner: source of the parameters and the optimiser state.
          program, spaces: content of every checkpoint.
          events: receives each saved checkpoint and each error.
          lock: guards the counters.
        """
        self._state, self._spec, self._health = state, state.spec, state.health
        self._learner, self._program, self._spaces = learner, program, spaces
        self._events, self._lock = events, lock
        self._newest: tuple[int, Path] | None = None  # policy version and directory of the last checkpoint

    def ensure_saved(self) -> Path | None:
        """Return the checkpoint of the present version; save it if it was not saved. Return None on a disk error."""
        if self._newest is not None:
            version, directory = self._newest
            if version == self._learner.policy_version and directory.exists():
                return directory
        return self.save()

    def save(self, *, last: bool = False) -> Path | None:
        """Save a checkpoint and return its directory, or None on a disk error; `last` is that of this process."""
        with self._lock:
            counters = self._state.saved(time.monotonic())
        try:
            if self._newest is not None and not (self._state.directory / CONFIG).exists():
                self._restore_config()
            directory = save_checkpoint(
                self._state.directory,
                spec=self._spec,
                spaces=self._spaces,
                policy_version=self._learner.policy_version,
                program=self._program,
                parameters=self._learner.weights(),
                state=self._learner.state(),
                counters=counters,
                keep=self._spec.service.keep_checkpoints,
                also_keep=self._state.evaluations.checkpoints_in_use,
            )
        except OSError as error:
            fault = error.strerror or type(error).__name__
            if last:
                text = f"the last checkpoint, at {counters['env_steps']:,} env_steps, could not be saved: {fault}; "
                text += f"{'make room' if error.errno in _FULL else 'correct this'}, then resume the run"
                self._events.add("checkpoint", text, level=logging.ERROR)
            elif not self._health.save_fault:
                text = (
                    f"checkpoint not saved: {fault}; the previous checkpoint is kept, training continues, "
                    f"and saving is retried every {self._spec.service.checkpoint_seconds:g} s"
                )
                self._events.add("checkpoint", text, level=logging.WARNING)
            self._health.save_fault = fault
            return None
        if self._health.save_fault:
            _logger.info("checkpoints are saved again")
        self._events.add("checkpoint", f"checkpoint saved at {counters['env_steps']:,} env_steps: {directory}")
        self._health.saved, self._health.save_fault = time.monotonic(), ""
        self._newest = self._learner.policy_version, directory
        return directory

    def _restore_config(self) -> None:
        """Write config.toml again, without which nobody can resume the run. Raises OSError."""
        directory = self._state.directory
        directory.mkdir(0o700, parents=True, exist_ok=True)
        try:
            write_config(directory, self._spec)
        except SettingsError as error:
            raise OSError(errno.EIO, str(error)) from None
        text = f"the run directory {directory} was moved or removed: the run continues in a new one of this name"
        self._events.add("checkpoint", text, level=logging.WARNING)
