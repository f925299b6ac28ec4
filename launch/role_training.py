"""Training of several runs that share games, on this machine: a learner for each role, a router, shared actors."""

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

from daedalus.actor.environments.roles import seat_names
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.local_run import (
    LocalRun,
    RunFailedError,
    RunStoppedError,
    UnsavedError,
    actor_arguments,
    helper_log_words,
)
from daedalus.launch.local_training import EVALUATOR, stopped_by, supervised_learner
from daedalus.launch.process_lifecycle import FINISHED, ORDERED, UNSAVED
from daedalus.launch.supervision import (
    LEARNER_GRACE_SECONDS,
    Child,
    FailedError,
    Supervised,
    ask_to_end,
    start,
    stop,
    supervised_actor,
)
from daedalus.launch.tracker_processes import TrackerProcesses
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.events import EventFile
from daedalus.learner.serving.rollout_intake import largest_request
from daedalus.protocol.spec import RunSpec
from daedalus.transport.private_address import private_address

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class RoleRun:
    """The run of one role."""

    role: str
    seats: tuple[str, ...]  # its names for --seat
    run: LocalRun
    output: ChildOutput  # of its learner and evaluations

    @property
    def name(self) -> str:
        """The name of the run."""
        return run_directory.run_name(self.run.directory)


def seats_of(specs: Mapping[str, RunSpec]) -> dict[str, tuple[str, ...]]:
    """Return the names for --seat of each role."""
    possible = [agent for spec in specs.values() for agent in spec.environment.agents]
    return {role: seat_names(spec.environment.agents, possible) for role, spec in specs.items()}


def check_roles(specs: Mapping[str, RunSpec]) -> None:
    """Raise SettingsError if learners with these settings cannot share actors."""
    synchronous = [role for role, spec in specs.items() if spec.algorithm.synchronous]
    if len(synchronous) > 1:
        raise SettingsError(
            f"the learners of {' and '.join(synchronous)} would both wait for all actors, and so for each other: "
            f"choose another algorithm for one of them, as in --set-role {synchronous[0]} training.algorithm=impala"
        )


def shared_settings(specs: Mapping[str, RunSpec]) -> Iterator[str]:
    """Yield a message for each setting of the actors, which all roles share, that roles set differently."""
    for name in ("actors", "envs_per_actor"):
        values = {role: getattr(spec.collection, name) for role, spec in specs.items()}
        if len({*values.values()}) > 1:
            each = ", ".join(f"{role} {value}" for role, value in values.items())
            yield f"collection.{name} differs between the roles ({each}), which share actors: the largest one applies"


class RoleTraining:
    """A learner for each role, and actors that take part in all runs, as supervised processes."""

    def __init__(
        self, roles: Sequence[RoleRun], over: Sequence[RoleRun], output: ChildOutput, listen: str | None
    ) -> None:
        """Start no process yet.

        Args:
          roles: the runs to train.
          over: further runs, whose newest policies play without learning.
          output: reads what the actors write.
          listen: address where more actors may join.
        """
        self._roles, self._over, self._output, self._listen = roles, list(over), output, listen
        self._learning = {role.role: role for role in roles}
        self._learners: dict[str, Supervised] = {}  # of those that learn, by role
        self._players: list[Supervised] = []  # actors and evaluators
        self._evaluators: dict[str, Supervised] = {}  # of those that learn, by role
        self._routers: list[Supervised] = []
        self._trackers: list[TrackerProcesses] = []
        self._actor_options: list[str] = []  # a restarted actor has those of the moment

    def run(self, stopping: threading.Event) -> dict[str, int]:
        """Train until all runs are over or `stopping` is set; return the exit status of each learner, by role.

        No child process is left when this returns or raises. Raises RunFailedError, RunStoppedError.
        """
        try:
            with private_address() as address:
                try:
                    self._start(address)
                    return self._watch(stopping)
                finally:
                    self._stop(stopping)
        except FailedError as error:
            if stopping.is_set():
                raise RunStoppedError from None
            raise RunFailedError(str(error)) from None

    def _start(self, address: str) -> None:
        self._routers.append(self._router([address, *filter(None, [self._listen])]))
        for role in self._roles:
            self._learners[role.role] = supervised_learner(role.run, address, role.output.unlimited_pipes, joins=True)
        self._choose_seats()
        for message in shared_settings({role.role: role.run.spec for role in self._roles}):
            _logger.info("%s", message)
        output, specs = self._output, [role.run.spec for role in self._roles]
        for index in range(max(spec.collection.actors for spec in specs)):
            name = f"actor-{index}"
            self._players.append(supervised_actor(name, address, self._actor_options, output.pipes, output.last_error))
        _logger.info(
            "%s: %d actors at %s; a learner for each role: %s",
            specs[0].environment.id,
            len(self._players),
            self._listen or address,
            ", ".join(
                f"{role.role} ({role.run.spec.training.algorithm}, {role.run.directory})" for role in self._roles
            ),
        )
        for role in self._roles:
            if role.run.spec.evaluation.seconds is not None:
                options, output = (*actor_arguments(role.run), "--evaluator", "--run", role.name), role.output
                evaluator = supervised_actor(EVALUATOR, address, options, output.pipes, output.last_error)
                self._evaluators[role.role] = evaluator
                self._players.append(evaluator)
            trackers = TrackerProcesses(role.run.log, role.run.directory, role.output, log_json=role.run.logs.as_json)
            self._trackers.append(trackers)
            trackers.start()

    def _router(self, addresses: Sequence[str]) -> Supervised:
        """Start the router: the end of a learner must not cut off the others."""
        run = self._roles[0].run
        largest = max(largest_request(role.run.spec) for role in self._roles) / 2**20
        options = [word for each in addresses for word in ("--listen", each)]
        options += ["--max-message-megabytes", repr(min(max(largest, 64.0), 1024.0)), *helper_log_words(run.logs)]
        options += ["--insecure"] if run.insecure else []

        def begin(_first: bool) -> Child:
            with self._output.pipes("router") as streams:
                return start("daedalus.cli.commands.router", *options, streams=streams)

        return Supervised("the router", begin, ended=frozenset(), no_fault={})

    def _choose_seats(self) -> None:
        """Let actors join the runs that are not over; of the others their newest policies play."""
        specs = [role.run.spec for role in (*self._roles, *self._over)]
        copies = max(spec.collection.envs_per_actor for spec in specs)
        words = [*actor_arguments(self._roles[0].run), "--envs", str(copies)]
        for role in (*self._learning.values(), *self._over):
            run = role.name if role.role in self._learning else str(role.run.directory.resolve())
            words += [word for name in role.seats for word in ("--seat", f"{name}={run}")]
        self._actor_options[:] = words

    def _watch(self, stopping: threading.Event) -> dict[str, int]:
        records = {role.role: EventFile(role.run.directory) for role in self._roles}
        statuses: dict[str, int] = {}

        def note(message: str | None, *roles: str) -> None:
            if message:
                _logger.warning("%s", message)
                for role in roles or records:
                    records[role].add_restart(message)

        while not stopping.wait(_POLL_SECONDS):
            for name, role in list(self._learning.items()):
                learner = self._learners[name]
                status = learner.process.poll()
                if status in FINISHED:
                    statuses[name] = status
                    self._end(role)
                elif status is not None and (status in learner.ended or learner.failed_at_once):
                    self._raise(role, status)
                elif message := learner.check():
                    note(f"{name}: {message}", name)
            if not self._learning:
                return statuses
            for router in self._routers:
                note(router.check())
            for player in list(self._players):
                owners = [name for name, evaluator in self._evaluators.items() if evaluator is player]
                try:
                    note(player.check(), *owners)
                except FailedError as error:
                    self._players.remove(player)
                    stop([player.process])
                    if all(each.name == EVALUATOR for each in self._players):
                        raise FailedError("all actors", error.reason, "failed") from None
                    note(f"{error}; training continues without this process", *owners)
        raise RunStoppedError

    def _end(self, role: RoleRun) -> None:
        """Note that the run of a role is over: its last policy plays on while others learn."""
        del self._learning[role.role]
        self._over.append(role)
        evaluator = self._evaluators.pop(role.role, None)
        if evaluator is not None:
            stop([evaluator.process])
            self._players = [player for player in self._players if player is not evaluator]
        if self._learning:
            self._choose_seats()
            _logger.info(
                "%s: the run is over; its last policy goes on playing while %s learns",
                role.role,
                " and ".join(self._learning),
            )

    def _raise(self, role: RoleRun, status: int) -> NoReturn:
        if status == ORDERED:
            raise RunStoppedError(stopped_by(role.run))
        if status == UNSAVED:
            raise UnsavedError(f"the last checkpoint of {role.role} could not be saved: make room on the disk")
        raise RunFailedError(status=status)  # it has printed the reason

    def _stop(self, stopping: threading.Event) -> None:
        learners = [each.process for each in self._learners.values()]
        for learner in learners:
            ask_to_end(learner)
        stop([each.process for each in self._players])
        stop(learners, grace_seconds=LEARNER_GRACE_SECONDS)
        stop([each.process for each in self._routers])
        for each in self._trackers:
            each.finish(stopping)
