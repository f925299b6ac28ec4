"""The quick half of `daedalus check`, in a process of its own: an environment may print, hang, or crash its process.

The process ends before the actors start, so that a simulator of which only one can run is free again.
"""

import json
import logging
import os
import select
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

from daedalus.learner.run.default_settings import default_settings
from daedalus.policy.user_modules import UserModules, modules_of
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

if TYPE_CHECKING:
    from daedalus.actor.checking.report import EnvironmentReport

_logger = logging.getLogger(__name__)

_PLAY_SECONDS, _PLAY_ENV_STEPS = 0.3, 50
_POLL_SECONDS = 0.2
_MOST_SECONDS = 20.0  # a simulator may need long to start; the run does not wait for it any longer


class CheckTimeoutError(Exception):
    """Error of a check that did not end in time."""


class EnvironmentProblemError(Exception):
    """Error of an environment that cannot be trained on. The message is one line."""


def checked_spaces(spec: RunSpec, *, fork: bool = False) -> Spaces | None:
    """Check the environment of a run of this machine, log warnings, and return its spaces, or None if it takes long.

    The user has named the modules of the environment. See quick_check. Raises EnvironmentProblemError.
    """
    report = _checked(spec, fork)
    if problem := report.text_problem(spec):
        raise EnvironmentProblemError(problem)
    return report.spaces


def checked_defaults(spec: RunSpec, *, fork: bool = False) -> tuple[Spaces | None, dict[str, Any]]:
    """Check an environment without settings: return its spaces and the default settings for it. See checked_spaces.

    A text that never changes is left out, and logged.
    """
    return _defaults(_checked(spec, fork), spec)


def _checked(spec: RunSpec, fork: bool) -> "EnvironmentReport":
    from daedalus.actor.checking.report import EnvironmentReport, float_images, slow_steps

    try:
        report = quick_check(spec.environment, UserModules(frozenset(modules_of(spec.user_modules))), fork=fork)
    except CheckTimeoutError as error:
        _logger.warning("the check of the environment was %s: the run starts without it", error)
        return EnvironmentReport()
    if report.problems:
        raise EnvironmentProblemError(report.problems[0])
    for warning in report.warnings:
        _logger.warning("%s", warning)
    for advice in (slow_steps(report, spec, os.cpu_count() or 1), float_images(report, spec)):
        if advice:
            _logger.info("%s", advice)
    return report


def transformed_spaces(spec: RunSpec, before: RunSpec, spaces: Spaces | None, *, fork: bool = False) -> Spaces | None:
    """Return the spaces after the transforms of `spec`; `spaces` are those with the transforms of `before`.

    Raises EnvironmentProblemError.
    """
    if spec.environment == before.environment or spaces is None:
        return spaces
    try:
        modules = UserModules(frozenset(modules_of(spec.user_modules)))
        report = quick_check(spec.environment, modules, play=False, fork=fork)
    except CheckTimeoutError:
        return None
    if problem := (*report.problems, report.text_problem(spec))[0]:
        raise EnvironmentProblemError(problem)
    return report.spaces


def expected_spaces(spec: RunSpec, modules: UserModules, stop: threading.Event) -> Spaces | None:
    """Return the spaces of a run's environment, or None where it cannot be made. Only makes the environment.

    Args:
      spec: the run.
      modules: the modules that may be imported.
      stop: ends the attempt early when it is set.
    """
    report = _expected(spec, modules, stop)
    if problem := report.text_problem(spec):
        _logger.info("%s", problem)
        return None
    return report.spaces


def expected_defaults(
    spec: RunSpec, modules: UserModules, stop: threading.Event
) -> tuple[Spaces | None, dict[str, Any]]:
    """Return the spaces of an environment without settings, and the default settings for it. See expected_spaces."""
    return _defaults(_expected(spec, modules, stop), spec)


def _expected(spec: RunSpec, modules: UserModules, stop: threading.Event) -> "EnvironmentReport":
    from daedalus.actor.checking.report import EnvironmentReport

    try:
        report = quick_check(spec.environment, modules, play=False, stop=stop)
    except CheckTimeoutError as error:
        reason = str(error)
    else:
        if report.spaces is not None and not report.problems:
            return report
        reason = report.problems[0]
    _logger.info("the first actor decides the spaces of the run, because they are not known here: %s", reason)
    return EnvironmentReport()


def _defaults(report: "EnvironmentReport", spec: RunSpec) -> tuple[Spaces | None, dict[str, Any]]:
    for name, text in report.constant_texts.items():
        _logger.info("observation component %r is left out (environment.leave_out): it is always %r", name, text)
    return report.spaces, default_settings(report.spaces, [*spec.environment.leave_out, *report.constant_texts])


def quick_check(
    spec: EnvironmentSpec,
    modules: UserModules,
    *,
    play: bool = True,
    fork: bool = False,
    stop: threading.Event | None = None,
) -> "EnvironmentReport":
    """Make one environment, play it for up to 0.3 s, close it, and return what was found.

    Args:
      spec: the environment and its transforms.
      modules: the modules that may be imported for it.
      play: False only makes it, for its spaces.
      fork: start the process by a fork if it is safe, which takes 0.1 s instead of 0.5 s. For commands, whose process
        has nothing that does not work after a fork.
      stop: ends the check early when it is set.

    Raises CheckTimeoutError.
    """
    from daedalus.actor.checking.report import EnvironmentReport

    words = json.dumps({"spec": spec.model_dump(mode="json"), "modules": sorted(modules.allowed), "play": play})
    reading, writing = os.pipe()
    with open(reading, "rb", buffering=0) as results:
        # Apple's frameworks do not work after a fork.
        forked = fork and sys.platform == "linux" and threading.active_count() == 1
        try:
            pid = _forked(words, writing) if forked else _spawned(words, writing)
        finally:
            os.close(writing)
        try:
            answer = _read(results.fileno(), stop or threading.Event())
            if answer:
                os.kill(pid, signal.SIGKILL)  # threads of the environment could keep it alive
        except BaseException:
            os.kill(pid, signal.SIGKILL)
            raise
        finally:
            _, status = os.waitpid(pid, 0)
    if not answer:
        ended = f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"status {os.WEXITSTATUS(status)}"
        problem = f"environment {spec.id} ended its process ({ended}): see what it prints with `daedalus check`"
        return EnvironmentReport(problems=(problem,))
    return EnvironmentReport.model_validate_json(answer)


def _read(descriptor: int, stop: threading.Event) -> bytes:
    """Read one line, or nothing if the other end closes before. Raises CheckTimeoutError."""
    data, until = b"", time.monotonic() + _MOST_SECONDS
    while not data.endswith(b"\n"):  # not to the end: processes of the environment may hold the descriptor
        if stop.is_set() or time.monotonic() > until:
            raise CheckTimeoutError(f"not done within {_MOST_SECONDS:g} s")
        if not select.select([descriptor], [], [], _POLL_SECONDS)[0]:
            continue
        part = os.read(descriptor, 1 << 16)
        if not part:
            return b""
        data += part
    return data


def _forked(words: str, writing: int) -> int:
    """Return the process id of a fork that writes the report to a descriptor."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    try:
        silent = os.open(os.devnull, os.O_RDWR)
        for standard in range(3):
            os.dup2(silent, standard)
        _report(words, writing)
    finally:
        os._exit(1)  # nothing that belongs to the parent may be closed or flushed here


def _spawned(words: str, writing: int) -> int:
    """Return the process id of a new interpreter that writes the report to a descriptor."""
    os.set_inheritable(writing, True)
    command = [sys.executable, "-P", "-m", "daedalus.cli.quick_check", str(writing), words]
    silent = [(os.POSIX_SPAWN_OPEN, standard, os.devnull, os.O_RDWR, 0) for standard in range(3)]
    return os.posix_spawn(sys.executable, command, os.environ, file_actions=silent)


def _report(words: str, writing: int) -> None:
    """Check the environment, and write the report to a descriptor."""
    # It ends with its parent, or soon after, even in native code.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(int(_MOST_SECONDS) + 5)
    from daedalus.actor.checking.play import check_environment

    options = json.loads(words)
    seconds = _PLAY_SECONDS if options["play"] else 0.0
    modules = UserModules(frozenset(options["modules"]))
    spec = EnvironmentSpec.model_validate(options["spec"])
    report = check_environment(spec, modules, seconds=seconds, env_steps=_PLAY_ENV_STEPS)
    with open(writing, "w", encoding="utf-8") as stream:
        stream.write(report.model_dump_json() + "\n")


if __name__ == "__main__":
    _report(sys.argv[2], int(sys.argv[1]))
