"""Progress of a run: one line that is rewritten on a terminal, or a log record every few seconds elsewhere."""

import logging
import os
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import TextIO

from daedalus.learner.reporting.metrics_rows import WIN_RATE
from daedalus.protocol.texts import policy_lag, short_number, short_rate, short_share

_LINE_SECONDS = 5.0  # between lines if the stream is not a terminal
_FIRST_LINE_SECONDS = 1.0
_SHOWN_OPPONENTS = 2  # in the line


_logger = logging.getLogger(__name__)


class RewrittenLine:
    """Line of a terminal that each text replaces. Whoever reads it may go away: the work that it shows goes on."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._rewriting = stream, False

    def rewrite(self, text: str) -> None:
        """Show a text in place of the one before."""
        self._write(f"\r\x1b[K{text}")
        self._rewriting = True

    def end(self) -> None:
        """End the line that is being rewritten."""
        if self._rewriting:
            self._write("\n")
            self._rewriting = False

    def _write(self, text: str) -> None:
        with suppress(OSError):
            self._stream.write(text)
            self._stream.flush()


class Progress(RewrittenLine):
    """Display of the newest metrics row."""

    def __init__(self, stream: TextIO, env_steps_budget: int, updates_per_batch: int = 1) -> None:
        super().__init__(stream)
        self._budget = env_steps_budget
        self.updates_per_batch = updates_per_batch  # by which a policy lag in updates is one in batches
        self._terminal = is_terminal(stream)
        self._next_line = time.monotonic() + _FIRST_LINE_SECONDS

    def show(self, row: Mapping[str, float], waits_for: str = "") -> None:
        """Show a metrics row. If the stream is not a terminal, show at most one row every few seconds.

        `waits_for` is what the first batch waits for: without it, the row has no figures. Empty: there is a batch.
        """
        if not self._terminal:
            if time.monotonic() < self._next_line:
                return
            self._next_line = time.monotonic() + _LINE_SECONDS
        parts = _parts(row, self._budget, self.updates_per_batch)
        parts = [parts[0], waits_for, parts[-1]] if waits_for else parts
        if self._terminal:
            # The last column would begin a new line.
            self.rewrite(_fitted(parts, shutil.get_terminal_size().columns - 1))
        else:
            _logger.info("%s", "  ".join(parts))

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self.end()
        self._write(text + "\n")


class SilentProgress(Progress):
    """Progress of a run that another process shows."""

    def show(self, row: Mapping[str, float], waits_for: str = "") -> None:
        """Show nothing."""


def is_terminal(stream: TextIO) -> bool:
    """Return whether a stream is a terminal that can rewrite a line."""
    return stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")


def _parts(row: Mapping[str, float], budget: int, updates_per_batch: int) -> list[str]:
    """Return the parts of a line, the most important first. What is not known yet is a dash."""
    rate, updates = row.get("env_steps_per_second", 0.0), row.get("updates_per_second")
    lag = policy_lag(row["policy_lag_mean"], updates_per_batch) if "policy_lag_mean" in row else "-"
    left = duration((budget - row["env_steps"]) / rate) if rate > 0.0 else "-"
    parts = [
        f"{row['wall_seconds']:7.1f} s",
        _strength(row),
        f"env_steps {row['env_steps']:>11,} ({100.0 * row['env_steps'] / budget:.0f} %)",
        f"{short_rate(rate) if rate else '-':>7}/s",
        f"left {left:>6}",
        f"updates {'-' if updates is None else short_rate(updates):>5}/s",
        f"lag {lag}",
        f"actors {row['actors']}",
    ]
    if "episode_length_mean" in row:
        parts.insert(5, f"length {row['episode_length_mean']:>6,.0f}")
    wins = {name.removeprefix(WIN_RATE): rate for name, rate in row.items() if name.startswith(WIN_RATE)}
    rates = [f"{name} {short_share(rate)}" for name, rate in wins.items()]
    if rates:
        parts.insert(2, f"wins against {', '.join(rates[:_SHOWN_OPPONENTS])}")
    return parts


def _strength(row: Mapping[str, float]) -> str:
    """Return how good the policy is. In a game with opponents that is a rating: what one side wins, the other loses."""
    if "rating" in row:
        return f"rating {round(row['rating']):>6,} +- {round(row['rating_deviation']):,}"
    mean = short_number(row["episode_return_mean"]) if "episode_return_mean" in row else "-"
    return f"return {mean:>7}"


def _fitted(parts: list[str], width: int) -> str:
    """Return as many of the parts, from the first on, as fit into one line."""
    while len(parts) > 1 and len("  ".join(parts)) > width:
        parts = parts[:-1]
    return "  ".join(parts)[: max(width, 0)]


def duration(seconds: float) -> str:
    """Return a short text: 45 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{max(seconds, 0.0):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"
