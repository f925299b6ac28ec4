"""The process of `daedalus learner`: construct one learner and run it.

Exit status: 0 the target was reached, all steps were done without a target to stop at, or a signal stopped the learner
and its checkpoint is saved; 3 the budget was used up before the target; 1 failed, or the last checkpoint could not be
saved; 2 bad usage; 7 a newer learner of the run has taken over. Under `daedalus train` a learner that a signal stopped
exits with STOPPED, and one that an operator stopped with ORDERED (process_lifecycle.py). A supervised learner whose
last checkpoint could not be saved exits with UNSAVED.
"""

import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.launch.child_output import ChildOutput
from daedalus.launch.environment_check import expected_defaults, expected_spaces
from daedalus.launch.local_run import helper_log_words
from daedalus.launch.logs import LogOptions, print_error
from daedalus.launch.process_lifecycle import (
    BAD_USAGE,
    FAILED,
    NOT_REACHED,
    ORDERED,
    REACHED,
    STOPPED,
    SUPERSEDED,
    UNSAVED,
)
from daedalus.launch.resumed_run import status_of
from daedalus.launch.run_choice import NewRun, check_learner_installed, warn_of_unread, with_record
from daedalus.launch.supervision import evaluators
from daedalus.launch.tracker_processes import TrackerProcesses
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.progress import Progress, SilentProgress
from daedalus.learner.reporting.recorder import OpenWriter
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.reporting.trackers.tracking import chosen_trackers
from daedalus.learner.reporting.user_metrics import RowsWriter, UserMetrics
from daedalus.learner.run import run_directory
from daedalus.learner.run.heartbeat import Heartbeat
from daedalus.learner.run.resuming import (
    Beginning,
    CheckpointMismatchError,
    allows_other_spaces,
    differing,
    finished_run,
    fixed_changes,
    initial_to_resume,
)
from daedalus.learner.run.run_lock import RunInUseError, RunLock
from daedalus.learner.run.settings import DeviceError, SettingsError
from daedalus.learner.service import LearnerService, Outcome, Outputs
from daedalus.learner.serving.rollout_intake import largest_request
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.target_confirmation import Player
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_code import shown_path
from daedalus.policy.user_modules import NetworkError, UserModules, allow_settings, allow_words, modules_of
from daedalus.protocol.algorithms import AlgorithmError
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.addresses import reachable
from daedalus.transport.connecting import connect_with_retry, listen
from daedalus.transport.credentials import (
    Credentials,
    CredentialsError,
    certificate_days_left,
    credentials_to_connect,
    credentials_to_listen,
    run_for,
)
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.private_address import private_address

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint

_logger = logging.getLogger(__name__)

LISTEN = "tcp/127.0.0.1:7447"

_PLAYER = "confirmation"  # name of the process that plays the new episodes

_FAILURES = (
    AlgorithmError,
    CheckpointMismatchError,
    CredentialsError,
    DamagedError,
    NetworkError,
    NoPolicyError,
    SettingsError,
    TransportError,
)
# The same command may succeed later.
_PASSING = (CredentialsError, DamagedError, DeviceError, RunInUseError, TransportError)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnerNetwork:
    """Where a learner listens, or the router that it connects to."""

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    tls: Path | None = None
    insecure: bool = False

    @property
    def addresses(self) -> list[str]:
        """Addresses that actors connect to."""
        return list(self.connect or self.listen or [LISTEN])

    def credentials(self) -> Credentials | None:
        """Return the credentials for the addresses, or None without TLS. Raises SECURITY_ERRORS."""
        if self.connect:
            return credentials_to_connect(self.addresses, self.tls, "learner")
        return credentials_to_listen(self.addresses, self.tls, "learner", insecure=self.insecure)

    def open(self, spec: RunSpec, credentials: Credentials | None, stop: threading.Event) -> Transport | None:
        """Connect to a router or listen for actors; return None if stopped before a router answered.

        Raises TransportError or CredentialsError.
        """
        limit = largest_request(spec)
        if self.connect:
            return connect_with_retry(self.addresses, stop, credentials=credentials, max_message_bytes=limit)
        return listen(self.addresses, credentials=credentials, max_message_bytes=limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnerOptions:
    """What a learner process was started with."""

    new: NewRun  # the run, unless it exists
    here: Path  # the working directory at the start
    resume: bool = False  # continue the run in its directory, or start it there
    reset_statistics: bool = False  # of the checkpoint to resume from
    allowed_modules: frozenset[str] = frozenset()
    network: LearnerNetwork = field(default_factory=LearnerNetwork)
    log: LogOptions = field(default_factory=LogOptions)
    trackers: Sequence[str] = ()
    shows_progress: bool = True
    started: float  # on the monotonic clock
    # From the program that has created the run directory and starts actors, trackers and evaluations itself:
    prepared: Path | None = None  # the run directory
    spaces: Spaces | None = None
    player_at: str | None = None  # address where an evaluator waits to confirm the target
    rows_to: int | None = None  # pipe for each row of metrics
    supervised: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenRun:
    """Run of a learner, as its options define it."""

    spec: RunSpec
    directory: Path
    exists: bool  # whether the run directory was created before
    changed: list[str]  # settings of a run that exists, which the options change
    modules: UserModules  # that the learner may import


def choose_run(options: LearnerOptions) -> ChosenRun:
    """Return the run that the options define.

    Modules that the command line itself names are allowed; those that only an existing config.toml names need
    --allow-module. Raises SettingsError or UserModuleError.
    """
    check_learner_installed()
    if options.reset_statistics and not options.resume:
        raise SettingsError("--reset-statistics needs --resume: a new run has no statistics")
    new = options.new
    directory = options.prepared or (_directory_to_resume(new.directory) if options.resume else None)
    if directory is None:
        spec = new.choice.spec()
        directory = new.directory or new.choice.directory(spec)
        run_directory.check_free(directory, "daedalus learner --resume --run-dir")
        changed = []
    else:
        before = run_directory.read_config(directory)
        spec = _resumed_spec(before, new, directory)
        changed = differing(before, spec)
    own = modules_of(spec.user_modules) if new.choice.is_named else []
    modules = UserModules(frozenset({*options.allowed_modules, *own}), str(directory / run_directory.CONFIG))
    modules.check(spec.learner_modules)  # the learner makes no environment
    spec = with_record(spec, modules)
    if options.prepared is None:  # else the program that prepared the run has said it
        has_demonstrations = new.demonstrations is not None or (
            directory is not None and (directory / run_directory.DEMONSTRATIONS).is_dir()
        )
        warn_of_unread(new.choice.names(), spec, demonstrations=has_demonstrations)
    exists = (directory / run_directory.CONFIG).exists()
    return ChosenRun(spec=spec, directory=options.here / directory, exists=exists, changed=changed, modules=modules)


def _resumed_spec(before: RunSpec, new: NewRun, directory: Path) -> RunSpec:
    """Return the specification of the run in `directory` with the settings that the options change.

    A preset must be that of the run. Raises SettingsError.
    """
    changes = replace(new.choice, preset=str(directory / run_directory.CONFIG), env=None)
    # The settings that --env begins with depend on the environment, which need not be made for this.
    chosen = new.choice if new.choice.is_named else changes
    spec = chosen.spec(before.model_dump(mode="json", exclude_none=True))
    if spec.environment.package is None:  # then the run has the one that was installed when it began
        environment = spec.environment.model_copy(update={"package": before.environment.package})
        spec = spec.model_copy(update={"environment": environment})
    other = fixed_changes(before, spec) or differing(changes.spec(), spec)
    if other:
        raise SettingsError(
            f"the run in {directory} has other settings ({', '.join(other)}): leave out PRESET, --env and all settings "
            "to continue it, or name another --run-dir"
        )
    return spec


def _directory_to_resume(directory: Path | None) -> Path | None:
    """Return the directory of a run that exists, or None if the run has to be started. Raises SettingsError."""
    if directory is None:
        raise SettingsError("--resume needs --run-dir DIR: name the directory of the run to start or to continue")
    return directory if (directory / run_directory.CONFIG).exists() else None


class LearnerProcess:
    """One learner in this process."""

    def __init__(self, options: LearnerOptions, stop: threading.Event, user_metrics: UserMetrics) -> None:
        """Choose the run. Raises SettingsError, UserModuleError or SECURITY_ERRORS.

        Args:
          options: what the process was started with.
          stop: ends the run.
          user_metrics: metrics of the program that started the run.
        """
        self._options, self._stop, self._user_metrics = options, stop, user_metrics
        self._credentials = options.network.credentials()
        self._run = choose_run(options)
        run_for(self._credentials, run_directory.run_name(self._run.directory))
        display = Progress if options.shows_progress else SilentProgress
        training = self._run.spec.training
        self._progress = display(sys.stdout, training.env_steps, training.updates_per_batch)
        self._context = {"run": run_directory.run_name(self._run.directory)}  # fields of the log
        self._actor_decides = False  # of which spaces the run is: another one may fit the settings

    def run(self) -> int:
        """Run the learner to its end and return the exit status."""
        process = "" if self._options.prepared else "learner"  # the launcher shows the lines to a person
        self._options.log.configure(process=process, context=self._context, write=self._progress.say)
        try:
            with ExitStack() as stack:
                return self._serve(self._run, stack)
        except _FAILURES as error:
            print_error("learner", error)
            return FAILED if self._actor_decides or isinstance(error, _PASSING) else BAD_USAGE

    def _serve(self, run: ChosenRun, stack: ExitStack) -> int:
        """Run the learner to its end and return the exit status; `stack` closes what is opened.

        Raises _FAILURES.
        """
        options = self._options
        if run.exists and options.prepared is None:  # the launcher of a prepared run has locked it
            stack.enter_context(RunLock(run.directory))
        if run.exists:
            stack.push(partial(_restore_config, run.directory))
        if options.new.directory is not None:
            stack.enter_context(run_directory.made(run.directory))  # before a router is waited for, for status --alive
        Heartbeat(run.directory).clear()
        resumed = options.resume and run.exists
        if resumed and (reason := run_directory.why_superseded(run.directory)):
            print_error("learner", reason)
            return SUPERSEDED
        finished = finished_run(run.directory, run.spec) if resumed else None
        if finished is not None:
            _logger.info("nothing to do: %s", finished.reason)
            return status_of(finished)
        if resumed and options.new.demonstrations is not None:
            _logger.info("the demonstrations are those that the run began with, if it has any")
        restored = _newest_checkpoint(run.directory) if resumed else None
        if run.changed:  # only now: a run that cannot go on stays as it was
            _logger.info("settings of the run changed: %s", ", ".join(run.changed))
            run_directory.change_config(run.directory, run.spec)
        spaces = options.spaces
        if restored is None and options.prepared is None:
            run, spaces = self._with_spaces(run)
            self._progress.updates_per_batch = run.spec.training.updates_per_batch
            self._actor_decides = spaces is None
        weights = options.new.init_from or (initial_to_resume(run.directory) if resumed else None)
        initial = find_policy(weights) if weights is not None and restored is None else None
        transport = options.network.open(run.spec, self._credentials, self._stop)
        stopped = STOPPED if options.prepared else 0
        if transport is None:  # stopped while no router answered
            return stopped
        stack.callback(transport.close)
        run = run if run.exists else self._with_directory(run, spaces, stack)
        try:
            say = self._progress.say
            # The launcher of a prepared run writes output.log itself: a file has one writer.
            log = run_directory.CONFIRMATION_OUTPUT if options.prepared else run_directory.OUTPUT
            output = stack.enter_context(ChildOutput(run.directory / log, say, say))
            service = self._service(run, transport, restored, initial, spaces, output)
            self._announce(run)
            if options.prepared is None:  # else the launcher starts them
                self._start_trackers(run.directory, output, stack)
            outcome = service.run()
            if outcome.superseded_by is not None:
                _note_superseded(run.directory, outcome.superseded_by)
        except _FAILURES:
            if not run.exists:
                run_directory.remove_failed(run.directory)
            raise
        return _status(outcome, run.spec, stopped, UNSAVED if options.supervised else FAILED)

    def _with_directory(self, run: ChosenRun, spaces: Spaces | None, stack: ExitStack) -> ChosenRun:
        """Create the directory of a new run, and return the run in it; `stack` unlocks it."""
        lock, spec = self._options.new.create(run.spec, run.directory, spaces)
        stack.enter_context(lock)
        self._context["run"] = run_directory.run_name(lock.directory)
        return replace(run, spec=spec, directory=lock.directory)

    def _service(
        self,
        run: ChosenRun,
        transport: Transport,
        restored: "Checkpoint | None",
        initial: SavedPolicy | None,
        spaces: Spaces | None,
        output: ChildOutput,
    ) -> LearnerService:
        options = self._options
        context = RunContext.begin(
            run.directory, run.spec, self._stop, started=options.started, spaces=spaces, restored=restored
        )
        context.health.certificate_days_left = partial(certificate_days_left, self._credentials)
        beginning = Beginning(
            restored=restored,
            initial=initial,
            allows_other_spaces=options.new.other_spaces or allows_other_spaces(run.directory),
            reset_statistics=options.reset_statistics,
            modules=run.modules,
        )
        writers = _writers(run.directory, options.rows_to)
        outputs = Outputs(progress=self._progress, writers=writers, user_metrics=self._user_metrics)
        self._context["epoch"] = f"{context.learner_epoch:x}"
        return LearnerService(context, transport, outputs, beginning, open_player=partial(self._player, run, output))

    def _with_spaces(self, run: ChosenRun) -> tuple[ChosenRun, Spaces | None]:
        """Return the run with the default settings of its spaces, and the spaces; None if they are not known here."""
        choice = self._options.new.choice
        if choice.env is None or run.exists:
            return run, expected_spaces(run.spec, run.modules, self._stop, is_new=not run.exists)
        spaces, defaults = expected_defaults(choice.spec, run.modules, self._stop)
        chosen = choice.spec(defaults)
        directory = (
            run.directory if self._options.new.directory else run.directory.with_name(choice.directory(chosen).name)
        )
        chosen = with_record(chosen, run.modules)
        if spaces is not None and chosen.environment != run.spec.environment:
            spaces = expected_spaces(chosen, run.modules, self._stop)
        return replace(run, spec=chosen, directory=directory), spaces

    def _announce(self, run: ChosenRun) -> None:
        """Log how actors join."""
        if self._options.prepared is not None:
            return
        spec = run.spec
        _logger.info(
            "run %s: learning %s with %s", shown_path(str(run.directory)), spec.environment.id, spec.training.algorithm
        )
        join = how_to_join(self._options.network.addresses, self._credentials, spec)
        _logger.info("actors join with: %s", join)
        if spec.environment.package is not None:
            _logger.info("the environment is of the package %s, which actors need", spec.environment.package)

    def _start_trackers(self, directory: Path, output: ChildOutput, stack: ExitStack) -> None:
        """Start the chosen trackers and those that have logged the run before; `stack` ends them."""
        names = chosen_trackers(self._options.trackers, directory)
        if names:
            trackers = TrackerProcesses(names, directory, output, service=True, log_json=self._options.log.as_json)
            stack.callback(trackers.finish, self._stop)
            trackers.start()

    @contextmanager
    def _player(self, run: ChosenRun, output: ChildOutput) -> Iterator[Player]:
        """Yield an evaluator of this host, for the new episodes that confirm the target. Raises TransportError."""
        if self._options.player_at is not None:  # whoever started this learner has started it, too
            with closing(listen([self._options.player_at])) as transport:
                yield Player(transport, lambda: "")
            return
        needed = modules_of(run.spec.environment.user_modules)
        allowed = allow_words(module for module in needed if module in run.modules.allowed)
        options = *helper_log_words(self._options.log), *allowed
        with (
            private_address() as address,
            closing(listen([address])) as transport,
            evaluators(address, [_PLAYER], options, output) as failure,
        ):
            yield Player(transport, failure)


def how_to_join(listening: list[str], credentials: Credentials | None, spec: RunSpec) -> str:
    """Return the command of an actor, with the other addresses that it may use."""
    address, *others = reachable(listening, credentials.hosts() if credentials else ())
    tls = ["--tls", "DIR"] if credentials else []
    command = ["daedalus actor --connect", address, *tls, *allow_settings(spec.actor_modules)]
    return " ".join([*command, *([f"(or at {', '.join(others)})"] if others else [])])


def _writers(directory: Path, rows_to: int | None) -> list[OpenWriter]:
    """Return the metrics writers; `rows_to` is a pipe to the program that started the run."""
    writers: list[OpenWriter] = [
        lambda: CsvWriter(directory / run_directory.METRICS),
        lambda: TensorBoardWriter(directory),
    ]
    return writers if rows_to is None else [lambda: RowsWriter(rows_to), *writers]


def _newest_checkpoint(directory: Path) -> "Checkpoint | None":
    """Return the newest undamaged checkpoint, or None if there is none yet. Raises DamagedError if all are damaged."""
    if not checkpoints(directory):
        _logger.info("no checkpoint found: the run starts from the beginning")
        return None
    from daedalus.learner.training.checkpoint import load_newest

    restored = load_newest(directory)
    steps = f"{restored.counters['env_steps']:,}"
    _logger.info("resuming from checkpoint %d at %s env_steps", restored.policy.policy_version, steps)
    return restored


def _note_superseded(directory: Path, learner_epoch: int) -> None:
    try:
        run_directory.note_superseded(directory, learner_epoch)
    except OSError as error:
        _logger.error("%s cannot be written, so do not start this learner again: %s", directory, error.strerror)


def _restore_config(directory: Path, kind: type[BaseException] | None, *_: object) -> None:
    """Take changed settings back, if they have ended the learner before it began."""
    if kind is not None and issubclass(kind, _FAILURES) and run_directory.restore_config(directory):
        _logger.info("%s has the settings from before again: the run did not begin with others", run_directory.CONFIG)


def _status(outcome: Outcome, spec: RunSpec, stopped: int, unsaved: int) -> int:
    """Return the exit status for the end of a run.

    `stopped` is that of a run that was stopped, and `unsaved` that of a run whose last checkpoint could not be saved.
    """
    if outcome.superseded_by is not None:
        return SUPERSEDED
    if not outcome.saved:
        return unsaved
    if not outcome.finished:
        return ORDERED if outcome.stopped_by and stopped else stopped
    wanted = bool(spec.target) and spec.training.stop_when_solved
    return NOT_REACHED if wanted and not outcome.solved else REACHED
