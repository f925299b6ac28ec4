"""Configuration of logging: lines for a person, for the log of a service, or JSON objects for a log collector."""

import json
import logging
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TextIO

from daedalus.protocol import keys
from daedalus.protocol.texts import printable, utc

EVENTS = "daedalus.learner.serving.events"  # logger of the events of a run
LEVELS = ("debug", "info", "warning", "error")


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """How a process writes its log records."""

    level: str = "info"  # lowest severity of the records shown, one of LEVELS
    as_json: bool = False

    def words(self) -> list[str]:
        """Return the options for the command line of another process."""
        return ["--log-level", self.level, *(["--log-json"] if self.as_json else [])]

    def configure(
        self,
        *,
        process: str = "",
        context: Mapping[str, str] | None = None,
        write: Callable[[str], None] | None = None,
    ) -> None:
        """See configure_logging."""
        configure_logging(self.level, as_json=self.as_json, process=process, context=context, write=write)


def configure_logging(
    level: str = "info",
    *,
    as_json: bool = False,
    process: str = "",
    context: Mapping[str, str] | None = None,
    command: str = "",
    write: Callable[[str], None] | None = None,
) -> None:
    """Send the records of all daedalus loggers to the terminal.

    Args:
      level: lowest severity of the records shown, one of LEVELS.
      as_json: write one JSON object per line, for a log collector.
      process: kind of this process, such as `learner`: each line has its time and severity, the process and the fields
        of `context`; in short if standard output is a terminal. Empty: each line has the message alone, for a person.
      context: fields of each record, such as `run` and `epoch`; read for each record, so the caller may change it.
      command: name of a command whose standard output is its result: lines go to standard error, after
        `daedalus COMMAND: ` unless they have the form of a service or of JSON.
      write: called with each line, if a progress line shares the terminal (default: print it).
    """
    context = {} if context is None else context
    if as_json:
        formatter: logging.Formatter = _JsonFormatter(context)
    elif not process:
        formatter = _MessageFormatter(f"daedalus {command}: " if command else "")
    elif sys.stdout.isatty():
        formatter = _TerminalFormatter(process, context)
    else:
        formatter = _ServiceFormatter(process, context)
    handler = LineHandler(write or (lambda line: say(line, sys.stderr if command else None)))
    handler.setFormatter(formatter)
    if not (process or as_json or level == "debug"):
        handler.addFilter(_needs_attention)
    logger = logging.getLogger("daedalus")
    logger.handlers[:] = [handler]
    logger.setLevel(level.upper())


def _needs_attention(record: logging.LogRecord) -> bool:
    """Return whether a person who watches a command should see a record: any but the usual events of a run."""
    return record.name != EVENTS or record.levelno >= logging.WARNING or getattr(record, "event", "") == "target"


def say(text: str, stream: TextIO | None = None) -> None:
    """Print a text that may contain what comes from outside; None: on standard output.

    What the stream cannot encode is escaped: the stream may be one of another program that calls a function of ours.
    """
    stream = stream or sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    print(printable(text).encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def print_error(command: str, text: object) -> None:
    """Write why `daedalus COMMAND` fails to standard error."""
    say(f"daedalus {command}: {text}", sys.stderr)


class LineHandler(logging.Handler):
    """Handler that writes each record as one line. It ignores a closed terminal."""

    def __init__(self, write: Callable[[str], None]) -> None:
        super().__init__()
        self._write = write

    def emit(self, record: logging.LogRecord) -> None:
        """See logging.Handler."""
        try:
            self._write(printable(self.format(record)))
        except (OSError, ValueError):  # closed
            return
        except Exception:
            self.handleError(record)


class _MessageFormatter(logging.Formatter):
    """Formatter for a person who watches one command: the message, after the name of the actor that it is about."""

    def __init__(self, prefix: str) -> None:
        super().__init__()
        self._prefix = prefix

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        return self._prefix + _about(record) + super().format(record)


class _TerminalFormatter(logging.Formatter):
    """Formatter for a service that runs in a terminal: time of day, process, message."""

    def __init__(self, process: str, context: Mapping[str, str]) -> None:
        super().__init__()
        self._process, self._context = process, context

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        of = " ".join(filter(None, (self._process, self._context.get("actor"))))
        level = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
        clock = time.strftime("%H:%M:%S", time.localtime(record.created))
        return f"{clock} {of}: {level}{_about(record)}{super().format(record)}"


class _ServiceFormatter(logging.Formatter):
    """Formatter for the log of a service: each line has time, severity, process and the fields of the context."""

    def __init__(self, process: str, context: Mapping[str, str]) -> None:
        super().__init__()
        self._process, self._context = process, context

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        fields = "".join(f" {name}={_word(value)}" for name, value in _fields(record, self._context).items())
        prefix = f"{utc(record.created)} {record.levelname.lower()} {self._process}{fields}: "
        # Each line of a longer text has the prefix: a text of a peer cannot imitate another record.
        return "\n".join(prefix + line for line in super().format(record).split("\n"))


class _JsonFormatter(logging.Formatter):
    """Formatter that writes a record as one JSON object."""

    def __init__(self, context: Mapping[str, str]) -> None:
        super().__init__()
        self._context = context

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        fields = {
            "time": utc(record.created),
            "level": record.levelname.lower(),
            "logger": record.name,
            "process": record.process,
            "thread": record.threadName,
            **_fields(record, self._context),
            "message": record.getMessage(),
        }
        if event := getattr(record, "event", ""):
            fields["event"] = event
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        return json.dumps(fields)


def _fields(record: logging.LogRecord, context: Mapping[str, str]) -> dict[str, str]:
    """Return run, epoch and actor of a record, as far as they are known."""
    actor = getattr(record, "actor", "")
    return {**context, "actor": actor} if actor else dict(context)


def _about(record: logging.LogRecord) -> str:
    """Return the name of the actor that an event is about, or an empty text."""
    actor = getattr(record, "actor", "")
    return f"{actor}: " if actor else ""


def _word(value: str) -> str:
    """Return a value that is one word, in quotes if it is none."""
    return value if keys.is_name(value) else json.dumps(value)
