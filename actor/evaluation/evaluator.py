"""The evaluator: an actor that evaluates the learner's newest policy on a schedule and reports the returns.

It contributes nothing to the training data. The only threads are the caller's and the transport's.
"""

import itertools
import logging
import threading
import time
from collections.abc import Callable

import numpy as np

from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.actor.evaluation.episodes import cut_note, environments_for, play_episodes
from daedalus.actor.session.config import ActorConfig
from daedalus.actor.session.learner_queries import LearnerQueries
from daedalus.actor.session.origin import own_origin
from daedalus.actor.session.run_end import RunEndWatch, RunOverError
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.messages import EvaluationReport, Join, Snapshot, Welcome
from daedalus.protocol.texts import short_number
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_DEFAULT_SECONDS = 60.0  # between evaluations, unless the run says otherwise
_POLL_SECONDS = 0.2  # how soon a wait notices the end of the run


class Evaluator:
    """One evaluator over one transport."""

    def __init__(
        self,
        config: ActorConfig,
        transport: Transport,
        stop: threading.Event,
        on_join: Callable[[Welcome], object] = lambda _: None,
    ) -> None:
        """`stop` ends `run`, also in the middle of an episode; for `on_join`, see ActorService."""
        self._config, self._stop, self._on_join = config, stop, on_join
        self._end = RunEndWatch(transport, stop)
        self._queries = LearnerQueries(transport)
        self._join = Join(actor=config.name, incarnation=config.incarnation, origin=own_origin(transport))
        self._warned_of_cuts = False

    def run(self) -> bool:
        """Evaluate until `stop` or until the run is over; return whether the run finished.

        Raises ActorError if the evaluator is refused, EnvironmentSetupError if the environment cannot be created here,
        PolicyError if the policy does not run.
        """
        try:
            while True:
                run = self._config.run_to_join(self._end.run)
                self._evaluate_learner(self._queries.join_learner(run, self._join, self._config.timeout, self._end))
        except RunOverError as error:
            _logger.info("%s", error)
            return error.finished
        except Exception as error:
            self._queries.report_failure(self._end.run, self._join, error)
            raise

    def _evaluate_learner(self, welcome: Welcome) -> None:
        """Evaluate the policies of one learner epoch until it ends."""
        self._end.follow(welcome.run, welcome.learner_epoch)
        self._on_join(welcome)
        spec = welcome.spec
        interval = spec.evaluation.seconds or _DEFAULT_SECONDS
        episodes = spec.evaluation.episodes
        actions = spec.evaluation.actions
        _logger.info(
            "run %r: %d %s episodes of %s every %g s", welcome.run, episodes, actions, spec.environment.id, interval
        )
        environment = spec.environment.as_evaluated()
        count = environments_for(episodes, environment, spec.collection)
        environments = make_environments(environment, count, modules=self._config.modules, one_episode=True)
        try:
            due = time.monotonic() + interval
            for number in itertools.count():
                while (now := time.monotonic()) < due:
                    self._end.wait(min(due - now, _POLL_SECONDS))
                due = time.monotonic() + interval
                # An actor's seed is made of other numbers: no episode of training is evaluated here.
                seed = int(np.random.SeedSequence([welcome.seed, spec.seed, number]).generate_state(1)[0])
                if not self._evaluate(welcome, environments, seed):
                    return
        finally:
            environments.close()

    def _evaluate(self, welcome: Welcome, environments: VectorEnvironment, seed: int) -> bool:
        """Request a policy, evaluate it and report; return False if the learner is gone."""
        snapshot = self._queries.evaluation_snapshot(welcome.run, self._config.name, self._end)
        if not isinstance(snapshot, Snapshot) or snapshot.learner_epoch != welcome.learner_epoch:
            return False
        program = self._queries.program(welcome.run, snapshot.program)
        if program is None:
            return False
        runtime = OnnxRuntime(program[1], self._stop)
        runtime.load(snapshot.weights)
        wanted = welcome.spec.evaluation
        sampled = wanted.actions == "sampled"
        evaluation = play_episodes(
            runtime,
            environments,
            wanted.episodes,
            seed,
            sampled=sampled,
            longest=wanted.max_episode_env_steps,
            progress=self._raise_if_ended,
        )
        _logger.info("policy version %d: return %s", snapshot.policy_version, short_number(evaluation.returns.mean()))
        if evaluation.cut.any() and not self._warned_of_cuts:
            self._warned_of_cuts = True
            cut, longest = int(evaluation.cut.sum()), wanted.max_episode_env_steps
            _logger.warning("%s", cut_note(cut, wanted.episodes, longest, sampled=sampled))
        self._queries.report_evaluation(
            welcome.run,
            EvaluationReport(
                evaluator=self._config.name,
                learner_epoch=snapshot.learner_epoch,
                policy_version=snapshot.policy_version,
                returns=evaluation.returns,
                lengths=evaluation.lengths,
            ),
            self._end,
        )
        return True

    def _raise_if_ended(self, _finished: int, _mean: float) -> bool:
        """End an evaluation with the run or on `stop`, in the middle of an episode: called after every step."""
        self._end.check()
        return False
