"""The evaluation after training: selection of the best checkpoint, then the final episodes, by `daedalus evaluate`."""

import json
import logging
import math
import signal
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from daedalus.launch.child_output import STREAMS, ChildOutput
from daedalus.launch.local_run import LocalRun, evaluation_arguments
from daedalus.launch.supervision import Child, StartPlayer, start, stop
from daedalus.learner.run import run_directory
from daedalus.learner.run.candidates import candidates
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import short_number

_ERRORS = 3.0  # standard errors between two means that differ
_FEWEST = 10  # episodes, from which on their standard error means something


def is_below_training(evaluation: dict[str, Any], training_mean: float | None) -> bool:
    """Return whether greedy episodes were clearly worse than the newest training episodes, whose actions are sampled.

    Args:
      evaluation: a result of `daedalus evaluate`.
      training_mean: mean return of the training episodes; None without any.
    """
    if evaluation["actions"] != "greedy" or evaluation["episodes"] < _FEWEST or training_mean is None:
        return False
    return training_mean - evaluation["return_mean"] > _ERRORS * _error(evaluation)


def sampled_note(greedy: dict[str, Any], sampled: dict[str, Any]) -> str:
    """Return a message about the results of greedy and of sampled actions, of the same checkpoint."""
    text = (
        f"sampled actions: return {short_number(sampled['return_mean'])} +- {short_number(sampled['return_std'])} over "
        f"{sampled['episodes']} episodes; played because the greedy ones were worse than training"
    )
    if sampled["return_mean"] - greedy["return_mean"] > _ERRORS * math.hypot(_error(greedy), _error(sampled)):
        text += ". Use the policy with --actions sampled (evaluation.actions)"
    return text


def other_task_note(training_mean: float) -> str:
    """Return a message about the mean return of training episodes of another task than that of evaluations."""
    return (
        f"the return {short_number(training_mean)} of training is that of another task (environment.training_kwargs or "
        "environment.no_reward_limit): it cannot be compared with evaluations"
    )


def _error(evaluation: dict[str, Any]) -> float:
    return evaluation["return_std"] / math.sqrt(evaluation["episodes"])


_POLL_SECONDS = 0.05
_REPORTED = (1, 2)  # exit statuses of a `daedalus evaluate` that has printed the reason


class EvaluationFailedError(Exception):
    """Error of an evaluation that failed or was stopped. The message holds output that was not printed yet."""


class EvaluationProcess:
    """One `daedalus evaluate`. The caller closes it."""

    def __init__(
        self, arguments: Sequence[str], name: str, output: ChildOutput, start: StartPlayer, *, shown: bool
    ) -> None:
        """Start the process.

        Args:
          arguments: of `daedalus evaluate`.
          name: of the process, different from that of every other one that runs.
          output: reads what it writes.
          start: starts the process.
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
    def process(self) -> Child:
        """The child process."""
        return self._process

    def result(self) -> dict[str, Any]:
        """Return the result of a process that has ended. Raises EvaluationFailedError if it failed."""
        status = self._process.poll()
        assert status is not None
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


def play(
    commands: list[list[str]], stopping: threading.Event, output: ChildOutput, start: StartPlayer = start
) -> list[dict[str, Any]]:
    """Run `daedalus evaluate` once for each list of arguments, all at the same time, and return the results.

    The progress of the first one is shown. Raises EvaluationFailedError.
    """
    evaluations: list[EvaluationProcess] = []
    try:
        for arguments in commands:
            name = f"evaluation-{len(evaluations)}"
            evaluations.append(EvaluationProcess(arguments, name, output, start, shown=not evaluations))
        while any(evaluation.process.poll() is None for evaluation in evaluations):
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


_logger = logging.getLogger(__name__)

_SEEDS = 2**33  # added to the seed of the run, so that neither training nor the final evaluation uses these seeds


def select_best(
    directory: Path,
    spec: RunSpec,
    options: list[str],
    stopping: threading.Event,
    output: ChildOutput,
    start: StartPlayer = start,
) -> list[dict[str, Any]]:
    """Re-evaluate the candidates, save their new scores, and return the scores, the best first.

    Args:
      directory: the run directory.
      spec: the specification of the run.
      options: options for each `daedalus evaluate`.
      stopping: ends the evaluations early when it is set.
      output: reads what the evaluations write. It shows the progress of the first one.
      start: starts each process.

    Returns: policy_version, return_mean and return_std of each candidate; empty if there are fewer than two.
    Raises EvaluationFailedError.
    """
    finalists = candidates(directory)
    if len(finalists) < 2:
        return []
    backend, seed = spec.environment.backend, spec.training.seed + _SEEDS
    _logger.info(
        "selecting the best of %d checkpoints: %d episodes each on %s",
        len(finalists),
        spec.evaluation.final_episodes,
        backend,
    )
    options = [*options, "--backend", backend, "--seed", str(seed)]
    results = play([[str(each.directory), *options] for each in finalists], stopping, output, start)
    scores = []
    for candidate, result in zip(finalists, results, strict=True):
        version, mean, std = candidate.policy_version, result["return_mean"], result["return_std"]
        before = ""
        if candidate.score is not None:
            before = f" ({short_number(candidate.score)} {'in training' if candidate.of_training else 'before'})"
        _logger.info("  policy version %d: %s +- %s%s", version, short_number(mean), short_number(std), before)
        try:
            candidate.rescore(mean)
        except OSError as error:
            _logger.warning("  the score of policy version %d could not be saved: %s", version, error.strerror or error)
        scores.append({"policy_version": version, "return_mean": mean, "return_std": std})
    return sorted(scores, key=lambda each: each["return_mean"], reverse=True)


def evaluate_run(run: LocalRun, stopping: threading.Event, output: ChildOutput) -> dict[str, Any]:
    """Select the best checkpoint, play the final episodes with it, and return the summary with the results.

    If greedy episodes are clearly worse than training was, the same episodes are played with sampled actions, too,
    unless the policy is greedy anyway, or sampled episodes have confirmed the target. A note says where training
    plays another task, whose returns say nothing about these. Raises EvaluationFailedError.
    """
    began = time.monotonic()
    summary = run_directory.read_json(run.directory / run_directory.SUMMARY)
    options = ["--episodes", str(run.spec.evaluation.final_episodes), *evaluation_arguments(run)]
    chosen = select_best(run.directory, run.spec, options, stopping, output, run.start_player)
    (evaluation,) = play([[str(run.directory), *options]], stopping, output, run.start_player)
    confirmed = summary.get("confirmation") is not None  # by sampled episodes
    can_differ = run.spec.algorithm.heads == "policy_and_value"  # the policy of action values is always greedy
    true_task = run.spec.environment.trains_true_task
    if not true_task and summary.get("episode_return_mean") is not None:
        evaluation["notes"].append(other_task_note(summary["episode_return_mean"]))
    if true_task and not confirmed and can_differ and is_below_training(evaluation, summary.get("episode_return_mean")):
        commands = [[str(run.directory), *options, "--actions", "sampled"]]
        (sampled,) = play(commands, stopping, output, run.start_player)
        evaluation["notes"].append(sampled_note(evaluation, sampled))
        summary["sampled_evaluation"] = without_episodes(sampled)
    summary |= evaluation_summary(evaluation, select_best=chosen, seconds=time.monotonic() - began)
    run_directory.write_json(run.directory / run_directory.EVALUATION, evaluation)
    run_directory.write_json(run.directory / run_directory.SUMMARY, summary)
    return summary
