"""The parameters, the optimiser and the policy version, and their updates. No threads, no I/O."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Algorithm
from daedalus.algorithms.batch import Batch, BatchAssembler
from daedalus.algorithms.curiosity import Curiosity
from daedalus.algorithms.diagnostics import BATCH_METRICS, FirstPass, batch_metrics, diagnostics
from daedalus.algorithms.gradient_inputs import NAME as GRADIENT_INPUTS
from daedalus.algorithms.gradient_inputs import TARGET, GradientInputs, exact, packed
from daedalus.algorithms.gradients import GradientComputer, Terms
from daedalus.algorithms.normalization import (
    ConfirmedRanges,
    Moments,
    ObservationStatistics,
    RewardNormalizer,
    moments_of,
    observations_name,
    one,
)
from daedalus.algorithms.replay_buffer import ReplayBuffer
from daedalus.learner.run.counters import updates_of
from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.training.demonstrations import Cloning
from daedalus.learner.training.optimizers import UpdateStep, build_optimizer
from daedalus.learner.training.update_graphs import UpdateGraphs, check_device, memory_faults
from daedalus.learner.training.update_metrics import UpdateMetrics
from daedalus.policy.acting.program import export_program
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.exploration import ANNEALING
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.algorithms import is_own
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Gradient, Rollout, Upload


def rollouts_at_fault(
    gradients: GradientComputer, joined: Callable[[Sequence[Rollout]], Batch], rollouts: Sequence[Rollout]
) -> list[Rollout]:
    """Return the rollouts that have no finite gradient of their own at the present parameters.

    Return none if a rollout of zeros has no finite gradient either: then the parameters are at fault, and no sender.
    The gradients of the parameters are overwritten; the parameters are not changed.

    Args:
      gradients: computes the gradients of a batch.
      joined: returns the batch of rollouts, as the updates have it.
      rollouts: the rollouts of the batch.
    """

    def is_finite(rollout: Rollout) -> bool:
        # All updates of the batch, because a minibatch has only some of its rows.
        updates = gradients.compute(joined([rollout]), 0.0)
        return all(bool(gradients.parameters.gradients.norm().isfinite()) for _ in updates)

    if not is_finite(_of_zeros(rollouts[0])):
        return []
    return [rollout for rollout in rollouts if not is_finite(rollout)]


def _of_zeros(rollout: Rollout) -> Rollout:
    """Return a rollout of the same shapes whose numbers are 0."""
    names = ("initial_state", "behaviour_log_probs", "rewards")
    arrays = {name: np.zeros_like(getattr(rollout, name)) for name in names}
    frames = {name: np.zeros_like(values) for name, values in rollout.frames.items()}
    continuous = {name: values for name, values in rollout.actions.items() if values.dtype == np.float32}
    actions = rollout.actions | {name: np.zeros_like(values) for name, values in continuous.items()}
    return replace(rollout, **arrays, frames=frames, actions=actions)


def weights_of(gradients: Sequence[Gradient]) -> list[float]:
    """Return the share of each gradient in all env_steps: each valid row then counts once in the mean."""
    total = max(sum(gradient.env_steps for gradient in gradients), 1)
    return [gradient.env_steps / total for gradient in gradients]


def mean_gradient(gradients: Sequence[Gradient], names: Sequence[str]) -> Tensor:
    """Return the weighted mean of float32 gradients [P], added up in the given order.

    Args:
      gradients: those of one batch.
      names: parameters with gradients, in the order of the vector.
    """
    mean = None
    for gradient, weight in zip(gradients, weights_of(gradients), strict=True):
        vector = np.concatenate([gradient.gradient[name].ravel() for name in names]) * np.float32(weight)
        mean = vector if mean is None else mean + vector
    assert mean is not None
    return torch.from_numpy(mean)


def mean_terms(gradients: Sequence[Gradient], device: torch.device) -> Terms:
    """Return the weighted means of the loss terms, on a device."""
    pairs = list(zip(gradients, weights_of(gradients), strict=True))
    return Terms(
        *(
            torch.tensor(sum(float(each.metrics[name]) * share for each, share in pairs), device=device)
            for name in Terms._fields
        )
    )


def batch_metrics_of(gradient: Gradient) -> Tensor | None:
    """Return BATCH_METRICS [3] of the rollout, nan for those that it does not have; None if it has none."""
    given = [float(gradient.metrics.get(name, np.nan)) for name in BATCH_METRICS]
    return None if np.isnan(given).all() else torch.tensor(given)


def diagnostics_of(gradient: Gradient) -> dict[str, float]:
    """Return the diagnostics of a rollout; empty for a rollout without valid rows."""
    others = (*Terms._fields, *BATCH_METRICS)
    return {name: float(value) for name, value in gradient.metrics.items() if name not in others}


def moments_in(gradient: Gradient) -> dict[str, Moments]:
    """Return the moments of the rollout, by name."""
    return {
        name: Moments(gradient.env_steps, *torch.from_numpy(values.copy())) for name, values in gradient.moments.items()
    }


# Names of what actors vote on besides components of observations (algorithms/normalization.py).
_RETURNS, _REWARDS, _NORM, _METRICS = "returns", "rewards", "gradient norm", "metrics/"
_LEAST_END = 1e-3  # of 1 - discount factor times what goes on, when the first values are computed: horizons are finite
_CURIOSITY = "curiosity/"  # beginning of the names of its statistics in checkpoints

_Seen = dict[str, Moments]
_Upload = TypeVar("_Upload", Rollout, Gradient)


class _Made(NamedTuple):
    """What is known of a batch after its updates."""

    first_pass: FirstPass
    metrics: Tensor  # BATCH_METRICS [3]


class _Pending(NamedTuple):
    """A batch whose updates were launched."""

    batch: Batch  # in main memory
    kept: list[Rollout]  # what it consists of
    seen: dict[Rollout, _Seen]
    progress: float
    updates: int  # their number
    made: _Made | None


class Learner:
    """Owner of the parameters. Makes policy versions from batches: computes gradients, then applies them."""

    def __init__(
        self,
        spec: TrainingSpec,
        policy: PolicySpec,
        spaces: Spaces,
        modules: UserModules = NO_MODULES,
    ) -> None:
        """Construct the learner at policy version 0, with parameters initialised from `spec.seed`.

        Args:
          spec: settings of the training.
          policy: settings of the network.
          spaces: components of observations and actions.
          modules: may be imported for the policy.

        Raises SettingsError if the device is not available, NetworkError if the policy does not support the spaces,
        AlgorithmError if the algorithm of the user cannot be used.
        """
        if spec.device == "cuda":
            check_device(spec.precision)
        torch.manual_seed(spec.seed)
        torch.set_num_threads(spec.threads)
        self._spec, self.spaces = spec, spaces
        self.device = torch.device(spec.device)
        self._network = ActorCritic(policy, spaces, modules, spec).to(self.device)
        self._gradients = GradientComputer(spec, self._network, spaces, modules)
        self._flat = self._gradients.parameters
        self._parameters = dict(self._network.named_parameters())
        self._loaded = {name: each for name, each in self._parameters.items() if name != ANNEALING}
        self.metrics = UpdateMetrics(spaces, self.device, spec.max_gradient_norm)
        self._step = UpdateStep(spec, self._flat, self.metrics)
        self._bonus = self._flat.values.new_zeros(())
        built_in = not (is_own(spec.algorithm) or self._network.has_user_modules)
        changes = type(self._gradients.algorithm).after_update is not Algorithm.after_update
        self.graphs = UpdateGraphs(self.device, can_record=built_in and not changes)
        self._pending: _Pending | None = None  # the newest batch, until it is known that its gradients were finite
        self._assembler = BatchAssembler(spaces, self.device)
        self._observations = ObservationStatistics(self._network.normalizer, self._network.codes)
        self._rewards: RewardNormalizer | None = None
        if spec.normalize_rewards:
            self._rewards = RewardNormalizer(spec.discount_factor, synchronous=spec.record.synchronous)
        self._curiosity: Curiosity | None = None
        if spec.curiosity:
            self._curiosity = Curiosity(spec.discount_factor, synchronous=spec.record.synchronous)
        self._ranges, self._reward_name = ConfirmedRanges(), _REWARDS if self._rewards is None else _RETURNS
        self._reward_shares: dict[Rollout, float] = {}  # of the newest batch: with how much of their size they count
        self.far_outside: dict[Upload, str] = {}  # of the newest batch: what was left out, and its component
        self._cloning: Cloning | None = None  # of demonstrations, if there are any
        self.first_pass: FirstPass | None = None  # of the newest batch, until its memory is used for the next one
        self._received_diagnostics: dict[str, float] = {}  # of the newest gradient of an actor
        # Whether `step` returns before a GPU is done: not if what follows a batch changes how the next is sorted out.
        waits = self._observations.moments or self._curiosity or spec.record.synchronous
        self.overlaps = self.graphs.is_enabled and not waits
        self.policy_version = 0
        self.updates_skipped = 0  # updates whose gradient was not finite: a new version with unchanged parameters
        self.anneal_exploration(spec.exploration_annealing(0.0, 0))

    @property
    def state_size(self) -> int:
        """S, the size of the recurrent state of the policy; 0 without memory."""
        return self._network.state_size

    @property
    def updates_due(self) -> int:
        """Number of updates that `step` has left to make, without rollouts: none, but for a replay buffer."""
        return 0

    def updates_of(self, rollouts: Sequence[Upload]) -> int:
        """Return the number of updates, and of new versions, that a batch of these uploads makes."""
        return updates_of(self._spec, rollouts, memory=self.state_size > 0)

    def step(self, rollouts: Sequence[Rollout], progress: float) -> list[Rollout]:
        """Make all updates of one batch. Return the rollouts that were left out of updates.

        If the gradient of an update is not finite, the update is repeated without the rollouts at fault. If no rollout
        is at fault, or all are, the remaining updates of the batch are skipped: new versions with unchanged parameters.
        An algorithm that makes fewer updates than expected skips none; the version is the same in all cases.

        A GPU may still compute when the method returns: the next call joins its rollouts meanwhile, and returns those
        of this batch that were left out, as `finish` does.

        Args:
          rollouts: the rollouts of the batch, in order.
          progress: share of the budget that is used, from 0 to 1; the rates are annealed by it.

        Raises SettingsError if the GPU has too little memory for the batch.
        """
        count = self.updates_of(rollouts)
        if self._curiosity is not None:
            self._curiosity.look(rollouts, _annealed(self._spec.curiosity, 0.0, progress))
        batch, kept, seen = self._sorted_out(rollouts)
        if self._spec.mean_first_value and self.policy_version == 0:
            self._begin_values(batch)
        with memory_faults(batch.rewards.numel(), lambda: self._fitting(batch)):
            on_device = self.graphs.moved(batch)
            left_out = self.finish()
            self.policy_version += count
            made = self._make_updates(on_device, progress, count)
            self._pending = _Pending(batch, kept, seen, progress, count, made)
            return left_out if self.overlaps else left_out + self.finish()

    def _begin_values(self, batch: Batch) -> None:
        """Let the values of all states begin as their mean over the first batch, unless weights were loaded.

        The mean of V(s) = r + discount_factor V(s') is r / (1 - discount_factor (1 - p)), with the mean reward r, and
        the share p of the rows that terminate.
        """
        head, rows = self._network.value_head, batch.valid > 0
        if head is None or float(head.bias.detach()) != 0.0 or not rows.any():
            return
        goes_on = 1.0 - float(batch.terminated[rows].float().mean())
        value = float(batch.rewards[rows].mean()) / max(1.0 - self._spec.discount_factor * goes_on, _LEAST_END)
        if math.isfinite(value):
            with torch.no_grad():
                head.bias.fill_(value)

    def _fitting(self, batch: Batch) -> int:
        """Return the number of rows of a batch, by halves of it, whose gradient fits into the memory of the device."""
        width = batch.rewards.shape[1]
        while width := width // 2:
            self.graphs.forget()
            part = batch.narrowed(width)
            try:
                for _ in self._gradients.compute(part.to(self.device), 0.0):
                    break
            except torch.OutOfMemoryError:
                continue
            return part.rewards.numel()
        return 0

    def finish(self) -> list[Rollout]:
        """Wait for the updates of the newest batch, and return the rollouts that were left out of them.

        Raises as `step`.
        """
        pending, self._pending = self._pending, None
        if pending is None:
            return []
        with memory_faults(pending.batch.rewards.numel(), lambda: self._fitting(pending.batch)):
            return self._finished(pending)

    def _finished(self, pending: _Pending) -> list[Rollout]:
        batch, kept, seen, progress, remaining, made = pending
        left_out: list[Rollout] = []
        while True:
            updates, failed = self._step.end()
            remaining -= updates
            if not failed:
                break
            at_fault = rollouts_at_fault(self._gradients, lambda some: self._joined(some).to(self.device), kept)
            left_out += at_fault
            kept = [rollout for rollout in kept if not any(rollout is each for each in at_fault)] if at_fault else []
            if not kept:
                break
            batch = self._joined(kept)
            made = self._make_updates(self.graphs.moved(batch), progress, remaining)
        if kept:
            if made is not None:  # an algorithm of the user may make no update
                self.first_pass = made.first_pass
                self.metrics.add_batch_metrics(made.metrics)
            self.metrics.add_batch(batch)
        else:
            self.updates_skipped += remaining
            self.first_pass = None
        self._merge_observations([seen[rollout] for rollout in kept])
        return left_out

    def _sorted_out(self, rollouts: Sequence[Rollout]) -> tuple[Batch, list[Rollout], dict[Rollout, _Seen]]:
        """Return the batch to learn from, its rollouts, and the moments of each: without those that are far outside.

        If all are, there is no other to tell which are right: then nothing is left out.
        """
        batch, first = self._assembler.join(rollouts), 0
        stacked = batch.stacked() if self._observations.moments else batch
        seen: dict[Rollout, _Seen] = {}
        for rollout in rollouts:
            seen[rollout] = self._moments_of(rollout, stacked, slice(first, first + rollout.environments))
            first += rollout.environments
        kept = self._without_far(rollouts, seen)
        if self._rewards is not None:
            self._ranges.merge(
                self._reward_name, [seen[each][self._reward_name] for each in kept], self._rewards.moments
            )
        pending = () if self._pending is None else self._pending.kept
        self._reward_shares = {each: self._reward_shares[each] for each in pending}
        self._reward_shares |= {
            each: self._ranges.share(self._reward_name, seen[each][self._reward_name]) for each in kept
        }
        if len(kept) < len(rollouts):
            batch = self._assembler.join(kept)
        return self._scaled(batch, kept), kept, seen

    def _moments_of(self, rollout: Rollout, batch: Batch, columns: slice) -> _Seen:
        """Return what a rollout votes on. `columns`: its environments in the batch."""
        seen = {observations_name(name): each for name, each in self._observations.moments_of(batch, columns).items()}
        for name, frames in rollout.frames.items():
            if frames.dtype.kind == "f" and observations_name(name) not in seen:
                seen[observations_name(name)] = one(float(np.abs(frames).max()))
        if self._rewards is not None:
            seen[self._reward_name] = self._rewards.moments_of([rollout])
        else:
            seen[self._reward_name] = moments_of(torch.from_numpy(rollout.rewards[rollout.learned]))
        return seen

    def _without_far(self, uploads: Sequence[_Upload], seen: Mapping[_Upload, _Seen]) -> list[_Upload]:
        """Let each upload vote on the ranges, and return those that are not far outside."""
        far = {each: self._ranges.vote(each.identity.actor, seen[each]) for each in uploads}
        kept = [each for each in uploads if not far[each]]
        self.far_outside = {each: name for each, name in far.items() if name} if kept else {}
        return kept or list(uploads)

    def _merge_observations(self, seen: Sequence[_Seen]) -> None:
        names = self._observations.moments
        parts = {name: [each[observations_name(name)] for each in seen] for name in names}
        self._observations.merge(parts, self._ranges)

    def _make_updates(self, batch: Batch, progress: float, count: int) -> "_Made | None":
        """Make the last `count` updates up to the present version, until a gradient is not finite."""
        self.first_pass = None  # its memory is used for this batch
        self._step.begin(self.learning_rate(progress))
        self._bonus.fill_(self.entropy_bonus(progress))
        if self._cloning is not None:
            self._cloning.weight = _annealed(self._spec.cloning_weight, 0.0, progress)
        return self.graphs.call(self._updated, batch, count)

    def _updated(self, batch: Batch, count: int) -> "_Made | None":
        """Make updates of a batch on the device, with stacks of frames or without. A graph may record this method."""
        cloning = self._cloning if self._cloning is not None and self._cloning.weight else None
        updates = self._gradients.compute(batch.stacked(), self._bonus, self._step if cloning is None else None)
        for number, terms in enumerate(updates, 1):
            if cloning is not None:
                self._flat.gradients.add_(cloning.gradient(), alpha=cloning.weight)
                self._step.clip(terms)
                self._step.apply()
            if not self.graphs.records:
                if self._step.has_failed:
                    return None
                self._gradients.after_update(self.policy_version - count + number)
            if number == count:
                break
        first_pass = self._gradients.take_first_pass()
        return None if first_pass is None else _Made(first_pass, batch_metrics(first_pass))

    def learn_from(self, demonstrations: ReplayBuffer) -> None:
        """Learn from demonstrations, too, from now on."""
        self.graphs.is_enabled = False  # each update draws other demonstrations, on the CPU
        self.overlaps = False
        forward = self._gradients.forward
        self._cloning = Cloning(self._network, self._flat, forward, self.spaces, demonstrations)

    def clone(self, goes_on: Callable[[], bool] = lambda: True) -> str:
        """Let the policy imitate the demonstrations before the first update, and return how well it does, in words.

        `goes_on` is called before each update, and ends the imitation with False. Return an empty string then, and
        where there is nothing to imitate.
        """
        cloning, updates = self._cloning, self._spec.cloning_updates
        if cloning is None or not updates:
            return ""
        if self._observations.moments:
            for observations in cloning.observations():
                self._observations.add(observations)
        before, optimizer = cloning.held_out(), build_optimizer(self._spec, self._flat.values)
        rate = self._flat.values.new_tensor(self.learning_rate(0.0))
        for _ in range(updates):
            if not goes_on():
                return ""
            self._flat.gradients.copy_(cloning.gradient())
            norm = self._flat.clip_gradients(self._spec.max_gradient_norm)
            optimizer.step(self._flat.values, self._flat.gradients, rate, (~norm.isfinite()).to(rate.dtype))
        if self._gradients.forward.target_parameters:
            self._gradients.forward.update_target()
        if np.isnan(before):
            return "there are too few steps to hold any out, so that it is not known how well the policy imitates them"
        return (
            f"mean log-probability of actions that were held out: {before:.3g} before, {cloning.held_out():.3g} after"
        )

    def apply(self, gradients: Sequence[Gradient], progress: float) -> None:
        """Make one update with the mean of gradients that actors computed, weighted by their env_steps.

        The intake has checked that each is finite. Those that are far outside are left out, as in `step`; the norm of
        another one counts with at most ten times what is confirmed, so that none decides the direction alone.

        Args:
          gradients: the gradients of the batch, in order.
          progress: as for `step`.
        """
        stated = {
            gradient: {
                **moments_in(gradient),
                _NORM: one(gradient.norm),
                **{_METRICS + name: one(float(value)) for name, value in gradient.metrics.items()},
            }
            for gradient in gradients
        }
        kept = [self._moderated(gradient) for gradient in self._without_far(gradients, stated)]
        seen = [moments_in(gradient) for gradient in kept]
        if self._rewards is not None:
            self._ranges.merge(_RETURNS, [each[_RETURNS] for each in seen], self._rewards.moments)
        self._flat.gradients.copy_(mean_gradient(kept, tuple(self.gradient_shapes)))
        self._step.begin(self.learning_rate(progress))
        self._step.clip(mean_terms(kept, self.device))
        self._step.apply()
        self.policy_version += 1
        _, failed = self._step.end()
        if failed:
            self.updates_skipped += 1
        else:
            self._gradients.after_update(self.policy_version)
            self._merge_observations(seen)
            for gradient in kept:
                if (measured := batch_metrics_of(gradient)) is not None:
                    self.metrics.add_batch_metrics(measured.to(self.device))
        self._received_diagnostics = diagnostics_of(kept[-1])
        for gradient in kept:
            counts = gradient.action_counts.items()
            self.metrics.add_action_counts({name: torch.from_numpy(values.copy()) for name, values in counts})

    def _moderated(self, gradient: Gradient) -> Gradient:
        """Return a gradient with the norm and the metrics that count."""
        norm, values = gradient.norm, gradient.gradient
        if (most := self._ranges.moderated(_NORM, norm)) < norm:
            values = {name: each * np.float32(most / norm) for name, each in values.items()}
        metrics = {
            name: np.array(self._ranges.moderated(_METRICS + name, float(value)), np.float32)
            for name, value in gradient.metrics.items()
        }
        return replace(gradient, gradient=values, metrics=metrics)

    def _joined(self, rollouts: Sequence[Rollout]) -> Batch:
        """Return the batch of the rollouts, with scaled rewards, in new main memory: the next batch may be joined."""
        return self._scaled(BatchAssembler(self.spaces, torch.device("cpu")).join(rollouts), rollouts)

    def _scaled(self, batch: Batch, rollouts: Sequence[Rollout]) -> Batch:
        """Return the batch to learn from. Scale its rewards in place, and draw its minibatches.

        Rewards are normalised, and those that are not confirmed count less. Those of curiosity are added, which have a
        scale of their own.
        """
        first = 0
        for rollout in rollouts:
            if (share := self._reward_shares.get(rollout, 1.0)) < 1.0:
                batch.rewards[:, first : first + rollout.environments] *= share
            first += rollout.environments
        if self._rewards is not None:
            self._rewards.scale(batch)
        if self._curiosity is not None:
            self._curiosity.add_to(batch, rollouts)
        return replace(batch, passes=self._gradients.algorithm.drawn(batch.valid, has_memory=self.state_size > 0))

    def learning_rate(self, progress: float) -> float:
        """Return the learning rate at a share of the budget."""
        return _annealed(self._spec.learning_rate, self._spec.learning_rate_final, progress)

    def entropy_bonus(self, progress: float) -> float:
        """Return the weight of the entropy in the loss at a share of the budget."""
        return _annealed(self._spec.entropy_bonus, self._spec.entropy_bonus_final, progress)

    def take_diagnostics(self) -> dict[str, float]:
        """Return the diagnostics of the newest batch (algorithms/diagnostics.py), once; empty without a new batch."""
        if self._received_diagnostics:
            received, self._received_diagnostics = self._received_diagnostics, {}
            return received
        first_pass, self.first_pass = self.first_pass, None
        rho_clip = self._spec.rho_clip if self._spec.record.corrected else None
        if first_pass is None:
            return {}
        return diagnostics(first_pass, rho_clip) | ({} if self._curiosity is None else self._curiosity.metrics())

    def anneal_exploration(self, annealing: float) -> None:
        """Set how much actors with the next snapshot explore: a result of `TrainingSpec.exploration_annealing`."""
        if self._network.exploration is not None:
            self._network.exploration.set_annealing(annealing)

    # ----------------------------------------------------------------------------- for actors and checkpoints

    def program(self) -> bytes:
        """Return the policy program (daedalus/policy/acting/program.py)."""
        return export_program(self._network, self.spaces)

    def weights(self) -> dict[str, np.ndarray]:
        """Return all parameters as numpy arrays.

        The arrays may share memory with the parameters: copy or encode them before the next step.
        """
        return {name: parameter.detach().cpu().numpy() for name, parameter in self._parameters.items()}

    def begin_weights(self) -> Callable[[], dict[str, np.ndarray]]:
        """Begin to copy all parameters, and return what waits for the copy and returns it, as `weights` does.

        A GPU copies them beside its updates; any thread may wait. On the CPU, wait before the next step.
        """
        if self.device.type == "cpu":
            return self.weights
        copied = self.graphs.begin_copy({name: each.detach() for name, each in self._parameters.items()})
        return lambda: {name: each.numpy() for name, each in copied().items()}

    def gradient_inputs(self, progress: float) -> dict[str, np.ndarray]:
        """Return what a snapshot needs besides `weights` for actors to compute gradients, at a share of the budget."""
        count = mean = squares = 0.0
        if self._rewards is not None:
            moments = self._rewards.moments
            count, mean, squares = float(moments.count), float(moments.mean), float(moments.squares)
        target = self._gradients.forward.target_parameters
        inputs = {TARGET + name: values.cpu().numpy() for name, values in target.items()}
        inputs |= {name: exact(values) for name, values in self._gradients.own_statistics.items()}
        inputs[GRADIENT_INPUTS] = packed(GradientInputs(self.entropy_bonus(progress), count, mean, squares))
        return inputs

    @property
    def gradient_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters that have gradients, by name."""
        return {name: tuple(each.shape) for name, each in self._parameters.items() if each.requires_grad}

    def state(self) -> dict[str, Tensor]:
        """Return the training state besides the parameters: optimiser and running statistics, random state."""
        return {"torch_random_state": torch.get_rng_state(), **self._statistics()}

    def _statistics(self) -> dict[str, Tensor]:
        statistics = {
            f"{self._spec.optimizer}/{name}": value for name, value in self._step.optimizer.statistics.items()
        }
        for component, moments in self._observations.moments.items():
            statistics |= {f"observations/{component}/{name}": value for name, value in moments.state().items()}
        statistics |= self._gradients.statistics
        if self._rewards is not None:
            statistics |= {f"returns/{name}": value for name, value in self._rewards.moments.state().items()}
        if self._curiosity is not None:
            statistics |= {_CURIOSITY + name: value for name, value in self._curiosity.statistics.items()}
        return statistics

    def load(self, parameters: dict[str, np.ndarray]) -> None:
        """Replace all parameters by the result of `weights` of another learner.

        Raises CheckpointMismatchError, which names a difference, if they belong to another network.
        """
        for name, parameter in self._loaded.items():
            if name not in parameters:
                raise CheckpointMismatchError(f"the checkpoint has no weights {name!r}, which this run's network has")
            if parameters[name].shape != tuple(parameter.shape):
                raise CheckpointMismatchError(
                    f"the weights {name!r} are {parameters[name].shape} in the checkpoint and {tuple(parameter.shape)} "
                    "in this run's network: use the same environment and [policy] settings"
                )
        unknown = parameters.keys() - {*self._loaded, ANNEALING}
        if unknown:
            raise CheckpointMismatchError(
                f"the checkpoint has weights {min(unknown)!r}, which this run's network lacks"
            )
        with torch.no_grad():
            for name, parameter in self._loaded.items():
                parameter.copy_(torch.from_numpy(parameters[name].copy()))
        if self._gradients.forward.target_parameters:
            self._gradients.forward.update_target()
        self._observations.take_from_network()

    def reset_statistics(self) -> None:
        """Forget the running statistics of observations and returns: the next rollouts define them."""
        self._observations.reset()
        if self._rewards is not None:
            self._rewards.reset()

    def restore(self, version: int, parameters: dict[str, np.ndarray], state: dict[str, Tensor]) -> None:
        """Restore a version from the results of `weights` and `state`; training then continues exactly as before.

        Only what is needed to doubt a rollout is not saved (algorithms/normalization.py). Raises
        CheckpointMismatchError if the results belong to another network or optimiser.
        """
        self.load(parameters)
        if self._network.exploration is not None and ANNEALING in parameters:
            self._network.exploration.set_annealing(float(parameters[ANNEALING].item()))
        for name, statistic in self._statistics().items():
            saved = state.get(name)
            if saved is None and name.startswith(_CURIOSITY):
                continue  # the run was not curious before
            if saved is not None and name.endswith("/count") and not saved.shape:
                saved = saved.expand(statistic.shape)  # in checkpoints of earlier releases: one count for all numbers
            if saved is None or saved.shape != statistic.shape:
                remedy = "training.optimizer, training.normalize_rewards and policy.normalize_observations of the run"
                if name.startswith("algorithm/") and is_own(self._spec.algorithm):
                    remedy = f"the class {self._spec.algorithm} that the run was trained with"
                raise CheckpointMismatchError(f"the checkpoint lacks the statistics {name!r}: restore {remedy}")
            statistic.copy_(saved)
        torch.set_rng_state(state["torch_random_state"])
        self.policy_version = version


def _annealed(first: float, final: float | None, progress: float) -> float:
    return first if final is None else first + (final - first) * min(max(progress, 0.0), 1.0)
