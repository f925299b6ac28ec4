"""Training with an exact policy lag: every rollout is played with weights of so many updates ago."""

from collections import deque

from benchmarks.study.one_process import LocalActor, LocalLearner
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import RunSpec


def train(spec: RunSpec, lag: int) -> LocalLearner:
    """Train with one rollout for each batch, until the end of the run.

    Args:
      spec: settings of the run.
      lag: updates by which snapshots arrive late. Where a batch makes several updates, snapshots are at least so late.
    """
    actor = LocalActor(spec, "actor-0")
    try:
        learner = LocalLearner(spec, actor.spaces)
        actor.begin(learner.program, spec.training.seed)
        snapshots: deque[Snapshot] = deque()
        while not learner.ended:
            snapshots.append(learner.snapshot())
            while len(snapshots) > 1 and snapshots[1].policy_version <= learner.policy_version - lag:
                snapshots.popleft()
            learner.train(actor.play(snapshots[0]))
    finally:
        actor.close()
    return learner
