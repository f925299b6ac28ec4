"""The evaluation after training: selection of the best checkpoint, then the final episodes, played by evaluators."""

import logging
import math
import os
import threading
import time
from functools import partial
from typing import Any, Literal

import numpy as np

from daedalus.launch.child_output import ChildOutput
from daedalus.launch.local_run import LocalRun, helper_log_words
from daedalus.launch.supervision import private_evaluators
from daedalus.learner.run import run_directory
from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorError, OfferedPolicy, play
from daedalus.policy.saving.best_checkpoints import best_score, is_best, is_best_in_training, rescore
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, candidates, find_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.messages import EvaluationReport, Program
from daedalus.protocol.spec import Backend, EnvironmentSpec
from daedalus.protocol.texts import short_number
from daedalus.transport.interface import TransportError

_logger = logging.getLogger(__name__)

# Added to the seed of the run, so that neither training nor another evaluation uses these seeds.
_FINAL_SEEDS, _SELECTION_SEEDS = 2**32, 2**33
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


class EvaluationFailedError(Exception):
    """Error of an evaluation that failed, with the reason, or was stopped, without one."""


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


class FinalEpisodes:
    """The episodes after training, played by evaluators."""

    def __init__(self, run: LocalRun, stopping: threading.Event, output: ChildOutput) -> None:
        """Construct what plays the episodes.

        Args:
          run: which has been trained.
          stopping: ends the evaluations early when it is set.
          output: reads what the evaluators print. It shows the progress of the first one.
        """
        self._run, self._stopping, self._output = run, stopping, output

    def play(
        self, policies: list[SavedPolicy], backend: Backend, seed: int, actions: Literal["greedy", "sampled"]
    ) -> list[tuple[dict[str, Any], EvaluationReport]]:
        """Return the result and the report of each policy. Raises EvaluationFailedError."""
        run, environment = self._run, _environment(self._run.spec.environment, backend)
        plan = EpisodePlan(
            run=run_directory.run_name(run.directory),
            spec=run.spec,
            environment=environment,
            spaces=policies[0].spaces,
            episodes=run.spec.evaluation.final_episodes,
            seed=run.spec.training.seed + seed,
            actions=actions,
        )
        names = [f"evaluation-{number}" for number in range(min(len(policies), os.cpu_count() or 1))]
        options = *helper_log_words(run.logs), *allow_settings(environment.user_modules)
        start = partial(private_evaluators, names, options, self._output)
        try:
            reports = play(plan, [_offered(each) for each in policies], start, lambda: not self._stopping.is_set())
        except (EvaluatorError, TransportError) as error:
            raise EvaluationFailedError(str(error)) from None
        if reports is None:
            raise EvaluationFailedError
        return [
            (plan.result(policy.directory, report), report) for policy, report in zip(policies, reports, strict=True)
        ]

    def select_best(self) -> list[dict[str, Any]]:
        """Re-evaluate the candidates, save their new scores, and return the scores, the best first.

        The episodes are those of the training's backend: a selection by the score on the final backend would make that
        score the best of several.

        Returns: policy_version, return_mean and return_std of each candidate; empty if there are fewer than two.
        Raises EvaluationFailedError.
        """
        run, finalists = self._run, candidates(self._run.directory)
        if len(finalists) < 2:
            return []
        backend, episodes = run.spec.environment.backend, run.spec.evaluation.final_episodes
        text = "selecting the best of %d checkpoints: %d episodes each on %s"
        _logger.info(text, len(finalists), episodes, backend)
        played = self.play(finalists, backend, _SELECTION_SEEDS, run.spec.evaluation.actions)
        scores = []
        for policy, (result, _) in zip(finalists, played, strict=True):
            version, mean, std = policy.policy_version, result["return_mean"], result["return_std"]
            before = ""
            if is_best(policy.directory):
                when = "in training" if is_best_in_training(policy.directory) else "before"
                before = f" ({short_number(best_score(policy.directory))} {when})"
            _logger.info("  policy version %d: %s +- %s%s", version, short_number(mean), short_number(std), before)
            try:
                rescore(policy.directory, mean, version)
            except OSError as error:
                reason = error.strerror or error
                _logger.warning("  the score of policy version %d could not be saved: %s", version, reason)
            scores.append({"policy_version": version, "return_mean": mean, "return_std": std})
        return sorted(scores, key=lambda each: each["return_mean"], reverse=True)


def _environment(trained: EnvironmentSpec, backend: Backend) -> EnvironmentSpec:
    """Return the environment to play."""
    if backend == trained.backend:
        return trained.as_evaluated()
    from daedalus.launch.evaluation import evaluated_environment  # imports gymnasium, which this process seldom needs

    return evaluated_environment(trained, backend)


def _offered(policy: SavedPolicy) -> OfferedPolicy:
    from daedalus.policy.acting.runtime import program_hash  # imports onnxruntime

    program = Program(hash=program_hash(policy.program), model=np.frombuffer(policy.program, np.uint8))
    return OfferedPolicy(policy_version=policy.policy_version, program=program, weights=policy.weights)


def evaluate_run(run: LocalRun, stopping: threading.Event, output: ChildOutput) -> dict[str, Any]:
    """Select the best checkpoint, play the final episodes with it, and return the summary with the results.

    If greedy episodes are clearly worse than training was, the same episodes are played with sampled actions, too,
    unless the policy is greedy anyway, or sampled episodes have confirmed the target. A note says where training
    plays another task, whose returns say nothing about these. Raises EvaluationFailedError.
    """
    began = time.monotonic()
    summary = run_directory.read_json(run.directory / run_directory.SUMMARY)
    episodes, backend = FinalEpisodes(run, stopping, output), run.spec.evaluation.final_backend
    backend = backend or run.spec.environment.backend
    chosen = episodes.select_best()
    try:
        best = [find_policy(run.directory)]
    except (NoPolicyError, DamagedError) as error:
        raise EvaluationFailedError(str(error)) from None
    ((evaluation, report),) = episodes.play(best, backend, _FINAL_SEEDS, run.spec.evaluation.actions)
    confirmed = summary.get("confirmation") is not None  # by sampled episodes
    can_differ = run.spec.algorithm.heads == "policy_and_value"  # the policy of action values is always greedy
    true_task = run.spec.environment.trains_true_task
    if not true_task and summary.get("episode_return_mean") is not None:
        evaluation["notes"].append(other_task_note(summary["episode_return_mean"]))
    if true_task and not confirmed and can_differ and is_below_training(evaluation, summary.get("episode_return_mean")):
        ((sampled, _),) = episodes.play(best, backend, _FINAL_SEEDS, "sampled")
        evaluation["notes"].append(sampled_note(evaluation, sampled))
        summary["sampled_evaluation"] = sampled
    summary |= evaluation_summary(evaluation, select_best=chosen, seconds=time.monotonic() - began)
    evaluation |= {"returns": report.returns.tolist(), "lengths": report.lengths.tolist()}
    run_directory.write_json(run.directory / run_directory.EVALUATION, evaluation)
    run_directory.write_json(run.directory / run_directory.SUMMARY, summary)
    return summary
