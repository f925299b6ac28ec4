"""What an actor asks of learners: to be found, to be let in, for programs and snapshots. No state, no threads."""

import contextlib
import logging
import queue
import threading
import time

from daedalus.policy.acting.runtime import program_hash
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, VersionMismatchError, decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS
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
)
from daedalus.transport.interface import Transport, TransportError

_logger = logging.getLogger(__name__)

_ANSWER_SECONDS = 5.0  # a query without an answer by then has none
_UPDATE_SECONDS = 60.0  # of one that is answered between two updates, which may be slow
_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_FIRST_RETRY_SECONDS, _MAX_RETRY_SECONDS = 0.02, 1.0
_TAKEN_SECONDS = 10.0  # for an earlier life of this actor to be found dead
_REOPEN_SECONDS = 5.0  # nobody answers for so long: perhaps the session is dead, so another is tried


class ActorError(Exception):
    """The actor cannot take part; the message says why and what to do."""


class LearnerLostError(Exception):
    """The learner went away, or lives another life; join again."""


class NameTakenError(ActorError):
    """Another actor of that name takes part, or did a moment ago."""


class RunOverError(Exception):
    """Told to stop, or the run is over; the message says which."""


class LearnerQueries:
    """Questions over a transport, their answers decoded."""

    def __init__(self, transport: Transport, hint: str = "") -> None:
        """`hint`: what else may be the matter, said where no learner answers."""
        self._transport = transport
        self._hint = hint

    def find(self, run: str, join: Join, timeout: float | None, stop: threading.Event) -> Welcome:
        """Asks to join until a learner of `run` (`*`: of any) answers.

        Raises RunOverError if told to stop; ActorError if refused, or after `timeout` seconds without an answer.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        pause, told = _FIRST_RETRY_SECONDS, False
        reopen_at = time.monotonic() + _REOPEN_SECONDS
        taken_until = time.monotonic() + _TAKEN_SECONDS
        while True:
            wanted = f"a learner{self._hint}"
            try:
                welcome = self.join(run, join)
            except NameTakenError:
                if time.monotonic() > (taken_until if deadline is None else min(taken_until, deadline)):
                    raise
                welcome = None
                wanted = "the other actor of this name to leave"
            if welcome is not None:
                return welcome
            if deadline is not None and time.monotonic() > deadline:
                raise ActorError(
                    f"no learner answered within {timeout:g} s: is it running, and is the address its own?{self._hint}"
                )
            if not told and pause >= _MAX_RETRY_SECONDS:
                _logger.info(f"waiting for {wanted}")
                told = True
            if stop.wait(pause):
                raise RunOverError("stopped")
            pause = min(2 * pause, _MAX_RETRY_SECONDS)
            if time.monotonic() > reopen_at:
                with contextlib.suppress(TransportError):  # no router there now: the session that is goes on looking
                    self._transport.reopen()
                reopen_at = time.monotonic() + _REOPEN_SECONDS

    def join(self, run: str, join: Join) -> Welcome | None:
        """One request to join; None if nobody answers now. Raises ActorError or RunOverError if refused."""
        answers = self._ask(keys.join(run), encode(join))
        welcomes = [answer for answer in answers if isinstance(answer, Welcome)]
        if len(welcomes) > 1:
            names = ", ".join(sorted(welcome.run for welcome in welcomes))
            raise ActorError(f"several learners answer here ({names}): choose one with --run")
        if welcomes:
            return welcomes[0]
        for refusal in answers:
            if isinstance(refusal, Refusal):
                if refusal.code == "finished":
                    raise RunOverError("the run is over")
                kind = NameTakenError if refusal.code == "name_taken" else ActorError
                raise kind(f"the learner refused this actor: {refusal.reason}")
        return None

    def is_there(self, run: str, join: Join) -> bool:
        """Whether any learner of `run` answers at all."""
        return bool(self._ask(keys.join(run), encode(join)))

    def program(self, run: str, name: str = "*") -> tuple[str, bytes] | None:
        """The program with that hash (`*`: the one that is played now) and its hash; None if nobody has it."""
        for answer in self._ask(keys.program(run, name)):
            if isinstance(answer, Program):
                model = answer.model.tobytes()
                found = program_hash(model)
                if found == answer.hash and name in ("*", found):
                    return found, model
        return None

    def newest(self, run: str) -> list[Message]:
        """The newest snapshot, or the run_ended, of a run."""
        return self._ask(keys.snapshots(run))

    def evaluation_snapshot(self, run: str, evaluator: str, stop: threading.Event) -> Snapshot | None:
        """The newest snapshot, of which the learner keeps a checkpoint until `report`; None if it has none to give.

        Raises RunOverError if the run is over, or if told to stop.
        """
        request = encode(EvaluationRequest(evaluator=evaluator))
        answer = self._ask_between_updates(keys.evaluations(run, evaluator), request, stop)
        if isinstance(answer, RunEnded) or (isinstance(answer, Refusal) and answer.code == "finished"):
            raise RunOverError("the run is over")
        return answer if isinstance(answer, Snapshot) else None

    def report(self, run: str, report: EvaluationReport, stop: threading.Event) -> None:
        """Tells the learner how a policy played; what it does not take is lost. Raises RunOverError if told to stop."""
        answer = self._ask_between_updates(keys.evaluations(run, report.evaluator), encode(report), stop)
        if isinstance(answer, Acknowledgement) and answer.verdict != "accepted":
            _logger.info(f"the learner did not take the evaluation: {answer.reason}")

    def decode(self, data: bytes) -> Message | None:
        """The message in `data`; None, and a word about it, if it is damaged.

        Raises ActorError if the learner is of another version.
        """
        try:
            return decode(data, LEARNER_LIMITS)
        except VersionMismatchError as error:
            raise ActorError(str(error)) from None
        except ProtocolError as error:
            _logger.info(f"ignored a message: {error}")
            return None

    def _ask_between_updates(self, key: str, payload: bytes, stop: threading.Event) -> Message | None:
        """One question to the learner's main thread; None without an answer. Raises RunOverError if told to stop."""
        answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        try:
            self._transport.query_async(key, payload, timeout=_UPDATE_SECONDS, on_answer=answers.put)
        except TransportError:
            return None
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                answer = answers.get(timeout=_HEARTBEAT_SECONDS)
                return None if answer is None else self.decode(answer)
        raise RunOverError("stopped")

    def _ask(self, key: str, payload: bytes = b"") -> list[Message]:
        try:
            answers = self._transport.query(key, payload, timeout=_ANSWER_SECONDS)
        except TransportError:
            return []
        return [message for message in map(self.decode, answers) if message is not None]
