"""A learner and actors in one process, without network and threads.

A run is determined by its settings and its seed.
"""

import numpy as np

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.algorithms.rollout_gradients import RolloutGradients
from daedalus.learner.run.counters import Annealing, RunCounters
from daedalus.learner.serving.upload_checks import restored
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Gradient, Rollout, RolloutIdentity


class LocalLearner:
    """A learner that trains on one upload at a time, and counts.

    Args:
        spec: Settings of the run.
        spaces: Of the environment.
    """

    def __init__(self, spec: RunSpec, spaces: Spaces) -> None:
        self._training = spec.training
        self._learner = Learner(spec.training, spec.policy, spaces)
        self._annealing = Annealing(budget=spec.training.env_steps)
        self.program = self._learner.program()
        self.counters = RunCounters(spec.training.target_episodes)
        self.env_steps_to_target: int | None = None  # until the mean return of the newest episodes reached the target

    @property
    def ended(self) -> bool:
        """Whether the budget is used, or the run stops at its target and has reached it."""
        reached = self.env_steps_to_target is not None and self._training.stop_when_solved
        return reached or self.counters.env_steps >= self._training.env_steps

    @property
    def policy_version(self) -> int:
        """The newest policy version."""
        return self._learner.policy_version

    def snapshot(self) -> Snapshot:
        """Return the newest weights, with what actors need to compute gradients."""
        weights: dict[str, np.ndarray] = {name: array.copy() for name, array in self._learner.weights().items()}
        weights |= self._learner.gradient_inputs(self._annealing.at(self.counters.env_steps))
        return Snapshot(learner_epoch=1, policy_version=self._learner.policy_version, program="", weights=weights)

    def train(self, upload: Rollout | Gradient) -> None:
        """Make the updates of a batch that is this upload."""
        version, env_steps = self._learner.policy_version, self.counters.env_steps
        progress = self._annealing.at(env_steps)
        if isinstance(upload, Gradient):
            self._learner.apply([upload], progress)
        else:
            self._learner.step([upload], progress)
        self._learner.anneal_exploration(self._training.exploration_annealing(progress, env_steps))
        self.counters.trained([upload], version, self._learner.policy_version - version)
        if self.env_steps_to_target is None and self.counters.reached(self._training.target_return):
            self.env_steps_to_target = self.counters.env_steps


class LocalActor:
    """An actor that plays, and computes gradients if the run's uploads are gradients.

    Args:
        spec: Settings of the run.
        name: Of the actor. The learner's running returns go on from rollout to rollout of an actor, by its name.
    """

    def __init__(self, spec: RunSpec, name: str) -> None:
        self._spec, self.name = spec, name
        self._sequence = 0
        self._collector = EnvironmentCollector()
        self.spaces, _ = self._collector.prepare(spec.for_actors())
        self._gradients = (
            RolloutGradients(spec.learning, self.spaces) if spec.collection.upload == "gradients" else None
        )

    def begin(self, program: bytes, seed: int, epsilon: float = 0.0) -> None:
        """Reset the environments.

        Args:
            program: that of the learner.
            seed: of the environments and of the actions.
            epsilon: with which the actor explores in the end.
        """
        self._collector.begin(OnnxRuntime(program), self._spec.for_actors(), seed, epsilon)

    def play(self, snapshot: Snapshot) -> Rollout | Gradient:
        """Return what the learner receives of a rollout under a snapshot. A rollout is valid until the next call."""
        self._collector.load(snapshot)
        identity = RolloutIdentity(actor=self.name, incarnation=1, sequence=self._sequence, learner_epoch=1)
        self._sequence += 1
        rollout = self._collector.collect(identity)
        if self._gradients is None:
            return rollout
        self._gradients.load(snapshot.weights)
        message = decode(encode(self._gradients.compute(rollout)), Limits())
        assert isinstance(message, Gradient)
        return restored(message)

    def close(self) -> None:
        """Close the environments."""
        self._collector.close()
