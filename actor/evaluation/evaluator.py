"""The evaluator: an actor that evaluates the learner's newest policy and reports the returns.

It does so on a schedule, or at once with each policy, for the process of this host that has started it.

It contributes nothing to the training data. The only threads are the caller's and the transport's.
"""

import itertools
import logging
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.actor.errors import LearnerLostError
from daedalus.actor.evaluation.episodes import (
    EvaluationProgress,
    cut_note,
    environments_for,
    no_progress,
    play_episodes,
)
from daedalus.actor.session.actor_config import ActorConfig, own_origin
from daedalus.actor.session.conversation import Conversation, Query, RunOverError, Steps, Wait, Work
from daedalus.actor.session.session_thread import SessionThread
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import (
    Acknowledgement,
    EvaluationReport,
    EvaluationRequest,
    Message,
    Refusal,
    Snapshot,
    Welcome,
)
from daedalus.protocol.spec import EvaluatorSpec
from daedalus.protocol.texts import short_number
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_DEFAULT_SECONDS = 60.0  # between evaluations, unless the run says otherwise
_UPDATE_SECONDS = 60.0  # for a query that is answered between two updates, which may be slow


class EvaluatorSession(Conversation):
    """All that an evaluator says to learners."""

    def request_snapshot(self) -> Steps[Snapshot | None]:
        """Return the newest snapshot, or None if the learner has none to evaluate.

        The learner keeps a checkpoint of the same version until `report`. Raises RunOverError if the run is over.
        """
        answer = yield from self._ask_between_updates(encode(EvaluationRequest(evaluator=self.config.name)))
        if isinstance(answer, Refusal) and answer.code == "finished":
            raise RunOverError("the run is over", finished=True)
        return answer if isinstance(answer, Snapshot) else None

    def report(self, report: EvaluationReport) -> Steps[None]:
        """Report a policy's returns to the learner; a rejected report is lost. Raises as `request_snapshot`."""
        answer = yield from self._ask_between_updates(encode(report))
        if isinstance(answer, Acknowledgement) and answer.verdict != "accepted":
            _logger.warning("the learner rejected the evaluation: %s", answer.reason)

    def _ask_between_updates(self, payload: bytes) -> Steps[Message | None]:
        """Send a query that the learner answers between two updates; return None without an answer."""
        answers = list[bytes | None]()
        key = keys.evaluations(self.run, self.config.name)
        self.act(Query(key, payload, _UPDATE_SECONDS, lambda answer, _: answers.append(answer)))
        while not answers:
            yield Wait(None)
            self.check_over()
        data = answers[0]
        return None if data is None else (yield Work(partial(self.decode, data)))


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
        self._session = EvaluatorSession(config, own_origin(transport))
        self._thread = SessionThread(self._session, transport, stop)
        self._warned_of_cuts = False

    def run(self) -> bool:
        """Evaluate until `stop` or until the run is over; return whether the run finished.

        Raises ActorError if the evaluator is refused, EnvironmentSetupError if the environment cannot be created here,
        PolicyError if the policy does not run.
        """
        try:
            while True:
                self._evaluate_learner(self._thread.run(self._session.find_learner()))
        except RunOverError as error:
            _logger.info("%s", error)
            return error.finished
        except Exception as error:
            self._thread.run(self._session.report_failure(error), to_the_end=True)
            raise

    def leave(self, by: float) -> None:
        """End `run`, also in the middle of an evaluation, whose episodes are dropped. From any thread."""
        self._thread.notify(self._session.leave, by)

    def _evaluate_learner(self, welcome: Welcome) -> None:
        """Evaluate the policies of one learner epoch until it ends."""
        self._thread.call(self._session.end_waiting)
        self._on_join(welcome)
        spec, wanted, at_once = welcome.spec, welcome.spec.evaluation, welcome.play_episodes > 0
        interval = 0.0 if at_once else wanted.seconds or _DEFAULT_SECONDS
        if at_once:
            wanted = wanted.model_copy(update={"episodes": welcome.play_episodes})
        else:
            plan = f"{wanted.episodes} {wanted.actions} episodes of {spec.environment.id} every {interval:g} s"
            _logger.info("run %r: %s", welcome.run, plan)
        environment = spec.environment.as_evaluated()
        count = environments_for(wanted.episodes, environment, spec.collection)
        environments = make_environments(environment, count, modules=self._config.modules, one_episode=True)
        try:
            if at_once:  # nobody else checks that the policy fits the environment
                join = replace(self._session.join, spaces=environments.spaces, environments=count)
                try:
                    self._thread.run(self._session.confirm(welcome, join))
                except LearnerLostError:
                    return  # there is something else to play by now
            due = time.monotonic() + interval
            for number in itertools.count():
                self._thread.run(self._session.pause(due - time.monotonic()))
                due = time.monotonic() + interval
                # An actor's seed is made of other numbers: no episode of training is evaluated here.
                seed = int(np.random.SeedSequence([welcome.seed, spec.seed, number]).generate_state(1)[0])
                if not self._evaluate(welcome, wanted, environments, welcome.play_seed if at_once else seed):
                    return
        finally:
            environments.close()

    def _evaluate(self, welcome: Welcome, wanted: EvaluatorSpec, environments: VectorEnvironment, seed: int) -> bool:
        """Request a policy, evaluate it and report; return False if the learner is gone."""
        snapshot = self._thread.run(self._session.request_snapshot())
        if not isinstance(snapshot, Snapshot) or snapshot.learner_epoch != welcome.learner_epoch:
            return False
        program = self._thread.run(self._session.program(snapshot.program))
        if program is None:
            return False
        runtime = OnnxRuntime(program, self._stop)
        runtime.load(snapshot.weights)
        sampled, longest = wanted.actions == "sampled", wanted.max_episode_env_steps
        shown = EvaluationProgress(sys.stderr, wanted.episodes, longest, self._stop)
        progress = shown if welcome.play_episodes else no_progress  # whoever has started this evaluator waits

        def raise_if_ended(finished: int, mean: float) -> bool:
            self._thread.call(self._session.check_over)  # also in the middle of an episode
            return progress(finished, mean)

        evaluation = play_episodes(
            runtime,
            environments,
            wanted.episodes,
            seed,
            sampled=sampled,
            longest=longest,
            progress=raise_if_ended,
        )
        _logger.info("policy version %d: return %s", snapshot.policy_version, short_number(evaluation.returns.mean()))
        note = ""
        if evaluation.cut.any():
            cut = int(evaluation.cut.sum())
            note = cut_note(welcome.spec.environment, cut, wanted.episodes, longest, sampled=sampled)
            if not (self._warned_of_cuts or welcome.play_episodes):  # whoever asked at once shows the note
                self._warned_of_cuts = True
                _logger.warning("%s", note)
        report = EvaluationReport(
            evaluator=self._config.name,
            learner_epoch=snapshot.learner_epoch,
            policy_version=snapshot.policy_version,
            returns=evaluation.returns,
            lengths=evaluation.lengths,
            note=note,
        )
        self._thread.run(self._session.report(report))
        return True
