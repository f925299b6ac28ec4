"""`daedalus evaluate` as child processes of a run."""

import json
import signal
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from daedalus.cli.child_output import STREAMS, ChildOutput
from daedalus.cli.supervisor import start, stop

_POLL_SECONDS = 0.05
_REPORTED = (1, 2)  # exit statuses of a `daedalus evaluate` that has printed the reason


class EvaluationFailedError(Exception):
    """Error of an evaluation that failed or was stopped. The message holds output that was not printed yet."""


class EvaluationProcess:
    """One `daedalus evaluate`. The caller closes it."""

    def __init__(self, arguments: Sequence[str], name: str, output: ChildOutput, *, shown: bool) -> None:
        """Start the process.

        Args:
          arguments: of `daedalus evaluate`.
          name: of the process, different from that of every other one that runs.
          output: reads what it writes.
          shown: show its progress.
        """
        self._name, self._output = name, output
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 (closed in close)
        try:
            with output.pipes(name, shown=STREAMS if shown else ()) as streams:
                own = replace(streams, stdout=self._file.fileno())
                self._process = start("daedalus.cli.commands.evaluate", *arguments, "--json", streams=own)
        except BaseException:
            self._file.close()
            raise

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The child process."""
        return self._process

    def has_ended(self) -> bool:
        """Return whether the process has ended, in any way."""
        return self._process.poll() is not None

    def result(self) -> dict[str, Any]:
        """Return the result of a process that has ended. Raises EvaluationFailedError if it failed."""
        status = self._process.returncode
        self._file.seek(0)
        text = self._file.read()
        if status == 0 and text:
            return json.loads(text)
        # The environment may have printed much: the error is at the end.
        lines = self._output.unshown(self._name)
        reported = status in _REPORTED and self._output.last_error(self._name)
        raise EvaluationFailedError("\n".join(lines if reported else [*lines, _died(status)]))

    def close(self) -> None:
        """End the process if it still runs."""
        stop([self._process])
        self._file.close()


def _died(status: int) -> str:
    """Return the error of an evaluation whose process ended without a result, from its exit status."""
    if status == -getattr(signal, "SIGKILL", 9):
        return "an evaluation was killed (signal 9): check whether it was killed for lack of memory"
    how = f"signal {-status}" if status < 0 else f"status {status}"
    return f"the environment or one of its libraries ended an evaluation ({how}): play it with `daedalus check`"


def play(commands: list[list[str]], stopping: threading.Event, output: ChildOutput) -> list[dict[str, Any]]:
    """Run `daedalus evaluate` once for each list of arguments, all at the same time, and return the results.

    The progress of the first one is shown. Raises EvaluationFailedError.
    """
    evaluations: list[EvaluationProcess] = []
    try:
        for arguments in commands:
            name = f"evaluation-{len(evaluations)}"
            evaluations.append(EvaluationProcess(arguments, name, output, shown=not evaluations))
        while not all(evaluation.has_ended() for evaluation in evaluations):
            if stopping.wait(_POLL_SECONDS):
                raise EvaluationFailedError
        return [evaluation.result() for evaluation in evaluations]
    finally:
        stop([evaluation.process for evaluation in evaluations])  # all at the same time
        for evaluation in evaluations:
            evaluation.close()


def without_episodes(result: dict[str, Any]) -> dict[str, Any]:
    """Return a result of `daedalus evaluate` without the lists of the episodes' returns and lengths."""
    return {name: value for name, value in result.items() if name not in ("returns", "lengths")}


def evaluation_summary(evaluation: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return what summary.json has of a final evaluation; `more` is about how it was made."""
    return {
        "evaluation_return_mean": evaluation["return_mean"],
        "evaluation_return_std": evaluation["return_std"],
        "evaluation": {**without_episodes(evaluation), **more},
    }
