"""Configuration of logging: plain lines for a person, or one JSON object per line for a log collector."""

import argparse
import json
import logging
import re
import time
from collections.abc import Callable

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # all but tab and newline
LEVELS = ("debug", "info", "warning", "error")


def add_logging(options: argparse._ActionsContainer) -> None:
    """Add --log-level and --log-json."""
    options.add_argument(
        "--log-level",
        choices=LEVELS,
        default="info",
        help="lowest severity of log records shown (default: %(default)s)",
    )
    options.add_argument("--log-json", action="store_true", help="write log records as JSON, one object per line")


def configure_logging(
    level: str = "info", *, as_json: bool = False, prefix: str = "", write: Callable[[str], None] | None = None
) -> None:
    """Send the records of all daedalus loggers to the terminal.

    Args:
      level: lowest severity of the records shown, one of LEVELS.
      as_json: write one JSON object per line, for a log collector, instead of plain messages.
      prefix: text before each plain message, such as the name of the process.
      write: called with each line, if a progress line shares the terminal (default: print to standard output).
    """
    handler = _LineHandler(write or _print)
    plain = logging.Formatter(prefix.replace("%", "%%") + "%(message)s")
    handler.setFormatter(_JsonFormatter() if as_json else plain)
    logger = logging.getLogger("daedalus")
    logger.handlers[:] = [handler]
    logger.setLevel(level.upper())


def _print(line: str) -> None:
    print(line, flush=True)


def printable(text: str) -> str:
    """Return `text` with control characters escaped: it may come from a peer, and a terminal would obey them."""
    return _CONTROL.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


class _LineHandler(logging.Handler):
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


class _JsonFormatter(logging.Formatter):
    """Formatter that writes a record as one JSON object."""

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        fields = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "process": record.process,
            "thread": record.threadName,
            "message": record.getMessage(),
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        return json.dumps(fields)
