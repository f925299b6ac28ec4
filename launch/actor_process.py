"""The process of `daedalus actor`: construct one actor and run it; or start and watch several (--actors N).

Exit status: 0 the run is over, the actor was stopped or an operator drained it; 1 failed; 2 bad usage. With --stay,
an actor ends by a signal, a drain, wrong arguments, or after the --timeout that its user set; all other failures have
causes that somebody else can remove, so it reports them and tries again.
"""

import logging
import os
import secrets
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.errors import ActorError, NoLearnerError
from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig, own_name
from daedalus.actor.session.actor_service import ActorService
from daedalus.actor.session.role_actor import RoleActor, Seating
from daedalus.launch.child_output import inherited
from daedalus.launch.logs import LogOptions, print_error
from daedalus.launch.process_lifecycle import FAILED, status_at_start
from daedalus.launch.supervision import (
    Child,
    FailedError,
    Inference,
    Supervised,
    start,
    stop,
    supervised_inference,
)
from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.saving.saved_policy import NoPolicyError
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_code import frames_of, is_of_user
from daedalus.policy.user_modules import UserModules
from daedalus.protocol import keys
from daedalus.protocol.messages import Welcome
from daedalus.transport.addresses import socket_path
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import (
    SECURITY_ERRORS,
    Credentials,
    NotValidNowError,
    credentials_to_connect,
    run_for,
)
from daedalus.transport.interface import Transport, TransportError, UnreachableError
from daedalus.transport.private_address import socket_folder
from daedalus.transport.retries import Retries

_logger = logging.getLogger(__name__)

# Each in one line
_REPORTED = (ActorError, DamagedError, EnvironmentSetupError, NoPolicyError, PolicyError, TransportError)
_LEAVE_SECONDS = 30.0  # for the present rollout to be finished and uploaded: the notice of some spot machines
_LATE_SECONDS = 0.5  # after which an actor that has not left in time is stopped: a step does not return
_NEXT_RUN_SECONDS = 2.0  # after a run, before the next is looked for: its learner may answer for some seconds more


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorOptions:
    """What an actor process was started with."""

    connect: list[str]
    tls: Path | None = None
    evaluator: bool = False  # play the evaluations of the run instead of sending rollouts
    stay: bool = False  # wait for the next run, and try again after failures that others may remove
    name: str | None = None  # None: made from the name of the host
    run: str = keys.ANY_RUN
    any_run: bool = False
    seats: Sequence[tuple[str, str]] = ()  # roles or agents, each with its run; empty: all seats are of `run`
    environments: int | None = None  # None: as the learner asks
    runtime: Literal["onnx", "torch"] = "onnx"
    inference_at: str | None = None  # Unix socket of the process that runs the policy
    link: Literal["auto", "lan", "wan"] = "auto"
    timeout: float | None = None
    allowed_modules: frozenset[str] = frozenset()

    def config(self, credentials: Credentials | None) -> ActorConfig:
        """Return the checked configuration. Raises ValueError or CredentialsError with a message of one line."""
        if self.environments is not None and not 1 <= self.environments <= 4096:
            raise ValueError(f"--envs is {self.environments}: choose a number from 1 to 4096")
        if self.run != keys.ANY_RUN:
            keys.check_name(self.run, "run")
        name = self.name or own_name(credentials.name if credentials else "")
        if credentials and credentials.name not in (name, name.partition(".")[0]):
            raise ValueError(
                f"the certificate in {credentials.directory} is not for {name!r}: "
                f"use --name {credentials.name} or {credentials.name}.ANYTHING"
            )
        return ActorConfig(
            name=keys.check_name(name, "actor name"),
            incarnation=secrets.randbits(62),
            run=run_for(credentials, self.run),
            environments=self.environments,
            runtime=self.runtime,
            inference=self.inference_at,
            modules=UserModules(self.allowed_modules, "the learner"),
            # Between processes of one machine, only a busy processor is slow.
            link="lan" if self.link == "auto" and all(map(socket_path, self.connect)) else self.link,
            timeout=self.timeout,
            any_run=self.any_run,
        )

    def seatings(self, credentials: Credentials | None) -> list[Seating]:
        """Return the seats of each run, checked. Raises ValueError or CredentialsError with a message of one line."""
        if self.seats and (self.evaluator or self.any_run or self.run != keys.ANY_RUN):
            raise ValueError("--seat names the runs: leave out --run, --any-run and --evaluator")
        names: dict[str, list[str]] = {}
        for name, run in self.seats:
            names.setdefault(run, []).append(name)
        seatings = [_seating(run, tuple(own), credentials) for run, own in names.items()]
        if len({each.run for each in seatings}) < len(seatings):
            raise ValueError("--seat names two run directories of one name, or a run and its directory: choose one")
        if seatings and all(each.policy is not None for each in seatings):
            raise ValueError("--seat names run directories only, from which nobody learns: name a run with a learner")
        return seatings


def _seating(run: str, names: tuple[str, ...], credentials: Credentials | None) -> Seating:
    path = Path(run)
    if path.name != run:  # a path: no run has a separator in its name
        return Seating(names=names, run=keys.as_name(path.resolve().name), policy=path)
    return Seating(names=names, run=run_for(credentials, keys.check_name(run, "run")))


class LeaveRequest:
    """Request to this process to leave, because its host is about to end. Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._by: float | None = None  # on the monotonic clock; None: there was no request
        self._role: Evaluator | ActorService | RoleActor | None = None  # that takes part in a run
        self._timer: threading.Timer | None = None

    @property
    def is_asked(self) -> bool:
        """Whether there was a request."""
        return self._by is not None

    def ask(self, stop: threading.Event) -> None:
        """Let the process finish its rollout and upload it, for 30 s at most. It ends at once if it has none.

        `stop` ends the process in any case.
        """
        with self._lock:
            if self._by is not None:
                return
            self._by = time.monotonic() + _LEAVE_SECONDS
            _logger.info("asked by a signal to leave: the present rollout has %.0f s", _LEAVE_SECONDS)
            if self._role is None:
                stop.set()
                return
            self._role.leave(self._by)
            self._timer = threading.Timer(_LEAVE_SECONDS + _LATE_SECONDS, stop.set)
            self._timer.daemon = True
            self._timer.start()

    @contextmanager
    def reaching(self, role: Evaluator | ActorService | RoleActor) -> Iterator[None]:
        """Let requests reach what takes part in a run."""
        with self._lock:
            self._role = role
            if self._by is not None:  # while it connected
                role.leave(self._by)
        try:
            yield
        finally:
            with self._lock:
                self._role = None
                if self._timer is not None:
                    self._timer.cancel()


def run_actor(options: ActorOptions, stop: threading.Event, context: dict[str, str], leave: LeaveRequest) -> int:
    """Run an actor, report why it fails, and return the exit status.

    Args:
      options: what the process was started with.
      stop: ends the actor.
      context: receives the fields of the log.
      leave: ends the actor after its rollout.
    """
    retries = Retries(stop)
    while True:
        try:
            credentials = credentials_to_connect(options.connect, options.tls, "actor")
            actor = _Actor(options, credentials, stop)
            break
        except (ValueError, *SECURITY_ERRORS) as error:
            if not (options.stay and isinstance(error, NotValidNowError)):
                print_error("actor", error)
                return status_at_start(error)
            if retries.wait(str(error)):
                return 0
    context["actor"] = actor.name

    def note(welcome: Welcome) -> None:
        context.update(run=welcome.run, epoch=f"{welcome.learner_epoch:x}")

    while True:
        try:
            finished = actor.take_part(leave, note)
        except Exception as error:  # broad: see _is_of_others
            if not options.stay or not _is_of_others(error):
                if not isinstance(error, _REPORTED):
                    raise
                print_error("actor", error)
                return FAILED
            if not isinstance(error, _REPORTED):
                _logger.exception("a module of the run has failed")
            stopped = leave.is_asked or retries.wait(str(error) or type(error).__name__)
        else:
            if leave.is_asked or not (finished and options.stay):
                return 0
            retries.succeeded()
            _logger.info("waiting for the next run")
            stopped = stop.wait(_NEXT_RUN_SECONDS)
        if stopped:
            return 0


def _is_of_others(error: Exception) -> bool:
    """Return whether somebody else can remove the cause of an error, such as who started a run or renews certificates.

    Not the end of the time that the user of this actor set, and no fault of ours. A module of the run may raise
    anything.
    """
    if isinstance(error, (NoLearnerError, UnreachableError)):
        return False
    of_users = (frame for frame in frames_of(error) if is_of_user(frame))
    return isinstance(error, _REPORTED) or any(
        frame.tb_frame.f_globals.get("__name__") != "__main__" for frame in of_users
    )


class _Actor:
    """One actor. It takes part in a run at a time, or in those of its seats, each time as another incarnation."""

    def __init__(self, options: ActorOptions, credentials: Credentials | None, stop: threading.Event) -> None:
        """Raises ValueError or CredentialsError with a message of one line."""
        self._options, self._credentials, self._stop = options, credentials, stop
        self._config, self._seatings = options.config(credentials), options.seatings(credentials)

    @property
    def name(self) -> str:
        """Name of the actor."""
        return self._config.name

    def take_part(self, leave: LeaveRequest, on_join: Callable[[Welcome], None]) -> bool:
        """Take part until the run is over, or `stop` is set; return whether it finished. Raises what `main` reports."""
        config = replace(self._config, incarnation=secrets.randbits(62), searched_since=time.monotonic())
        with ExitStack() as stack:

            def connect() -> Transport:
                transport = connect_with_retry(self._options.connect, self._stop, config.timeout, self._credentials)
                if transport is None:
                    raise _StoppedError
                return stack.enter_context(closing(transport))

            try:
                if self._seatings:
                    role = RoleActor(config, self._seatings, connect, self._stop)
                else:
                    kind = Evaluator if self._options.evaluator else ActorService
                    role = kind(config, connect(), self._stop, on_join=on_join)
            except _StoppedError:
                return False
            with leave.reaching(role):
                return role.run()


class _StoppedError(Exception):
    """The actor was stopped before it was connected."""


_POLL_SECONDS = 0.1
_LEAVE = getattr(signal, "SIGUSR1", None)  # Windows has none


class ActorGroup:
    """Actors that share a command line, and the process of their policy. An actor that has ended its work stays gone.

    An actor that fails is started again, unless it fails too often: the others then go on without it. `leave` lets all
    of them finish their rollouts.
    """

    def __init__(self, words: Sequence[str], names: Sequence[str], inference: Inference, logs: LogOptions) -> None:
        """Start no process yet.

        Args:
          words: the command line of each actor, without its name.
          names: of the actors.
          inference: where their policies run.
          logs: how the inference process logs.
        """
        self._words, self._names, self._logs = words, names, logs
        self._inference: Inference = inference
        self._actors: list[Supervised] = []
        self._leave = threading.Event()
        self._leaving = False  # whether each actor has been told to leave

    def leave(self, _stop: threading.Event) -> None:
        """Let the actors finish and upload their rollouts, and end; from any thread."""
        self._leave.set()

    def run(self, stopping: threading.Event) -> int:
        """Run the actors until all have ended, or until `stopping`; return the largest of their exit statuses."""
        inference: list[Supervised] = []
        statuses = [0]
        with socket_folder() as folder:
            try:
                inference, shared = supervised_inference(self._inference, folder, self._logs.words())
                for name in self._names:
                    begin = partial(self._begin, name, shared)
                    self._actors.append(Supervised(name, begin, ended={0}, no_fault={}))
                while self._actors and not stopping.wait(_POLL_SECONDS):
                    if self._leave.is_set() and not self._leaving:
                        self._tell_to_leave()
                    for actor in list(self._actors):
                        if (status := self._ended(actor)) is not None:
                            self._actors.remove(actor)
                            statuses.append(status)
                    for each in inference:
                        _check(each)
            except FailedError as error:
                print_error("actor", error)
                statuses.append(FAILED)
            finally:
                stop([actor.process for actor in self._actors], [each.process for each in inference])
        return max(statuses)

    def _tell_to_leave(self) -> None:
        self._leaving = True
        for actor in self._actors:
            if _LEAVE is not None and actor.process.poll() is None:
                os.kill(actor.process.pid, _LEAVE)  # which kills one that has just begun to start

    def _ended(self, actor: Supervised) -> int | None:
        """Return the exit status of an actor that stays gone. Else restart it if it has died, and return None."""
        status = actor.process.poll()
        if status is not None and (status == 0 or self._leaving or actor.failed_at_once):
            return status  # it has said why
        try:
            _check(actor)
        except FailedError as error:
            print_error("actor", error)
            return FAILED
        return None

    def _begin(self, name: str, shared: Sequence[str], _first: bool) -> Child:
        words = [*self._words, "--actors", "1", "--inference", "local", "--name", name, *shared]
        with inherited(name) as streams:
            return start("daedalus.cli.commands.actor", *words, streams=streams, one_thread=True)


def _check(process: Supervised) -> None:
    if message := process.check():
        _logger.warning("%s", message)
