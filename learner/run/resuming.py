"""What a run begins with or is resumed from: weights of another run, changed settings, whether it has finished.

Without torch, so that a command can import it early.
"""

import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daedalus.learner.league.ratings import LeagueState, Ratings
from daedalus.learner.run.counters import RunCounters, check_counters
from daedalus.learner.run.run_directory import SUMMARY, VERSIONS, read_json
from daedalus.learner.run.settings import SettingsError, assign, flat_settings, override, run_spec
from daedalus.policy.saving.saved_policy import (
    NoPolicyError,
    OtherFormatError,
    SavedPolicy,
    check_format,
    checkpoints,
    find_policy,
)
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, RunSpec, TrainingSpec

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint
    from daedalus.learner.training.learner import Learner

_logger = logging.getLogger(__name__)

# They define what is learned, and by what: the weights, the statistics of the optimiser and the results so far belong
# to them.
_FIXED_SECTIONS = ("environment.", "policy.")
_FIXED = {"training.algorithm", "training.optimizer", "training.seed", "training.normalize_rewards", "league.sides"}
_CHANGEABLE = {"environment.max_episode_steps", "environment.package", "environment.processes"}
# Settings of `training` that are annealed over the budget, each with the setting of its last value; none: 0.
_ANNEALED = {
    "learning_rate": "learning_rate_final",
    "entropy_bonus": "entropy_bonus_final",
    "curiosity": "",
    "cloning_weight": "",
}
_AT_THE_START = {"training.cloning_updates", "training.mean_first_value"}  # settings that are read before an update


def with_changes(
    spec: RunSpec, assignments: Sequence[str], directory: Path, values: Mapping[str, Any] | None = None
) -> RunSpec:
    """Return the specification of a run with `section.key=value` assignments, and values by `section.key`, applied.

    Raises SettingsError for an invalid assignment, and for settings that cannot change when the run in `directory` is
    resumed.
    """
    settings = spec.model_dump(mode="json", exclude_none=True)
    override(settings, assignments)
    for path, value in (values or {}).items():
        assign(settings, path, value)
    assignments = [*assignments, *(f"{path}={value}" for path, value in (values or {}).items())]
    try:
        changed = run_spec(settings)
        fixed = fixed_changes(spec, changed)
    except SettingsError:  # perhaps because others would have to change with a setting that cannot
        fixed = [name for name in _named(assignments) if _is_fixed(name) and name in _values(spec)]
        if not fixed:
            raise
        changed = spec
    if fixed:
        changes = [word for assignment in assignments for word in ("--set", assignment)]
        words = ["daedalus", "train", f"{directory}/config.toml", "--init-from", str(directory), *changes]
        raise SettingsError(
            f"{' and '.join(fixed)} cannot change when a run is resumed: start a new run from the weights of this one, "
            f"such as with: {shlex.join(words)}"
        )
    return changed


def fixed_changes(before: RunSpec, after: RunSpec) -> list[str]:
    """Return the settings that differ and cannot change when a run is resumed, as `section.key`."""
    return [name for name in differing(before, after) if _is_fixed(name)]


def differing(before: RunSpec, after: RunSpec) -> list[str]:
    """Return the settings in which two specifications differ, as `section.key`."""
    old, new = _values(before), _values(after)  # [lessons] has the keys that the user gives it
    return [name for name in {**old, **new} if old.get(name) != new.get(name)]


def only_at_the_start(directory: Path) -> set[str]:
    """Return the settings that nothing reads any more when the run in a directory is resumed."""
    return _AT_THE_START if checkpoints(directory) else set()


def _annealed_before(before: TrainingSpec, training: TrainingSpec) -> list[str]:
    """Return the settings that changed, and that have no effect once their annealing has ended."""
    return [
        f"training.{name}"
        for name, final in _ANNEALED.items()
        if getattr(before, name) != getattr(training, name) and (not final or getattr(training, final) is not None)
    ]


def _named(assignments: Sequence[str]) -> list[str]:
    return [assignment.partition("=")[0].strip() for assignment in assignments]


def _is_fixed(name: str) -> bool:
    return name not in _CHANGEABLE and (name in _FIXED or name.startswith(_FIXED_SECTIONS))


def _values(spec: RunSpec) -> dict[str, Any]:
    return flat_settings(spec.model_dump(mode="json"))


def check_initial(directory: Path | None, *, other_spaces: bool) -> None:
    """Raise SettingsError if no policy can be read from a directory, that of --init-from; None: there is none.

    `other_spaces` is --allow-other-spaces, which needs a directory.
    """
    if other_spaces and directory is None:
        raise SettingsError("--allow-other-spaces is for the weights of another run: add --init-from, or leave it out")
    _check(directory, "--init-from: ")


def allows_other_spaces(directory: Path) -> bool:
    """Return whether a run was started with --allow-other-spaces, as its versions.json says. Raises SettingsError."""
    return (directory / VERSIONS).exists() and read_json(directory / VERSIONS).get("init_from_other_spaces") is True


def initial_to_resume(directory: Path) -> Path | None:
    """Return the run whose weights a resumed run still has to begin with, or None.

    A run that was stopped before its first checkpoint begins with them again; versions.json names their run. Raises
    SettingsError if no policy can be read from there.
    """
    if checkpoints(directory) or not (directory / VERSIONS).exists():
        return None
    recorded = read_json(directory / VERSIONS).get("init_from")
    initial = None if recorded is None else Path(recorded)
    _check(initial, f"the run in {directory} has no checkpoint, and begins with the weights of another run, but ")
    return initial


def _check(initial: Path | None, source: str) -> None:
    if initial is not None:
        try:
            find_policy(initial)
        except (DamagedError, NoPolicyError) as error:
            raise SettingsError(f"{source}{error}") from None


def other_spaces(policy: SavedPolicy, environment: EnvironmentSpec, spaces: Spaces) -> str:
    """Return what differs between the spaces of a policy and those of a run, or an empty string.

    Weights fit wherever the shapes do, but a policy means nothing by numbers of another name, order or scale.
    """
    found = differing_spaces(policy.spaces, spaces)
    for name in ("action_table", "action_table_columns"):  # what the choices mean
        if getattr(policy.spec.environment, name) != getattr(environment, name):
            found.append(f"environment.{name} is another")
    return "; ".join(found)


def differing_spaces(before: Spaces, now: Spaces) -> list[str]:
    """Return in what the spaces of another run or of a dataset, "there", differ from those of a run, "here"."""
    return [
        *_components("observation", before.observations, now.observations),
        *_components("action", before.actions, now.actions),
    ]


def _components(kind: str, before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    missing, new = (", ".join(sorted(one.keys() - other.keys())) for one, other in ((before, now), (now, before)))
    found = [f"{kind} {missing} is not here"] if missing else []
    found += [f"{kind} {new} is not there"] if new else []
    for name in before.keys() & now.keys():
        if before[name] != now[name]:
            found.append(f"{kind} {name} is {_in_detail(before[name])} there, and {_in_detail(now[name])} here")
    if not found and list(before) != list(now):
        found.append(f"the components of the {kind} are in the order {', '.join(before)} there, {', '.join(now)} here")
    return found


def _in_detail(space: Any) -> str:
    """Return a space in words, with what differs between spaces of the same words."""
    if isinstance(space, ContinuousSpace) and len(set(zip(space.low, space.high, strict=True))) > 1:
        return f"{space} (low {_some(space.low)}, high {_some(space.high)})"
    if isinstance(space, DiscreteSpace) and space.size > 8:
        return f"{space} ({_some(space.counts)})"
    return str(space)


def _some(values: tuple[float | None, ...]) -> str:
    texts = ["none" if value is None else f"{value:g}" for value in values[:8]]
    return " ".join([*texts, *(["..."] if len(values) > 8 else [])])


def other_network(policy: SavedPolicy, spec: PolicySpec, spaces: Spaces) -> str:
    """Return the first setting by which a run's network computes something else from equal weights, or an empty string.

    Settings that change names or shapes of weights are left to the loading of the weights. Needs torch.
    """
    from daedalus.policy.network.encoders import encoder_names

    before = policy.spec.policy
    names = encoder_names(before, policy.spaces.observations), encoder_names(spec, spaces.observations)
    different: dict[str, tuple[Any, Any]] = {"encoder": names, "codes": (before.codes, spec.codes)}
    if "mlp" in names[1] or "grid" in names[1] or ":" in names[1]:
        different["activation"] = before.activation, spec.activation
    if spaces.continuous_numbers:
        different["distribution"] = before.distribution, spec.distribution
    for name, (there, here) in different.items():
        if there != here:
            return f"policy.{name} is {there} there, and {here} here: use the same [policy] settings"
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedRun:
    """Run that has nothing left to train."""

    reason: str  # why, and how to go on
    missed: bool  # whether the budget was used up before the target at which the run was to stop
    to_evaluate: bool  # whether training ended by itself, and the final evaluation is missing


def finished_run(directory: Path, spec: RunSpec) -> FinishedRun | None:
    """Return how a run has finished under a specification, or None if there is something left to train.

    A learner that was killed between its last checkpoint and its summary has to be started again.

    Raises SettingsError for checkpoints of another format, before anything of the run is changed: the release that
    wrote them can go on with it.
    """
    counters, league = _newest_counters(directory, spec)
    try:
        summary = read_json(directory / SUMMARY)
    except SettingsError:
        return None
    if counters is None or summary.get("env_steps") != counters.env_steps:
        return None
    training = spec.training
    # Not while new episodes have to confirm it:
    solved = (counters.is_solved(spec) or _reached_in_league(spec, league)) and bool(summary.get("solved"))
    if solved and training.stop_when_solved:
        reason = (
            f"the target, {spec.target}, was reached, and {counters.env_steps:,} env_steps are done: train on with "
            "--set training.stop_when_solved=false, or set a higher target"
        )
    elif counters.env_steps >= training.env_steps:
        reason = (
            f"{counters.env_steps:,} env_steps are done, and the budget is {training.env_steps:,}: "
            "raise it with --env-steps"
        )
    else:
        return None
    missed = bool(spec.target) and training.stop_when_solved and not solved
    evaluated = summary.get("evaluation") is not None or spec.evaluation.final_episodes == 0
    to_evaluate = bool(summary.get("finished")) and not evaluated
    return FinishedRun(reason=reason, missed=missed, to_evaluate=to_evaluate)


def _reached_in_league(spec: RunSpec, state: Any) -> bool:
    """Return whether the league of a checkpoint has reached the target of a specification."""
    return state is not None and Ratings(spec.league.opponents, LeagueState.model_validate(state)).reach(spec.league)


def _newest_counters(directory: Path, spec: RunSpec) -> tuple[RunCounters | None, Any]:
    """Return the counters of the newest checkpoint and the state of its league, or None for each.

    Raises SettingsError for a checkpoint of another format.
    """
    for checkpoint in checkpoints(directory):
        counters = RunCounters(spec.training.target_episodes)
        try:
            sealed = SealedDirectory(checkpoint)
            check_format(checkpoint, sealed)
            saved = check_counters(sealed.content["counters"])
        except OtherFormatError as error:
            raise SettingsError(str(error)) from None
        except (DamagedError, KeyError, ValueError):
            continue  # the learner reports it
        counters.restore(saved)
        return counters, saved.get("league")
    return None, None


class CheckpointMismatchError(Exception):
    """Error for a checkpoint of another network or optimiser."""


_OUTPUTS = {  # of a network, by the heads of the algorithm
    "policy_and_value": "a policy and values",
    "action_values": "action values",
    "policy": "a policy without values",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beginning:
    """What the policy of a learner process begins with: a checkpoint, the weights of another run, or neither."""

    restored: "Checkpoint | None" = None
    initial: SavedPolicy | None = None  # policy of another run, without a checkpoint to continue from
    allows_other_spaces: bool = False  # whether the spaces of `initial` may be others than those of this run
    reset_statistics: bool = False  # whether to forget the running statistics of the checkpoint
    modules: UserModules = NO_MODULES  # that may be imported for the policy

    def load_into(self, learner: "Learner", spec: RunSpec, progress: float) -> None:
        """Give a learner its first weights. Raises CheckpointMismatchError.

        Args:
          learner: at policy version 0.
          spec: specification of the run.
          progress: of the annealed settings, from 0 to 1.
        """
        if self.restored is not None:
            policy = self.restored.policy
            if difference := other_network(policy, spec.policy, learner.spaces):
                raise CheckpointMismatchError(f"{policy.directory}: {difference}")
            learner.restore(policy.policy_version, policy.weights, self.restored.state)
            if self.reset_statistics:
                learner.reset_statistics()
                _logger.info("statistics of observations and rewards reset: the next rollouts define them")
            if progress >= 1.0 and (unread := _annealed_before(policy.spec.training, spec.training)):
                _logger.warning(
                    "no effect: %s; the budget from before was used up, at whose end it has its final value "
                    "(training.learning_rate_final, training.entropy_bonus_final; else 0): change that, or start a new "
                    "run from the weights of this one, with --init-from",
                    ", ".join(unread),
                )
            if learner.learning_rate(progress) == 0.0:
                _logger.warning(
                    "the learning rate has been annealed to 0: the policy changes no more; "
                    "start a new run from its weights, with --init-from"
                )
        elif self.initial is not None:
            try:
                self._check_initial(self.initial, spec, learner.spaces)
                learner.load(self.initial.weights)
            except CheckpointMismatchError as error:
                raise CheckpointMismatchError(f"--init-from {self.initial.directory}: {error}") from None
            version, directory = self.initial.policy_version, self.initial.directory
            _logger.info("initial weights: policy version %d of %s", version, directory)

    def _check_initial(self, initial: SavedPolicy, spec: RunSpec, spaces: Spaces) -> None:
        """Raise CheckpointMismatchError if the policy of another run means something else in this one."""
        there, here = initial.spec.training, spec.training
        if there.record.heads != here.record.heads:  # the weights may fit all the same
            raise CheckpointMismatchError(
                f"{there.algorithm} learned {_OUTPUTS[there.record.heads]}, and {here.algorithm} learns "
                f"{_OUTPUTS[here.record.heads]}: name a run of an algorithm that learns the same"
            )
        if difference := other_network(initial, spec.policy, spaces):
            raise CheckpointMismatchError(difference)
        difference = other_spaces(initial, spec.environment, spaces)
        if difference and not self.allows_other_spaces:
            raise CheckpointMismatchError(
                f"its policy is for other spaces: {difference}; name a run of the same spaces, or add "
                "--allow-other-spaces (in Python: allow_other_spaces=True) to load its weights if all shapes fit"
            )
        if difference:
            _logger.warning("initial weights of other spaces (--allow-other-spaces): %s", difference)


NO_WEIGHTS = Beginning()
