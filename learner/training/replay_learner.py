"""The learner of an algorithm with a replay buffer: rollouts go into it, and minibatches of it make the updates."""

import contextlib
import logging
import math
import secrets
import time
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.gradients import Terms, is_mixed
from daedalus.algorithms.replay_buffer import ReplayBuffer, Transitions, joined
from daedalus.algorithms.sac import POLICY_PERIOD, Sac, TwinCritics
from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.learner.training.optimizers import build_optimizer
from daedalus.learner.training.update_graphs import memory_faults
from daedalus.policy.network.layers import map_components
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec, TrainingSpec
from daedalus.protocol.texts import mebibytes
from daedalus.protocol.uploads import Rollout, Upload
from daedalus.transport.process_usage import available_memory

_logger = logging.getLogger(__name__)

_SLICE_SECONDS = 0.5  # of updates at a time: evaluators, orders and signals wait meanwhile
_MEMORY_SHARE = 0.75  # of what is available, where the run does not say


class ReplayLearner(Learner):
    """Learner with a replay buffer.

    Each row to learn from earns `training.updates_per_env_step` updates, of which the whole ones are made after its
    rollout, before the next rollout is taken: actors that are faster wait, and slower ones are waited for.
    """

    def __init__(self, run: RunSpec, spaces: Spaces, modules: UserModules = NO_MODULES) -> None:
        """Construct the learner at policy version 0. Raises as Learner, and SettingsError for too large a buffer."""
        spec = run.training
        super().__init__(spec, run.policy, spaces, modules)
        self.replay = build_replay_buffer(spec, spaces, run.collection.rollout_length)
        algorithm = self._gradients.algorithm
        assert isinstance(algorithm, Sac)
        mixed = is_mixed(spec.precision, self.device, self._network.convolutional)
        critics = TwinCritics(run.policy, spaces, modules).to(self.device)
        algorithm.build(critics, self._network, is_mixed=mixed)
        self._algorithm = algorithm
        self._learned = {"policy": self._flat.values, **algorithm.learned}
        self._optimizers = {
            "policy": self._step.optimizer,
            **{name: build_optimizer(spec, values) for name, values in algorithm.learned.items()},
        }
        self.demonstrations: ReplayBuffer | None = None
        self._begin = max(min(spec.replay_begin, self.replay.capacity // 2, spec.env_steps // 2), 1)
        self._owed = torch.zeros((), dtype=torch.float64)  # updates that rows have earned, and that are not made yet
        # Of the run: its buffer on the disk has the same.
        self._identity = torch.tensor(secrets.randbits(62))

    @property
    def replay_identity(self) -> int:
        """Random number of the run, which its saved replay buffer bears."""
        return int(self._identity)

    def load(self, parameters: dict[str, np.ndarray]) -> None:
        """See Learner. The critics get the convolutions of the policy."""
        super().load(parameters)
        self._algorithm.take_convolutions()

    def restore(self, version: int, parameters: dict[str, np.ndarray], state: dict[str, Tensor]) -> None:
        """See Learner. Raises CheckpointMismatchError also for critics that would give other values."""
        shapes = {f"algorithm/{name}": values.shape for name, values in self._algorithm.statistics.items()}
        if any(name.startswith("algorithm/") and shapes.get(name) != values.shape for name, values in state.items()):
            raise CheckpointMismatchError(
                "the critics of the run are those of an earlier version of Daedalus: go on with that, or begin a run "
                "with its policy: --init-from RUN_DIRECTORY"
            )
        super().restore(version, parameters, state)

    def learn_from(self, demonstrations: ReplayBuffer) -> None:
        """See Learner: they are a share of each minibatch."""
        self.demonstrations = demonstrations

    def updates_of(self, rollouts: Sequence[Upload]) -> int:
        """Return the number of updates that the learner makes after it has received these rollouts."""
        steps = sum(rollout.agent_steps for rollout in rollouts)
        if self.replay.rows_added + steps < self._begin or not (len(self.replay) or steps):
            return 0
        return math.floor(float(self._owed) + self._spec.updates_per_env_step * steps)

    @property
    def updates_due(self) -> int:
        """Number of updates to make before the next rollout is taken."""
        return self.updates_of(())

    def step(self, rollouts: Sequence[Rollout], progress: float) -> list[Rollout]:
        """Add rollouts to the buffer, and make the updates that are due, for half a second at most.

        While `updates_due` is not 0, the caller calls again, without rollouts. See Learner.
        Raises SettingsError if the GPU has too little memory for a minibatch.
        """
        self.far_outside = {}
        if rollouts:
            before = self.replay.rows_added
            steps = sum(rollout.agent_steps for rollout in self._receive(rollouts))
            if before + steps >= self._begin:
                self._owed += self._spec.updates_per_env_step * steps
        end = time.monotonic() + _SLICE_SECONDS
        while self.updates_due and time.monotonic() < end:
            self._owed -= 1.0
            with memory_faults(self._spec.minibatch_rows, self._fitting_minibatch, "training.minibatch_rows"):
                self._update(progress)
        return []

    def _receive(self, rollouts: Sequence[Rollout]) -> list[Rollout]:
        """Add rollouts to the buffer, and return those that were not left out."""
        batch, kept, seen = self._sorted_out(rollouts)
        for rollout in kept:
            # With the rewards as they came: what a few short rollouts confirm would keep rare rewards small for ever.
            self.replay.add(rollout)
        self._merge_observations([seen[rollout] for rollout in kept])
        self.metrics.add_batch(batch)
        return kept

    def _fitting_minibatch(self) -> int:
        """Return the number of rows of a minibatch, by halves of it, whose gradients fit into the device's memory."""
        rows = self._spec.minibatch_rows
        while rows := rows // 2:
            with contextlib.suppress(torch.OutOfMemoryError):
                self._algorithm.gradients(self._sampled(rows))
                return rows
        return 0

    def _update(self, progress: float) -> None:
        """Make one update, or skip it if a gradient is not finite."""
        spec = self._spec
        of_policy = self.policy_version % POLICY_PERIOD == 0
        gradients, terms = self._algorithm.gradients(self._sampled(spec.minibatch_rows), of_policy=of_policy)
        norms = {name: float(torch.linalg.vector_norm(gradient)) for name, gradient in gradients.items()}
        self.policy_version += 1
        if not all(map(math.isfinite, norms.values())):
            self.updates_skipped += 1
            return
        rate, made = (torch.tensor(value, device=self.device) for value in (self.learning_rate(progress), 0.0))
        for name, gradient in gradients.items():
            if norms[name] > spec.max_gradient_norm:
                gradient = gradient * (spec.max_gradient_norm / norms[name])
            self._optimizers[name].step(self._learned[name], gradient, rate, made)
        self._gradients.after_update(self.policy_version)
        if terms:
            self.metrics.add_update(Terms(*terms), rate.new_tensor(math.hypot(*norms.values())))
            self.metrics.count_updates(1)

    def _sampled(self, rows: int) -> Transitions:
        """Return a minibatch, with its share of demonstrations: Ball et al. (2023), "Efficient Online Reinforcement
        Learning with Offline Data", section 4.1."""
        spec = self._spec
        given, taught = len(self.demonstrations or ()), self.replay.taught
        shown = round(spec.demonstration_share * rows) if given or taught else 0
        if not len(self.replay):  # a person has done all so far
            shown = rows
        helped = int((torch.rand(shown) < taught / (given + taught)).sum()) if taught else 0
        counts = {self.replay.sample: rows - shown, self.replay.sample_taught: helped}
        if self.demonstrations is not None:
            counts[self.demonstrations.sample] = shown - helped
        drawn = (draw(count, spec.n_step, spec.discount_factor) for draw, count in counts.items() if count)
        return joined([_moved(part, self.device) for part in drawn])

    def entropy_bonus(self, progress: float) -> float:
        """Return the weight of the entropy: the temperature, which is learned."""
        return self._algorithm.temperature

    def _statistics(self) -> dict[str, Tensor]:
        statistics = super()._statistics() | {"replay/owed": self._owed, "replay/identity": self._identity}
        for name in self._algorithm.learned:
            for part, values in self._optimizers[name].statistics.items():
                statistics[f"{self._spec.optimizer}/{name}/{part}"] = values
        return statistics


def build_replay_buffer(spec: TrainingSpec, spaces: Spaces, rollout_length: int) -> ReplayBuffer:
    """Return an empty buffer. With a GPU its frames are there, if they fit into half of what is free.

    Raises SettingsError, with how many transitions would fit, if it is too large.
    """
    # An env_step is followed by a reset row at most; or a person helps in as many.
    capacity = min(spec.replay_transitions, 2 * spec.env_steps)
    columns = -(-capacity // rollout_length)
    column, frames = spaces.replay_bytes(rollout_length), spaces.frame_bytes(rollout_length)
    device = _device_of_frames(spec, columns * frames)
    if spec.replay_megabytes is None and device == "cuda":
        column -= frames
    if spec.replay_megabytes is not None:
        most, whose = int(spec.replay_megabytes * 2**20), "training.replay_megabytes allows"
    else:
        most, whose = available_memory(), "three quarters of the available memory are"
        most = None if most is None else int(_MEMORY_SHARE * most)
    if most is not None and columns * column > most:
        fitting = most // column * rollout_length
        remedy = f"set training.replay_transitions={fitting} or fewer" if fitting else "use smaller observations"
        remedy += "" if spec.replay_megabytes is None else ", or raise training.replay_megabytes"
        size, limit = mebibytes(columns * column, most)
        raise SettingsError(
            f"a replay buffer of {capacity:,} transitions takes {size} MiB, and {whose} {limit} MiB: "
            f"{fitting:,} transitions fit; {remedy}"
        )
    return ReplayBuffer(spaces, rollout_length, capacity, device)


def _device_of_frames(spec: TrainingSpec, size: int) -> Literal["cpu", "cuda"]:
    """Return where frames of so many bytes are kept: on the GPU of the learner, if they take at most half of it."""
    if spec.device == "cpu":
        return "cpu"
    half = torch.cuda.mem_get_info()[0] // 2
    _logger.info(
        "replay buffer: its frames are %s, with %s MiB; half of the GPU's free memory is %s MiB",
        "on the GPU" if size <= half else "in main memory",
        f"{size / 2**20:,.0f}",
        f"{half / 2**20:,.0f}",
    )
    return "cuda" if size <= half else "cpu"


def _moved(transitions: Transitions, device: torch.device) -> Transitions:
    if device.type == "cpu":
        return transitions

    def moved(values: Tensor) -> Tensor:
        return values.to(device)

    observations, following, *others = transitions
    return Transitions(map_components(observations, moved), map_components(following, moved), *map(moved, others))
