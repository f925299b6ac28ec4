"""Which checkpoint of a run is its best: those that scored highest, and the newest, play it out.

The best of many scores over a few episodes was lucky; over fresh episodes, more of them and the same for all, it counts
what each can do.
"""

import json
import logging
import subprocess
import sys
import tempfile
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

from daedalus.cli.child_output import INHERITED, Streams
from daedalus.cli.supervisor import stop
from daedalus.learner.run.candidates import candidates
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.05
_SEEDS = 2**33  # added to the run's: neither training nor the final episodes have these


class EvaluationFailedError(Exception):
    """Episodes could not be played, or were stopped; the message is what the first evaluation did not print itself."""


def select_best(
    directory: Path,
    spec: RunSpec,
    options: list[str],
    stopping: threading.Event,
    streams: Streams = INHERITED,
) -> list[dict[str, Any]]:
    """Scores each candidate anew; what each got, the best first. Nothing, if there are not two to choose from.

    `options` are what `daedalus evaluate` takes. Raises EvaluationFailedError.
    """
    finalists = candidates(directory)
    if len(finalists) < 2:
        return []
    backend, seed = spec.environment.backend, spec.training.seed + _SEEDS
    _logger.info(
        f"{len(finalists)} checkpoints play for the best: {spec.evaluation.final_episodes} episodes each on {backend}"
    )
    with_it = [*options, "--backend", backend, "--seed", str(seed)]
    results = play([[str(each.directory), *with_it] for each in finalists], stopping, streams)
    scores = []
    for candidate, result in zip(finalists, results, strict=True):
        version, mean, std = candidate.policy_version, result["return_mean"], result["return_std"]
        before = "" if candidate.score is None else f" ({candidate.score:.1f} before)"
        _logger.info(f"  policy version {version}: {mean:.1f} +- {std:.1f}{before}")
        try:
            candidate.rescore(mean)
        except OSError as error:
            _logger.info(f"  which could not be written down ({error.strerror})")
        scores.append({"policy_version": version, "return_mean": mean, "return_std": std})
    return sorted(scores, key=lambda each: each["return_mean"], reverse=True)


def play(commands: list[list[str]], stopping: threading.Event, streams: Streams = INHERITED) -> list[dict[str, Any]]:
    """Runs `daedalus evaluate`, once for each list of words, beside one another; their results.

    Raises EvaluationFailedError.
    """
    with ExitStack() as stack:
        outputs = [stack.enter_context(tempfile.TemporaryFile()) for _ in commands]
        # The first tells how far it is, for all of them; what the others say is for when they fail.
        others = [stack.enter_context(tempfile.TemporaryFile()) for _ in commands[1:]]
        processes: list[subprocess.Popen[bytes]] = []
        try:
            for words, output, error in zip(commands, outputs, [streams.stderr, *others], strict=True):
                processes.append(_start_evaluation(words, output, error))
            while any(process.poll() is None for process in processes) and not stopping.wait(_POLL_SECONDS):
                pass
        finally:
            stop(processes)
        errors = [None, *others]
        failed = [error for process, error in zip(processes, errors, strict=True) if process.returncode != 0]
        if failed:
            said = [] if stopping.is_set() else [_text(error) for error in failed if error is not None]
            raise EvaluationFailedError("".join(said))
        for output in outputs:
            output.seek(0)
        results = [json.load(output) for output in outputs]
    for result in results:
        for each_episode in ("returns", "lengths"):
            del result[each_episode]
    return results


def _start_evaluation(words: list[str], output: IO[bytes], error: IO[bytes] | int | None) -> subprocess.Popen[bytes]:
    program = [sys.executable, "-P", "-m", "daedalus.cli.commands.evaluate"]
    command = [*program, *words, "--json", "--exit-with-parent"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=error)


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")
