"""The process of the evaluation after training: it selects the best checkpoint, and lets evaluators play with it."""

import argparse
import io
import logging
import math
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.evaluation.episodes import EvaluationStoppedError
from daedalus.launch.evaluation_options import FINAL_SEEDS, EvaluationOptions, evaluated_environment
from daedalus.launch.logs import configure_logging, print_error
from daedalus.launch.match_evaluation import MatchScores, evaluated_matches
from daedalus.launch.process_lifecycle import (
    FAILED,
    UNSAVED,
    UNWRITABLE,
    exit_on_thread_exceptions,
    exit_with_parent,
    stop_on_signals,
)
from daedalus.learner.league.versions import opponent_copy
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorError, EvaluatorHost, OfferedPolicy
from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.saving.best_checkpoints import best_score, is_best, is_best_in_training, rescore
from daedalus.policy.saving.hub import HubError
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, find_policy, read_candidates
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import ModuleNotAllowedError
from daedalus.protocol.messages import EvaluationReport, Program
from daedalus.protocol.spec import Backend, RunSpec
from daedalus.protocol.texts import short_number
from daedalus.transport.connecting import listen
from daedalus.transport.interface import Transport, TransportError

_logger = logging.getLogger("daedalus.launch.final_evaluation")  # this module is __main__ in the process

_SELECTION_SEEDS = 2**33  # see FINAL_SEEDS
_FAILURES = (
    *(EnvironmentSetupError, EvaluatorError, NoPolicyError, DamagedError, HubError),
    *(ModuleNotAllowedError, PolicyError, SettingsError, TransportError),
)
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
        f"the return {short_number(training_mean)} of training is that of another task (environment.training_kwargs, "
        "environment.no_reward_limit or lessons): it cannot be compared with evaluations"
    )


def _error(evaluation: dict[str, Any]) -> float:
    return evaluation["return_std"] / math.sqrt(evaluation["episodes"])


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


def match_note(scores: MatchScores) -> str:
    """Return how the games against one opponent ended."""
    total = scores.total
    low, high = (f"{100.0 * bound:.0f}" for bound in total.win_interval)
    return (
        f"against {scores.opponent}: won {total.wins} of {total.games} games (95 % interval {low} to {high} %), drew "
        f"{total.draws}, lost {total.losses}"
    )


class FinalEpisodes:
    """The episodes after training, in the process that offers the policies to the evaluators."""

    def __init__(self, directory: Path, spec: RunSpec, transport: Transport, stop: threading.Event) -> None:
        """Construct what lets them be played.

        Args:
          directory: of a run that has been trained.
          spec: of the run.
          transport: reaches the evaluators.
          stop: ends the evaluations early.
        """
        self._directory, self._spec, self._stop = directory, spec, stop
        self._host = EvaluatorHost(run_directory.run_name(directory), transport)

    def play(
        self, policies: list[SavedPolicy], backend: Backend, seeds: int, actions: Literal["greedy", "sampled"]
    ) -> list[tuple[dict[str, Any], EvaluationReport]]:
        """Return the result and the report of each policy. Raises EvaluatorError and EvaluationStoppedError."""
        plan = EpisodePlan(
            spec=self._spec,
            environment=evaluated_environment(self._spec.environment, backend),
            spaces=policies[0].spaces,
            episodes=self._spec.evaluation.final_episodes,
            seed=self._spec.training.seed + seeds,
            actions=actions,
        )
        reports = self._host.play(plan, [_offered(each) for each in policies], lambda: not self._stop.is_set())
        if reports is None:
            raise EvaluationStoppedError
        return [
            (plan.result(policy.directory, report), report) for policy, report in zip(policies, reports, strict=True)
        ]

    def select_best(self) -> list[dict[str, Any]]:
        """Re-evaluate the candidates, save their new scores, and return the scores, the best first.

        The episodes are those of the training's backend: a selection by the score on the final backend would make that
        score the best of several.

        Returns: policy_version, return_mean and return_std of each candidate; empty if there are fewer than two.
        Raises as `play`.
        """
        finalists = read_candidates(self._directory)
        if len(finalists) < 2:
            return []
        backend, evaluation = self._spec.environment.backend, self._spec.evaluation
        text = "selecting the best of %d checkpoints: %d episodes each on %s"
        _logger.info(text, len(finalists), evaluation.final_episodes, backend)
        scores = []
        played = self.play(finalists, backend, _SELECTION_SEEDS, evaluation.actions)
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

    def play_matches(self, opponents: Sequence[str], modules: frozenset[str]) -> None:
        """Play the final games against opponents in this process, and write summary.json and evaluation.json.

        The result is that of the first opponent; notes have those of the others. Raises as `evaluate`,
        EnvironmentSetupError and HubError.
        """
        began, directory, spec = time.monotonic(), self._directory, self._spec
        policy, sides = find_policy(directory), len(spec.league.sides) or 2
        games = max(spec.evaluation.final_episodes // sides, 1) * sides
        results = []
        for name in opponents:
            copy = opponent_copy(name, directory / run_directory.LEAGUE)  # the policy that training has met
            against = str(copy) if copy.exists() else name
            options = EvaluationOptions(directory=directory, against=against, episodes=games, allowed_modules=modules)
            seed = spec.training.seed + FINAL_SEEDS
            result = evaluated_matches(policy, options, seed, self._stop, io.StringIO())
            results.append({**result, "matches": replace(result["matches"], opponent=name)})
        evaluation = {**results[0], "matches": asdict(results[0]["matches"])}
        evaluation["notes"] += [match_note(result["matches"]) for result in results[1:]]
        summary = run_directory.read_json(directory / run_directory.SUMMARY)
        seconds = time.monotonic() - began
        summary |= evaluation_summary(
            evaluation, select_best=[], seconds=seconds, summary=match_note(results[0]["matches"])
        )
        run_directory.write_json(directory / run_directory.EVALUATION, evaluation)
        run_directory.write_json(directory / run_directory.SUMMARY, summary)

    def evaluate(self) -> None:
        """Select the best checkpoint, play the final episodes with it, and write summary.json and evaluation.json.

        If greedy episodes are clearly worse than training was, the same episodes are played with sampled actions, too,
        unless the policy is greedy anyway, or sampled episodes have confirmed the target. A note says where training
        plays another task, whose returns say nothing about these. Raises as `play`, OSError, and as `find_policy`.
        """
        began, directory, spec = time.monotonic(), self._directory, self._spec
        summary = run_directory.read_json(directory / run_directory.SUMMARY)
        chosen = self.select_best()
        best, backend = [find_policy(directory)], spec.evaluation.final_backend or spec.environment.backend
        ((evaluation, report),) = self.play(best, backend, FINAL_SEEDS, spec.evaluation.actions)
        confirmed = summary.get("confirmation") is not None  # by sampled episodes
        can_differ = spec.algorithm.heads != "action_values"  # whose policy is always greedy
        true_task, trained = spec.trains_true_task, summary.get("episode_return_mean")
        if not true_task and trained is not None:
            evaluation["notes"].append(other_task_note(trained))
        if true_task and not confirmed and can_differ and is_below_training(evaluation, trained):
            ((sampled, _),) = self.play(best, backend, FINAL_SEEDS, "sampled")
            evaluation["notes"].append(sampled_note(evaluation, sampled))
            summary["sampled_evaluation"] = sampled
        summary |= evaluation_summary(evaluation, select_best=chosen, seconds=time.monotonic() - began)
        evaluation |= {"returns": report.returns.tolist(), "lengths": report.lengths.tolist()}
        run_directory.write_json(directory / run_directory.EVALUATION, evaluation)
        run_directory.write_json(directory / run_directory.SUMMARY, summary)


def _offered(policy: SavedPolicy) -> OfferedPolicy:
    return OfferedPolicy(
        policy_version=policy.policy_version, program=Program.of(policy.program), weights=policy.weights
    )


def main() -> int:
    """Run the process that offers the policies to the evaluators, and return its exit status."""
    options = argparse.ArgumentParser()
    options.add_argument("directory", type=Path)
    options.add_argument("address")
    options.add_argument("--log-level", default="info")
    options.add_argument("--log-json", action="store_true")
    options.add_argument("--exit-with-parent", action="store_true")
    options.add_argument("--against", action="append", default=[])
    options.add_argument("--allow-module", action="append", default=[])
    parsed = options.parse_args()
    configure_logging(parsed.log_level, as_json=parsed.log_json)
    stop = stop_on_signals(exit_if_stuck=True)
    exit_with_parent(stop)
    try:
        with closing(listen([parsed.address])) as transport:
            final = FinalEpisodes(parsed.directory, run_directory.read_config(parsed.directory), transport, stop)
            if parsed.against:
                final.play_matches(parsed.against, frozenset(parsed.allow_module))
            else:
                final.evaluate()
    except _FAILURES as error:
        print_error("train", error)
        return FAILED
    except EvaluationStoppedError:
        return FAILED
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        print_error("train", f"the evaluation could not be saved: {error.strerror}")
        return UNSAVED
    return 0


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(main())
