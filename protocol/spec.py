"""The specification of a run: everything that decides what is played and how it is learned.

One frozen model per concern, checked at construction; unknown fields are errors. The learner owns the
specification and sends it whole to every actor that joins. This file does not know where it came from
(a preset, a file, the command line) nor what will be done with it.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, JsonValue, model_validator

from daedalus.protocol.algorithms import ALGORITHMS, Algorithm, check_algorithm
from daedalus.protocol.specification import NaturalInt, PositiveInt, Specification, UnitInterval

Backend = Literal["gymnasium", "envpool", "ale", "fast"]  # fast: CarRacing-v3 with a cheaper renderer


class EnvironmentSpec(Specification):
    """Which environment the actors play, and what they do to its pixels, actions and rewards.

    The transforms apply in the order in which they stand here. A step of the result is one env_step, however many of
    the environment's own steps (frames) it repeats its action for.
    """

    id: Annotated[str, Field(min_length=1, max_length=200)]
    backend: Backend = "gymnasium"  # whose implementation of it
    kwargs: dict[str, JsonValue] = Field(default_factory=dict)
    processes: bool = False  # on gymnasium's backend: each in a process of its own, where the environment is slow
    max_episode_steps: PositiveInt | None = None  # in the environment's own steps

    action_table: Annotated[tuple[tuple[float, ...], ...], Field(min_length=2, max_length=65_536)] | None = None
    action_repeat: Annotated[int, Field(ge=1, le=64)] = 1
    no_reward_limit: PositiveInt | None = None  # an episode is cut after so many env_steps without a positive reward

    crop: tuple[NaturalInt, NaturalInt, NaturalInt, NaturalInt] | None = None  # pixels off top, bottom, left, right
    grey: bool = False
    resize: tuple[PositiveInt, PositiveInt] | None = None  # to height, width: the mean of what each pixel covers
    frame_stack: Annotated[int, Field(ge=1, le=16)] = 1

    # Learning sees these rewards and ends; logs and evaluations show the true ones.
    reward_clip: Annotated[float, Field(gt=0.0)] | None = None  # to +- this
    reward_scale: Annotated[float, Field(gt=0.0)] = 1.0
    bootstrap_terminations: bool = False  # at terminations, as if they were truncations

    def as_evaluated(self, backend: Backend | None = None) -> "EnvironmentSpec":
        """The same environment for a score: episodes are played to their true end, on another backend if named."""
        return self.model_copy(update={"no_reward_limit": None, "backend": backend or self.backend})


class PolicySpec(Specification):
    """The network: an encoder, a memory if it has one, then a head for the policy and one for the value."""

    encoder: Annotated[str, Field(pattern=r"^(mlp|small|nature|impala|article|[\w.]+:\w+)$", max_length=200)] = "mlp"
    hidden: Annotated[tuple[PositiveInt, ...], Field(max_length=8)] = (64, 64)  # of the mlp
    activation: Literal["tanh", "relu"] = "tanh"  # of the mlp
    memory: Literal["none", "gru"] = "none"
    memory_units: Annotated[int, Field(ge=1, le=4096)] = 256


class CollectionSpec(Specification):
    """How actors gather experience."""

    actors: PositiveInt = 2  # started by `daedalus train`; a2c waits for as many before its first update
    envs_per_actor: Annotated[int, Field(ge=1, le=4096)] = 16
    rollout_length: Annotated[int, Field(ge=1, le=4096)] = 16
    window: Annotated[int, Field(ge=1, le=64)] = 2  # an actor's rollouts that are being played or not yet taken in


class TrainingSpec(Specification):
    """How the learner learns, and when it stops."""

    algorithm: Annotated[str, AfterValidator(check_algorithm)] = "impala"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    env_steps: PositiveInt = 1_000_000  # the budget
    target_return: float | None = None  # solved when the mean of the last `target_episodes` reaches it
    target_episodes: PositiveInt = 100
    stop_when_solved: bool = True

    batch_rollouts: PositiveInt | None = None  # rollouts in a batch; unset: a3c 1, impala and appo one per actor
    max_policy_lag: NaturalInt | None = None  # updates; older rollouts are dropped and counted; unset: 32 batches

    discount_factor: UnitInterval = 0.99
    trace_lambda: UnitInterval = 1.0  # 1: n-step returns; below: lambda-returns
    rho_clip: Annotated[float, Field(gt=0.0)] = 1.0  # V-trace: impala and appo
    trace_clip: Annotated[float, Field(gt=0.0)] = 1.0  # V-trace's c: impala and appo
    passes: Annotated[int, Field(ge=1, le=64)] = 3  # over each batch, appo only
    minibatches: Annotated[int, Field(ge=1, le=4096)] = 4  # that a batch is shuffled into, one update each; appo only
    clip_range: Annotated[float, Field(gt=0.0)] = 0.2  # of the probability ratio, appo only

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

    device: Literal["cpu", "cuda"] = "cpu"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"  # of convolutions; auto: bfloat16 where it is faster
    threads: PositiveInt = 1  # of the learner; two that spin for a core the actors use are far slower than one

    @property
    def updates_per_batch(self) -> int:
        """How many policy versions one batch makes."""
        return self.passes * self.minibatches if ALGORITHMS[self.algorithm].passes_over_batch else 1

    @property
    def policy_lag_bound(self) -> int:
        """The largest policy lag that is learned from, in updates."""
        return 32 * self.updates_per_batch if self.max_policy_lag is None else self.max_policy_lag


class EvaluationSpec(Specification):
    """The evaluator that `daedalus train` keeps beside the actors: episodes that training never sees."""

    seconds: Annotated[float, Field(gt=0.0)] | None = None  # from one evaluation's start to the next's; unset: none
    episodes: Annotated[int, Field(ge=1, le=10_000)] = 10
    actions: Literal["greedy", "sampled"] = "greedy"  # the most probable, or as in training
    final_episodes: Annotated[int, Field(ge=1, le=10_000)] = 100  # with the best policy, once training has ended
    final_backend: Backend | None = None  # unset: the one that was trained on


class ServiceSpec(Specification):
    """How the learner runs as a service."""

    checkpoint_seconds: Annotated[float, Field(gt=0.0)] = 60.0
    keep_checkpoints: PositiveInt = 3
    log_seconds: Annotated[float, Field(gt=0.0)] = 0.5
    queue_megabytes: Annotated[float, Field(gt=0.0)] = 64.0  # rollouts waiting to be decoded; beyond: `busy`

    @property
    def queue_bytes(self) -> int:
        """What the rollouts that wait to be decoded may hold together."""
        return int(self.queue_megabytes * 2**20)


class RunSpec(Specification):
    """All of a run. Written complete as `config.toml`, which reproduces it."""

    environment: EnvironmentSpec
    policy: PolicySpec = PolicySpec()
    collection: CollectionSpec = CollectionSpec()
    training: TrainingSpec = TrainingSpec()
    evaluation: EvaluationSpec = EvaluationSpec()
    service: ServiceSpec = ServiceSpec()

    @model_validator(mode="after")
    def _one_batch_fits_the_barrier(self) -> "RunSpec":
        if self.algorithm.synchronous and self.training.batch_rollouts is not None:
            raise ValueError(
                f"training.batch_rollouts has no meaning for {self.algorithm.name}: "
                "its batch is one rollout of every live actor"
            )
        return self

    @model_validator(mode="after")
    def _stack_fits_the_rollout(self) -> "RunSpec":
        stack, rows = self.environment.frame_stack, self.collection.rollout_length
        if stack > rows:
            raise ValueError(
                f"environment.frame_stack is {stack}, longer than a rollout: "
                f"collection.rollout_length is {rows}, make it at least {stack}"
            )
        return self

    @property
    def algorithm(self) -> Algorithm:
        """How the run's updates are scheduled."""
        return ALGORITHMS[self.training.algorithm]

    @property
    def batch_rollouts(self) -> int:
        """How many rollouts make a batch where no barrier decides it."""
        return self.training.batch_rollouts or self.algorithm.batch_rollouts or self.collection.actors
