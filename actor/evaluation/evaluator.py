"""The evaluator: an actor that plays the learner's newest policy for a score, on a schedule, and reports. Contributes
nothing to the training data. No threads but the transport's.
"""

import itertools
import logging
import threading
import time

import numpy as np

from daedalus.actor.environments.interface import VectorEnvironment
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import environments_for, play_episodes
from daedalus.actor.session.learner_queries import LearnerQueries, RunOverError
from daedalus.actor.session.service import ActorConfig
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.messages import EvaluationReport, Join, Snapshot, Welcome
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_DEFAULT_SECONDS = 60.0  # between evaluations where the run does not say


class Evaluator:
    """One evaluator over one transport."""

    def __init__(self, config: ActorConfig, transport: Transport, stop: threading.Event) -> None:
        self._config = config
        self._stop = stop
        self._link = LearnerQueries(transport, config.hint)

    def run(self) -> None:
        """Evaluates until stopped or until the run is over.

        Raises ActorError if it is refused, EnvironmentSetupError if the environment cannot be made here, PolicyError if
        the policy cannot be played.
        """
        join = Join(actor=self._config.name, incarnation=self._config.incarnation)
        try:
            while True:
                self._attend(self._link.find(self._config.run, join, self._config.timeout, self._stop))
        except RunOverError as error:
            _logger.info(str(error))

    def _attend(self, welcome: Welcome) -> None:
        """Evaluates for one life of a learner, until it ends."""
        spec = welcome.spec
        interval = spec.evaluation.seconds or _DEFAULT_SECONDS
        episodes = spec.evaluation.episodes
        actions = spec.evaluation.actions
        _logger.info(
            f"run {welcome.run!r}: {episodes} {actions} episodes of {spec.environment.id} every {interval:g} s"
        )
        environment = spec.environment.as_evaluated()
        environments = make_environments(environment, environments_for(episodes, environment), wrap=self._config.wrap)
        try:
            due = time.monotonic() + interval
            for number in itertools.count():
                if self._stop.wait(max(due - time.monotonic(), 0.0)):
                    raise RunOverError("stopped")
                due = time.monotonic() + interval
                # Actors' seeds are one number, these three: no episode of training is played here.
                seed = int(np.random.SeedSequence([welcome.seed, spec.training.seed, number]).generate_state(1)[0])
                if not self._evaluate(welcome, environments, seed):
                    return
        finally:
            environments.close()

    def _evaluate(self, welcome: Welcome, environments: VectorEnvironment, seed: int) -> bool:
        """One evaluation, from the request to the report; False if the learner is not there any more."""
        snapshot = self._link.evaluation_snapshot(welcome.run, self._config.name, self._stop)
        if not isinstance(snapshot, Snapshot) or snapshot.learner_epoch != welcome.learner_epoch:
            return False
        program = self._link.program(welcome.run, snapshot.program)
        if program is None:
            return False
        runtime = OnnxRuntime(program[1])
        runtime.load(snapshot.weights)
        how = welcome.spec.evaluation
        evaluation = play_episodes(
            runtime, environments, how.episodes, seed, sampled=how.actions == "sampled", progress=self._continue
        )
        _logger.info(f"policy version {snapshot.policy_version}: return {evaluation.returns.mean():.1f}")
        self._link.report(
            welcome.run,
            EvaluationReport(
                evaluator=self._config.name,
                learner_epoch=snapshot.learner_epoch,
                policy_version=snapshot.policy_version,
                returns=evaluation.returns,
                lengths=evaluation.lengths,
            ),
            self._stop,
        )
        return True

    def _continue(self, _finished: int, _mean: float) -> None:
        """Called after every step: a request to stop ends it in the middle of an episode."""
        if self._stop.is_set():
            raise RunOverError("stopped")
