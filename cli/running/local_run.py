"""The settings of one run on this machine, and how it ends."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daedalus.cli.running.run_observer import RunObserver
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec


class RunFailedError(Exception):
    """Error of a run that did not finish. The message is empty if a child process has printed the reason."""

    def __init__(self, message: str = "", status: int = 1) -> None:
        super().__init__(message)
        self.status = status  # exit status for the command


class UnsavedError(RunFailedError):
    """Error of a run whose result could not be saved. The run can be resumed."""


class RunStoppedError(Exception):
    """Error of a run that was stopped before its end."""


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
    listen: str | None = None  # address for actors of other hosts, in addition to a private one of this machine
    tls: Path | None = None
    insecure: bool = False
    log_level: str = "info"  # of the learner and the evaluation; actors log warnings, or everything at "debug"
    log_json: bool = False
    watch: bool = False  # start a gateway with the page of the run
    camera: bool = True  # with a camera
    clients: bool = False  # with the page, let clients take part
    log: Sequence[str] = ()  # trackers that the run is logged to
    observer: RunObserver = field(default_factory=RunObserver)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnd:
    """End of a run: exit status and summary."""

    status: int  # 0: target reached, or all steps done without a target to stop at; 3: budget used up before the target
    summary: dict[str, Any]  # summary.json, with the evaluation


def resume_command(run: LocalRun) -> str:
    """Return the command line that continues a run."""
    return shlex.join(["daedalus", "resume", str(run.directory), *allow_settings(run.spec.user_modules)])
