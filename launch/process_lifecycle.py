"""What every process does: stop on signals, end with its parent, and end when one of its threads fails."""

import contextlib
import errno
import gc
import io
import logging
import os
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import NoReturn, TextIO

from daedalus.policy.user_code import frames_of, is_of_user
from daedalus.protocol.texts import printable
from daedalus.transport.credentials import NotValidNowError
from daedalus.transport.slow_calls import in_progress

_logger = logging.getLogger(__name__)

# Exit statuses of every command; docs/operations.md has the table of all. A supervisor starts a process that failed
# again, and not one that was started wrongly: that fails each time.
FAILED, BAD_USAGE = 1, 2
# Exit statuses of a run that has finished: the target was reached, or all steps were done without a target to stop at;
# and the budget was used up before the target.
REACHED, NOT_REACHED = 0, 3
FINISHED = {REACHED, NOT_REACHED}
# Exit status of a learner that its supervisor stopped; of one that nobody supervises, the status is 0.
STOPPED = 128 + signal.SIGTERM
ORDERED = 4  # exit status of a supervised learner that an operator stopped
UNSAVED = 6  # exit status of a supervised learner whose last checkpoint could not be saved
SUPERSEDED = 7  # exit status of a learner that a newer one of its run has replaced: it must not be started again
UNREAD = 128 + getattr(signal, "SIGPIPE", 13)  # exit status, as of other programs; Windows has no such signal
UNWRITABLE = {errno.ENOSPC, errno.EDQUOT, errno.EIO}  # errors of a full disk, and of a terminal that was closed
_LEAVE = getattr(signal, "SIGUSR1", None)  # Windows has none
_STUCK_SECONDS = 4.0  # in one call after a signal: a process that is stuck ends within 5 s
_END_SECONDS = 30.0  # for the orderly end of a process that is not stuck, even on a busy machine
_THREADS_SECONDS = 1.0  # for threads that are not ours, at the end
_REPEAT_SECONDS = 0.05  # after an interrupt that was dropped
_LAST_WORD_SECONDS = 0.5  # for a last line that may block
_TRACEBACK_SECONDS = 5.0  # for a traceback that may block
_LONGEST_LINE = 1 << 16  # bytes, from the parent
_MACOS_DESCRIPTORS = 10_240  # the kernel of macOS refuses more, whatever the hard limit is


def status_at_start(error: Exception) -> int:
    """Return the exit status of a process that cannot start: BAD_USAGE, unless only the certificate is not valid now.

    It may be renewed, or the clock corrected, so that the same command works.
    """
    return FAILED if isinstance(error, NotValidNowError) else BAD_USAGE


def raise_descriptor_limit() -> None:
    """Raise the limit of open file descriptors to the hard limit: each connection of a listener uses one.

    Without this, about a thousand connections would use up the usual limit, and no checkpoint could be written.
    """
    try:
        import resource
    except ModuleNotFoundError:  # Windows has no limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    for limit in (hard, _MACOS_DESCRIPTORS):
        if soft in (limit, resource.RLIM_INFINITY):
            return
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
            return


@contextlib.contextmanager
def interrupts_held(*others: signal.Signals) -> Iterator[None]:
    """Block SIGINT in this thread, and in the child processes that are started in the block until `stop_on_signals`.

    A child process needs seconds to import its modules. Ctrl-C would end it there with a traceback; a blocked signal
    waits for the handlers. `others` are blocked too.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *others})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Stop(threading.Event):
    """Event that knows whether the main thread has found it set."""

    def __init__(self) -> None:
        super().__init__()
        self.noticed = threading.Event()

    def is_set(self) -> bool:
        return self._note(super().is_set())

    def wait(self, timeout: float | None = None) -> bool:
        return self._note(super().wait(timeout))

    def _note(self, found: bool) -> bool:
        if found and threading.current_thread() is threading.main_thread():
            self.noticed.set()
        return found


def stop_on_signals(
    *,
    exit_if_stuck: bool = False,
    stuck_seconds: float = _STUCK_SECONDS,
    end_seconds: float = _END_SECONDS,
    on_leave: Callable[[threading.Event], None] | None = None,
) -> threading.Event:
    """Return an event that SIGTERM and SIGINT set. Call it in the main thread.

    `on_leave` is called with the event after SIGUSR1, on a thread of its own.

    The process can so close its resources before it ends. A thread sets the event, not the signal handlers. Python
    calls no handler while the main thread runs native code, such as a simulator or a policy. And a handler may
    interrupt the main thread, or another handler, inside the event: it would wait for ever for the event's lock.

    With `exit_if_stuck`, the process ends with status 1 if the main thread does not check the event within
    `stuck_seconds`, because a call such as a step of a simulator does not return, or does not end within
    `end_seconds` more.
    """
    stop = _Stop()

    def watch() -> None:
        while number := os.read(reader, 1):
            if number[0] in (signal.SIGTERM, signal.SIGINT):
                stop.set()
            elif number[0] == _LEAVE and on_leave is not None:
                on_leave(stop)

    reader, writer = os.pipe()
    if hasattr(os, "set_blocking"):  # Windows with Python 3.11 has none, and does not require it
        os.set_blocking(writer, False)
    signal.signal(signal.SIGTERM, _ignore)
    signal.signal(signal.SIGINT, _ignore)
    if _LEAVE is not None and on_leave is not None:
        signal.signal(_LEAVE, _ignore)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)  # the interpreter writes each signal's number at once
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # see interrupts_held
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_default_signals)
    threading.Thread(target=watch, name="signals", daemon=True).start()
    if exit_if_stuck:
        threading.Thread(
            target=_exit_if_stuck, args=(stop, stuck_seconds, end_seconds), name="stuck-watch", daemon=True
        ).start()
    return stop


def _default_signals() -> None:
    """Undo `stop_on_signals` in a fork, such as a process of an environment: a signal shall end it.

    Not SIGUSR1, which some supervisors send to all processes of an actor: its rollout needs them.
    """
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    if _LEAVE is not None and signal.getsignal(_LEAVE) is _ignore:
        signal.signal(_LEAVE, signal.SIG_IGN)


def _ignore(_number: int, _frame: object) -> None:
    """Handle a signal that a thread reads from the wakeup descriptor."""


def _exit_if_stuck(stop: _Stop, stuck_seconds: float, end_seconds: float) -> None:
    """Wait for `stop`, and end the process unless it ends by itself."""
    stop.wait()
    if stop.noticed.wait(stuck_seconds):
        time.sleep(end_seconds)
    _end_with(_say_stuck, within=_LAST_WORD_SECONDS)


def _say_stuck() -> None:
    _logger.error(
        "asked to stop, but a call, such as a step of the environment or a write to the disk, does not return: "
        "the process ends"
    )
    sys.stdout.flush()


def _end_with(last_words: Callable[[], None], *, within: float) -> NoReturn:
    """Say the last words, and end this process with status 1, at most `within` seconds later.

    The words block where a terminal is stopped or a pipe is not read: then the process ends without them.
    """
    try:
        saying = threading.Thread(target=last_words, name="last-words", daemon=True)
        saying.start()
        saying.join(within)
    finally:
        os._exit(1)


def exit_with_parent(stop: threading.Event, on_line: Callable[[bytes], None] = lambda _: None) -> None:
    """Set `stop` when standard input ends: the parent holds it open while it runs.

    `on_line` is called with each line that the parent writes, on a thread of its own. For everybody else standard input
    is empty from now on: an environment that reads it, such as one with `breakpoint()`, would wait for ever.
    """
    held, empty = os.dup(sys.stdin.fileno()), os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, sys.stdin.fileno())
    os.close(empty)

    def watch() -> None:
        rest = b""
        while data := os.read(held, 4096):
            *lines, rest = (rest + data).split(b"\n")
            rest = rest[-_LONGEST_LINE:]
            for line in lines:
                on_line(line)
        stop.set()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def open_standard_streams() -> None:
    """Open each standard stream that was closed when the process started, as by `>&-`; what it receives is discarded.

    What an output cannot encode, such as a path in a locale without UTF-8, is escaped from now on.

    Call it before any other file is opened. A descriptor that is free would go to the next file, and what libraries and
    child processes print would be written into that file.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)  # the lowest free one, which is that of the stream
            os.set_inheritable(descriptor, True)
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8", errors="backslashreplace"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors != "backslashreplace":
            stream.reconfigure(errors="backslashreplace")


def reserved_stdout() -> TextIO:
    """Return standard output for its caller alone: whatever else this process prints goes to standard error.

    This includes libraries that are not Python's, and the processes of environments.
    """
    reserved = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8", errors="backslashreplace")
    sys.stdout.flush()
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return reserved


def exit_status(command: Callable[[], int], *outputs: TextIO) -> int:
    """Run a command and return its exit status; 141 if nobody reads its output any more, as in `daedalus ... | head`.

    Every command runs in it. After Ctrl-C, or if the disk is full or a file belongs to another user, the status is 1.
    `outputs` are the streams that the command writes to, besides standard output and standard error.
    """
    open_standard_streams()
    gc.freeze()  # what has been imported: the interpreter would look through it again, also at its end
    gc.enable()  # see cli/commands/__init__.py
    before = set(threading.enumerate())
    try:
        try:
            with _lost_interrupts_repeated(), _interrupts_recognised():
                return _ended(command(), before)
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:  # before a command has handlers of its own, or without any
        print("stopped", file=sys.stderr)
        return _ended(1, before)
    except BrokenPipeError:
        unread = [stream for stream in (*outputs, sys.stdout, sys.stderr) if _is_unread(stream)]
        if not unread:  # another pipe: a fault of ours
            raise
        discard(*unread)
        return UNREAD
    except PermissionError as error:
        if error.filename is None:
            raise
        print(printable(f"daedalus: {error.filename}: {error.strerror}"), file=sys.stderr)
        return 1
    except OSError as error:
        if error.errno not in UNWRITABLE or error.filename is not None:
            raise
        discard(*outputs, sys.stdout)
        print(f"daedalus: cannot write the output: {error.strerror}", file=sys.stderr)
        return 1


def _ended(status: int, before: set[threading.Thread]) -> int:
    """Return the status, or end the process with it now if it could not end by itself.

    A call of Zenoh that is in progress would abort it. And the interpreter waits for every thread that is no daemon:
    one of an environment, such as the loop of a simulator's connection, may run for ever.
    """
    if in_progress() or _any_lasts(set(threading.enumerate()) - before):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _any_lasts(threads: set[threading.Thread]) -> bool:
    """Return whether the interpreter would wait for one of these threads for longer than a second."""
    deadline = time.monotonic() + _THREADS_SECONDS
    waited_for = [thread for thread in threads if not thread.daemon]
    for thread in waited_for:
        thread.join(max(deadline - time.monotonic(), 0.0))
    return any(thread.is_alive() for thread in waited_for)


@contextlib.contextmanager
def _interrupts_recognised() -> Iterator[None]:
    """Raise KeyboardInterrupt after Ctrl-C, also where a library has replaced it by an exception of its own.

    The validators of pydantic do this while a module is imported.
    """
    interrupts: list[int] = []

    def handle(number: int, _frame: object) -> None:
        interrupts.append(number)
        raise KeyboardInterrupt

    default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not default or threading.current_thread() is not threading.main_thread():  # ignored, as after `&` in a script
        yield
        return
    signal.signal(signal.SIGINT, handle)
    try:
        yield
    except Exception as error:
        if not interrupts:
            raise
        raise KeyboardInterrupt from error
    finally:
        if signal.getsignal(signal.SIGINT) is handle:  # the command has no handlers of its own
            signal.signal(signal.SIGINT, signal.default_int_handler)


@contextlib.contextmanager
def _lost_interrupts_repeated() -> Iterator[None]:
    """Repeat an interrupt whose KeyboardInterrupt Python has dropped, as it does in callbacks of weak references.

    The import system has such callbacks, and a command imports for seconds before it has handlers of its own.
    """
    others = sys.unraisablehook

    def repeat() -> None:
        raising = signal.getsignal(signal.SIGTERM) is signal.default_int_handler
        number = signal.SIGTERM if raising else signal.SIGINT  # which may be ignored
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, number)  # which ends its wait
        else:  # Windows
            signal.raise_signal(number)

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if isinstance(dropped.exc_value, KeyboardInterrupt):
            later = threading.Timer(_REPEAT_SECONDS, repeat)  # in the hook it would be dropped again
            later.daemon = True
            later.start()
        else:
            others(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = others


def discard(*streams: TextIO) -> None:
    """Discard what streams could not write, and what is written to them: the interpreter flushes them at its end."""
    for stream in streams:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _is_unread(stream: TextIO) -> bool:
    """Return whether the other end of a pipe is closed."""
    if not hasattr(select, "poll"):  # Windows: it cannot be asked, and standard streams are the only pipes there
        return True
    poll = select.poll()
    poll.register(stream.fileno(), 0)
    return bool(poll.poll(0))  # of errors and closed ends alone


def exit_on_thread_exceptions(*, plays: bool = False) -> None:
    """Make an exception in any thread end the process with status 1, with its traceback on standard error.

    An exception that no thread handles is a fault of ours. Without this hook only its thread would end and the process
    would idle; with it a supervisor restarts the process. Call this at the start of a command.

    Args:
      plays: the process plays environments. In a thread that one has started for itself, an exception ends only the
        thread, as in every other program.
    """

    def end_process(arguments: threading.ExceptHookArgs) -> None:
        name = arguments.thread.name if arguments.thread else "unknown"
        if plays and _is_of_environment(arguments.exc_value):
            threading.__excepthook__(arguments)
            return

        def say_why() -> None:
            print(f"exception in thread {name}:", file=sys.stderr)
            traceback.print_exception(arguments.exc_type, arguments.exc_value, arguments.exc_traceback)
            sys.stderr.flush()
            _logger.critical("exception in thread %s: %s: the process ends", name, arguments.exc_type.__name__)
            sys.stdout.flush()

        # sys.exit would end only this thread, and an orderly end could wait for the failed thread without end.
        _end_with(say_why, within=_TRACEBACK_SECONDS)

    threading.excepthook = end_process


def _is_of_environment(error: BaseException | None) -> bool:
    """Return whether an exception was raised in a thread of an environment: no function of ours has called it."""
    names = [frame.tb_frame.f_globals.get("__name__", "") for frame in frames_of(error)]
    ours = any(name == "__main__" or name.partition(".")[0] == "daedalus" for name in names)
    return not ours and any(is_of_user(frame) for frame in frames_of(error))


def process_started() -> float:
    """Return the start of this process on the monotonic clock, or the present time where it is not known."""
    now = time.monotonic()
    try:
        with (
            open("/proc/self/stat", encoding="ascii") as stat,
            open("/proc/uptime", encoding="ascii") as uptime,
        ):
            ticks = int(stat.read().rsplit(")", 1)[1].split()[19])
            age = float(uptime.read().split()[0]) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):  # not Linux
        return now
    return now - max(age, 0.0)
