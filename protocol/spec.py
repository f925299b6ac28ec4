"""Specification of a run: every setting of the environment, the policy, the training and the service.

One frozen model per concern, checked at construction; unknown fields are errors. The learner owns the
specification and sends ActorSpec, the part that actors need, to every actor that joins. The docstring below a field is
its description in the reference of all settings. This file does not know where a specification comes from (a preset, a
file, the command line) or how it is used.
"""

import copy
import math
import re
from typing import Annotated, Any, Literal, TypeVar

import msgpack
from pydantic import AfterValidator, Field, JsonValue, ValidationError, model_validator

from daedalus.protocol.algorithms import ALGORITHMS, ActorDemands, AlgorithmRecord, Epsilons, check_algorithm, is_own
from daedalus.protocol.lessons import MAX_LESSONS, Lessons, Number, ParameterName, check_lessons
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.models import (
    NaturalInt,
    PositiveInt,
    Specification,
    UnitInterval,
    changed_fields,
    has_field,
)
from daedalus.protocol.releases import REPLACED_SETTINGS
from daedalus.protocol.spaces import ComponentName
from daedalus.protocol.texts import bounded_text, exact_number

Backend = Literal["gymnasium", "envpool", "ale", "fast", "pettingzoo"]
GAME_PACKAGES = ("pettingzoo", "mpe2")  # whose modules are games with several agents
FrameStackSize = Annotated[int, Field(ge=1, le=16)]
Surrogate = Literal["clip", "spo"]
Codes = Annotated[tuple[Annotated[int, Field(ge=1, le=256)], ...], Field(min_length=1, max_length=256)]
_OBJECT = r"\w+(\.\w+)*:\w+"  # module:name
_Part = TypeVar("_Part", bound=Specification)
_MAX_BYTES = LEARNER_LIMITS.max_header_bytes - (8 << 10)  # the rest of a Welcome, and the names of the settings


_ANY_LAG = 2**62  # more updates than any run makes
_PAST_SHARE = 0.2  # of the matches, if it is not set
_WITH_PARAMETERS = ("gymnasium", "fast")  # backends
FROM_PYTHON = "python:"  # beginning of the id of an environment that only the program has which started the run


# A requirement that may stand in a command: name, extras and version, without characters of any shell.
_REQUIREMENT = r"^[A-Za-z0-9][A-Za-z0-9._-]*(\[[A-Za-z0-9._-]+(,[A-Za-z0-9._-]+)*\])?==[0-9][A-Za-z0-9.+_-]*$"
_MOST_REQUIREMENT = 100  # characters
# Settings that tell people something, or that ask for more than an actor needs: one that does not know them plays on.
_NOT_NEEDED = frozenset({"environment.package", "algorithm.learns_overrides"})


def is_requirement(text: str) -> bool:
    """Return whether a text has the form `name==version` or `name[extra]==version`, as `environment.package`."""
    return len(text) <= _MOST_REQUIREMENT and re.fullmatch(_REQUIREMENT[1:-1], text) is not None


def _check_environment_id(value: str) -> str:
    # It may come from a peer, and messages show it and suggest its module.
    module, colon, name = value.rpartition(":")
    if not value.isprintable() or not name or (colon and re.fullmatch(r"\w+(\.\w+)*", module) is None):
        raise ValueError("must be an id, or module:Id for your own")
    return value


class EnvironmentSpec(Specification):
    """Environment that the actors play, and the transforms of its pixels, actions and rewards.

    The transforms apply in the order of the fields. One step of the result is one env_step, however many of the
    environment's own steps (frames) its action is repeated for.
    """

    id: Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_check_environment_id)]
    """Environment to play: a gymnasium id, `module:Id` or `module:Class` for your own, or the backend's own name.
    `python:NAME` is an object that a Python program gave to `daedalus.train`, and that no module has. A game with
    several agents: its module, such as `pettingzoo.classic.connect_four_v3`, or `module:function` for your own."""
    package: Annotated[str, Field(pattern=_REQUIREMENT, max_length=_MOST_REQUIREMENT)] | None = None
    """Python package that has the environment, as `name==version` or `name[extra]==version`: what an actor without it
    names in its error, and an actor with another version in a warning. It is never installed. Unset: recorded when the
    run starts, if an installed package of the module's name has the environment."""
    backend: Backend = "gymnasium"
    """Implementation of the environment. `fast` is gymnasium's CarRacing-v3 with a cheaper renderer; `pettingzoo` plays
    games with several agents, and is chosen for its modules."""
    agents: Annotated[tuple[Annotated[str, Field(max_length=64)], ...], Field(max_length=1024)] = ()
    """Agents of a game that the policy plays; others take random actions. Unset: all, if their spaces are the same."""
    agent_ids: bool = False
    """Let the policy observe which agent of a game it plays, as a component `agent`."""
    kwargs: dict[str, JsonValue] = Field(default_factory=dict)
    """Further arguments of the environment's constructor."""
    training_kwargs: dict[str, JsonValue] = Field(default_factory=dict)
    """The same in training only, such as those of a shaped reward or of an easier task. Evaluations go without them."""
    parameters: Annotated[dict[ParameterName, Number], Field(max_length=4 * MAX_LESSONS)] = Field(default_factory=dict)
    """Numbers that every episode of the true task begins with, by name: arguments of the environment's method
    `set_parameters`, or without it options of its `reset`. `[lessons]` vary them in training. All numbers that lessons
    draw for one are whole if it is written without a point. The gymnasium backend only."""
    processes: bool = False
    """Run each environment in its own process, for slow environments. The gymnasium backend only."""
    max_episode_steps: PositiveInt | None = None
    """Truncate episodes after this many of the environment's own steps. Unset: the environment's own limit."""
    wrap: Annotated[str, Field(pattern=rf"^{_OBJECT}$", max_length=200)] | None = None
    """`module:function` of your own that takes each environment and returns the one to play. Gymnasium backend only."""

    action_table: Annotated[tuple[tuple[float, ...], ...], Field(min_length=2, max_length=65_536)] | None = None
    """Discrete actions over a continuous action space: one row for each choice, the values of one action."""
    action_table_columns: Annotated[tuple[NaturalInt, ...], Field(min_length=1, max_length=4096)] | None = None
    """Which numbers of an action the rows of `action_table` give, from 0. The others stay continuous. Unset: all."""
    action_repeat: Annotated[int, Field(ge=1, le=64)] = 1
    """Take each action this many times and sum the rewards; together they are one env_step. It ends early with the
    episode, and where a mask of illegal actions forbids the action."""
    no_reward_limit: PositiveInt | None = None
    """End an episode after this many env_steps in a row without a positive reward. Learning takes the value after it as
    0, also with `bootstrap_terminations`. Not in evaluations."""

    leave_out: Annotated[tuple[ComponentName, ...], Field(max_length=64)] = ()
    """Components of the observation that the policy does not see, such as a text: `leave_out = ["mission"]`."""
    crop: tuple[NaturalInt, NaturalInt, NaturalInt, NaturalInt] | None = None
    """Pixels to remove at the top, bottom, left and right."""
    grey: bool = False
    """Convert RGB frames to greyscale; the colour axis is removed."""
    resize: tuple[PositiveInt, PositiveInt] | None = None
    """Resize frames to (height, width); each pixel is the mean of the area that it covers."""
    frame_stack: FrameStackSize | dict[ComponentName, FrameStackSize] = 1
    """Number of newest frames that the policy sees, stacked on a new first axis if more than one. For observations of
    several components, a table by name; one number stands for all images, or for all arrays if there are no images."""

    # Learning uses these rewards and terminations; logs and evaluations show the true ones.
    reward_clip: Annotated[float, Field(gt=0.0)] | None = None
    """Clip the rewards that learning uses to +- this value, before `reward_scale`."""
    reward_scale: Annotated[float, Field(gt=0.0)] = 1.0
    """Multiply the rewards that learning uses by this value."""
    bootstrap_terminations: bool = False
    """Bootstrap at the environment's terminations as if they were truncations."""

    @model_validator(mode="before")
    @classmethod
    def _choose_backend(cls, values: Any) -> Any:
        if isinstance(values, dict) and "backend" not in values:
            name = values.get("id")
            if isinstance(name, str) and name.startswith(tuple(f"{package}." for package in GAME_PACKAGES)):
                return {**values, "backend": "pettingzoo"}
        return values

    @model_validator(mode="after")
    def _games_have_no_wrappers(self) -> "EnvironmentSpec":
        names = ("agents", "agent_ids")
        if self.is_game:
            names = ("wrap", "processes", "max_episode_steps", "action_repeat", "no_reward_limit")
            if self.is_from_python:
                raise ValueError(
                    f"environment.backend=pettingzoo needs a game of a module, and no module has {self.id}: move it to "
                    "a module, a file of its own, and pass its class or function"
                )
        for name in names:
            if getattr(self, name) != type(self).model_fields[name].default:
                kind = "is for games with several agents" if not self.is_game else "does not apply to games"
                raise ValueError(f"environment.{name} {kind} (environment.backend=pettingzoo): leave it unset")
        return self

    @property
    def is_game(self) -> bool:
        """Whether several agents may play in one environment, each with rows of its own."""
        return self.backend == "pettingzoo"

    @property
    def remedy_of_endless(self) -> str:
        """What to do about episodes that do not end."""
        remedy = "truncate its agents in the game" if self.is_game else "set environment.max_episode_steps"
        return f"if the environment never ends them, {remedy}"

    @property
    def constructor_kwargs(self) -> dict[str, JsonValue]:
        """Arguments of an environment's constructor: `kwargs` and `training_kwargs`.

        They are a copy: an environment may change a map or a list in place, which the next one must not see.
        """
        return copy.deepcopy({**self.kwargs, **self.training_kwargs})

    @property
    def user_modules(self) -> dict[str, str]:
        """Settings that name a module as `module:name`, with their values."""
        named = {"environment.id": None if self.is_from_python else self.id, "environment.wrap": self.wrap}
        return {setting: value for setting, value in named.items() if value is not None and ":" in value}

    @property
    def is_from_python(self) -> bool:
        """Whether only the Python program that started the run has the environment."""
        return self.id.startswith(FROM_PYTHON)

    @property
    def trains_true_task(self) -> bool:
        """Whether training plays the task of evaluations, so that the returns of both can be compared."""
        return self.model_copy(update={"kwargs": self.constructor_kwargs, "training_kwargs": {}}) == self.as_evaluated()

    def as_evaluated(self, backend: Backend | None = None) -> "EnvironmentSpec":
        """Return the environment for evaluations: the true task, on another backend if one is named."""
        true_task = {"training_kwargs": {}, "no_reward_limit": None}
        return self.model_copy(update={**true_task, "backend": backend or self.backend})


class PolicySpec(Specification):
    """Network: an encoder, an optional memory, then a policy head and a value head."""

    encoder: Annotated[
        str, Field(pattern=rf"^(auto|mlp|grid|small|nature|impala|article|{_OBJECT})$", max_length=200)
    ] = "auto"
    """Encoder of observations: `mlp`, `grid`, `small`, `nature`, `impala`, `article`, or `module:Class` for your own.
    `grid`: the `mlp` with a convolution before it, for small maps (height, width, planes). `auto`: `nature` for images,
    `impala` for images smaller than 36 pixels, `mlp` for everything else."""
    codes: dict[ComponentName, Codes] = Field(default_factory=dict)
    """Components of bytes that are codes, such as kinds of things, and not quantities; each with how many codes there
    are in each place of its last axis, or one number for all places: `image = [11, 6, 4]` in MiniGrid. The `mlp` and
    `grid` encoders read a code as one-hot. Observations with a higher code are refused. Your own encoder receives the
    bytes."""
    hidden: Annotated[tuple[PositiveInt, ...], Field(max_length=8)] = (64, 64)
    """Units of each hidden layer; the `mlp` and `grid` encoders only."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation function; the `mlp` and `grid` encoders only."""
    normalize_observations: bool = False
    """Shift and scale observations to mean 0 and standard deviation 1, by running statistics; of codes, the one-hot
    numbers. What a convolution of the `grid` encoder reads, and bytes (`uint8`) that an image encoder or your own
    encoder reads are left out."""
    distribution: Annotated[
        str, Field(pattern=r"^(gaussian|squashed_gaussian|gaussian_mixture|kumaraswamy|[\w.]+:\w+)$", max_length=200)
    ] = "gaussian"
    """Distribution of continuous actions: `gaussian`, `squashed_gaussian`, `gaussian_mixture`, `kumaraswamy`, or
    `module:Class` for your own. Discrete actions are categorical."""
    initial_std: Annotated[float, Field(gt=0.0, le=7.0)] = 0.6
    """Standard deviation of the Gaussian distributions at the start; 1 is half the range of a bounded action."""
    state_dependent_std: bool = False
    """Let the network compute standard deviations from the observation. `gaussian` and `squashed_gaussian` only."""
    mixture_components: Annotated[int, Field(ge=1, le=16)] = 3
    """Gaussians in each mixture; `gaussian_mixture` only."""
    separate_value_encoder: bool = False
    """Give the value head an encoder of its own: the losses of policy and value then share no layer. Has no effect
    with a memory, which both heads share."""
    memory: Literal["none", "gru"] = "none"
    """Recurrent layer between the encoder and the heads."""
    memory_units: Annotated[int, Field(ge=1, le=4096)] = 256
    """Size of the recurrent state."""

    @property
    def user_modules(self) -> dict[str, str]:
        """Settings that name a module as `module:name`, with their values."""
        named = {"policy.encoder": self.encoder, "policy.distribution": self.distribution}
        return {name: value for name, value in named.items() if ":" in value}


class CollectionSpec(Specification):
    """How actors gather experience."""

    actors: PositiveInt = 2
    """Actor processes that `daedalus train` starts. `a2c` waits for this many before its first update."""
    envs_per_actor: Annotated[int, Field(ge=1, le=4096)] = 16
    """Environments of one actor (E), stepped together with one batched forward pass."""
    rollout_length: Annotated[int, Field(ge=1, le=4096)] = 16
    """Rows of a rollout (T): env_steps of each environment under one snapshot."""
    window: Annotated[int, Field(ge=1, le=64)] = 2
    """Maximum number of rollouts of one actor that are being played or not yet acknowledged."""
    upload: Literal["rollouts", "gradients"] = "rollouts"
    """What actors send: their `rollouts`, or the `gradients` of their rollouts at the weights that played them. Actors
    then need torch. Not for `impala`, `appo`, and algorithms of your own that are corrected or make several passes."""


class LossSpec(Specification):
    """The settings of `training` that a gradient is computed from: actors that upload gradients need them too."""

    algorithm: Annotated[str, Field(max_length=200), AfterValidator(check_algorithm)] = "impala"
    """`a2c`: synchronous; `a3c`: asynchronous; `impala`: with V-trace; `appo`: PPO, asynchronous, in several passes;
    `one_step_q`, `one_step_sarsa` and `n_step_q`: action values, for one discrete action; `sac`: from a replay buffer,
    for bounded continuous actions or one discrete action. Or `module:Class` for your own."""
    algorithm_kwargs: dict[str, JsonValue] = Field(default_factory=dict)
    """Further arguments of the constructor of an algorithm of your own."""
    algorithm_record: AlgorithmRecord | None = None
    """Schedule of an algorithm of your own, for the actors. Taken from the class: leave it unset."""

    discount_factor: UnitInterval = 0.99
    """Discount of the reward of the next step."""
    trace_lambda: UnitInterval = 1.0
    """Decay of the multi-step targets. 1: n-step returns; below 1: lambda-returns. Not for `one_step_q` and
    `one_step_sarsa`."""
    rho_clip: Annotated[float, Field(gt=0.0)] = 1.0
    """Upper bound of the importance weights rho: of V-trace in `impala`, and of the policy gradient in `a2c`, `a3c` and
    `appo` where actors explore."""
    trace_clip: Annotated[float, Field(gt=0.0)] = 1.0
    """Upper bound of V-trace's trace coefficients c; `impala` only."""
    passes: Annotated[int, Field(ge=1, le=64)] = 3
    """Passes over each batch; `appo` only."""
    minibatches: Annotated[int, Field(ge=1, le=4096)] = 4
    """Minibatches that each pass shuffles the batch into, one update for each; `appo` only. A batch with fewer parts
    (environments with memory, else valid rows) makes as many minibatches as it has parts."""
    clip_range: Annotated[float, Field(gt=0.0)] = 0.2
    """Clip range of the ratio between the probabilities of the new and the proximal policy; `appo` only."""
    surrogate: Surrogate = "clip"
    """What keeps the ratio in the clip range. `clip`: PPO's, no gradient beyond it; `spo`: a quadratic penalty, which
    brings back what is beyond it, learns more slowly at the same range, and keeps what is learned. `appo` only."""
    proximal_policy: Literal["newest", "behaviour"] = "newest"
    """Policy that the clip keeps the new one near: the `newest` before the batch, or the `behaviour` policy, which
    played the row. With `behaviour` the clip bounds the change over the policy lag too. Where actors explore it is
    `newest`. `appo` only."""
    target_period: PositiveInt = 100
    """Updates between two copies of the network to the target network, where the algorithm has one."""

    exploration: Epsilons | None = None
    """Epsilons: each actor draws one, by the seed and its name, and takes a random legal action with that probability.
    Repeat a number to make it more probable. Unset: 0.1, 0.01 or 0.5 with the probabilities 0.4, 0.3 and 0.3 for action
    values; no exploration for the other algorithms, whose policies are random themselves."""

    value_loss: Literal["mse", "huber"] = "mse"
    """Loss of the value, or of the action values."""
    value_coefficient: Annotated[float, Field(ge=0.0)] = 0.5
    """Weight of that loss."""
    entropy_bonus: Annotated[float, Field(ge=0.0)] = 0.01
    """Weight of the policy's entropy."""
    normalize_rewards: bool = False
    """Divide rewards by the running standard deviation of the discounted return, or by a fifth of its mean if that is
    larger, so that values are near one."""
    normalize_advantages: bool = False
    """Scale the advantages of each batch to mean 0 and standard deviation 1. With `collection.upload=gradients`, each
    actor scales those of each rollout."""

    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Precision of the forward passes. `auto`: bfloat16 for convolutions where the hardware multiplies it."""

    @property
    def user_modules(self) -> dict[str, str]:
        """Settings that name a module as `module:name`, with their values."""
        return {"training.algorithm": self.algorithm} if is_own(self.algorithm) else {}

    @property
    def record(self) -> AlgorithmRecord:
        """How the updates are scheduled. For an algorithm of the user's own: the default, until its class is known."""
        return ALGORITHMS.get(self.algorithm) or self.algorithm_record or AlgorithmRecord()

    @property
    def epsilons(self) -> tuple[float, ...]:
        """The epsilons that actors draw theirs from."""
        return self.record.epsilons if self.exploration is None else self.exploration

    @property
    def explores(self) -> bool:
        """Whether an actor may take random actions besides those of its policy."""
        return max(self.epsilons) > 0.0

    @property
    def updates_per_batch(self) -> int:
        """Number of policy versions that one batch produces, if the batch is not smaller than its minibatches."""
        return self.updates_from(self.minibatches)

    def updates_from(self, parts: int) -> int:
        """Return the number of policy versions that a batch of `parts` parts produces: no minibatch is empty.

        A part is an environment where the policy has memory, else a valid row.
        """
        return self.passes * min(self.minibatches, parts) if self.record.passes_over_batch else 1


class TrainingSpec(LossSpec):
    """How the learner learns, and when it stops."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Seed of the network, the environments and the actions."""
    env_steps: PositiveInt = 1_000_000
    """Budget: env_steps over all actors."""
    target_return: float | None = None
    """The target is reached when the mean return of the last `target_episodes` episodes reaches this value. Where
    actors explore, it is also reached when the mean return of an evaluation does; where they play another task than
    evaluations (`environment.training_kwargs`, `environment.no_reward_limit`, `[lessons]`), only then. `daedalus
    train` confirms it with as many new episodes."""
    target_episodes: PositiveInt = 100
    """Number of newest training episodes in the mean return. In a game, those of its agents: several in each match."""
    stop_when_solved: bool = True
    """Stop when the target is reached: `target_return`, or that of `[league]`. Otherwise use the whole budget."""

    batch_rollouts: PositiveInt | None = None
    """Rollouts in a batch. Unset: `collection.actors` for `impala` and `appo`, 1 for the others. Not for `a2c`."""
    max_policy_lag: NaturalInt | None = None
    """Drop and count rollouts with a larger policy lag, in updates. Unset: the updates of 8 batches for `a3c` and the
    methods of action values, of 32 for the others; of more where the live actors can have more than half as many in
    flight. No limit for `sac`."""
    exploration_env_steps: NaturalInt | None = None
    """Env_steps of all actors together in which epsilon falls linearly from 1 to the number that the actor drew; 0: it
    has that number from the start. Unset: a tenth of the budget for action values, 0 for the others."""
    replay_transitions: PositiveInt = 1_000_000
    """Newest transitions that the replay buffer keeps, at most twice as many as `env_steps`: reset rows and those that
    people play take room, too. `sac` only, as are the next seven settings."""
    replay_megabytes: Annotated[float, Field(gt=0.0)] | None = None
    """MiB of memory that the replay buffer may need: one that needs more is refused. Unset: three quarters of the
    memory that is available when the learner starts."""
    replay_saved: bool = True
    """Save the replay buffer in the run directory, with each checkpoint. A resumed run otherwise begins with an empty
    one."""
    replay_begin: NaturalInt = 1000
    """Transitions in the replay buffer before updates begin; at most half of its capacity, and of `env_steps`."""
    updates_per_env_step: Annotated[float, Field(gt=0.0, le=64.0)] = 1.0
    """Updates for each env_step that is received; in a game, for each step of an agent. Actors wait for a learner that
    falls behind."""
    minibatch_rows: Annotated[int, Field(ge=1, le=65_536)] = 256
    """Transitions that each update learns from, drawn uniformly from the replay buffer."""
    n_step: Annotated[int, Field(ge=1, le=64)] = 1
    """Rewards in the target of a transition before it bootstraps; fewer at the end of an episode or a rollout."""
    demonstration_share: UnitInterval = 0.5
    """Share of each minibatch that comes from demonstrations (`--demonstrations`) and from actions of people that
    were played in place of the policy's, where there are any."""
    cloning_updates: NaturalInt = 1000
    """Updates before training in which the policy imitates the demonstrations (`--demonstrations`); `appo` only, as is
    the next setting."""
    cloning_weight: Annotated[float, Field(ge=0.0)] = 0.1
    """Weight of the imitation of demonstrations in the loss at the start; it falls linearly to 0 over the budget."""
    mean_first_value: bool = False
    """Let the values of all states begin as the mean over the first batch, not as 0. Where rewards are negative, 0 is
    more than any state is worth: the policy goes to states that it does not know, until it knows better. That may be
    what finds a goal, or what several agents take very long to unlearn."""
    entropy_bonus_final: Annotated[float, Field(ge=0.0)] | None = None
    """Anneal the entropy bonus linearly to this value over the budget. Unset: constant."""

    curiosity: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    """Weight of a reward for each observation that is new in its episode, for goals that random actions hardly ever
    reach; try 1. It falls linearly to 0 over the budget. 0: none. Observations must come back, as grids do."""

    optimizer: Literal["adam", "rmsprop"] = "adam"
    """Optimiser of the network's parameters."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-3
    """Learning rate at the start."""
    learning_rate_final: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Anneal the learning rate linearly to this value over the budget. Unset: constant."""
    optimizer_epsilon: Annotated[float, Field(gt=0.0)] = 1e-5
    """Epsilon of the optimiser."""
    rmsprop_decay: UnitInterval = 0.99
    """Decay of the mean squared gradient; `rmsprop` only."""
    max_gradient_norm: Annotated[float, Field(gt=0.0)] = 0.5
    """Clip the gradient of an update to this norm."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the learner."""
    threads: PositiveInt = 1
    """Threads of the learner. More than one is slower if actors use the same cores. `sac` on a CPU uses another one for
    the gradient of its policy."""

    def exploration_annealing(self, progress: float, env_steps: int) -> float:
        """Return how much of epsilon's way from 1 to its final value is left, from 1 to 0.

        `progress` is the share of the budget that is used (learner/run/counters.py), and `env_steps` their number.
        """
        if self.exploration_env_steps is None:
            used, end = progress, self.record.exploration_share
        else:
            used, end = env_steps, self.exploration_env_steps
        return max(1.0 - used / end, 0.0) if end else 0.0


class EvaluatorSpec(Specification):
    """The settings of `evaluation` that an evaluator needs."""

    seconds: Annotated[float, Field(gt=0.0)] | None = None
    """Seconds from the start of one evaluation to the start of the next. Unset: no evaluator."""
    episodes: Annotated[int, Field(ge=1, le=10_000)] = 10
    """Episodes of each evaluation during training."""
    actions: Literal["greedy", "sampled"] = "greedy"
    """Actions of evaluations: the most probable choices and the means, or sampled as in training."""
    max_episode_env_steps: PositiveInt = 27_000
    """Cut episodes of evaluations after this many env_steps, and report how many were cut: the environment may never
    end them. The default is Atari's half an hour, at four frames a step."""


class EvaluationSpec(EvaluatorSpec):
    """Evaluator that `daedalus train` runs beside the actors, on episodes that training never uses."""

    final_episodes: Annotated[int, Field(ge=0, le=10_000)] = 100
    """Episodes of the evaluation of the best policy after training. 0: none, and the best policy is the one that was
    best in training; for simulators and robots where they would take too long."""
    final_backend: Backend | None = None
    """Backend of the final evaluation. Unset: `environment.backend`."""


class ServiceSpec(Specification):
    """How the learner runs as a service."""

    checkpoint_seconds: Annotated[float, Field(gt=0.0)] = 60.0
    """Seconds between checkpoints: the most training time that a killed learner loses."""
    keep_checkpoints: PositiveInt = 3
    """Number of newest checkpoints to keep."""
    log_seconds: Annotated[float, Field(gt=0.0)] = 0.5
    """Seconds between rows of metrics. Old rows of a run of many hours are merged."""
    queue_megabytes: Annotated[float, Field(gt=0.0)] = 64.0
    """MiB of rollouts that may wait to be decoded. Rollouts beyond this limit are answered `busy`."""

    @property
    def queue_bytes(self) -> int:
        """Bytes that the rollouts waiting to be decoded may occupy together."""
        return int(self.queue_megabytes * 2**20)


class LearningSpec(Specification):
    """Settings of the network and of the loss: what an actor with torch needs besides the others."""

    policy: PolicySpec = PolicySpec()
    training: LossSpec = LossSpec()

    @property
    def user_modules(self) -> dict[str, str]:
        """Settings that name a module as `module:name`, with their values."""
        return {**self.policy.user_modules, **self.training.user_modules}


class LeagueSpec(Specification):
    """Opponents of games with several agents: past versions of the policy, and fixed ones. Ratings of all of them.

    The policy plays the agents of one side of a match, and an opponent plays the agents of all others.
    """

    sides: Annotated[
        tuple[Annotated[tuple[Annotated[str, Field(max_length=64)], ...], Field(min_length=1)], ...],
        Field(max_length=1024),
    ] = ()
    """Agents that play together, for each side. Unset: each agent alone if there are two, else all on one side."""
    past_share: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Share of the matches against past versions. Unset: 0.2, or what `opponents` leave."""
    opponents: Annotated[
        dict[Annotated[str, Field(min_length=1, max_length=200)], Annotated[float, Field(ge=0.0, le=1.0)]],
        Field(max_length=64),
    ] = Field(default_factory=lambda: {"random": 0.0})
    """Fixed opponents, each with its share of the matches; 0: it is only rated. `random`, `module:Bot` for your own,
    another run's directory, or USER/NAME of a policy on the Hub. The rest of the matches is the newest policy's own."""
    choice: Literal["uniform", "prioritized"] = "uniform"
    """Which past version to play: any, or more often those that win about half of their matches: in proportion to
    p (1 - p) of the probability p to beat it."""
    openings: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Begin each match with random legal actions of all agents, for a number of env_steps that is drawn from 0 to this.
    They do not count as env_steps and are not learned from. A match that would end in its opening has none."""
    keep_env_steps: PositiveInt | None = None
    """Keep a version after this many env_steps. Unset: a fiftieth of `training.env_steps`."""
    versions: Annotated[int, Field(ge=1, le=256)] = 20
    """Number of versions to keep. Beyond it, the version nearest to its neighbours in env_steps is removed."""
    rating_share: Annotated[float, Field(ge=0.0, le=0.5)] = 0.01
    """Share of the matches that are only played to rate the players, and not learned from."""
    rating_actions: Literal["sampled", "greedy"] = "sampled"
    """Actions of the policies in rating matches. With `greedy` only these matches count for ratings and scores; with
    `sampled` those of training do, too."""
    target_opponent: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """The target is reached when the newest policy surely has `target_win_rate` against this one of `opponents`: the
    lower end of the 95 % interval over about the last 200 matches. In place of `training.target_return`."""
    target_win_rate: Annotated[float, Field(gt=0.0, le=0.98)] = 0.9
    """Share of matches that are won; a draw is half. So few matches cannot prove more than 0.98."""
    target_rating: float | None = None
    """The target is reached when the rating of the newest policy is two deviations above this value. In place of
    `training.target_return`."""

    @model_validator(mode="after")
    def _has_one_target(self) -> "LeagueSpec":
        if self.target_opponent is not None:
            if self.target_opponent not in self.opponents:
                raise ValueError(f"league.target_opponent {self.target_opponent!r} is not one of league.opponents")
            if self.target_rating is not None:
                raise ValueError("league.target_opponent and league.target_rating are both set: unset one of them")
        return self

    @property
    def past(self) -> float:
        """Share of the matches against past versions in a game with more than one side."""
        if self.past_share is not None:
            return self.past_share
        return max(min(_PAST_SHARE, 1.0 - sum(self.opponents.values())), 0.0)

    @property
    def user_modules(self) -> dict[str, str]:
        """Settings that name a module as `module:name`, with their values."""
        return {f"league.opponents.{name}": name for name in self.opponents if ":" in name}


class UnsupportedRunError(ValueError):
    """The run has a setting that this release does not know or cannot apply."""


class ActorSpec(Specification):
    """What an actor needs to know of a run: the learner sends it in Welcome.

    The learner and the actor may be of different releases, so an actor ignores settings that it does not know, unless
    the run uses them: `changed` names all settings that differ from their defaults.
    """

    environment: EnvironmentSpec
    collection: CollectionSpec = CollectionSpec()
    evaluation: EvaluatorSpec = EvaluatorSpec()
    algorithm: ActorDemands = ActorDemands()
    league: LeagueSpec = LeagueSpec()
    lessons: Lessons = Field(default_factory=dict)
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1  # of the run
    max_upload_bytes: NaturalInt = 1 << 26  # the learner does not receive larger messages
    # The fields of LearningSpec, unchecked: most actors do not need them, and may not know each encoder and algorithm.
    learning: dict[str, JsonValue] = Field(default_factory=dict)
    changed: Annotated[tuple[str, ...], Field(max_length=4096)] = ()  # paths, such as `environment.grey`

    @property
    def uploads_gradients(self) -> bool:
        """Whether actors upload gradients instead of rollouts."""
        return self.collection.upload == "gradients"

    def check_known(self) -> None:
        """Raise UnsupportedRunError if the run uses a setting of a newer release, except in `learning`."""
        _refuse_unknown([path for path in self.changed if not path.startswith("learning.")], ActorSpec)

    @property
    def learning_settings(self) -> LearningSpec:
        """The settings in `learning`. Raises UnsupportedRunError if this release does not know one that is used."""
        _refuse_unknown([path[9:] for path in self.changed if path.startswith("learning.")], LearningSpec)
        try:
            return LearningSpec.model_validate(self.learning, extra="ignore")
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(map(str, first["loc"]))
            reason = bounded_text(f"{name} does not fit this release: {first['msg']}")
            raise UnsupportedRunError(f"the run's {reason}") from None


def _refuse_unknown(paths: list[str], model: type[Specification]) -> None:
    unknown = [path for path in paths if not has_field(model, path)]
    for path in unknown:
        if replacement := REPLACED_SETTINGS.get(path):
            raise UnsupportedRunError(
                f"the run sets {path}, which {replacement} replaces in this release: upgrade daedalus-rl at the learner"
            )
    if unknown:
        names = bounded_text(", ".join(unknown[:3]), 150)
        raise UnsupportedRunError(
            f"the run sets {names}, which this release does not know: upgrade daedalus-rl here to the learner's release"
        )


class RunSpec(Specification):
    """Complete specification of a run, written as `config.toml`, which reproduces the run."""

    environment: EnvironmentSpec
    """Environment that the actors play."""
    policy: PolicySpec = PolicySpec()
    """Network."""
    collection: CollectionSpec = CollectionSpec()
    """How actors gather experience."""
    training: TrainingSpec = TrainingSpec()
    """How the learner learns, and when it stops."""
    evaluation: EvaluationSpec = EvaluationSpec()
    """Evaluator beside the actors."""
    service: ServiceSpec = ServiceSpec()
    """How the learner runs as a service."""
    league: LeagueSpec = LeagueSpec()
    """Opponents in games with several agents."""
    lessons: Lessons = Field(default_factory=dict)
    """Parameters of the environment that vary in training, as `[lessons.NAME]`."""

    @model_validator(mode="after")
    def _fits_one_message(self) -> "RunSpec":
        sizes: dict[str, int] = {}
        for section, settings in self.model_dump(mode="json").items():
            for name, value in settings.items():
                try:
                    sizes[f"{section}.{name}"] = len(msgpack.packb(value) or b"")
                except (ValueError, OverflowError) as error:  # such as an integer of more than 64 bits
                    raise ValueError(f"{section}.{name} cannot be sent to actors: {error}") from None
        total = sum(sizes.values())
        if total > _MAX_BYTES:
            largest = max(sizes, key=lambda name: sizes[name])
            raise ValueError(
                f"{largest} has {sizes[largest]:,} bytes, too many to send to actors: all settings together may have "
                f"{_MAX_BYTES:,}, and have {total:,}"
            )
        return self

    @model_validator(mode="after")
    def _one_batch_fits_the_barrier(self) -> "RunSpec":
        if self.algorithm.synchronous and self.training.batch_rollouts is not None:
            raise ValueError(
                f"training.batch_rollouts has no meaning for {self.training.algorithm}: "
                "its batch is one rollout of every live actor"
            )
        return self

    @model_validator(mode="after")
    def _arguments_are_of_an_own_algorithm(self) -> "RunSpec":
        for name in ("algorithm_kwargs", "algorithm_record"):
            if getattr(self.training, name) and not is_own(self.training.algorithm):
                raise ValueError(
                    f"training.{name} is for an algorithm of your own (module:Class), not for "
                    f"{self.training.algorithm}: leave it unset"
                )
        return self

    @model_validator(mode="after")
    def _actors_can_compute_the_gradient(self) -> "RunSpec":
        if self.uploads_gradients and (self.algorithm.corrected or self.algorithm.passes_over_batch):
            kind = "makes several updates of" if self.algorithm.passes_over_batch else "corrects the policy lag of"
            raise ValueError(
                f"collection.upload is gradients, but {self.training.algorithm} {kind} a batch, which only the learner "
                "can do: use a3c, a2c or n_step_q, or set collection.upload=rollouts"
            )
        return self

    @model_validator(mode="after")
    def _replay_fits_the_policy(self) -> "RunSpec":
        if not self.algorithm.replay:
            return self
        name, policy = self.training.algorithm, self.policy
        if is_own(name):
            raise ValueError(f"training.algorithm={name}: replay is for sac alone: leave it out of the record")
        if self.uploads_gradients:
            raise ValueError(
                f"collection.upload is gradients, but {name} learns from a replay buffer, which only the learner has: "
                "set collection.upload=rollouts"
            )
        if policy.memory != "none":
            raise ValueError(
                f"policy.memory is {policy.memory}, but {name} learns from single transitions: set policy.memory=none, "
                "and environment.frame_stack if one observation does not tell enough, or use appo"
            )
        if (policy.distribution, policy.state_dependent_std) != ("squashed_gaussian", True):
            raise ValueError(
                f"{name} needs policy.distribution=squashed_gaussian and policy.state_dependent_std=true, as they are "
                f"where the algorithm is chosen with --algorithm {name}"
            )
        if self.training.normalize_rewards:
            raise ValueError(
                f"training.normalize_rewards is true, but {name} keeps rewards for many updates, which need one scale: "
                "set it to false, and environment.reward_scale if rewards are very large or small"
            )
        if self.training.curiosity:
            raise ValueError(
                f"training.curiosity is for algorithms that learn from new rollouts, but {name} keeps rewards in a "
                "replay buffer, where they would not fade: set training.curiosity=0"
            )
        rows = self.collection.rollout_length
        if self.training.n_step > rows:
            raise ValueError(
                f"training.n_step is {self.training.n_step}, but the targets of {name} end with their rollout, and "
                f"collection.rollout_length is {rows}: set n_step lower, or rollout_length to at least as many"
            )
        return self

    @model_validator(mode="after")
    def _curiosity_sees_rollouts(self) -> "RunSpec":
        if self.uploads_gradients and self.training.curiosity:
            raise ValueError(
                "training.curiosity needs rollouts, and with collection.upload=gradients none reach the learner: "
                "set collection.upload=rollouts, or training.curiosity=0"
            )
        return self

    @model_validator(mode="after")
    def _games_send_rollouts(self) -> "RunSpec":
        if self.uploads_gradients and self.environment.is_game:
            raise ValueError(
                "collection.upload is gradients, but a gradient does not tell the env_steps of a game with several "
                "agents: set collection.upload=rollouts"
            )
        return self

    @model_validator(mode="after")
    def _league_is_of_a_game(self) -> "RunSpec":
        changed = tuple(changed_fields(self.league, "league."))
        if changed and not self.environment.is_game:
            raise ValueError(
                f"{changed[0]} is for games with several agents (environment.backend=pettingzoo): leave it unset"
            )
        if self.league.past + sum(self.league.opponents.values()) > 1.0 + 1e-9:
            raise ValueError("league.past_share and the shares of league.opponents are more than 1 together")
        for name in ("target_opponent", "target_rating"):
            if getattr(self.league, name) is not None and self.training.target_return is not None:
                raise ValueError(f"training.target_return and league.{name} are both set: unset one of them")
        return self

    @model_validator(mode="after")
    def _lessons_end_at_the_true_task(self) -> "RunSpec":
        check_lessons(self.lessons, self.environment.parameters)
        return self

    @model_validator(mode="after")
    def _next_action_is_in_the_rollout(self) -> "RunSpec":
        if self.algorithm.next_action and self.collection.rollout_length < 2:
            raise ValueError(
                f"collection.rollout_length is 1, but {self.training.algorithm} learns from an action and the next "
                "one: make it at least 2"
            )
        return self

    @model_validator(mode="after")
    def _stack_fits_the_rollout(self) -> "RunSpec":
        sizes, rows = self.environment.frame_stack, self.collection.rollout_length
        stack = sizes if isinstance(sizes, int) else max(sizes.values(), default=1)
        if stack > rows:
            raise ValueError(
                f"environment.frame_stack is {stack}, longer than a rollout: "
                f"collection.rollout_length is {rows}, make it at least {stack}"
            )
        return self

    @model_validator(mode="after")
    def _wrapped_environments_are_gymnasiums(self) -> "RunSpec":
        backends = {
            "environment.backend": self.environment.backend,
            "evaluation.final_backend": self.evaluation.final_backend,
        }
        for setting, backend in backends.items():
            if self.environment.wrap is not None and backend not in (None, "gymnasium"):
                raise ValueError(f"environment.wrap needs gymnasium's environments: {setting} is {backend}")
            if self.environment.parameters and backend not in (None, *_WITH_PARAMETERS):
                raise ValueError(f"environment.parameters need gymnasium's environments: {setting} is {backend}")
        return self

    def for_actors(self) -> ActorSpec:
        """Return what actors need. A new setting of a section below reaches them; any other only the learner reads."""
        learning = self.learning
        spec = ActorSpec(
            environment=self.environment,
            collection=self.collection,
            evaluation=_part(EvaluatorSpec, self.evaluation),
            algorithm=_part(ActorDemands, self.algorithm),
            league=self.league,
            lessons=self.lessons,
            seed=self.training.seed,
            max_upload_bytes=min(self.service.queue_bytes, 2**63 - 1),
        )
        of_actors = [path for path in changed_fields(spec) if path not in _NOT_NEEDED]
        changed = (*of_actors, *changed_fields(learning, "learning."))
        return spec.model_copy(update={"learning": learning.model_dump(mode="json"), "changed": changed})

    @property
    def trains_true_task(self) -> bool:
        """Whether training plays the task of evaluations, so that the returns of both can be compared."""
        return not self.lessons and self.environment.trains_true_task

    @property
    def target(self) -> str:
        """What the run is to reach, in words; empty if nothing."""
        league = self.league
        if league.target_opponent is not None:
            return f"win rate {exact_number(league.target_win_rate)} against {league.target_opponent}"
        if league.target_rating is not None:
            return f"rating {exact_number(league.target_rating)}"
        target = self.training.target_return
        return "" if target is None else f"mean return {exact_number(target)}"

    @property
    def user_modules(self) -> dict[str, str]:
        """Settings that name a module as `module:name`, with their values."""
        return {**self.environment.user_modules, **self.league.user_modules, **self.learner_modules}

    @property
    def learner_modules(self) -> dict[str, str]:
        """Those of `user_modules` that the learner imports."""
        return {**self.policy.user_modules, **self.training.user_modules}

    @property
    def actor_modules(self) -> dict[str, str]:
        """Those of `user_modules` that an actor imports: with gradients, also the learner's."""
        if self.uploads_gradients:
            return self.user_modules
        return {**self.environment.user_modules, **self.league.user_modules}

    @property
    def learning(self) -> LearningSpec:
        """Settings of the network and of the loss."""
        return LearningSpec(policy=self.policy, training=_part(LossSpec, self.training))

    @property
    def uploads_gradients(self) -> bool:
        """Whether actors upload gradients instead of rollouts."""
        return self.collection.upload == "gradients"

    @property
    def algorithm(self) -> AlgorithmRecord:
        """How the run's updates are scheduled."""
        return self.training.record

    @property
    def batch_rollouts(self) -> int:
        """How many rollouts make a batch where no barrier decides it."""
        return self.training.batch_rollouts or self.algorithm.batch_rollouts or self.collection.actors

    def policy_lag_bound_with(self, live: int) -> int:
        """Return the largest policy lag that is learned from, in updates, with so many live actors.

        Where the learner is slower than its actors, all rollouts in flight wait for it. Unless it is set, the bound
        leaves room for twice as many: otherwise every rollout of an actor slower than the others would be too old.
        """
        training = self.training
        if training.max_policy_lag is not None:
            return training.max_policy_lag
        if self.algorithm.replay:
            return _ANY_LAG
        actors = max(self.collection.actors, live)
        in_flight = math.ceil(actors * self.collection.window / self.batch_rollouts)  # batches
        return max(self.algorithm.max_lag_batches, 2 * in_flight) * training.updates_per_batch


def _part(part: type[_Part], whole: _Part) -> _Part:
    """Return the fields of a base class of a specification."""
    return part.model_construct(**{name: getattr(whole, name) for name in part.model_fields})
