"""Messages that the daedalus loggers recorded during the current test."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

LINES: list[str] = []


class _Collector(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        LINES.append(record.getMessage())


@contextmanager
def collected() -> Iterator[None]:
    """Collect messages at level INFO and above in LINES, from empty; undo what the test configures."""
    LINES.clear()
    logger, collector = logging.getLogger("daedalus"), _Collector()
    level, handlers = logger.level, list(logger.handlers)
    logger.addHandler(collector)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.handlers[:] = handlers
        logger.setLevel(level)
