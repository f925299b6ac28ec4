"""Selection of a run's best checkpoint: the best-scored checkpoints and the newest are re-evaluated.

The highest of many scores over a few episodes is partly luck. All candidates play the same number of new episodes.
"""

import logging
import threading
from pathlib import Path
from typing import Any

from daedalus.cli.child_output import ChildOutput
from daedalus.cli.evaluation_processes import play
from daedalus.learner.run.candidates import candidates
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import short_number

_logger = logging.getLogger(__name__)

_SEEDS = 2**33  # added to the seed of the run, so that neither training nor the final evaluation uses these seeds


def select_best(
    directory: Path,
    spec: RunSpec,
    options: list[str],
    stopping: threading.Event,
    output: ChildOutput,
) -> list[dict[str, Any]]:
    """Re-evaluate the candidates, save their new scores, and return the scores, the best first.

    Args:
      directory: the run directory.
      spec: the specification of the run.
      options: options for each `daedalus evaluate`.
      stopping: ends the evaluations early when it is set.
      output: reads what the evaluations write. It shows the progress of the first one.

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
    results = play([[str(each.directory), *options] for each in finalists], stopping, output)
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
