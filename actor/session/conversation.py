"""The conversation of every process with a learner: joining, whether the learner is there, the end of the run."""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.errors import ActorError, ActorRefusedError, NameInUseError, NoLearnerError
from daedalus.actor.session.session_thread import StateLock
from daedalus.policy.acting.runtime import PolicyError, program_hash
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, UnfitMessageError, VersionMismatchError, decode, encode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS, LEARNER_LIMITS
from daedalus.protocol.messages import (
    Acknowledgement,
    EvaluationReport,
    EvaluationRequest,
    Join,
    Message,
    Program,
    Refusal,
    RunEnded,
    Snapshot,
    Welcome,
    starts_of,
)
from daedalus.protocol.spec import UnsupportedRunError
from daedalus.protocol.texts import MAX_ANSWER_TEXT, bounded_text
from daedalus.transport.interface import Inbox, RefusedError, Transport, TransportError
from daedalus.transport.slow_calls import SlowCall

DRAINED = "an operator drained this actor: it leaves the run"


class RunOverError(Exception):
    """The session ends for good: the run finished, or the actor was asked to stop; the message says which."""

    def __init__(self, reason: str, *, finished: bool = False) -> None:
        """`finished`: the run finished, and an actor that stays looks for the next run."""
        super().__init__(reason)
        self.finished = finished


class RunEndWatch:
    """Watch for a local stop and for the RunEnded messages of one run after the other. For one thread."""

    def __init__(self, transport: Transport, stop: threading.Event, on_news: Callable[[], None] = lambda: None) -> None:
        """`on_news` is called on the transport's threads when a message has come."""
        self._transport, self._stop, self._on_news = transport, stop, on_news
        self._inboxes: dict[str, Inbox] = {}  # by run
        self.run, self.learner_epoch = "", -1  # of the learner that is followed; an empty name before the first
        self.learner_stopped = False  # since `follow`

    def follow(self, run: str, learner_epoch: int) -> None:
        """Follow a learner from now on."""
        self.run, self.learner_epoch, self.learner_stopped = run, learner_epoch, False
        if run not in self._inboxes:
            self._inboxes[run] = self._transport.subscribe(keys.run_end(run), self._on_news)

    def check(self) -> None:
        """Raise RunOverError on a local stop or if the run finished; note if the learner was stopped."""
        if self._stop.is_set():
            raise RunOverError("stopped")
        inbox = self._inboxes.get(self.run)
        data = None if inbox is None else inbox.take()
        if data is None:
            return
        try:
            message = decode(data, ACKNOWLEDGEMENT_LIMITS)
        except ProtocolError:
            return
        if isinstance(message, RunEnded):
            self.apply(message)

    def apply(self, message: RunEnded) -> None:
        """Obey a message. Raises RunOverError if the run finished.

        A later learner may have finished the run during a long rollout. An older one that was cut off, from which the
        run was continued elsewhere, has not.
        """
        if message.outcome == "finished" and starts_of(message.learner_epoch) >= starts_of(self.learner_epoch):
            raise RunOverError(f"the run is over: {bounded_text(message.reason, MAX_ANSWER_TEXT)}", finished=True)
        if message.learner_epoch == self.learner_epoch:
            self.learner_stopped = True

    def wait(self, seconds: float) -> None:
        """Wait, then `check`. A local stop ends the wait at once."""
        self._stop.wait(seconds)
        self.check()


_logger = logging.getLogger(__name__)

_ANSWER_SECONDS = 5.0  # for a query that is answered at once
_UPDATE_SECONDS = 60.0  # for a query that is answered between two updates, which may be slow
_REPORT_SECONDS, _MAX_FAILURE = 2.0, 300  # for the report of a failure, and its length in characters
_POLL_SECONDS = 0.2  # how soon a wait notices `stop`
_FIRST_RETRY_SECONDS, _MAX_RETRY_SECONDS = 0.02, 1.0
_NAME_IN_USE_SECONDS = 10.0  # until the network notices that an earlier incarnation of this actor is dead
_LOOK_AROUND_SECONDS, _MAX_RUNS = 10.0, 10  # between looks for other runs, and how many are named
_STEP_DOWN_SECONDS = 5.0  # for the older of two learners of a run to notice the newer one
_REOPEN_SECONDS = 5.0  # without an answer for so long, the session may be dead: open another


class LearnerQueries:
    """Queries over a transport, with decoded answers."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._noted = ""  # the last warning of another release

    def join_learner(self, run: str, join: Join, timeout: float | None, end: RunEndWatch) -> Welcome:
        """Send requests to join until a learner of `run` (`*`: of any run) answers.

        While several learners of one run answer, wait for the older ones to step down, for at most 5 s: they would
        answer queries that are meant for the newest.

        Raises RunOverError on a local stop or if the run is over; NoLearnerError after `timeout` seconds without an
        answer; another ActorError if refused.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        pause, logged, log_at = _FIRST_RETRY_SECONDS, "", 0.0
        reopen_at = time.monotonic() + _REOPEN_SECONDS
        name_free_by = time.monotonic() + _NAME_IN_USE_SECONDS
        alone_by: float | None = None
        while True:
            end.check()  # a request may take 5 s
            awaited = ""
            try:
                welcomes = self._request_joins(run, join)
            except NameInUseError:
                if time.monotonic() > (name_free_by if deadline is None else min(name_free_by, deadline)):
                    raise
                welcomes = []
                awaited = "the other actor of this name to leave"
            is_late = deadline is not None and time.monotonic() > deadline
            if len(welcomes) > 1 and alone_by is None:
                alone_by = time.monotonic() + _STEP_DOWN_SECONDS
                _log_several(welcomes)
            if len(welcomes) == 1 or (welcomes and (is_late or time.monotonic() > (alone_by or 0.0))):
                return welcomes[0]
            if welcomes:
                awaited = "the older learner to step down"
            elif is_late:
                raise NoLearnerError(f"no learner answered within {timeout:g} s: {self._remedy(run, join)}")
            if pause >= _MAX_RETRY_SECONDS and time.monotonic() >= log_at:
                log_at = time.monotonic() + _LOOK_AROUND_SECONDS
                end.check()  # the request may have taken 5 s, and the next one may too
                text = f"waiting for {awaited or self._awaited(run, join)}"
                if text != logged:
                    _logger.info("%s", text)
                logged = text
            end.wait(pause)
            pause = min(2 * pause, _MAX_RETRY_SECONDS)
            if time.monotonic() > reopen_at:
                self._reopen(end)
                reopen_at = time.monotonic() + _REOPEN_SECONDS

    def _remedy(self, run: str, join: Join) -> str:
        """Return what to do where no learner of the run answers."""
        if run != keys.ANY_RUN and self._runs(join):
            return f"waited for {self._awaited(run, join)}; choose with --run"
        return "check that the learner runs and that the address is correct"

    def _awaited(self, run: str, join: Join) -> str:
        """Return which learner the actor waits for, and which runs are there instead."""
        if run == keys.ANY_RUN:
            return "a learner"
        there = ", ".join(repr(name) for name in self._runs(join) if name != run)
        return f"a learner of run {run!r}" + (f"; the runs here are {there}" if there else "")

    def _runs(self, join: Join) -> list[str]:
        """Return the names of the runs whose learners answer."""
        request, runs = encode(replace(join, spaces=None, environments=0)), set()
        with contextlib.suppress(TransportError):
            for answer in self._transport.query(keys.join(keys.ANY_RUN, join.actor), request, timeout=_ANSWER_SECONDS):
                with contextlib.suppress(ProtocolError):  # a learner of another version is not the one awaited
                    message = decode(answer, LEARNER_LIMITS)
                    runs.update({message.run} if isinstance(message, Welcome) else ())
        return sorted(runs)[:_MAX_RUNS]

    def _reopen(self, end: RunEndWatch) -> None:
        """Open another session in place of one that may be dead.

        Raises ActorError if the certificate is refused, and as `end.check` does.
        """
        try:
            SlowCall(self._transport.reopen).wait(end.check)
        except RefusedError as error:  # it was revoked or has expired since the start
            raise ActorError(str(error)) from None
        except TransportError:
            pass  # no router now: the present session keeps trying

    def request_join(self, run: str, join: Join) -> Welcome | None:
        """Send a request to join; return the answer of the newest learner, or None if no learner is ready.

        Raises ActorError or RunOverError if refused, and ActorError if learners of several runs answer.
        """
        return next(iter(self._request_joins(run, join)), None)

    def _request_joins(self, run: str, join: Join) -> list[Welcome]:
        """Send a request to join; return the answers of the learners of one run, the newest first. See request_join."""
        answers = self._ask(keys.join(run, join.actor), encode(join))
        welcomes = [answer for answer in answers if isinstance(answer, Welcome)]
        names = sorted({welcome.run for welcome in welcomes})
        if len(names) > 1:
            raise ActorError(f"several learners answer here ({', '.join(names)}): choose one with --run")
        if welcomes:
            for welcome in welcomes:
                self._check_known(welcome, join)
            return sorted(welcomes, key=lambda welcome: welcome.learner_epoch, reverse=True)
        _raise_if_over(answers)
        for refusal in answers:
            if isinstance(refusal, Refusal):
                if refusal.code == "not_ready":  # the learner is stopping; another process may continue the run
                    continue
                kind = NameInUseError if refusal.code == "name_taken" else ActorRefusedError
                raise kind(f"the learner refused this actor: {bounded_text(refusal.reason, MAX_ANSWER_TEXT)}")
        return []

    def _check_known(self, welcome: Welcome, join: Join) -> None:
        """Raise ActorError, and report it, if the run has settings of a newer release."""
        try:
            welcome.spec.check_known()
        except UnsupportedRunError as error:
            failure = ActorError(str(error))
            self.report_failure(welcome.run, join, failure)
            raise failure from None

    def report_failure(self, run: str, join: Join, error: Exception) -> None:
        """Report why this actor ends, for the status of the run. Does nothing if the learner itself is the cause."""
        if not run or isinstance(error, ActorRefusedError):
            return
        expected = isinstance(error, (ActorError, EnvironmentSetupError, PolicyError))
        failure = f"{'' if expected else type(error).__name__ + ': '}{error}"[:_MAX_FAILURE]
        with contextlib.suppress(TransportError):
            failed = replace(join, spaces=None, environments=0, failure=failure or type(error).__name__)
            self._transport.query(keys.join(run, join.actor), encode(failed), timeout=_REPORT_SECONDS)

    def learner_responds(self, run: str, join: Join) -> bool:
        """Return whether any learner of `run` answers a request to join. Raises RunOverError if the answer says so."""
        answers = self._ask(keys.join(run, join.actor), encode(join))
        if not any(isinstance(answer, Welcome) for answer in answers):
            _raise_if_over(answers)
        return bool(answers)

    def program(self, run: str, name: str = "*") -> tuple[str, bytes] | None:
        """Return hash and bytes of the program with that hash (`*`: the current one), or None if nobody has it."""
        for answer in self._ask(keys.program(run, name)):
            if isinstance(answer, Program):
                model = answer.model.tobytes()
                computed = program_hash(model)
                if computed == answer.hash and name in ("*", computed):
                    return computed, model
        return None

    def newest_snapshot(self, run: str) -> list[Message]:
        """Return the answers of the run's learners: the newest Snapshot, or RunEnded."""
        return self._ask(keys.snapshots(run))

    def evaluation_snapshot(self, run: str, evaluator: str, end: RunEndWatch) -> Snapshot | None:
        """Return the newest snapshot, or None if the learner has none to evaluate.

        The learner keeps a checkpoint of the same version until `report_evaluation`. Raises RunOverError if the run is
        over, or on a local stop.
        """
        request = encode(EvaluationRequest(evaluator=evaluator))
        answer = self._ask_between_updates(keys.evaluations(run, evaluator), request, end)
        if isinstance(answer, Refusal) and answer.code == "finished":
            raise RunOverError("the run is over", finished=True)
        return answer if isinstance(answer, Snapshot) else None

    def report_evaluation(self, run: str, report: EvaluationReport, end: RunEndWatch) -> None:
        """Report a policy's returns to the learner; a rejected report is lost. Raises as `evaluation_snapshot`."""
        answer = self._ask_between_updates(keys.evaluations(run, report.evaluator), encode(report), end)
        if isinstance(answer, Acknowledgement) and answer.verdict != "accepted":
            _logger.warning("the learner rejected the evaluation: %s", answer.reason)

    def decode(self, data: bytes) -> Message | None:
        """Return the message in `data`; log damaged data and return None.

        Raises ActorError if the learner's release is another one, of which this actor can apply no message or not all
        settings of the run.
        """
        try:
            return decode(data, LEARNER_LIMITS)
        except VersionMismatchError as error:
            raise ActorError(str(error)) from None
        except ProtocolError as error:
            if isinstance(error, UnfitMessageError) and error.kind == Welcome.__name__:
                raise ActorError(
                    f"this release cannot play the run ({error}): upgrade daedalus-rl here to the learner's release"
                ) from None
            _logger.warning("ignored a damaged message: %s", error)
            return None

    def _ask_between_updates(self, key: str, payload: bytes, end: RunEndWatch) -> Message | None:
        """Send a query that the learner answers between two updates; return None without an answer.

        Raises RunOverError on a local stop or if the run is over.
        """
        answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        try:
            self._transport.query_async(key, payload, timeout=_UPDATE_SECONDS, on_answer=answers.put)
        except TransportError:
            return None
        while True:
            end.check()
            with contextlib.suppress(queue.Empty):
                answer = answers.get(timeout=_POLL_SECONDS)
                return None if answer is None else self.decode(answer)

    def _ask(self, key: str, payload: bytes = b"") -> list[Message]:
        try:
            answers = self._transport.query(key, payload, timeout=_ANSWER_SECONDS)
        except TransportError:
            return []
        messages, foreign = list[Message](), None
        for answer in answers:
            try:
                message = self.decode(answer)
            except ActorError as error:
                foreign = error
            else:
                messages += [] if message is None else [message]
        if foreign is not None and not messages:
            raise foreign
        if foreign is not None and str(foreign) != self._noted:
            self._noted = str(foreign)
            _logger.warning("ignored the answer of another learner: %s", foreign)
        return messages


def _log_several(welcomes: list[Welcome]) -> None:
    newest = welcomes[0]
    _logger.warning(
        "%d learners of run %r answer: following the newest, epoch %x, once the older has stepped down",
        len(welcomes),
        newest.run,
        newest.learner_epoch,
    )


def _raise_if_over(answers: list[Message]) -> None:
    """Raise RunOverError if an answer says that the run is over, or that an operator drained this actor."""
    for answer in answers:
        if isinstance(answer, Refusal) and answer.code == "finished":
            raise RunOverError("the run is over", finished=True)
        if isinstance(answer, Refusal) and answer.code == "drained":
            raise RunOverError(DRAINED)


class LearnerPresence:
    """When the learner was last heard, and whether it left. The lock guards both."""

    def __init__(self, lock: StateLock) -> None:
        self._lock = lock
        self._left = False
        self._heard_at = 0.0

    @property
    def left(self) -> bool:
        """Whether a learner of the run left since `joined`: the one there now may be another."""
        return self._left

    @property
    def heard_at(self) -> float:
        """The monotonic time of the last message of the learner."""
        return self._heard_at

    def joined(self) -> None:
        """Forget what was known about an earlier learner: one has just answered a request to join."""
        with self._lock:
            self._left, self._heard_at = False, time.monotonic()

    def heard(self) -> None:
        """Note a message of the learner. From any thread."""
        with self._lock:
            self._heard_at = time.monotonic()
            self._lock.announce_change()

    def on_presence(self, _key: str, present: bool) -> None:
        """Note that a learner of the run came or left. Called on the transport's threads."""
        with self._lock:
            self._left = self._left or not present
            self._lock.announce_change()
