"""What actors upload: rollouts, or the gradients that they computed of them.

Shapes are checked at construction, so an inconsistent upload can neither be sent nor decoded.

Time first: row t holds observation t, the action chosen from it and the reward that action earned.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from daedalus.protocol.keys import check_name
from daedalus.protocol.league import MAX_SIDES, Matches
from daedalus.protocol.lessons import MAX_LESSONS

MAX_INFO_NAMES, MAX_INFO_VALUES = 16, 256  # of Rollout.episode_info
# A float32 has no number between 16,777,216 and 16,777,218: results of episodes are exact in float64 alone.
EPISODE_DTYPES = (np.dtype(np.float64), np.dtype(np.float32))
LARGEST_EPISODE_NUMBER = float(np.finfo(np.float32).max)  # of returns and scalars: sums of their squares are finite
LARGEST_GRADIENT_NORM = 1e12  # no healthy actor comes near it, and the mean of many gradients stays finite
# Names in Gradient.metrics: the terms of the loss (algorithms/gradients.py), and the diagnostics that an algorithm
# gives of a rollout (algorithms/diagnostics.py).
LOSS_TERMS = ("policy_loss", "value_loss", "entropy", "clipped_fraction")
DIAGNOSTICS = (
    "explained_variance",
    "value_mean",
    "advantage_std",
    "behaviour_kl",
    "rho_mean",
    "rho_effective_share",
    "value_error_p05",
    "value_error_p50",
    "value_error_p95",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutIdentity:
    """Unique identity of a rollout: the learner trains on each rollout at most once."""

    actor: str
    incarnation: int
    sequence: int  # counts up from 0 within an incarnation and learner epoch
    learner_epoch: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rollout:
    """T consecutive rows of E environments under one snapshot. Actor -> learner, on `rollouts/{actor}`.

    Each frame is sent once. With a frame stack of k, the observation of row t consists of the frames t to t+k-1, where
    the first frame of an episode replaces the frames before it (protocol/frames.py); without a frame stack k is 1.
    Environments reset by gymnasium's NEXT_STEP rule: the row after the end of an episode only resets the environment.
    Its action was ignored and it is not `valid`; its observation is the final observation of the episode.

    Where somebody else than the policy chose the action that was played, such as a person or a safety filter, a row is
    `overridden`: it holds the action that the policy would have taken. It is not learned from, and the rows before it
    are bootstrapped with the value of its observation, but the episode and the memory of the policy go on. Where it
    is `taught`, too, it holds the action that was played: an algorithm that learns from demonstrations learns from it.

    Observations, actions and masks are maps of components, as in Spaces (protocol/spaces.py).
    """

    identity: RolloutIdentity
    policy_version: int  # of the behaviour policy
    frames: dict[str, np.ndarray]  # each [k-1 + T+1, E, *frame_shape], discrete ones [T+1, E, D]; the last bootstraps
    initial_state: np.ndarray  # [E, S] float32, the policy's memory at row 0; S is 0 without a memory
    actions: dict[str, np.ndarray]  # each [T, E, D]: integers, or float32 as ContinuousSpace describes
    masks: dict[str, np.ndarray]  # of the masked actions [T, E, choices] bool, True for a legal choice
    behaviour_log_probs: np.ndarray  # [T, E] float32, log mu(a_t | s_t), summed over the components of the action
    rewards: np.ndarray  # [T, E] float32, scaled and clipped for learning
    terminated: np.ndarray  # [T, E] bool, the environment ended the episode
    truncated: np.ndarray  # [T, E] bool, a limit ended the episode
    valid: np.ndarray  # [T, E] bool, False where the environment only reset
    # [K] float64, or float32: unscaled undiscounted returns of the episodes that ended in this rollout
    episode_returns: np.ndarray
    episode_lengths: np.ndarray  # [K] int32, their env_steps
    # By name [n] float64, or float32, n from 1 to K: scalars of the environment's `info` at the ends of these episodes.
    episode_info: dict[str, np.ndarray] = field(default_factory=dict)
    # Of a run with lessons, by parameter [K] float64: the values that these episodes were played with. Empty if K is 0.
    lessons: dict[str, np.ndarray] = field(default_factory=dict)
    overridden: np.ndarray | None = None  # [T, E] bool, somebody else chose the action; None: in no row
    # [T, E] bool, the overridden rows that hold the action that was played; None: none
    taught: np.ndarray | None = field(default=None, metadata={"sparse": True})
    # Env_steps of a game with several agents, at most its rows to learn from times its sides, for the opponents' steps
    # count, too; None: each row is one.
    game_steps: int | None = field(default=None, metadata={"sparse": True})
    # Of a game: how the matches ended that ended in this rollout; None: none did.
    matches: Matches | None = field(default=None, metadata={"sparse": True})

    @property
    def nbytes(self) -> int:
        """Size of the observations, actions and masks in memory, in bytes. The other arrays are small."""
        return sum(array.nbytes for part in (self.frames, self.actions, self.masks) for array in part.values())

    def __post_init__(self) -> None:
        if self.rewards.ndim != 2:
            raise ValueError(f"rewards must be [T, E], not {self.rewards.shape}")
        rows, environments = self.rewards.shape
        if rows == 0 or environments == 0:
            raise ValueError("a rollout must have at least one row and one environment")
        if not self.frames or not self.actions:
            raise ValueError("a rollout must have observations and actions")
        for name, frames in self.frames.items():
            if frames.ndim < 3 or len(frames) <= rows or frames.shape[1] != environments:
                raise ValueError(f"frames/{name} must be [{rows + 1} or more, {environments}, ...], not {frames.shape}")
        if self.initial_state.ndim != 2 or len(self.initial_state) != environments:
            raise ValueError(f"initial_state must be [{environments}, S], not {self.initial_state.shape}")
        for kind, components in (("actions", self.actions), ("masks", self.masks)):
            for name, values in components.items():
                if values.ndim != 3 or values.shape[:2] != (rows, environments):
                    raise ValueError(f"{kind}/{name} must be [{rows}, {environments}, D], not {values.shape}")
        for name, array in {"behaviour_log_probs": self.behaviour_log_probs, **self._flags}.items():
            if array.shape != (rows, environments):
                raise ValueError(f"{name} must be [{rows}, {environments}] like rewards, not {array.shape}")
        self._check_dtypes()
        _check_episodes(self)
        if self.game_steps is not None and not 0 <= self.game_steps <= self.agent_steps * MAX_SIDES:
            raise ValueError(
                f"game_steps is {self.game_steps}, of a rollout with {self.agent_steps} rows to learn from"
            )
        if len(self.episode_returns) > rows * environments:
            raise ValueError("more episodes ended than the rollout has rows")

    def _check_dtypes(self) -> None:
        masks = {f"masks/{name}": mask for name, mask in self.masks.items()}
        for name, array in (self._flags | masks).items():
            if array.dtype != np.bool_:
                raise ValueError(f"{name} must be bool, not {array.dtype}")
        for name in ("initial_state", "behaviour_log_probs", "rewards"):
            if getattr(self, name).dtype != np.float32:
                raise ValueError(f"{name} must be float32, not {getattr(self, name).dtype}")
        for name, actions in self.actions.items():
            if actions.dtype != np.float32 and actions.dtype.kind not in "iu":
                raise ValueError(f"actions/{name} must be float32 or integers, not {actions.dtype}")

    @property
    def _flags(self) -> dict[str, np.ndarray]:
        flags = {"terminated": self.terminated, "truncated": self.truncated, "valid": self.valid}
        others = {"overridden": self.overridden, "taught": self.taught}
        return flags | {name: values for name, values in others.items() if values is not None}

    @property
    def rows(self) -> int:
        """T, the number of rows."""
        return self.rewards.shape[0]

    @property
    def environments(self) -> int:
        """E, the number of environments."""
        return self.rewards.shape[1]

    @property
    def learned(self) -> np.ndarray:
        """Rows to learn from [T, E] bool: valid, and not overridden."""
        return self.valid if self.overridden is None else self.valid & ~self.overridden

    @property
    def agent_steps(self) -> int:
        """Number of rows to learn from, over all environments or seats."""
        return int(np.count_nonzero(self.learned))

    @property
    def env_steps(self) -> int:
        """Steps of the environments: the rows to learn from, unless several agents act in one step of a game."""
        return self.agent_steps if self.game_steps is None else self.game_steps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gradient:
    """Gradient of one rollout at the weights that played it. Actor -> learner, on `rollouts/{actor}`.

    Actors send it in place of the rollout if `collection.upload` is `gradients`. With it come the results that the
    learner would compute from the rows.
    """

    identity: RolloutIdentity  # of the rollout
    policy_version: int  # of the weights
    # By parameter that has a gradient: float32 [*shape], or the planes of its bfloat16 (protocol/compact.py), uint8
    # [2, *shape]. The mean over the valid rows; not clipped.
    gradient: dict[str, np.ndarray]
    env_steps: int  # of the rollout: its rows to learn from
    metrics: dict[str, np.ndarray]  # each of LOSS_TERMS, and those of DIAGNOSTICS that are known: float32 scalars []
    # Mean and sum of squared deviations over the valid rows, float64 [2, *shape]: `observations/NAME` of each component
    # that is normalised, and `returns` of the discounted returns if rewards are normalised.
    moments: dict[str, np.ndarray]
    action_counts: dict[str, np.ndarray]  # of each discrete component [choices] int64
    episode_returns: np.ndarray  # as in Rollout, like the next two
    episode_lengths: np.ndarray
    episode_info: dict[str, np.ndarray] = field(default_factory=dict)
    lessons: dict[str, np.ndarray] = field(default_factory=dict)  # as in Rollout

    @property
    def nbytes(self) -> int:
        """Size of the gradient in memory, in bytes. The other arrays are small."""
        return sum(array.nbytes for array in self.gradient.values())

    def __post_init__(self) -> None:
        if not self.gradient:
            raise ValueError("a gradient must have parameters")
        for name, values in self.gradient.items():
            planes = values.dtype == np.uint8 and values.ndim > 0 and len(values) == 2
            if values.dtype != np.float32 and not planes:
                raise ValueError(f"gradient/{name} must be float32 or uint8 [2, ...], not {values.dtype}")
        for name, values in self.metrics.items():
            if values.shape or values.dtype != np.float32:
                raise ValueError(f"metrics/{name} must be float32 [], not {values.dtype} {values.shape}")
        for name, values in self.moments.items():
            if values.dtype != np.float64 or values.ndim < 1 or len(values) != 2:
                raise ValueError(f"moments/{name} must be float64 [2, ...], not {values.dtype} {values.shape}")
        for name, values in self.action_counts.items():
            if values.dtype != np.int64 or values.ndim != 1:
                raise ValueError(f"action_counts/{name} must be int64 [choices], not {values.dtype} {values.shape}")
        _check_episodes(self)

    @property
    def agent_steps(self) -> int:
        """Number of rows to learn from of its rollout: no game has gradients."""
        return self.env_steps

    @property
    def norm(self) -> float:
        """Norm of a float32 gradient; nan or inf if a value is not finite, and inf above 1e19."""
        flat = (values.ravel() for values in self.gradient.values())
        # Not with @: BLAS shares a product of vectors among threads, which then wait in a loop for the next one. That
        # took half of the learner's CPU time with gradients of the Nature network.
        with np.errstate(over="ignore"):
            return math.sqrt(sum(float(np.einsum("i,i->", values, values)) for values in flat))


Upload = Rollout | Gradient


def mean_return(returns: Sequence[float] | np.ndarray) -> float:
    """Return the mean of at least one return in float64: of equal ones exactly theirs, which a target may be."""
    values = np.asarray(returns, np.float64)
    rounded = values.mean()
    return float(rounded + (values - rounded).mean())


def _check_episodes(upload: Upload) -> None:
    """Raise ValueError if the results of episodes are inconsistent."""
    returns, lengths = upload.episode_returns, upload.episode_lengths
    if returns.ndim != 1 or returns.shape != lengths.shape:
        raise ValueError("episode_returns and episode_lengths must both be [K]")
    if returns.dtype not in EPISODE_DTYPES:
        raise ValueError(f"episode_returns must be float64 or float32, not {returns.dtype}")
    if lengths.dtype.kind not in "iu":
        raise ValueError("episode_lengths must be integers")
    if len(upload.episode_info) > MAX_INFO_NAMES:
        raise ValueError(f"episode_info has {len(upload.episode_info)} names, at most {MAX_INFO_NAMES} are allowed")
    most = min(len(returns), MAX_INFO_VALUES)
    for name, values in upload.episode_info.items():
        check_name(name, "the name in episode_info")
        if values.ndim != 1 or values.dtype not in EPISODE_DTYPES or not 1 <= len(values) <= most:
            raise ValueError(
                f"episode_info {name!r} must be float64 or float32 [n], with n from 1 to {most}, "
                f"not {values.dtype} {values.shape}"
            )
    if len(upload.lessons) > MAX_LESSONS:
        raise ValueError(f"lessons has {len(upload.lessons)} names, at most {MAX_LESSONS} are allowed")
    for name, values in upload.lessons.items():
        check_name(name, "the name in lessons")
        if values.shape != returns.shape or values.dtype != np.float64:
            raise ValueError(
                f"lessons {name!r} must be float64 [{len(returns)}], one value for each episode, "
                f"not {values.dtype} {values.shape}"
            )
