"""The processes of one learner: rank 0 starts the others on its machine, or torchrun has started them all."""

import argparse
import os
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from daedalus.cli.settings_arguments import resolve_spec
from daedalus.launch.child_output import inherited
from daedalus.launch.logs import configure_logging, print_error
from daedalus.launch.process_lifecycle import RANK_LOST
from daedalus.launch.run_choice import ChosenRun, check_processes
from daedalus.launch.supervision import start
from daedalus.learner.ranks.errors import RankLostError, RanksDisagreeError
from daedalus.learner.ranks.meeting import Meeting, meeting_of
from daedalus.learner.ranks.opening import lead, no_other_ranks
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_modules import UserModules, allow_settings, modules_of
from daedalus.protocol.spec import RunSpec
from daedalus.transport.private_address import private_folder

if TYPE_CHECKING:
    from daedalus.learner.ranks.leader import OtherRanks

_END_SECONDS = 1.5  # for the other ranks to end by themselves
_EXIT_SECONDS = 3.0  # from a signal to the end of a rank that rank 0 has not ended
_FAULT_SECONDS = 1.0  # in which a rank whose connection is closed ends
_POLL_SECONDS = 0.02
_FAILED = 1


class RankProcesses:
    """The other ranks of a learner. This base class is for a learner without any."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Do nothing."""

    def open(self, spec: RunSpec, stop: threading.Event) -> "OtherRanks | None":
        """See daedalus.learner.ranks.opening.OpenRanks."""
        return no_other_ranks(spec, stop)

    def dismiss(self, spec: RunSpec, stop: threading.Event) -> None:
        """End the other ranks of a run that has nothing to do."""

    def fault(self, error: RankLostError) -> tuple[str, int]:
        """Return what has happened to the other ranks, in one line, and the exit status of rank 0."""
        return str(error), RANK_LOST


class StartedRanks(RankProcesses):
    """Ranks that this process, rank 0, starts on its machine. They end with it, however it ends."""

    def __init__(self, number: int, options: Sequence[str]) -> None:
        """Define `number` ranks with this one; the others are started in the context, with `options`."""
        self._number, self._options = number, tuple(options)
        self._processes: list[subprocess.Popen[bytes]] = []
        self._connected = False
        self._statuses: list[int | None] = []  # of the other ranks when one was lost
        self._folder, self._stack = Path(), ExitStack()

    def __enter__(self) -> Self:
        self._folder = Path(self._stack.enter_context(private_folder()))
        with inherited("") as streams:
            for rank in range(1, self._number):
                place = ("--rank", str(rank), "--processes", str(self._number), "--folder", str(self._folder))
                self._processes.append(start("daedalus.cli.commands.rank", *place, *self._options, streams=streams))
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """End the other ranks, if rank 0 has not ended them already."""
        if isinstance(error, RankLostError):
            self._await(_FAULT_SECONDS, lambda: any(process.poll() for process in self._processes))
            self._statuses = [process.poll() for process in self._processes]
        elif self._connected:
            self._await(_END_SECONDS, lambda: all(process.poll() is not None for process in self._processes))
        self._kill()
        self._stack.close()

    def open(self, spec: RunSpec, stop: threading.Event) -> "OtherRanks | None":
        """See daedalus.learner.ranks.opening.OpenRanks."""
        meeting = Meeting(rank=0, number=self._number, local_rank=0, folder=self._folder, on_this_machine=True)
        other_ranks = lead(meeting, None, spec, stop, self._check, self._kill)
        self._connected = other_ranks is not None
        return other_ranks

    def fault(self, error: RankLostError) -> tuple[str, int]:
        """See RankProcesses. Call it after the context. A rank that failed by itself would fail again."""
        for rank, status in enumerate(self._statuses, 1):
            if status is not None and status < 0:
                return f"process {rank} of the learner was killed by signal {-status}", RANK_LOST
            if status == _FAILED:
                return f"process {rank} of the learner failed; see the error above", _FAILED
        return f"a process of the learner does not answer: {error}", RANK_LOST

    @staticmethod
    def _await(seconds: float, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not condition():
            time.sleep(_POLL_SECONDS)

    def _check(self) -> None:
        """Raise RankLostError if a rank has ended."""
        if any(process.poll() is not None for process in self._processes):
            raise RankLostError("it ended before it was connected")

    def _kill(self) -> None:
        """End all other ranks at once. Idempotent."""
        for process in self._processes:
            if process.poll() is None:
                process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()


class LaunchedRanks(RankProcesses):
    """Ranks that torchrun, or another launcher, has started, perhaps on several hosts."""

    def __init__(self, meeting: Meeting, options: dict[str, Any]) -> None:
        """Take part as rank 0, with the options of the command line."""
        self._meeting, self._options = meeting, options

    def open(self, spec: RunSpec, stop: threading.Event) -> "OtherRanks | None":
        """See daedalus.learner.ranks.opening.OpenRanks."""
        return lead(self._meeting, self._options, spec, stop, lambda: None, lambda: os._exit(RANK_LOST))

    def dismiss(self, spec: RunSpec, stop: threading.Event) -> None:
        """See RankProcesses."""
        ranks = self.open(spec, stop)
        if ranks is not None:
            ranks.close()


def meeting_for(arguments: argparse.Namespace) -> Meeting | None:
    """Return the meeting that torchrun has arranged for `daedalus learner`, or None. Raises SettingsError."""
    if arguments.exit_with_parent:  # started by `daedalus train`, or by supervise_learner
        return None
    meeting = meeting_of(os.environ, insecure=arguments.insecure)
    if meeting is not None and arguments.processes not in (None, meeting.number):
        raise SettingsError(
            f"--processes is {arguments.processes}, and torchrun has started {meeting.number}: leave out --processes"
        )
    return meeting


def ranks_for(arguments: argparse.Namespace, run: ChosenRun, meeting: Meeting | None) -> RankProcesses:
    """Return the other processes of rank 0 of `daedalus learner`.

    Raises SettingsError if there would be nothing for them to do.
    """
    number = (arguments.processes or 1) if meeting is None else meeting.number
    if number == 1:
        return RankProcesses()
    check_processes(number, run.spec)
    if meeting is not None:
        return LaunchedRanks(meeting, run_defining(arguments))
    log = ["--log-level", arguments.log_level, *(["--log-json"] if arguments.log_json else [])]
    return StartedRanks(number, [*log, *allow_settings(run.spec.learner_modules)])


def follow_launched(meeting: Meeting, arguments: argparse.Namespace, stop: threading.Event) -> int:
    """Take part in the updates as a rank that torchrun has started, and return the exit status.

    Raises SettingsError, or UserModuleError for a module that may not be imported.
    """
    configure_logging(arguments.log_level, as_json=arguments.log_json, process=f"learner, rank {meeting.rank}")
    named = arguments.preset is not None or arguments.env is not None
    own = modules_of(resolve_spec(arguments).user_modules) if named else []
    modules = UserModules(frozenset({*arguments.allow_module, *own}), "rank 0")
    return follow(meeting, run_defining(arguments), modules, stop)


def run_defining(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of `daedalus learner` in which all ranks must agree, by name."""
    names = ("preset", "env", "algorithm", "actors", "seed", "env_steps", "wrap", "set", "init_from", "resume")
    values = {name: getattr(arguments, name) for name in names}
    values["init_from"] = None if arguments.init_from is None else str(arguments.init_from)
    return {name if name == "preset" else f"--{name.replace('_', '-')}": value for name, value in values.items()}


def follow(meeting: Meeting, options: dict[str, Any] | None, modules: UserModules, stop: threading.Event) -> int:
    """Take part in the updates of rank 0 until it ends the run, and return the exit status."""
    threading.Thread(target=_exit_after, args=(stop,), name="rank-end", daemon=True).start()
    from daedalus.learner.ranks.follower import Follower

    try:
        group = meeting.connect(stop.is_set)
        if group is not None:
            Follower(group, options, modules, meeting.local_rank).run()
    except RanksDisagreeError as error:
        if options is not None:  # else rank 0 says it, in the same terminal
            print_error("learner", error)
        return _FAILED
    except RankLostError as error:
        if options is not None and not stop.is_set():
            print_error("learner", f"rank {meeting.rank} has lost rank 0: {error}")
        return RANK_LOST
    return 0


def _exit_after(stop: threading.Event) -> None:
    """End this process soon after a signal, or the end of its parent: it may wait for rank 0 in native code."""
    stop.wait()
    time.sleep(_EXIT_SECONDS)
    os._exit(RANK_LOST)
