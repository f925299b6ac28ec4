"""The algorithms by name: what a process must know of one to schedule its work, without any mathematics.

The learner's buffers, the actors and the command line read these records; the losses are in daedalus/algorithms. The
record of an algorithm of the user's own is an attribute of its class; ActorSpec carries what it demands to the actors,
which do not import the class.
"""

import difflib
import re
from typing import Annotated, Literal

from pydantic import Field

from daedalus.protocol.models import PositiveInt, Specification, UnitInterval

Heads = Literal["policy_and_value", "action_values", "policy"]
Epsilons = Annotated[tuple[UnitInterval, ...], Field(min_length=1, max_length=64)]


class AlgorithmError(Exception):
    """Error of an algorithm that cannot be used in a run. The message is one line."""


class ActorDemands(Specification):
    """What one algorithm demands of actors."""

    synchronous: bool = False
    """Actors wait for each update; a batch is one rollout of every live actor (a barrier)."""
    next_action: bool = False
    """Targets need the action of the next row (Sarsa), so that a rollout has at least two rows."""
    learns_overrides: bool = False
    """Overridden rows are sent with the action that was played, also where a rollout has no other rows. An actor of an
    older release does not know this field, and sends others."""


class AlgorithmRecord(ActorDemands):
    """What one algorithm needs of the network, of the actors and of the schedule of updates. Immutable."""

    summary: Annotated[str, Field(max_length=200)] = ""
    """One line for `--help`."""
    corrected: bool = False
    """Targets are corrected for policy lag (V-trace)."""
    passes_over_batch: bool = False
    """A batch makes `training.passes` x `training.minibatches` updates, not one."""
    batch_rollouts: PositiveInt | None = None
    """Rollouts in a batch where the run does not say. None: one per actor."""
    max_lag_batches: PositiveInt = 32
    """The largest policy lag where the run does not say, in batches."""
    heads: Heads = "policy_and_value"
    """`action_values`: the head computes Q(s, a) of each choice, and the policy is greedy; there is no value head.
    `policy`: there is no value head; critics stay in the learner."""
    replay: bool = False
    """Rollouts go into a replay buffer, however old their policy is; minibatches of its transitions make the updates,
    in a fixed ratio to the env_steps."""
    demonstrations: bool = False
    """The learner learns from demonstrations of a dataset, too."""
    target_network: bool = False
    """The learner keeps a second network, which `Algorithm.after_update` sets and which gradients do not change."""
    epsilons: Epsilons = (0.0,)
    """The epsilons that actors draw theirs from where `training.exploration` is unset."""
    exploration_share: UnitInterval = 0.0
    """Share of the budget in which epsilon falls from 1 where `training.exploration_env_steps` is unset."""


def _of_action_values(summary: str, *, next_action: bool = False) -> AlgorithmRecord:
    """Return the record of a method of Mnih et al. (2016) that learns action values. Section 8 has the epsilons."""
    return AlgorithmRecord(
        summary=summary,
        batch_rollouts=1,
        max_lag_batches=8,
        heads="action_values",
        target_network=True,
        next_action=next_action,
        epsilons=(0.1,) * 4 + (0.01,) * 3 + (0.5,) * 3,
        exploration_share=0.1,
    )


ALGORITHMS = {
    "a2c": AlgorithmRecord(summary="synchronous", synchronous=True),
    "a3c": AlgorithmRecord(
        summary="asynchronous, uncorrected; the paper's with --set collection.upload=gradients",
        batch_rollouts=1,
        max_lag_batches=8,  # measured: docs/study.md
    ),
    "impala": AlgorithmRecord(summary="asynchronous, corrected for policy lag", corrected=True),
    "appo": AlgorithmRecord(
        summary="asynchronous PPO: several passes over each batch", passes_over_batch=True, demonstrations=True
    ),
    "one_step_q": _of_action_values("Q-learning with one-step targets"),
    "one_step_sarsa": _of_action_values("as one_step_q, on the action that was taken next", next_action=True),
    "n_step_q": _of_action_values("Q-learning with n-step targets"),
    "sac": AlgorithmRecord(
        summary="soft actor-critic: learns from each step many times, for slow environments",
        batch_rollouts=1,
        heads="policy",
        replay=True,
        demonstrations=True,
        learns_overrides=True,
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
