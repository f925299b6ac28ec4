"""Gradients of an actor's own rollouts, at the weights that played them. State; no I/O, no threads."""

import math
import threading
from dataclasses import replace

import numpy as np
import torch

from daedalus.algorithms.batch import BatchAssembler
from daedalus.algorithms.diagnostics import BATCH_METRICS, ActionCounts, batch_metrics, diagnostics
from daedalus.algorithms.gradient_inputs import NAME as GRADIENT_INPUTS
from daedalus.algorithms.gradient_inputs import TARGET, restored, unpacked
from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.normalization import Moments, ObservationStatistics, RewardNormalizer, observations_name
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.torch_runtime import load_weights
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.compact import bfloat16, float32, planes
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import LearningSpec
from daedalus.protocol.uploads import LARGEST_GRADIENT_NORM, Gradient, Rollout

_CONSTRUCTION = threading.Lock()


class RolloutGradients:
    """Computes what an actor uploads in place of its rollouts.

    A synchronous algorithm gets float32, because its updates must equal those of one process to the bit. The others get
    bfloat16 with error feedback: what one rounding loses is added to the next gradient, so that nothing is lost in the
    long run. Seide et al. (2014), section 2.
    """

    def __init__(self, spec: LearningSpec, spaces: Spaces, modules: UserModules = NO_MODULES) -> None:
        """Raise NetworkError or AlgorithmError if the network or the algorithm cannot be constructed here."""
        torch.set_num_threads(1)
        training = spec.training
        # A learner in the same process draws numbers of its own: leave them as they were. The lock is for several
        # actors, of which one would otherwise restore what another has drawn.
        with _CONSTRUCTION, torch.random.fork_rng(devices=()):
            self._network = ActorCritic(spec.policy, spaces, modules, training)
        self._computer = GradientComputer(training, self._network, spaces, modules)
        self._assembler = BatchAssembler(spaces, torch.device("cpu"))
        self._observations = ObservationStatistics(self._network.normalizer, self._network.codes)
        self._rewards: RewardNormalizer | None = None
        if training.normalize_rewards:
            self._rewards = RewardNormalizer(training.discount_factor, synchronous=training.record.synchronous)
        self._actions = ActionCounts(spaces, torch.device("cpu"))
        self._in_float32 = training.record.synchronous
        self._parameters = dict(self._network.named_parameters())
        target = self._computer.forward.target_parameters
        self._loaded = {**self._parameters, **{TARGET + name: values for name, values in target.items()}}
        self._unsent: dict[str, np.ndarray] = {}  # by parameter: what rounding has lost so far
        self._entropy_bonus = 0.0

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Use the weights of a snapshot in all later calls. Raises PolicyError if they do not fit."""
        statistics = self._computer.own_statistics
        try:
            inputs = unpacked(weights[GRADIENT_INPUTS])
            given = {name: restored(weights[name], tuple(values.shape)) for name, values in statistics.items()}
        except (KeyError, ValueError) as error:
            raise PolicyError(f"the snapshot has no numbers to compute gradients with: {error}") from None
        load_weights(weights, self._loaded, self._loaded)
        with torch.no_grad():
            for name, values in statistics.items():
                values.copy_(given[name])
        self._entropy_bonus = inputs.entropy_bonus
        if self._rewards is not None:
            moments = self._rewards.moments
            moments.count.fill_(inputs.returns_count)
            moments.mean.fill_(inputs.returns_mean)
            moments.squares.fill_(inputs.returns_squares)

    def compute(self, rollout: Rollout) -> Gradient:
        """Return the gradient of a rollout that the loaded weights have played. Call once for each rollout, in order.

        Rewards are normalised as the learner would: with the statistics of the snapshot and of the rollout itself.
        """
        batch = self._assembler.join([rollout]).to(torch.device("cpu"))
        moments = {observations_name(name): part for name, part in self._observations.moments_of(batch).items()}
        if self._rewards is not None:
            moments["returns"] = self._rewards.moments_of([rollout])
            if moments["returns"].squares.isfinite():  # else the learner rejects this gradient, and not the next one
                self._rewards.moments.merge(moments["returns"])
            self._rewards.scale(batch)
        (terms,) = list(self._computer.compute(batch, self._entropy_bonus)) or [self._computer.no_update()]
        first_pass = self._computer.take_first_pass()
        measured: dict[str, float] = {}
        if first_pass is not None:
            of_batch = zip(BATCH_METRICS, batch_metrics(first_pass).tolist(), strict=True)
            measured = {name: value for name, value in of_batch if not math.isnan(value)}
            measured |= diagnostics(first_pass, None)
        self._actions.add(batch)
        gradient = Gradient(
            identity=rollout.identity,
            policy_version=rollout.policy_version,
            gradient=self._computed(),
            env_steps=rollout.env_steps,
            metrics={
                name: np.array(float(value), np.float32) for name, value in {**terms._asdict(), **measured}.items()
            },
            moments={name: _packed(part) for name, part in moments.items()},
            action_counts={name: np.array(counts, np.int64) for name, counts in self._actions.take().items()},
            episode_returns=rollout.episode_returns,
            episode_lengths=rollout.episode_lengths,
            episode_info=rollout.episode_info,
            lessons=rollout.lessons,
        )
        return gradient if self._in_float32 else self._rounded(gradient)

    def _computed(self) -> dict[str, np.ndarray]:
        """Return a copy of the computed gradient by parameter."""
        learned = {name: each.shape for name, each in self._parameters.items() if each.requires_grad}
        parts = self._computer.parameters.gradients.split([shape.numel() for shape in learned.values()])
        return {
            name: part.view(shape).numpy().copy() for (name, shape), part in zip(learned.items(), parts, strict=True)
        }

    def _rounded(self, gradient: Gradient) -> Gradient:
        """Return the gradient in bfloat16, and keep what rounding has lost for the next one."""
        wanted = gradient.gradient
        if gradient.norm <= LARGEST_GRADIENT_NORM:  # the learner rejects all others
            wanted = {name: values + self._unsent.get(name, np.float32(0.0)) for name, values in wanted.items()}
        bits = bfloat16(wanted)
        if wanted is not gradient.gradient:
            sent = float32(bits)
            self._unsent = {name: values - sent[name] for name, values in wanted.items()}
        return replace(gradient, gradient=planes(bits, None))


def _packed(moments: Moments) -> np.ndarray:
    return torch.stack([moments.mean, moments.squares]).numpy()
