"""The specification of a run: everything that decides what is played and how it is learned.

One frozen model per concern, checked at construction; unknown fields are errors. The learner owns the
specification and sends it whole to every actor that joins. This file does not know where it came from
(a preset, a file, the command line) nor what will be done with it.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

PositiveInt = Annotated[int, Field(ge=1)]
UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


class Specification(BaseModel):
    """Base of every specification: immutable, and strict about names it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# ---------------------------------------------------------------------------------------------- spaces


class ArraySpace(Specification):
    """Arrays of one shape and dtype (gymnasium's Box), as they travel: `float32` or `uint8`."""

    kind: Literal["array"] = "array"
    shape: tuple[PositiveInt, ...]
    dtype: Literal["float32", "uint8"]

    def __str__(self) -> str:
        return f"{self.dtype} array of shape {self.shape}"


class ChoiceSpace(Specification):
    """One of `count` choices, numbered from 0 (gymnasium's Discrete, its `start` taken away)."""

    kind: Literal["choice"] = "choice"
    count: Annotated[int, Field(ge=1, le=65_536)]

    def __str__(self) -> str:
        return f"{self.count} choices"


class Spaces(Specification):
    """What an environment shows and what it can be told; the actor finds them, the learner holds all to them."""

    observation: ArraySpace
    action: ChoiceSpace

    def __str__(self) -> str:
        return f"observation: {self.observation}; action: {self.action}"


# ------------------------------------------------------------------------------------------ the run


class EnvironmentSpec(Specification):
    """Which environment the actors play, and what is done to its rewards before learning."""

    id: Annotated[str, Field(min_length=1, max_length=200)]
    kwargs: dict[str, JsonValue] = {}
    max_episode_steps: PositiveInt | None = None
    reward_scale: Annotated[float, Field(gt=0.0)] = 1.0  # learning sees reward x scale; logs show the true return


class PolicySpec(Specification):
    """The network: an encoder, then one head for the policy and one for the value."""

    encoder: Literal["mlp"] = "mlp"
    hidden: Annotated[tuple[PositiveInt, ...], Field(min_length=1, max_length=8)] = (64, 64)
    activation: Literal["tanh", "relu"] = "tanh"


class CollectionSpec(Specification):
    """How actors gather experience."""

    actors: PositiveInt = 2  # started by `daedalus train`; a2c waits for as many before its first update
    envs_per_actor: Annotated[int, Field(ge=1, le=4096)] = 16
    rollout_length: Annotated[int, Field(ge=1, le=4096)] = 16
    window: Annotated[int, Field(ge=1, le=64)] = 2  # rollouts an actor may have unanswered at once


class TrainingSpec(Specification):
    """How the learner learns, and when it stops."""

    algorithm: Literal["a2c", "a3c", "impala"] = "impala"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    env_steps: PositiveInt = 1_000_000  # the budget
    target_return: float | None = None  # solved when the mean of the last `target_episodes` reaches it
    target_episodes: PositiveInt = 100
    stop_when_solved: bool = True

    batch_rollouts: PositiveInt | None = None  # rollouts in a batch; unset: a3c 1, impala one per actor
    max_policy_lag: Annotated[int, Field(ge=0)] = 32  # updates; older rollouts are dropped and counted

    discount_factor: UnitInterval = 0.99
    trace_lambda: UnitInterval = 1.0  # 1: n-step returns; below: lambda-returns
    rho_clip: Annotated[float, Field(gt=0.0)] = 1.0  # V-trace, impala only
    trace_clip: Annotated[float, Field(gt=0.0)] = 1.0  # V-trace's c, impala only

    value_loss: Literal["mse", "huber"] = "mse"
    value_coefficient: Annotated[float, Field(ge=0.0)] = 0.5
    entropy_bonus: Annotated[float, Field(ge=0.0)] = 0.01
    entropy_bonus_final: Annotated[float, Field(ge=0.0)] | None = None  # annealed to this over the budget
    normalize_advantages: bool = False

    optimizer: Literal["adam", "rmsprop"] = "adam"
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-3
    learning_rate_final: Annotated[float, Field(ge=0.0, le=1.0)] | None = None  # annealed to this over the budget
    optimizer_epsilon: Annotated[float, Field(gt=0.0)] = 1e-5
    rmsprop_decay: UnitInterval = 0.99
    max_gradient_norm: Annotated[float, Field(gt=0.0)] = 0.5
    threads: PositiveInt = 1  # of the learner; two that spin for a core the actors use are far slower than one


class ServiceSpec(Specification):
    """How the learner runs as a service."""

    checkpoint_seconds: Annotated[float, Field(gt=0.0)] = 60.0
    keep_checkpoints: PositiveInt = 3
    log_seconds: Annotated[float, Field(gt=0.0)] = 0.5
    queue_megabytes: Annotated[float, Field(gt=0.0)] = 64.0  # rollouts waiting to be decoded; beyond: `busy`


class RunSpec(Specification):
    """All of a run. Written complete as `config.toml`, which reproduces it."""

    environment: EnvironmentSpec
    policy: PolicySpec = PolicySpec()
    collection: CollectionSpec = CollectionSpec()
    training: TrainingSpec = TrainingSpec()
    service: ServiceSpec = ServiceSpec()

    @model_validator(mode="after")
    def _one_batch_fits_the_barrier(self) -> "RunSpec":
        if self.training.algorithm == "a2c" and self.training.batch_rollouts is not None:
            raise ValueError(
                "training.batch_rollouts has no meaning for a2c: its batch is one rollout of every live actor"
            )
        return self

    @property
    def synchronous(self) -> bool:
        """Whether actors wait for each update (a2c) or never do."""
        return self.training.algorithm == "a2c"


# ---------------------------------------------------------------------------------------------- status


class ActorStatus(Specification):
    """One actor as the learner sees it."""

    actor: str
    alive: bool
    seconds_since_seen: float
    environments: int
    rollouts_accepted: int
    rollouts_rejected: dict[str, int]
    env_steps: int
    policy_lag: int


class RunStatus(Specification):
    """The fleet as the learner sees it; the answer to a `status` query."""

    run: str
    learner_epoch: int
    algorithm: str
    environment: str
    uptime_seconds: float
    env_steps: int
    env_steps_budget: int
    updates: int
    episode_return_mean: float | None
    env_steps_per_second: float
    updates_per_second: float
    policy_lag_mean: float
    actors: tuple[ActorStatus, ...]
