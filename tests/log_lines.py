"""What the daedalus loggers have recorded during the running test, as plain messages."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

LINES: list[str] = []


class _Collector(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        LINES.append(record.getMessage())


@contextmanager
def collected() -> Iterator[None]:
    """Collect into LINES, from empty, what is logged at INFO and above; undo what the test configures."""
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
