"""The algorithms by name: what a process must know of one to schedule its work, without any mathematics.

The learner's buffers, the actors and the command line read these records; the losses are in daedalus/algorithms.
"""

import difflib
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmRecord:
    """The schedule of one algorithm's updates.

    Attributes:
      name: as in `training.algorithm`.
      summary: one line for `--help`.
      synchronous: actors wait for each update; a batch is one rollout of every live actor (a barrier).
      corrected: targets are corrected for policy lag (V-trace).
      passes_over_batch: a batch makes `training.passes` x `training.minibatches` updates, not one.
      batch_rollouts: rollouts in a batch where the run does not say; None: one per actor.
    """

    name: str
    summary: str
    synchronous: bool = False
    corrected: bool = False
    passes_over_batch: bool = False
    batch_rollouts: int | None = None


ALGORITHMS = {
    algorithm.name: algorithm
    for algorithm in (
        AlgorithmRecord(name="a2c", summary="synchronous", synchronous=True),
        AlgorithmRecord(
            name="a3c", summary="asynchronous, uncorrected: not the paper's, see docs/concepts.md", batch_rollouts=1
        ),
        AlgorithmRecord(name="impala", summary="asynchronous, corrected for policy lag", corrected=True),
        AlgorithmRecord(
            name="appo", summary="as impala, several passes over each batch", corrected=True, passes_over_batch=True
        ),
    )
}


def check_algorithm(name: str) -> str:
    """Return `name` if there is such an algorithm. Raises ValueError, naming all of them, if not."""
    if name not in ALGORITHMS:
        near = difflib.get_close_matches(name, ALGORITHMS, 1, 0.5)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise ValueError(f"must be one of {', '.join(ALGORITHMS)}{hint}")
    return name
