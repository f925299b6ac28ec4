"""Value estimates by the newest checkpoint of a run directory, for the camera of a gateway on the learner's machine."""

import logging
from pathlib import Path

import numpy as np

from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import UserModules

_logger = logging.getLogger("daedalus.cli")


class CheckpointValues:
    """Estimates of one run, as far as torch is installed and there is a checkpoint."""

    def __init__(self, directory: Path, modules: UserModules) -> None:
        self._directory, self._modules = directory, modules
        self._loaded: Path | None = None
        self._estimate = _unknown

    def refresh(self) -> None:
        """Use the newest checkpoint from now on. What cannot be read leaves the estimates as they are."""
        newest = next(iter(checkpoints(self._directory)), None)
        if newest is None or newest == self._loaded:
            return
        try:
            from daedalus.policy.acting.value_estimator import ValueEstimator  # imports torch

            self._estimate = ValueEstimator(read_policy(newest), self._modules)
        except ImportError:
            _logger.debug("there are no value estimates without torch")
        except (DamagedError, PolicyError, OSError) as error:  # such as a checkpoint that was pruned meanwhile
            _logger.debug("no value estimates: %s", error)
        self._loaded = newest

    def __call__(self, observations: dict[str, np.ndarray], state: np.ndarray) -> float | None:
        """Return the value of one observation; None if it is not known. See ValueEstimator."""
        return self._estimate(observations, state)


def _unknown(observations: dict[str, np.ndarray], state: np.ndarray) -> float | None:
    return None
