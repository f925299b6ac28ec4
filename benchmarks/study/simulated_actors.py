"""Training with several actors at a time, in simulated time: only the steps of environments take any."""

import heapq

import numpy as np

from benchmarks.study.one_process import LocalActor, LocalLearner
from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.messages import Join
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Gradient, Rollout

_SPREAD = 0.1  # by which the duration of a rollout differs at most from the mean, as a share of it


def train_simulated(spec: RunSpec, step_seconds: float) -> tuple[LocalLearner, float]:
    """Train with the actors of the run, each batch one upload; return the learner and the simulated seconds.

    An actor plays a rollout with the newest snapshot at its beginning, and the learner trains on it at its end, as
    processes do whose updates take much less time than their rollouts. Rollouts do not begin together, and do not
    always take the same time, so that actors pass each other.

    Args:
      spec: settings of the run. Seeds and exploration of the actors are those that a learner gives them.
      step_seconds: duration of a step of each environment.
    """
    actors = [LocalActor(spec, f"actor-{number}") for number in range(spec.collection.actors)]
    try:
        learner = LocalLearner(spec, actors[0].spaces)
        fleet = Fleet(spec.training.seed, actors[0].spaces, spec.training.epsilons)
        for actor in actors:
            join = Join(actor=actor.name, incarnation=1, environments=1, spaces=actor.spaces)
            assert fleet.join(join, now=0.0) is None
            actor.begin(learner.program, fleet.seed_for(actor.name, 0), fleet.epsilon_for(actor.name))
        return learner, _simulate(spec, step_seconds, learner, actors)
    finally:
        for actor in actors:
            actor.close()


def _simulate(spec: RunSpec, step_seconds: float, learner: LocalLearner, actors: list[LocalActor]) -> float:
    random = np.random.default_rng(spec.training.seed)
    duration = spec.collection.rollout_length * step_seconds
    uploads: dict[int, Rollout | Gradient] = {}  # of the rollouts that are being played, by actor
    ends = [(duration * random.uniform(), number) for number in range(len(actors))]
    heapq.heapify(ends)
    now = 0.0
    while not learner.ended:
        now, number = heapq.heappop(ends)
        if number in uploads:
            learner.train(uploads[number])
        uploads[number] = actors[number].play(learner.snapshot())
        heapq.heappush(ends, (now + duration * random.uniform(1.0 - _SPREAD, 1.0 + _SPREAD), number))
    return now
