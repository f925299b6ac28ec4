"""Demonstrations in the learner: a buffer of their transitions."""

import logging
from collections.abc import Callable
from pathlib import Path

from daedalus.algorithms.replay_buffer import ReplayBuffer
from daedalus.learner.run.demonstration_files import DemonstrationFiles, check_memory
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)


def read_demonstrations(
    directory: Path, spec: RunSpec, spaces: Spaces, taken: int, beat: Callable[[], None] = lambda: None
) -> ReplayBuffer | None:
    """Return the demonstrations of a run directory, or None if it has none.

    Args:
      directory: of the run.
      spec: of the run.
      spaces: of the run.
      taken: bytes that the learner's replay buffer may take.
      beat: called before each part is read.

    Raises DamagedError, or SettingsError if they do not fit into memory, or not the run.
    """
    files = DemonstrationFiles(directory)
    if not files.steps:
        return None
    check_memory(files.steps, files.columns * spaces.replay_bytes(files.rows), taken)
    buffer = ReplayBuffer(spaces, files.rows, files.columns * files.rows)
    for rollout in files.rollouts(spaces, spec.policy):
        beat()
        buffer.add(rollout)
    _logger.info("demonstrations: %s steps of %s", f"{files.steps:,}", files.dataset)
    return buffer
