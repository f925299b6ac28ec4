"""The process of a gateway's camera: plays episodes with the newest policy, and writes what the page shows.

The gateway starts it while somebody watches. See playing_child.py.
"""

import argparse
import logging
import os
import time
from pathlib import Path

import numpy as np

from daedalus.actor.evaluation.episode_camera import EpisodeCamera, Moment, jpeg
from daedalus.gateway.watching.playing_process import frame, note
from daedalus.launch.playing_child import GatewayPipes, run_player
from daedalus.learner.run.run_directory import run_name
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import UserModules

_logger = logging.getLogger("daedalus.launch.camera_process")


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
            import torch

            from daedalus.policy.acting.value_estimator import ValueEstimator

            torch.set_num_threads(1)
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


FRAMES_PER_SECOND = 15.0
_LONGEST_SECONDS = 1.0  # for one frame, for somebody who waits
_BETWEEN_EPISODES_SECONDS = 0.7


class _Film:
    """Frames to the gateway, at most FRAMES_PER_SECOND; of slower environments at their own speed."""

    def __init__(self, gateway: GatewayPipes) -> None:
        self._gateway, self._due = gateway, time.monotonic()

    def show(self, moment: Moment, version: int) -> None:
        """Write a frame when it is due."""
        facts = {"version": version, "step": moment.step, "reward": moment.reward, "total": moment.total}
        facts |= {"value": moment.value}
        self._gateway.stop.wait(max(self._due - time.monotonic(), 0.0))
        seconds = min(max(moment.seconds, 1.0 / FRAMES_PER_SECOND), _LONGEST_SECONDS)
        self._due = max(self._due + seconds, time.monotonic())
        self._gateway.write(frame({**facts, "actions": moment.actions}, jpeg(moment.picture)))


def _play(gateway: GatewayPipes, modules: UserModules, arguments: argparse.Namespace) -> int:
    """Play until the gateway stops this process, and return the exit status."""
    try:
        _film(gateway, modules, arguments.checkpoints)
    except ImportError:
        gateway.write(note('The camera needs Pillow: pip install "daedalus-rl[gateway]" on the host of the gateway.'))
        return 1
    return 0


def _film(gateway: GatewayPipes, modules: UserModules, checkpoints: Path | None) -> None:
    # The environment may change the working directory.
    checkpoints = None if checkpoints is None else Path(os.path.abspath(checkpoints))
    welcome, program = gateway.begin()
    film, stop = _Film(gateway), gateway.stop
    runtime = OnnxRuntime(program.model.tobytes(), stop)
    is_its_directory = checkpoints is not None and run_name(checkpoints) == welcome.run
    values = CheckpointValues(checkpoints, modules) if checkpoints is not None and is_its_directory else None
    camera = EpisodeCamera(welcome.spec, modules) if values is None else EpisodeCamera(welcome.spec, modules, values)
    try:
        while not stop.is_set():
            snapshot = gateway.newest
            assert snapshot is not None
            runtime.load(snapshot.weights)
            if values is not None:
                values.refresh()
            for moment in camera.play(runtime):
                film.show(moment, snapshot.policy_version)
                if stop.is_set():
                    return
            stop.wait(_BETWEEN_EPISODES_SECONDS)
    finally:
        camera.close()


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--checkpoints", type=Path, help="run directory, for value estimates")
    run_player("camera", "The camera cannot play", _play, options)
