"""A check of an environment in a process of its own: the environment may print, hang, or end its process."""

import faulthandler
import json
import logging
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import IO, TYPE_CHECKING, Any

from daedalus.launch.forked_process import fork as fork_process
from daedalus.launch.forked_process import open_descriptors
from daedalus.launch.process_lifecycle import interrupts_held
from daedalus.policy.user_code import names_place
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.lessons import Parameters, extremes
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.transport.process_usage import available_processors

if TYPE_CHECKING:
    from daedalus.actor.checking.check_report import EnvironmentReport

_POLL_SECONDS = 0.2
_KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # which kills on Windows, too
_ALARM_SECONDS = 5  # after the limit: a process without its parent ends then, even in native code


class CheckTimeoutError(Exception):
    """Error of a check that did not end in time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentCheck:
    """What to check, and how long. See check_environment."""

    spec: EnvironmentSpec
    modules: UserModules
    seconds: float
    env_steps: int
    seed: int = 0
    most_seconds: float  # for the whole check
    shown: bool = False  # show what the environment prints, on standard error, and the end of one that crashes
    notes: bool = False  # add what gymnasium's own checker says
    bots: tuple[str, ...] = ()  # fixed opponents of a game that are code
    lessons: Sequence[Parameters] = ()  # parameters that episodes of lessons may have

    def run(self) -> "EnvironmentReport":
        """Check the environment in this process."""
        from daedalus.actor.checking.checker import gymnasium_notes
        from daedalus.actor.checking.play import check_environment

        report = check_environment(
            self.spec,
            self.modules,
            seconds=self.seconds,
            env_steps=self.env_steps,
            seed=self.seed,
            bots=self.bots,
            lessons=self.lessons,
        )
        if not self.notes or report.problems:
            return report
        return report.model_copy(update={"notes": gymnasium_notes(self.spec, self.modules)})

    def words(self) -> str:
        """Return the check as text, for `from_words` in another process."""
        plain = {
            name: getattr(self, name)
            for name in ("seconds", "env_steps", "seed", "most_seconds", "shown", "notes", "bots", "lessons")
        }
        return json.dumps({**plain, "spec": self.spec.model_dump(mode="json"), "modules": sorted(self.modules.allowed)})

    @classmethod
    def from_words(cls, words: str) -> "EnvironmentCheck":
        """Return the check of `words`."""
        values: dict[str, Any] = json.loads(words)
        spec = EnvironmentSpec.model_validate(values.pop("spec"))
        modules = UserModules(frozenset(values["modules"]))
        return cls(**values | {"spec": spec, "modules": modules, "bots": tuple(values["bots"])})


def check_in_process(
    check: EnvironmentCheck,
    *,
    fork: bool = False,
    stop: threading.Event | None = None,
    slow_seconds: float = math.inf,
    on_slow: Callable[[], object] = lambda: None,
) -> "EnvironmentReport":
    """Run a check in a process of its own, and return what was found. An environment that ends it has a problem.

    Args:
      check: what to check.
      fork: start the process by a fork if it is safe, which takes 0.1 s instead of 0.5 s. For commands, whose process
        has nothing that does not work after a fork. Only for a check that is not shown.
      stop: ends the check early when it is set.
      slow_seconds, on_slow: call this function once if the check takes so long.

    Raises CheckTimeoutError.
    """
    from daedalus.actor.checking.check_report import EnvironmentReport

    # Apple's frameworks do not work after a fork.
    forked = fork and sys.platform == "linux" and hasattr(os, "fork") and threading.active_count() == 1
    process = _forked(check) if forked or check.spec.is_from_python else _spawned(check)
    try:
        answer = _Answer(process.results)
        answer.wait(stop or threading.Event(), check.most_seconds, slow_seconds, on_slow)
        if answer.line:
            process.end(own_group=not check.shown)  # threads of the environment could keep it alive
    except BaseException:
        process.end(own_group=not check.shown)
        raise
    finally:
        status = process.wait()
    if not answer.line:
        ended = f"signal {-status}" if status < 0 else f"status {status}"
        hint = ", as it would end an actor" if check.shown else ": see what it prints with `daedalus check`"
        return EnvironmentReport(problems=(f"environment {check.spec.id} ended its process ({ended}){hint}",))
    return EnvironmentReport.model_validate_json(answer.line)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Process:
    """A process that checks an environment."""

    pid: int
    results: IO[bytes]  # where it writes its report
    wait: Callable[[], int]  # for its end; returns the exit status, negative after a signal

    def end(self, *, own_group: bool) -> None:
        """Kill it, with the programs that its environment has started: another simulator could not start."""
        if own_group:
            with suppress(OSError, AttributeError):  # a fork has not begun, and has none yet; Windows has no groups
                os.killpg(self.pid, _KILL)
        with suppress(PermissionError):  # of Windows, where it has ended
            os.kill(self.pid, _KILL)


class _Answer:
    """The line that a process writes, read by a thread: not every system can wait for a pipe with a time limit."""

    def __init__(self, results: IO[bytes]) -> None:
        self.line = b""  # empty if the other end closes before
        self._changed = threading.Event()
        threading.Thread(target=self._read, args=(results,), name="check-results", daemon=True).start()

    def wait(self, stop: threading.Event, seconds: float, slow_seconds: float, on_slow: Callable[[], object]) -> None:
        """Wait for the line or the end. See check_in_process. Raises CheckTimeoutError."""
        began = time.monotonic()
        while not self._changed.wait(_POLL_SECONDS):
            passed = time.monotonic() - began
            if stop.is_set() or passed > seconds:
                raise CheckTimeoutError(f"not done within {seconds:g} s")
            if passed > slow_seconds:
                slow_seconds = math.inf
                on_slow()

    def _read(self, results: IO[bytes]) -> None:
        data = b""
        with results:  # not to the end: processes of the environment may hold the descriptor
            while not data.endswith(b"\n") and (part := os.read(results.fileno(), 1 << 16)):
                data += part
        self.line = data if data.endswith(b"\n") else b""
        self._changed.set()


def _forked(check: EnvironmentCheck) -> _Process:
    """Start a fork that writes the report to a pipe."""
    reading, writing = os.pipe()

    def work() -> int:
        os.setpgid(0, 0)  # see _Process.end
        _report(check, writing)
        return 0

    silent = os.open(os.devnull, os.O_RDWR)
    try:
        pid = fork_process(work, (silent, silent, silent), open_descriptors())
    except BaseException:
        os.close(reading)
        raise
    finally:
        os.close(silent)
        os.close(writing)
    results = open(reading, "rb", buffering=0)  # noqa: SIM115 - closed by its reader
    return _Process(pid=pid, results=results, wait=lambda: os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))


def _spawned(check: EnvironmentCheck) -> _Process:
    """Start a new interpreter that writes the report to its standard output."""
    with interrupts_held():
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "daedalus.launch.environment_check", check.words()],
            stdin=None if check.shown else subprocess.DEVNULL,  # a debugger of the user reads it
            stdout=subprocess.PIPE,
            stderr=None if check.shown else subprocess.DEVNULL,
            bufsize=0,
            process_group=None if check.shown else 0,  # see _Process.end
        )
    assert process.stdout is not None
    return _Process(pid=process.pid, results=process.stdout, wait=process.wait)


def _report(check: EnvironmentCheck, writing: int) -> None:
    """Check the environment, and write the report to a descriptor."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # the parent reports Ctrl-C
    threading.excepthook = threading.__excepthook__  # a fork has the parent's, which ends the process
    if hasattr(signal, "alarm"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(int(check.most_seconds) + _ALARM_SECONDS)
    if check.shown:
        faulthandler.enable(all_threads=False)
    report = check.run()
    with open(writing, "w", encoding="utf-8") as stream:
        stream.write(report.model_dump_json() + "\n")


_logger = logging.getLogger(__name__)

_PLAY_SECONDS, _PLAY_ENV_STEPS = 0.3, 50
_MOST_SECONDS = 20.0  # a simulator may need long to start; the run does not wait for it any longer
_MOST_SECONDS_FOR_SETTINGS = 120.0  # unless its settings depend on the spaces


class EnvironmentProblemError(Exception):
    """Error of an environment that cannot be trained on. The message is one line."""


class RolesError(EnvironmentProblemError):
    """Error of a game whose agents need a policy for each role; `roles` are the agents of each."""

    def __init__(self, problem: str, roles: dict[str, tuple[str, ...]]) -> None:
        super().__init__(problem)
        self.roles = roles


def checked_spaces(spec: RunSpec, *, fork: bool = False) -> Spaces | None:
    """Check the environment of a run of this machine, log warnings, and return its spaces, or None if it takes long.

    The user has named the modules of the environment. See quick_check. Raises EnvironmentProblemError.
    """
    report = _checked(spec, fork)
    if problem := report.text_problem(spec) or report.code_problem(spec):
        raise EnvironmentProblemError(problem)
    _log_advice(report, spec)
    return report.spaces


def checked_defaults(
    spec_with: Callable[[dict[str, Any] | None], RunSpec], *, fork: bool = False
) -> tuple[Spaces | None, dict[str, Any]]:
    """Check an environment without settings: return its spaces and the default settings for it. See checked_spaces.

    A text that never changes is left out, and logged, as is why slow environments get processes of their own.

    Args:
      spec_with: returns the specification with default settings; None: without knowledge of the spaces.
      fork: see quick_check.
    """
    spec = spec_with(None)
    report = _checked(spec, fork, for_settings=True)
    spaces, defaults = _defaults(report, spec)
    if problem := report.code_problem(spec):
        raise EnvironmentProblemError(problem)
    defaults, reason = with_measured_processes(spec_with, defaults, report)
    if reason:
        _logger.info("%s", reason)
    _log_advice(report, spec_with(defaults))
    return spaces, defaults


def with_measured_processes(
    spec_with: Callable[[dict[str, Any] | None], RunSpec], defaults: dict[str, Any], report: "EnvironmentReport"
) -> tuple[dict[str, Any], str]:
    """Give slow environments processes of their own, unless the user has chosen.

    Return the default settings, and the reason, or an empty string. With processes, nothing changes but the speed. See
    checked_defaults for the arguments.
    """
    from daedalus.actor.checking.check_report import slow_steps

    slow = slow_steps(report, spec_with(defaults), available_processors())
    if not slow:
        return defaults, ""
    changed = {**defaults, "environment": {**defaults.get("environment", {}), "processes": True}}
    return changed, f"{slow}; each gets a process of its own instead (environment.processes=true)"


def _checked(spec: RunSpec, fork: bool, *, for_settings: bool = False) -> "EnvironmentReport":
    from daedalus.actor.checking.check_report import EnvironmentReport, slow_start

    try:
        modules, lessons = UserModules.of(spec.user_modules), extremes(spec.lessons, spec.environment.parameters)
        report = quick_check(spec.environment, modules, fork=fork, for_settings=for_settings, lessons=lessons)
    except CheckTimeoutError as error:
        hint = slow_start(spec)
        _logger.warning("the check of the environment was %s: the run starts without it%s", error, hint)
        return EnvironmentReport()
    if report.roles:
        raise RolesError(report.problems[0], report.roles)
    if report.problems:
        problem = with_preset(report.problems[0], spec)
        # Nothing is recorded yet: the check has no terminal, and the run no folder.
        hint = "; `daedalus check` with the same options shows the traceback" if names_place(problem) else ""
        raise EnvironmentProblemError(f"{problem}{hint}")
    for warning in report.warnings:
        _logger.warning("%s", warning)
    return report


def _log_advice(report: "EnvironmentReport", spec: RunSpec) -> None:
    from daedalus.actor.checking.check_report import advice

    for text in advice(report, spec, available_processors()):
        _logger.info("%s", text)


def with_preset(problem: str, spec: RunSpec) -> str:
    """Return a problem, with a hint if the unknown environment has the name of a preset."""
    from daedalus.learner.run.settings import preset_names  # which the process of a check does not need

    name = spec.environment.id
    return f"{problem}; {name!r} is a preset, which is named without --env" if name in preset_names() else problem


def transformed_spaces(spec: RunSpec, before: RunSpec, spaces: Spaces | None, *, fork: bool = False) -> Spaces | None:
    """Return the spaces after the transforms of `spec`; `spaces` are those with the transforms of `before`.

    Raises EnvironmentProblemError.
    """
    if spec.environment == before.environment or spaces is None:
        return spaces
    try:
        report = quick_check(spec.environment, UserModules.of(spec.user_modules), play=False, fork=fork)
    except CheckTimeoutError:
        return None
    if problem := (*report.problems, report.text_problem(spec))[0]:
        raise EnvironmentProblemError(problem)
    return report.spaces


def expected_spaces(
    spec: RunSpec, modules: UserModules, stop: threading.Event, *, is_new: bool = False
) -> Spaces | None:
    """Return the spaces of a run's environment, or None where it cannot be made. Only makes the environment.

    Args:
      spec: the run.
      modules: the modules that may be imported.
      stop: ends the attempt early when it is set.
      is_new: log what the environment and the settings of a run that begins have between them.
    """
    report = _expected(spec, modules, stop)
    if problem := report.text_problem(spec):
        _logger.info("%s", problem)
        return None
    if is_new:
        _log_found(report, spec)
    return report.spaces


def expected_defaults(
    spec_with: Callable[[dict[str, Any] | None], RunSpec], modules: UserModules, stop: threading.Event
) -> tuple[Spaces | None, dict[str, Any]]:
    """Return the spaces of an environment without settings, and the default settings for it.

    See expected_spaces, and checked_defaults for `spec_with`.
    """
    spec = spec_with(None)
    report = _expected(spec, modules, stop, for_settings=True)
    spaces, defaults = _defaults(report, spec)
    if spaces is not None:
        _log_found(report, spec_with(defaults))
        _logger.info("the environment was made and not played here: `daedalus check` looks for faults")
    return spaces, defaults


def _log_found(report: "EnvironmentReport", spec: RunSpec) -> None:
    for warning in report.warnings:
        _logger.warning("%s", warning)
    _log_advice(report, spec)


def _expected(
    spec: RunSpec, modules: UserModules, stop: threading.Event, *, for_settings: bool = False
) -> "EnvironmentReport":
    from daedalus.actor.checking.check_report import EnvironmentReport

    try:
        report = quick_check(spec.environment, modules, play=False, stop=stop, for_settings=for_settings)
    except CheckTimeoutError as error:
        reason = f"the check of environment {spec.environment.id} was {error}"
    else:
        if report.spaces is not None and not report.problems:
            return report
        reason = report.problems[0]
    _logger.info("the first actor decides the spaces of the run, because they are not known here: %s", reason)
    return EnvironmentReport()


def _defaults(report: "EnvironmentReport", spec: RunSpec) -> tuple[Spaces | None, dict[str, Any]]:
    from daedalus.learner.run.default_settings import default_settings  # which the process of a check does not need

    for name, text in report.constant_texts.items():
        _logger.info("observation component %r is left out (environment.leave_out): it is always %r", name, text)
    if report.spaces is None:
        # Those of an algorithm with a replay buffer are the same for all actions.
        actions, others = ("", "") if spec.algorithm.replay else (" and discrete actions", " or continuous actions")
        _logger.warning(
            "the default settings are those for numbers%s, because the spaces of environment %s are not known: if it "
            "has images%s, name the settings with --set or in a TOML file",
            actions,
            spec.environment.id,
            others,
        )
    leave_out = [*spec.environment.leave_out, *report.constant_texts]
    # An encoder for images that the user has chosen takes no codes.
    found = report.codes if spec.policy.encoder in ("auto", "mlp", "grid") else {}
    for name, codes in found.items():
        shown = ",".join(map(str, codes))
        _logger.info("observation component %r has codes: by default policy.codes.%s=[%s]", name, name, shown)
    maps = report.maps if spec.policy.encoder == "auto" else ()
    defaults = default_settings(report.spaces, leave_out, report.seats, found, maps)
    for name in maps if "encoder" in defaults["policy"] else ():  # not with images or continuous actions
        _logger.info("observation component %r is a map of a few cells: by default policy.encoder=grid", name)
    return report.spaces, defaults


def quick_check(
    spec: EnvironmentSpec,
    modules: UserModules,
    *,
    play: bool = True,
    fork: bool = False,
    stop: threading.Event | None = None,
    for_settings: bool = False,
    lessons: Sequence[Parameters] = (),
) -> "EnvironmentReport":
    """Make one environment, play it for up to 0.3 s, close it, and return what was found.

    Args:
      spec: the environment and its transforms.
      modules: the modules that may be imported for it.
      play: False only makes it, for its spaces.
      fork: start the process by a fork if it is safe, which takes 0.1 s instead of 0.5 s. For commands, whose process
        has nothing that does not work after a fork.
      stop: ends the check early when it is set.
      for_settings: wait longer for a simulator that starts slowly: the settings of the run depend on its spaces.
      lessons: see check_environment.

    Raises CheckTimeoutError.
    """
    most_seconds = _MOST_SECONDS_FOR_SETTINGS if for_settings else _MOST_SECONDS
    waiting = "the check of environment %s takes long: waiting up to %g s, because its spaces decide the settings"
    return check_in_process(
        EnvironmentCheck(
            spec=spec,
            modules=modules,
            seconds=_PLAY_SECONDS if play else 0.0,
            env_steps=_PLAY_ENV_STEPS,
            most_seconds=most_seconds,
            lessons=lessons,
        ),
        fork=fork,
        stop=stop,
        slow_seconds=_MOST_SECONDS,
        on_slow=partial(_logger.info, waiting, spec.id, most_seconds),
    )


if __name__ == "__main__":
    own_output = os.dup(1)
    os.dup2(2, 1)  # what the environment prints
    _report(EnvironmentCheck.from_words(sys.argv[1]), own_output)
