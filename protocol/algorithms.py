"""The algorithms by name: what a process must know of one to schedule its work, without any mathematics.

The learner's buffers, the actors and the command line read these records; the losses are in daedalus/algorithms. The
record of an algorithm of the user's own is an attribute of its class; the specification of the run carries it to the
actors, which do not import the class.
"""

import difflib
import re
from typing import Annotated

from pydantic import Field

from daedalus.protocol.specification import PositiveInt, Specification


class AlgorithmRecord(Specification):
    """The schedule of one algorithm's updates. Immutable."""

    summary: Annotated[str, Field(max_length=200)] = ""
    """One line for `--help`."""
    synchronous: bool = False
    """Actors wait for each update; a batch is one rollout of every live actor (a barrier)."""
    corrected: bool = False
    """Targets are corrected for policy lag (V-trace)."""
    passes_over_batch: bool = False
    """A batch makes `training.passes` x `training.minibatches` updates, not one."""
    batch_rollouts: PositiveInt | None = None
    """Rollouts in a batch where the run does not say. None: one per actor."""
    max_lag_batches: PositiveInt = 32
    """The largest policy lag where the run does not say, in batches."""


ALGORITHMS = {
    "a2c": AlgorithmRecord(summary="synchronous", synchronous=True),
    "a3c": AlgorithmRecord(
        summary="asynchronous, uncorrected; the paper's with --set collection.upload=gradients",
        batch_rollouts=1,
        max_lag_batches=8,  # measured: docs/results.md
    ),
    "impala": AlgorithmRecord(summary="asynchronous, corrected for policy lag", corrected=True),
    "appo": AlgorithmRecord(
        summary="as impala, several passes over each batch", corrected=True, passes_over_batch=True
    ),
}
_OWN = re.compile(r"\w+(\.\w+)*:\w+")  # module:Class


def is_own(name: str) -> bool:
    """Return whether an algorithm is the user's own, named as `module:Class`."""
    return _OWN.fullmatch(name) is not None


def check_algorithm(name: str) -> str:
    """Return `name` if it is an algorithm or `module:Class`. Raises ValueError, which names all algorithms, if not."""
    if name not in ALGORITHMS and not is_own(name):
        near = difflib.get_close_matches(name, ALGORITHMS, 1, 0.5)
        hint = f" (did you mean {near[0]}?)" if near else ", or module:Class for your own"
        raise ValueError(f"must be one of {', '.join(ALGORITHMS)}{hint}")
    return name
