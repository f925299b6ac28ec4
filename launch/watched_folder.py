"""What the page of a gateway shows of a run directory on its machine: settings, output, and how the run ended."""

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daedalus.gateway.watching.page_data import FolderView
from daedalus.learner.run.run_directory import CONFIG, OUTPUT, REPORT, SUMMARY, read_config, run_name
from daedalus.learner.run.run_files import RunDataError, read_end, read_json
from daedalus.learner.run.settings import SettingsError, changed_settings, flat_settings, setting_text
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.texts import printable, short_number

_logger = logging.getLogger(__name__)

_OUTPUT_BYTES = 32 << 10


class WatchedFolder:
    """Reader of one run directory, which may be written meanwhile. One thread at a time.

    What cannot be read is left as it was: the page of a run does not depend on its directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._summary_before = self._stamp(SUMMARY)  # of a life of the learner before this one
        self._read: dict[str, tuple[tuple[int, int], Any]] = {}  # by file: when it was changed, and its content
        self._modules: dict[str, str] = {}

    def __call__(self, run: str) -> FolderView | None:
        """Return what the directory has; None if it is of another run than the one with this name."""
        if run != run_name(self._directory):
            return None
        settings = self._unless_equal(CONFIG, self._settings, ())
        output = self._unless_equal(OUTPUT, lambda: printable(read_end(self._directory / OUTPUT, _OUTPUT_BYTES)), "")
        if self._stamp(SUMMARY) == self._summary_before:
            return FolderView(settings=settings, output=output)
        summary = self._unless_equal(SUMMARY, lambda: read_json(self._directory / SUMMARY) or {}, {})
        ends, stopped = self._ends(summary), summary.get("finished") is False
        return FolderView(settings=settings, output=output, ends=ends, stopped=stopped)

    def _settings(self) -> tuple[tuple[str, str, bool], ...]:
        spec = read_config(self._directory)
        self._modules = spec.user_modules
        values = flat_settings(spec.model_dump(mode="json"))
        changed = set(changed_settings(values))
        return tuple(
            (path, printable(setting_text(value)), path in changed)
            for path, value in values.items()
            if value is not None or path in changed
        )

    def _ends(self, summary: dict[str, Any]) -> tuple[str, ...]:
        """Return how the run ended, beyond what the learner says: its evaluation, its report, how to continue."""
        match summary.get("evaluation"):
            case {"return_mean": float(mean), "return_std": float(std), "episodes": int(episodes), "actions": str(how)}:
                played = f"{episodes:,} {how} episodes"
                evaluated = [f"Evaluation: return {short_number(mean)} ± {short_number(std)} over {played}."]
            case _:
                evaluated = []
        report = self._directory / REPORT
        newest = self._stamp(REPORT)[0] >= self._stamp(SUMMARY)[0] > 0  # else of an earlier end of the run
        words = ["daedalus", "resume", str(self._directory), *allow_settings(self._modules)]
        left = [f"Report, on the host of the gateway: {report}"] if newest else []
        how = [] if summary.get("finished") else [f"Continue it with: {' '.join(words)}"]
        return tuple(map(printable, [*evaluated, *left, *how]))

    def _stamp(self, name: str) -> tuple[int, int]:
        """Return when a file was changed, and its size; zeros without the file."""
        try:
            state = os.stat(self._directory / name)
        except OSError:
            return 0, 0
        return state.st_mtime_ns, state.st_size

    def _unless_equal(self, name: str, read: Callable[[], Any], otherwise: Any) -> Any:
        """Return what `read` makes of a file, read again only if the file has changed."""
        stamp, (before, content) = self._stamp(name), self._read.get(name, ((-1, -1), otherwise))
        if stamp == before:
            return content
        try:
            content = read() if stamp != (0, 0) else otherwise
        except (RunDataError, SettingsError, OSError) as error:
            _logger.debug("%s cannot be shown: %s", name, error)
        self._read[name] = stamp, content
        return content
