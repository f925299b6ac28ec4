"""The settings of one run on this machine, the command lines of its processes, who observes it, and how it ends."""

import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from daedalus.launch.logs import LogOptions
from daedalus.launch.supervision import Child, Inference, StartPlayer, start
from daedalus.learner.run import run_directory
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec


class RunObserver:
    """Observer of the training of a run. This one does nothing."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """File descriptors that the learner inherits."""
        return ()

    @property
    def learner_options(self) -> list[str]:
        """Options of the learner."""
        return []

    def begin(self, address: str) -> None:
        """Called before the processes start. `address` is where the learner will answer."""

    def end(self) -> None:
        """Called after they have ended, in any way."""

    def poll(self, learner: Child) -> bool:
        """Do what is due, and return whether training has to end. Called many times a second."""
        return False


class RunFailedError(Exception):
    """Error of a run that did not finish. The message is empty if a child process has printed the reason."""

    def __init__(self, message: str = "", status: int = 1) -> None:
        super().__init__(message)
        self.status = status  # exit status for the command


class UnsavedError(RunFailedError):
    """Error of a run whose result could not be saved. The run can be resumed."""


class RunStoppedError(Exception):
    """Error of a run that was stopped before its end; the message says which operator stopped it, if one did."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalRun:
    """Settings of one run on this machine. Its directory and config.toml exist already.

    The processes import the modules that the specification names: the caller has checked that the user allows them.
    """

    directory: Path
    spec: RunSpec
    started: float  # on the monotonic clock; the seconds of the run count from this time
    lock: tuple[int, ...] = ()  # descriptor of the run's lock, which the learner inherits and holds as long as it lives
    resume: bool = False
    reset_statistics: bool = False  # of the checkpoint to resume from
    trained: int | None = None  # exit status of a run that is already trained and that only lacks its evaluation
    spaces: Spaces | None = None  # of the environment, if it was checked
    init_from: Path | None = None  # another run, whose weights the learner begins with
    inference: Inference = "local"  # where the policies of the actors run
    listen: str | None = None  # address for actors of other hosts, in addition to a private one of this machine
    tls: Path | None = None
    insecure: bool = False
    logs: LogOptions = field(default_factory=LogOptions)  # of the learner and the evaluation; others log warnings
    watch: bool = False  # start a gateway with the page of the run
    camera: bool = True  # with a camera
    clients: bool = False  # with the page, let clients take part
    keeps_page: bool = False  # keep the page when the run has ended, until the user stops it
    log: Sequence[str] = ()  # trackers that the run is logged to
    observer: RunObserver = field(default_factory=RunObserver)
    start_player: StartPlayer = start  # starts actors, evaluators and evaluations
    player_address: str | None = None  # where an evaluator that this process has started waits for the learner


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnd:
    """End of a run: exit status and summary."""

    status: int  # REACHED or NOT_REACHED
    summary: dict[str, Any]  # summary.json, with the evaluation


def resume_command(run: LocalRun) -> str:
    """Return the command line that continues a run."""
    if run.spec.environment.is_from_python:
        return f"daedalus.resume({str(run.directory)!r}, env=...)  (in Python, with the environment again)"
    return shlex.join(["daedalus", "resume", str(run.directory), *allow_settings(run.spec.user_modules)])


def learner_arguments(run: LocalRun, address: str, *, first: bool, joins: bool) -> list[str]:
    """Return the arguments of the learner, which also listens at an address for the children of this machine.

    Args:
      run: the run.
      address: private address of this machine.
      first: whether this is the first learner. After a crash, the next one resumes from the newest checkpoint.
      joins: connect to a router at that address instead.
    """
    since = run.started if first else time.monotonic()
    addresses = [address, run.listen] if run.listen else [address]
    arguments = ["--prepared", str(run.directory)]
    arguments += ["--connect", address] if joins else [word for each in addresses for word in ("--listen", each)]
    if run.tls:
        arguments += ["--tls", str(run.tls)]
    if run.insecure:
        arguments.append("--insecure")
    arguments += ["--started", repr(since), *run.logs.words(), *run.observer.learner_options]
    arguments += allow_settings(run.spec.user_modules)  # with those of the environment, for the confirmation
    if run.spaces is not None:
        arguments += ["--spaces", run.spaces.model_dump_json()]
    if run.player_address is not None:
        arguments += ["--player-at", run.player_address]
    if run.init_from is not None:
        arguments += ["--init-from", str(run.init_from)]
    if run.resume or not first:
        arguments.append("--resume")
    if run.reset_statistics and first:
        arguments.append("--reset-statistics")
    return arguments


def actor_arguments(run: LocalRun) -> tuple[str, ...]:
    """Return the arguments of this machine's actors and of the evaluator."""
    # The learner reports the progress of all actors: the records of each one are for debugging.
    return *helper_log_words(run.logs), *allow_settings(run.spec.actor_modules)


def gateway_arguments(run: LocalRun) -> tuple[str, ...]:
    """Return the arguments of the gateway with the page."""
    camera = allow_settings(run.spec.user_modules) if run.camera else ["--no-camera"]
    folder = ("--run-dir", str(run.directory))
    token = ("--operator-token", str(run.directory / run_directory.OPERATOR_TOKEN))
    return *helper_log_words(run.logs), *token, *folder, *camera, *([] if run.clients else ["--page-only"])


def helper_log_words(logs: LogOptions) -> list[str]:
    """Return the options of actors, evaluators, and the gateway, which prints its address at any level."""
    return replace(logs, level="debug" if logs.level == "debug" else "warning").words()
