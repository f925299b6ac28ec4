"""Sampled episodes after greedy ones that were worse than training: greedy actions may go in circles."""

import math
from typing import Any

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
