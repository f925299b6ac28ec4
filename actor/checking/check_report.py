"""What a check of an environment found, and what follows from it for a run."""

from pydantic import Field

from daedalus.policy.component_inputs import coded_components
from daedalus.protocol.models import Specification
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, Spaces
from daedalus.protocol.spec import RunSpec

_SLOW_SECONDS = 0.005  # a step of a few milliseconds costs more than the exchange with another process
_WIDE = 1e6  # from bound to bound of an action: the policy explores a hundredth of it to the end
_SMALL_PIXEL = 16  # an image without a larger value is rather a map of numbers, such as the kinds of things in a grid
_DEAR_SECONDS = 0.02  # a step of so long costs more than several updates of a small network
_FEWEST_EPISODES = 10  # whose equal lengths are no chance
_BUSY = 0.2  # share of processor time below which a step mostly waits, even on a busy machine


class EnvironmentReport(Specification):
    """Result of a check. It crosses a pipe as JSON."""

    spaces: Spaces | None = None  # as a run has them; None if the environment cannot be made or is not supported
    first_choices: dict[str, tuple[int, ...]] = Field(default_factory=dict)  # of components that do not count from 0
    constant_texts: dict[str, str] = Field(default_factory=dict)  # components left out, and their content
    seats: int = 1  # agents of a game that the policy plays
    problems: tuple[str, ...] = ()  # training would fail
    roles: dict[str, tuple[str, ...]] = Field(default_factory=dict)  # agents by role, if each needs its own policy
    warnings: tuple[str, ...] = ()  # training would run, perhaps not as intended
    notes: tuple[str, ...] = ()  # advice of gymnasium's own checker
    env_steps: int = 0  # played
    step_seconds: float = 0.0  # mean, without the first step, which may compile or load something
    busy_share: float = 1.0  # processor time of the steps, as a share of their duration
    reset_seconds: float = 0.0  # mean
    vectorized: bool = False  # training plays it by a vector entry point of its own
    time_limit: int | None = None  # at which gymnasium truncates episodes
    # Largest values seen in arrays of bytes, by component: in each place of the last axis, or in all places.
    byte_maxima: dict[str, tuple[int, ...]] = Field(default_factory=dict)
    codes: dict[str, tuple[int, ...]] = Field(default_factory=dict)  # of components that are codes, as policy.codes
    maps: tuple[str, ...] = ()  # components that are maps of a few cells, with planes of 0 and 1
    lengths: tuple[int, ...] = ()  # of the episodes that ended
    returns: tuple[float, ...] = ()
    truncations: int = 0  # of the episodes that ended, those that were truncated

    def text_problem(self, spec: RunSpec) -> str:
        """Return the problem of a run whose settings do not leave out a text, or an empty string."""
        for name in self.constant_texts:
            return (
                f"environment {spec.environment.id}: observation component {name!r} is a text, which the policy cannot "
                f"read: --set \"environment.leave_out=['{name}']\", or make numbers of it with --wrap MODULE:FUNCTION"
            )
        return ""

    def code_problem(self, spec: RunSpec) -> str:
        """Return the problem of a run that observes a value which is no code of `policy.codes`, or an empty string."""
        observations = {} if self.spaces is None else self.spaces.observations
        for name, codes in coded_components(spec.policy, observations).items():
            maxima = self.byte_maxima.get(name, ())
            each = codes if len(maxima) == len(codes) else (max(codes),)
            for largest, count in zip(maxima, each, strict=False):
                if largest >= count:
                    return (
                        f"environment {spec.environment.id}: observation component {name!r} has the value {largest} "
                        f"where policy.codes.{name} has {count} codes, from 0 to {count - 1}: correct the environment, "
                        "or set higher numbers in policy.codes, or policy.codes=none"
                    )
        return ""


def advice(report: EnvironmentReport, spec: RunSpec, processors: int) -> list[str]:
    """Return advice for the run. See the functions below."""
    slow = slow_steps(report, spec, processors)
    texts = (
        f"{slow}; use --set environment.processes=true" if slow else "",
        float_images(report, spec),
        stacked_images(report, spec),
        reduced_images(report, spec),
        planes_first(report, spec),
        small_bytes(report, spec),
        uninformative_bounds(report),
        terminated_by_time(report, spec),
        replay_instead(report, spec),
    )
    return [text for text in texts if text]


def slow_steps(report: EnvironmentReport, spec: RunSpec, processors: int) -> str:
    """Return why each actor's environments should have processes of their own, or an empty string.

    Processes help where steps wait for something else, or where processors would be idle.
    """
    chosen = "processes" in spec.environment.model_fields_set
    if chosen or report.vectorized or not _in_turn(spec):
        return ""
    environments = spec.collection.envs_per_actor
    idle = report.busy_share < _BUSY or processors > spec.collection.actors
    if report.step_seconds < _SLOW_SECONDS or not idle:
        return ""
    row = report.step_seconds * environments
    first = row * spec.collection.rollout_length
    return (
        f"a step takes {_duration(report.step_seconds)}, and an actor steps its {environments} environments in turn: "
        f"{_duration(row)} a row, {_duration(first)} a rollout"
    )


def slow_start(spec: RunSpec) -> str:
    """Return advice for an environment that takes long to make, if each actor makes several in turn; else nothing."""
    if not _in_turn(spec):
        return ""
    return (
        f"; an actor makes its {spec.collection.envs_per_actor} environments in turn: --set environment.processes=true "
        "makes them at the same time, --set collection.envs_per_actor=1 only one"
    )


def _in_turn(spec: RunSpec) -> bool:
    """Return whether an actor makes and steps several environments, one after the other."""
    environment, several = spec.environment, spec.collection.envs_per_actor > 1
    in_turn = environment.backend == "gymnasium" and not environment.processes
    return several and in_turn and not environment.is_from_python  # which no new process can make


def float_images(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice if an array of floats has the shape of an image, else an empty string."""
    if report.spaces is None or spec.policy.encoder != "auto":
        return ""
    for name, space in report.spaces.observations.items():
        if not isinstance(space, ArraySpace) or space.dtype != "float32" or len(space.shape) != 3:
            continue
        if _is_shape_of_image(space.shape):
            return (
                f"{name!r} is a {space}, which goes through a multilayer perceptron: if it is an image, "
                "return bytes from 0 to 255 (Box of uint8), which get convolutions"
            )
    return ""


def stacked_images(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice if an array of four axes has the shape of several images, else an empty string."""
    if report.spaces is None or spec.policy.encoder != "auto":
        return ""
    for name, space in report.spaces.observations.items():
        if isinstance(space, ArraySpace) and len(space.shape) == 4 and _is_shape_of_image(space.shape[1:]):
            return (
                f"{name!r} is a {space}, which goes through a multilayer perceptron: one image has two or three axes; "
                "return one, of uint8, and stack frames with environment.frame_stack"
            )
    return ""


def reduced_images(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return what the default settings remove from an image, or an empty string.

    The spaces are those of the environment with the transforms that the user has chosen.
    """
    chosen = spec.environment
    for name, space in report.spaces.observations.items() if report.spaces is not None else ():
        if not isinstance(space, ArraySpace) or not space.is_image:
            continue
        parts, remedies = [], []
        if chosen.grey and space.image_shape[0] == 3:
            parts, remedies = ["grey"], ["if colours matter, use --set environment.grey=false"]
        if chosen.resize is not None and space.image_shape[1:] != chosen.resize:
            parts.append("{} x {} pixels small".format(*chosen.resize))
            remedies.append("if small details matter, --set environment.resize=[HEIGHT,WIDTH]")
        if parts:
            return f"{name!r} is a {space}, and is made {' and '.join(parts)} for the policy: {'; '.join(remedies)}"
    return ""


def planes_first(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice if the encoder `grid`, which reads maps (height, width, planes), may get others; else nothing."""
    if spec.policy.encoder != "grid" or report.spaces is None:
        return ""
    for name, space in report.spaces.observations.items():
        if isinstance(space, ArraySpace) and len(space.shape) == 3:
            height, width, planes = space.shape
            if height != width == planes:
                return (
                    f"policy.encoder=grid reads {name!r} as {height} x {width} cells with {planes} planes: if it has "
                    f"{height} planes of {width} x {planes} cells, put the planes last in a wrapper (--wrap)"
                )
    return ""


def _is_shape_of_image(shape: tuple[int, ...]) -> bool:
    return ArraySpace(shape=shape, dtype="uint8").is_image


def small_bytes(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice if an array of bytes has only small values, which may be codes; else an empty string."""
    policy = spec.policy
    if ":" in policy.encoder or report.spaces is None:
        return ""
    for name, maxima in report.byte_maxima.items():
        space, largest = report.spaces.observations.get(name), max(maxima)
        if not isinstance(space, ArraySpace) or len(space.shape) == 1 or name in {*policy.codes, *report.codes}:
            continue
        if not 0 < largest < _SMALL_PIXEL or (largest == 1 and not space.is_image):
            continue
        codes = "[" + ",".join(str(value + 1) for value in maxima) + "]"
        encoder = "" if policy.encoder in ("mlp", "grid") or not space.is_image else " --set policy.encoder=mlp"
        divided = ", and the encoder divides bytes by 255" if _divides_bytes(spec, space) else ""
        return (
            f"{name!r} has no value above {largest}{divided}: if its values are codes, such as kinds of things, and "
            f"not quantities, use --set policy.codes.{name}={codes}{encoder}, with as many codes as there can be"
        )
    return ""


def _divides_bytes(spec: RunSpec, space: ArraySpace) -> bool:
    policy = spec.policy
    if space.is_image:
        return policy.encoder != "grid" and not (policy.encoder == "mlp" and policy.normalize_observations)
    return policy.encoder != "grid" and not policy.normalize_observations


def uninformative_bounds(report: EnvironmentReport) -> str:
    """Return advice if an action lacks a bound, or has bounds too wide to explore, else an empty string."""
    for name, space in report.spaces.actions.items() if report.spaces is not None else ():
        if not isinstance(space, ContinuousSpace):
            continue
        for low, high in zip(space.low, space.high, strict=True):
            if low is None or high is None:
                return (
                    f"action {name!r} is not bounded on both sides, so that it is not scaled: the policy begins within "
                    "about 1 of 0; where useful values are of another size, give it their bounds"
                )
            if high - low > _WIDE:
                return (
                    f"action {name!r} goes from {low:g} to {high:g}, and the policy explores all of it: "
                    "where useful values are closer together, give it their bounds"
                )
    return ""


def replay_instead(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice to learn from each step many times, where steps are slow and sac can learn, or an empty string.

    Not for a choice, where sac has not been better for the same number of steps (docs/results.md), and not where the
    run has what sac refuses.
    """
    if spec.policy.memory != "none" or spec.training.curiosity or spec.uploads_gradients:
        return ""
    fits = report.spaces is not None and report.spaces.fits_replay and report.spaces.only_choice is None
    if report.step_seconds <= _DEAR_SECONDS or not fits or spec.algorithm.replay or spec.environment.is_game:
        return ""
    return (
        f"a step takes {_duration(report.step_seconds)}: training.algorithm=sac (--algorithm sac) learns from each "
        f"step many times, and so needs far fewer of them than {spec.training.algorithm}"
    )


def terminated_by_time(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice if all episodes terminated after equally many steps, as by a limit of time, else nothing."""
    lengths = report.lengths
    if len(lengths) < _FEWEST_EPISODES or len(set(lengths)) > 1 or lengths[0] == 1:
        return ""
    if report.truncations or spec.environment.bootstrap_terminations or spec.environment.is_game:
        return ""
    return (
        f"all {len(lengths):,} episodes terminated after {lengths[0]} env_steps: if that is a limit of time, which the "
        "observation does not show, return truncated in place of terminated, or use "
        "--set environment.bootstrap_terminations=true"
    )


def never_ends(report: EnvironmentReport, spec: RunSpec) -> str:
    """Return advice if no episode ended and nothing limits episodes, else an empty string."""
    if report.lengths or report.time_limit is not None or spec.environment.max_episode_steps is not None:
        return ""
    remedy = spec.environment.remedy_of_endless
    return f"no episode ended within {report.env_steps:,} env_steps of random actions: {remedy}"


def _duration(seconds: float) -> str:
    return f"{seconds * 1000:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"
