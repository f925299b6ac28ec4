"""Progress of a run: one line that is rewritten on a terminal, or a new line every few seconds elsewhere."""

import time
from collections.abc import Mapping
from typing import TextIO

_LINE_SECONDS = 5.0  # between lines if the stream is not a terminal
_FIRST_LINE_SECONDS = 1.0


class Progress:
    """Display of the newest metrics row."""

    def __init__(self, stream: TextIO, env_steps_budget: int) -> None:
        self._stream = stream
        self._budget = env_steps_budget
        self._terminal = stream.isatty()
        self._next_line = time.monotonic() + _FIRST_LINE_SECONDS
        self._rewriting = False

    def show(self, row: Mapping[str, float]) -> None:
        """Show a metrics row. If the stream is not a terminal, show at most one row every few seconds."""
        if not self._terminal:
            if time.monotonic() < self._next_line:
                return
            self._next_line = time.monotonic() + _LINE_SECONDS
        line = _line(row, self._budget)
        if self._terminal:
            self._stream.write(f"\r\x1b[K{line}")
            self._rewriting = True
        else:
            self._stream.write(line + "\n")
        self._stream.flush()

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self.end()
        self._stream.write(text + "\n")
        self._stream.flush()

    def end(self) -> None:
        """End the line that is being rewritten."""
        if self._rewriting:
            self._stream.write("\n")
            self._stream.flush()
            self._rewriting = False


def _line(row: Mapping[str, float], budget: int) -> str:
    mean = f"{row['episode_return_mean']:.1f}" if "episode_return_mean" in row else "-"
    share = 100.0 * row["env_steps"] / budget
    return (
        f"{row['wall_seconds']:7.1f} s  return {mean:>7}  env_steps {row['env_steps']:>11,} ({share:.0f} %)"
        f"  {row['env_steps_per_second']:>9,.0f}/s  updates {row['updates_per_second']:>6,.0f}/s"
        f"  lag {row['policy_lag_mean']:.1f}  actors {row['actors']}"
    )
