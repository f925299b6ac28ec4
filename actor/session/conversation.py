"""The conversation of every process with a learner, without I/O, threads or clock: events in, actions out.

A part of the conversation is a generator, `Steps`. It yields an action that takes its time (`Ask`, `Wait`, `Work` and
those of the roles), and is sent what came of it. What is to be done at once meanwhile, `take_actions` returns. Events
may come between two steps: `received`, `presence_changed`, and the answers to queries. Time is `now`, which is set
before each step and each event.

Whoever drives a conversation performs the actions: a thread (session_thread.py), an event loop (gateway/joining.py), or
a simulation in virtual time (tests/simulation/actors.py).
"""

import contextlib
import logging
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias, TypeVar

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.errors import ActorError, ActorRefusedError, LearnerLostError, NameInUseError, NoLearnerError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.policy.acting.runtime import PolicyError
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, UnfitMessageError, VersionMismatchError, decode, encode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS, LEARNER_LIMITS
from daedalus.protocol.messages import (
    UNKNOWN,
    Join,
    Message,
    OrderRequest,
    Origin,
    Program,
    Refusal,
    RunEnded,
    Welcome,
    program_hash,
    starts_of,
)
from daedalus.protocol.releases import as_release, own_release
from daedalus.protocol.spec import UnsupportedRunError
from daedalus.protocol.texts import MAX_ANSWER_TEXT, MAX_NAME, bounded_text

_logger = logging.getLogger(__name__)

_ANSWER_SECONDS = 5.0  # for a query that is answered at once
_LATE_SECONDS = 0.5  # for a query after the time to look for a learner
_REPORT_SECONDS, _MAX_FAILURE = 2.0, 300  # for the report of a failure, and its length in characters
_FIRST_RETRY_SECONDS, _MAX_RETRY_SECONDS = 0.02, 1.0
_NAME_IN_USE_SECONDS = 10.0  # until the network notices that an earlier incarnation of this actor is dead
_LOOK_AROUND_SECONDS, _MAX_RUNS = 10.0, 10  # between looks for other runs, and how many are named
_STEP_DOWN_SECONDS = 5.0  # for the older of two learners of a run to notice the newer one
_REOPEN_SECONDS = 5.0  # without an answer for so long, the session may be dead: open another
_SILENCE_SECONDS = 10.0  # without a message for so long, ask whether the learner is there

LEAVES = "asked by a signal to leave"
WAITING_ORDERS = keys.orders(keys.NO_RUN, "*")  # to actors that wait for a run

Result = TypeVar("Result")
Steps: TypeAlias = Generator[Any, Any, Result]  # yields actions, is sent what came of each, returns a result


# ------------------------------------------------------------------------------------- actions that take their time


@dataclass(frozen=True, slots=True)
class Ask:
    """Send a query, and send back the list of all answers that arrive in time."""

    key: str
    payload: bytes = b""
    timeout: float = _ANSWER_SECONDS


@dataclass(frozen=True, slots=True)
class Wait:
    """Go on at a time, or as soon as an event has come; None: with the next event."""

    until: float | None


@dataclass(frozen=True, slots=True)
class Work:
    """Call a function that may take long, and send back its result. Events may come meanwhile."""

    call: Callable[[], Any]


@dataclass(frozen=True, slots=True)
class Reopen:
    """Open another transport session in place of one that may be dead; without a router now, go on with it."""


# ------------------------------------------------------------------------------------------ actions without a result


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """Send a query, and call `on_answer` with the first answer and the time, or with None if there is no answer."""

    key: str
    payload: bytes
    timeout: float
    on_answer: Callable[[bytes | None, float], None]


@dataclass(frozen=True, slots=True)
class Subscribe:
    """Pass on the values of a key, from now on. Idempotent, as the next three."""

    key: str


@dataclass(frozen=True, slots=True)
class Unsubscribe:
    """Pass on the values of a key no longer."""

    key: str


@dataclass(frozen=True, slots=True)
class WatchPresence:
    """Pass on who comes and leaves under a key, from now on."""

    key: str


@dataclass(frozen=True, slots=True)
class DeclarePresence:
    """Be present under a key."""

    key: str


@dataclass(frozen=True, slots=True)
class WithdrawPresence:
    """Be present under a key no longer. Idempotent."""

    key: str


AtOnce: TypeAlias = Query | Subscribe | Unsubscribe | WatchPresence | DeclarePresence | WithdrawPresence


class RunOverError(Exception):
    """The session ends for good: the run finished, or the actor was asked to stop; the message says which."""

    def __init__(self, reason: str, *, finished: bool = False) -> None:
        """`finished`: the run finished, and an actor that stays looks for the next run."""
        super().__init__(reason)
        self.finished = finished


class Conversation:
    """What one process knows of one learner after the other, and what it says to them.

    Attributes:
      now: the monotonic time of the present step or event, in seconds.
      run, learner_epoch: of the learner that is followed; an empty name before the first.
      heard_at: the time of the last message of the learner.
    """

    is_actor = True  # whether operators may see that it waits for a run, and drain it then

    def __init__(self, config: ActorConfig, origin: Origin = UNKNOWN) -> None:
        """`origin` says where this process runs, for the operator who reads the status."""
        self.config = config
        self.join = Join(actor=config.name, incarnation=config.incarnation, origin=origin)
        self.now = 0.0
        self.run, self.learner_epoch = "", -1
        self.heard_at = 0.0
        self._has_joined = False  # any learner
        self._left = False  # whether a learner of the run left since the last join: the one there may be another
        self._over: RunOverError | None = None
        self.leave_by: float | None = None  # the time by which this process has to leave; None: it stays
        self._learner_stopped = False  # since `follow`
        self._actions: list[AtOnce] = []
        self._noted = ""  # the last warning of another release
        self._waits = False  # whether it shows that it waits for a run

    # ------------------------------------------------------------------------------------------------ events

    def received(self, key: str, data: bytes) -> None:
        """Receive the newest value of a key that is subscribed to."""
        if key not in (WAITING_ORDERS, keys.run_end(self.run)):
            return
        with contextlib.suppress(ProtocolError):
            message = decode(data, ACKNOWLEDGEMENT_LIMITS)
            if isinstance(message, RunEnded) and key != WAITING_ORDERS:
                self.run_ended(message)
            if isinstance(message, OrderRequest) and key == WAITING_ORDERS:
                self._ordered(message)

    def _ordered(self, message: OrderRequest) -> None:
        """Carry out an order to this actor while it waits for a run."""
        this = self.join.actor, self.join.incarnation
        if message.order == "drain" and (message.actor, message.incarnation) == this and self._waits:
            host = f" at {bounded_text(message.host, MAX_NAME)}" if message.host else ""
            self._over = RunOverError(f"drained by an operator{host} while it waited for a run")

    def presence_changed(self, present: bool) -> None:
        """Note that a learner of the run came or left."""
        self._left = self._left or not present

    def heard(self, now: float) -> None:
        """Note a message of the learner."""
        self.heard_at = max(self.heard_at, now)

    def run_ended(self, message: RunEnded) -> None:
        """Note that the run finished, or that its learner was stopped.

        A later learner may have finished the run during a long rollout. An older one that was cut off, from which the
        run was continued elsewhere, has not.
        """
        if message.outcome == "finished" and starts_of(message.learner_epoch) >= starts_of(self.learner_epoch):
            reason = bounded_text(message.reason, MAX_ANSWER_TEXT)
            self._over = RunOverError(f"the run is over: {reason}", finished=True)
        elif message.learner_epoch == self.learner_epoch:
            self._learner_stopped = True

    def leave(self, by: float) -> None:
        """Leave once what is under way is finished, and at the latest at a time."""
        self.leave_by = by

    # --------------------------------------------------------------------------------------------- at once

    def act(self, *actions: AtOnce) -> None:
        """Let actions be performed after this step or event."""
        self._actions += actions

    def take_actions(self) -> list[AtOnce]:
        """Return the actions to perform now, in their order."""
        actions, self._actions = self._actions, []
        return actions

    # ------------------------------------------------------------------------------------- is there a reason to end

    def check_over(self) -> None:
        """Raise RunOverError if the run finished, or if this process was asked to leave and has nothing to finish."""
        over, self._over = self._over, None
        if over is not None:
            raise over
        if self.leave_by is not None:
            self.check_leave(self.leave_by)

    def check_leave(self, by: float) -> None:
        """Raise RunOverError if there is nothing to finish before this process leaves, or no time."""
        raise RunOverError(LEAVES)

    def check(self) -> None:
        """Raise if there is a reason to leave the learner: as `check_over` does, or LearnerLostError."""
        self.check_over()  # first: a learner that finished says so before it leaves
        if self._learner_stopped:
            raise LearnerLostError("the learner was stopped; waiting for it to return")
        if self._left:
            raise LearnerLostError

    def probe_if_silent(self) -> Steps[None]:
        """After a long silence ask whether the learner is there: a dead session can look alive.

        Raises LearnerLostError if nobody responds, and RunOverError as `check_over` does.
        """
        if self.now < self.silent_at:
            return
        self.check_over()  # a request may take 5 s
        answers = yield from self.ask(keys.join(self.run, self.join.actor), encode(self.join))
        if not any(isinstance(answer, Welcome) for answer in answers):
            _raise_if_over(answers)
        if not answers:
            raise LearnerLostError
        self.heard(self.now)

    @property
    def silent_at(self) -> float:
        """The time from which the learner counts as silent, unless a message comes."""
        return self.heard_at + _SILENCE_SECONDS

    # ---------------------------------------------------------------------------------------------- joining

    def find_learner(self) -> Steps[Welcome]:
        """Ask until a learner of the run answers, and follow it.

        While several learners of one run answer, wait for the older ones to step down, for at most 5 s: they would
        answer queries that are meant for the newest.

        Raises RunOverError if the run is over; NoLearnerError after the timeout without an answer; another ActorError
        if refused.
        """
        welcome = yield from self._join_learner(self.config.run_to_join(self.run), self.join)
        self._left = False
        self.heard(self.now)
        self.run, self.learner_epoch, self._learner_stopped = welcome.run, welcome.learner_epoch, False
        self.act(Subscribe(keys.run_end(welcome.run)))
        return welcome

    def confirm(self, welcome: Welcome, join: Join, *, asks_only: bool = False) -> Steps[Welcome]:
        """Take part in a learner's run, with spaces; return the learner's answer.

        `asks_only`: do not look what else is there if there is no answer. Raises LearnerLostError if another learner
        answers, and as `find_learner` does.
        """
        self.act(DeclarePresence(keys.presence(welcome.run, join.actor, join.incarnation)))
        confirmed = yield from self._join_learner(welcome.run, join, asks_only=asks_only)
        if confirmed.learner_epoch != welcome.learner_epoch:
            raise LearnerLostError
        self._has_joined = True
        self.end_waiting()
        return confirmed

    @property
    def _timeout(self) -> float | None:
        """Seconds to look for a learner."""
        return None if self._has_joined and self.config.waits_for_return else self.config.timeout

    def _join_learner(self, run: str, join: Join, *, asks_only: bool = False) -> Steps[Welcome]:
        timeout, began = self._timeout, self.now
        since = began if self.run or self.config.searched_since is None else self.config.searched_since
        deadline = None if timeout is None else since + timeout
        pause, logged, log_at, reopen_at = _FIRST_RETRY_SECONDS, "", 0.0, began + _REOPEN_SECONDS
        name_free_by = began + (_NAME_IN_USE_SECONDS if timeout is None else min(_NAME_IN_USE_SECONDS, timeout))
        alone_by: float | None = None
        while True:
            self.check_over()  # a request may take 5 s
            awaited, welcomes = "", list[Welcome]()
            try:
                welcomes = yield from self._request_joins(run, join, deadline)
            except NameInUseError:
                if self.now > name_free_by:
                    raise
                awaited = "the other actor of this name to leave"
            is_late = deadline is not None and self.now > deadline
            if len(welcomes) > 1 and alone_by is None:
                alone_by = self.now + _STEP_DOWN_SECONDS
                _log_several(welcomes)
            if len(welcomes) == 1 or (welcomes and (is_late or self.now > (alone_by or 0.0))):
                return welcomes[0]
            if welcomes:
                awaited = "the older learner to step down"
            elif is_late:
                remedy = yield from self._remedy(run, join)
                raise NoLearnerError(f"no learner answered within {timeout:g} s: {remedy}")
            if pause >= _MAX_RETRY_SECONDS and self.now >= log_at and not asks_only:
                if not awaited:
                    self._show_waiting()
                log_at = self.now + _LOOK_AROUND_SECONDS
                self.check_over()  # the request may have taken 5 s, and the next one may too
                there = [] if awaited or run == keys.ANY_RUN else (yield from self._runs(join))
                text = f"waiting for {awaited or _awaited(run, there)}"
                if text != logged:
                    _logger.info("%s", text)
                logged = text
            yield from self.pause(pause)
            pause = min(2 * pause, _MAX_RETRY_SECONDS)
            if self.now > reopen_at and not asks_only:
                yield Reopen()
                reopen_at = self.now + _REOPEN_SECONDS

    def _show_waiting(self) -> None:
        """Let operators see that this actor waits for a run, and drain it."""
        if self.is_actor and not self._waits:
            self._waits = True
            self.act(Subscribe(WAITING_ORDERS), DeclarePresence(self._waiting_key))

    def end_waiting(self) -> None:
        """Show no longer that this actor waits for a run: it takes part in one."""
        if self._waits:
            self._waits = False
            self.act(WithdrawPresence(self._waiting_key), Unsubscribe(WAITING_ORDERS))

    @property
    def _waiting_key(self) -> str:
        return keys.presence(keys.NO_RUN, self.join.actor, self.join.incarnation)

    def pause(self, seconds: float) -> Steps[None]:
        """Let time pass. Raises as `check_over` does."""
        until = self.now + seconds
        while self.now < until:
            yield Wait(until)
            self.check_over()

    def _remedy(self, run: str, join: Join) -> Steps[str]:
        """Return what to do where no learner of the run answers."""
        if run != keys.ANY_RUN and (there := (yield from self._runs(join, _LATE_SECONDS))):
            return f"waited for {_awaited(run, there)}; choose with --run"
        return "check that the learner runs and that the address is correct"

    def _runs(self, join: Join, within: float = _ANSWER_SECONDS) -> Steps[list[str]]:
        """Return the names of the runs whose learners answer in time."""
        request, runs = encode(replace(join, spaces=None, environments=0)), set[str]()
        for answer in (yield Ask(keys.join(keys.ANY_RUN, join.actor), request, within)):
            with contextlib.suppress(ProtocolError):  # a learner of another version is not the one awaited
                message = decode(answer, LEARNER_LIMITS)
                runs.update({message.run} if isinstance(message, Welcome) else ())
        return sorted(runs)[:_MAX_RUNS]

    def _request_joins(self, run: str, join: Join, deadline: float | None) -> Steps[list[Welcome]]:
        """Send a request to join; return the answers of the learners of one run, the newest first.

        The answers are awaited until a little after the deadline at most.

        Raises ActorError or RunOverError if refused, and ActorError if learners of several runs answer.
        """
        within = _ANSWER_SECONDS if deadline is None else max(min(deadline - self.now, _ANSWER_SECONDS), _LATE_SECONDS)
        try:
            answers = yield from self.ask(keys.join(run, join.actor), encode(join), within)
        except ActorError as error:  # a learner of another release, whose operator sees then which host to upgrade
            if not self.run and run != keys.ANY_RUN:  # else the caller reports it, or the run is not known
                yield from self._report_failure(run, join, error)
            raise
        welcomes = [answer for answer in answers if isinstance(answer, Welcome)]
        names = sorted({welcome.run for welcome in welcomes})
        if len(names) > 1:
            raise ActorError(f"several learners answer here ({', '.join(names)}): choose one with --run")
        if welcomes:
            for welcome in welcomes:
                yield from self._check_known(welcome, join)
            return sorted(welcomes, key=lambda welcome: welcome.learner_epoch, reverse=True)
        _raise_if_over(answers)
        for refusal in answers:
            if isinstance(refusal, Refusal):
                if refusal.code == "not_ready":  # the learner is stopping; another process may continue the run
                    continue
                kind = NameInUseError if refusal.code == "name_taken" else ActorRefusedError
                raise kind(f"the learner refused this actor: {bounded_text(refusal.reason, MAX_ANSWER_TEXT)}")
        return []

    def _check_known(self, welcome: Welcome, join: Join) -> Steps[None]:
        """Raise ActorError, and report it, if the run has settings of a newer release."""
        try:
            welcome.spec.check_known()
        except UnsupportedRunError as error:
            failure = ActorError(_with_release(error, welcome.software))
            yield from self._report_failure(welcome.run, join, failure)
            raise failure from None

    def report_failure(self, error: Exception) -> Steps[None]:
        """Report why this process ends, for the status of the run. Nothing if the learner itself is the cause."""
        yield from self._report_failure(self.run, self.join, error)

    def _report_failure(self, run: str, join: Join, error: Exception) -> Steps[None]:
        if not run or isinstance(error, ActorRefusedError):
            return
        expected = isinstance(error, (ActorError, EnvironmentSetupError, PolicyError))
        failure = f"{'' if expected else type(error).__name__ + ': '}{error}"[:_MAX_FAILURE]
        failed = replace(join, spaces=None, environments=0, failure=failure or type(error).__name__)
        yield Ask(keys.join(run, join.actor), encode(failed), _REPORT_SECONDS)

    # ------------------------------------------------------------------------------------- programs and answers

    def program(self, name: str = "*") -> Steps[bytes | None]:
        """Return the bytes of the program with a hash (`*`: the current one), or None if the learner has it not."""
        for answer in (yield from self.ask(keys.program(self.run, name))):
            if isinstance(answer, Program):
                model = answer.model.tobytes()
                computed = program_hash(model)
                if computed == answer.hash and name in ("*", computed):
                    return model
        return None

    def ask(self, key: str, payload: bytes = b"", within: float = _ANSWER_SECONDS) -> Steps[list[Message]]:
        """Send a query and return the decoded answers. Raises ActorError if all are of another release."""
        answers = yield Ask(key, payload, within)
        messages = yield Work(partial(self._decode_all, answers))
        if isinstance(messages, ActorError):
            raise messages
        return messages

    def _decode_all(self, answers: list[bytes]) -> list[Message] | ActorError:
        messages, foreign = list[Message](), None
        for answer in answers:
            try:
                message = self.decode(answer)
            except ActorError as error:
                foreign = error
            else:
                messages += [] if message is None else [message]
        if foreign is not None and not messages:
            return foreign
        if foreign is not None and str(foreign) != self._noted:
            self._noted = str(foreign)
            _logger.warning("ignored the answer of another learner: %s", foreign)
        return messages

    def decode(self, data: bytes) -> Message | None:
        """Return the message in `data`; log damaged data and return None. For large data, call this in `Work`.

        Raises ActorError if the learner's release is another one, of which this actor can apply no message or not all
        settings of the run.
        """
        try:
            return decode(data, LEARNER_LIMITS)
        except VersionMismatchError as error:
            raise ActorError(str(error)) from None
        except ProtocolError as error:
            if isinstance(error, UnfitMessageError) and error.kind == Welcome.__name__:
                reason = (
                    f"this release cannot play the run ({error}): upgrade daedalus-rl here to the learner's release"
                )
                raise ActorError(_with_release(reason, error.release)) from None
            _logger.warning("ignored a damaged message: %s", error)
            return None


def _with_release(reason: object, learner: str) -> str:
    """Return why a run cannot be played, with the release of its learner, if it states one, and of this process."""
    release = as_release(learner)
    return f"{reason} ({release}; this process has {own_release()})" if release else str(reason)


def _awaited(run: str, there: list[str]) -> str:
    """Return which learner an actor waits for, and which runs are there instead."""
    if run == keys.ANY_RUN:
        return "a learner"
    others = ", ".join(repr(name) for name in there if name != run)
    return f"a learner of run {run!r}" + (f"; the runs here are {others}" if others else "")


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
            raise drained(answer.reason)


def drained(reason: str) -> RunOverError:
    """Return why this actor leaves, as the learner says: who ordered it."""
    order = bounded_text(reason, MAX_ANSWER_TEXT) or "drained by an operator"
    return RunOverError(f"{order}: this actor leaves the run")
