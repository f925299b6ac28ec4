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
    """Collects into LINES, from empty, what is logged at INFO and above."""
    LINES.clear()
    logger, collector = logging.getLogger("daedalus"), _Collector()
    level = logger.level
    logger.addHandler(collector)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(collector)
        logger.setLevel(level)
