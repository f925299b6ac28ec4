"""Training in one process with an exact policy lag: every rollout is played with weights of so many updates ago.

No network and no threads: a run is determined by its settings and its seed.
"""

from collections import deque
from dataclasses import dataclass

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.algorithms.rollout_gradients import RolloutGradients
from daedalus.learner.run.annealing import Annealing
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.gradient_checks import restored
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Gradient, Rollout, RolloutIdentity

_IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of a run."""

    counters: RunCounters
    env_steps_to_target: int | None  # until the mean return of the newest episodes reached the target; None: never


def train(spec: RunSpec, lag: int) -> Outcome:
    """Train with one rollout for each batch, until the end of the budget or, if the run stops there, its target.

    Args:
      spec: settings of the run. With collection.upload = "gradients", the gradient of each rollout is computed at the
        weights that played it, and passes the codec as on its way to a learner.
      lag: updates by which snapshots arrive late. Where a batch makes several updates, snapshots are at least so late.
    """
    training = spec.training
    collector = EnvironmentCollector()
    spaces, _ = collector.prepare(spec)
    try:
        learner = Learner(training, spec.policy, spaces)
        gradients = RolloutGradients(spec, spaces) if spec.collection.upload == "gradients" else None
        collector.begin(OnnxRuntime(learner.program()), spec, training.seed)
        counters, annealing = RunCounters(training.target_episodes), Annealing(budget=training.env_steps)
        snapshots: deque[Snapshot] = deque()
        reached = None
        while counters.env_steps < training.env_steps and not (reached and training.stop_when_solved):
            version, progress = learner.policy_version, annealing.at(counters.env_steps)
            snapshots.append(_snapshot(learner, progress))
            while len(snapshots) > 1 and snapshots[1].policy_version <= version - lag:
                snapshots.popleft()
            collector.load(snapshots[0])
            rollout = collector.collect(_IDENTITY)
            if gradients is None:
                learner.step([rollout], progress)
            else:
                gradients.load(snapshots[0].weights)
                learner.apply([_sent(gradients, rollout)], progress)
            counters.trained([rollout], version, learner.policy_version - version)
            if reached is None and counters.reached(training.target_return):
                reached = counters.env_steps
    finally:
        collector.close()
    return Outcome(counters=counters, env_steps_to_target=reached)


def _snapshot(learner: Learner, progress: float) -> Snapshot:
    """Return the newest weights, with what actors need to compute gradients."""
    weights = {name: array.copy() for name, array in learner.weights().items()}
    weights |= learner.gradient_inputs(progress)
    return Snapshot(learner_epoch=1, policy_version=learner.policy_version, program="", weights=weights)


def _sent(gradients: RolloutGradients, rollout: Rollout) -> Gradient:
    """Return the gradient of a rollout as the learner receives it."""
    message = decode(encode(gradients.compute(rollout)), Limits())
    assert isinstance(message, Gradient)
    return restored(message)
