"""A dataset of recorded episodes, as the demonstrations of a run: its spaces and its size are checked, then it is
written into the run directory in the form that the learner reads."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from daedalus.actor.collecting.rollout_writer import make_learnable
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.minari_files import DatasetError, Episode, MinariReader
from daedalus.actor.environments.transforms import Transforms
from daedalus.launch.environment_check import CheckTimeoutError, quick_check
from daedalus.learner.run.demonstration_files import (
    PART_BYTES,
    DemonstrationsWriter,
    check_memory,
    check_spaces,
    rows_of_rollout,
)
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import LARGEST_REWARD, DiscreteSpace, Spaces, unfit_number
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.texts import bounded_text, listed
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_logger = logging.getLogger(__name__)

_Values = dict[str, np.ndarray]


def write_demonstrations(name: str, spec: RunSpec, spaces: Spaces | None, directory: Path) -> None:
    """Write the episodes of a dataset into a run directory.

    Args:
      name: of the dataset; see dataset_folder.
      spec: of the run.
      spaces: of the run, if they are known; else the learner compares them.
      directory: of the run.

    Raises SettingsError, in one line, if the dataset cannot be read or does not fit the run, or nothing would learn
    from it. Then nothing is written.
    """
    if reason := _unlearned(spec):
        raise SettingsError(reason)
    try:
        with MinariReader(name, spec.environment.leave_out) as dataset:
            transforms = Transforms(spec.environment, dataset.observation_space, dataset.action_space)
            if spaces is not None:
                check_spaces(name, transforms.spaces, spaces)
                _check_first_choices(name, transforms, spec)
            _warn(dataset, spec.environment)
            rows = rows_of_rollout(transforms.spaces)
            columns = -(-(dataset.rows(spec.environment.action_repeat) + dataset.episodes) // rows)
            check_memory(dataset.steps, columns * transforms.spaces.replay_bytes(rows))
            writer = DemonstrationsWriter(directory, name, transforms.spaces)
            try:
                rollouts = _rollouts(dataset, transforms, spec)
                newest = next(rollouts)
                for following in rollouts:
                    writer.add(newest, last=False)
                    newest = following
                writer.add(newest, last=True)
            finally:
                writer.discard()
            _logger.info("demonstrations: %s steps in %d episodes of %s", f"{dataset.steps:,}", dataset.episodes, name)
    except (DatasetError, EnvironmentSetupError) as error:
        raise SettingsError(str(error)) from None
    except OSError as error:
        raise SettingsError(f"demonstrations cannot be written to {directory}: {error.strerror}") from None


def _unlearned(spec: RunSpec) -> str:
    """Return why the run would learn from no demonstrations, or an empty string."""
    training = spec.training
    if not spec.algorithm.demonstrations:
        return f"{training.algorithm} does not learn from demonstrations: choose appo or sac"
    if spec.environment.is_game:
        return "demonstrations are of one agent, and this environment has several"
    if spec.algorithm.replay:
        share, rows = training.demonstration_share, training.minibatch_rows
        if not round(share * rows):
            return (
                f"training.demonstration_share is {share:g} of the {rows} rows of a minibatch, and none is a "
                "demonstration: raise it, or leave --demonstrations out"
            )
    elif not (training.cloning_updates or training.cloning_weight):
        return (
            "training.cloning_updates and training.cloning_weight are 0, and nothing is learned from demonstrations: "
            "raise one of them, or leave --demonstrations out"
        )
    return ""


def _check_first_choices(name: str, transforms: Transforms, spec: RunSpec) -> None:
    """Raise SettingsError if the choices of a dataset do not begin with those of the environment, which is made again.

    A run counts all choices from 0, so that its spaces do not tell.
    """
    spaces = transforms.spaces
    if not any(isinstance(each, DiscreteSpace) for each in (*spaces.observations.values(), *spaces.actions.values())):
        return
    try:
        report = quick_check(spec.environment, UserModules.of(spec.user_modules), play=False)
    except CheckTimeoutError:
        _logger.warning("the environment was not made in time: whether its choices begin as those of %s is open", name)
        return
    there, here = transforms.first_choices, report.first_choices
    for part in sorted({*there, *here} if report.spaces is not None else ()):
        if there.get(part) != here.get(part):
            first, own = (listed(choices.get(part, "0")) for choices in (there, here))
            raise SettingsError(
                f"dataset {name} (there) has other spaces than the run (here): the choices of {part} begin with "
                f"{first} there, and with {own} here"
            )


def _warn(dataset: MinariReader, environment: EnvironmentSpec) -> None:
    if dataset.environment and dataset.environment != environment.id.rpartition(":")[2]:
        _logger.warning(
            "dataset %s was recorded in %s, and the run plays %s", dataset.name, dataset.environment, environment.id
        )
    elif others := _other_arguments(dataset, environment):
        _logger.warning(
            "dataset %s was recorded without the arguments %s, which the environment of the run has: its rewards, and "
            "what follows an action, may be others",
            dataset.name,
            bounded_text(", ".join(f"{name}={value!r}" for name, value in others.items()), 200),
        )
    if dataset.has_images_as_jpeg:
        _logger.warning(
            "dataset %s has images as JPEG, which are not quite those that the policy will see: Minari writes exact "
            "ones with jpeg_encoding=False",
            dataset.name,
        )


def _other_arguments(dataset: MinariReader, environment: EnvironmentSpec) -> dict[str, JsonValue]:
    """Return the arguments of the run's environment that the one of a dataset had not, if that is known."""
    there, here = dataset.environment_kwargs, environment.constructor_kwargs
    if not isinstance(there, dict):
        return {}
    return {name: value for name, value in here.items() if name != "render_mode" and there.get(name, ...) != value}


def _rollouts(dataset: MinariReader, transforms: Transforms, spec: RunSpec) -> Iterator[Rollout]:
    """Yield the episodes as rollouts, as an actor would have sent them. Raises DatasetError."""
    rows = rows_of_rollout(transforms.spaces)
    row_bytes = max(transforms.spaces.replay_bytes(rows) // rows, 1)
    most = max(PART_BYTES // row_bytes // rows * rows, rows)  # rows of a part
    pending, mixed, repeat = _Stream(transforms.spaces, rows), 0, spec.environment.action_repeat
    for number, episode in enumerate(dataset):
        try:
            part, differing = _learnable(episode, transforms, spec.environment)
            if differing and spec.algorithm.replay:
                raise ValueError(
                    f"the run repeats each action {repeat} times (environment.action_repeat), and {differing:,} times "
                    f"the actions of so many steps differ, which {spec.training.algorithm} cannot learn from: record "
                    "the policy of a run that repeats as often, leave environment.action_repeat out, or choose appo"
                )
            pending.add(part)
            mixed += differing
        except ValueError as error:
            raise DatasetError(f"dataset {dataset.name}: episode {number}: {error}") from None
        while pending.rows >= most:
            yield pending.taken(most)
    if mixed:
        _logger.warning(
            "the run repeats each action %d times (environment.action_repeat), and in %s of %s rows of dataset %s the "
            "actions of so many steps differ: the policy imitates the first one of each row",
            repeat,
            f"{mixed:,}",
            f"{dataset.rows(repeat):,}",
            dataset.name,
        )
    if pending.rows:
        yield pending.taken(pending.rows)


def _learnable(
    episode: Episode, transforms: Transforms, environment: EnvironmentSpec
) -> tuple[dict[str, _Values], int]:
    """Return the rows of an episode by kind, and in how many of them the actions differ.

    A row has as many steps as the run repeats an action, with the first of their actions and the sum of their rewards.
    The last row is the reset row, with the last observation. Raises ValueError.
    """
    length, repeat = len(episode.rewards), environment.action_repeat
    starts = np.arange(0, length, repeat)
    steps = len(starts)
    try:
        frames = transforms.observe(episode.observations, None, np.zeros(length + 1, np.bool_)).frames
    except EnvironmentSetupError as error:
        raise ValueError(str(error)) from None
    for name, values in frames.items():
        values = values if repeat == 1 else values[np.append(starts, length)]
        if unfit := unfit_number(values):
            raise ValueError(f"component {name!r} of an observation {unfit}")
        frames[name] = values.astype(transforms.spaces.observations[name].dtype, copy=False)
    actions, differing = {}, np.zeros(steps, np.bool_)
    for name, values in transforms.policy_actions(episode.actions).items():
        actions[name] = values[starts]
        changed = (values != np.repeat(actions[name], repeat, axis=0)[:length]).any(1)
        differing |= np.logical_or.reduceat(changed, starts)
    ends = np.zeros((2, steps + 1), np.bool_)
    # A recording that breaks off is cut: the episode would have gone on. A termination at a limit is a termination.
    ends[:, steps - 1] = episode.terminated, not episode.terminated
    rewards = np.append(np.add.reduceat(episode.rewards, starts), 0.0)
    if np.abs(rewards).max() > LARGEST_REWARD:
        raise ValueError(f"a reward is beyond +-{LARGEST_REWARD:g}")
    rewards = rewards.astype(np.float32)
    make_learnable(environment, rewards, *ends)
    part = {
        "frames": frames,
        "actions": {name: np.concatenate([values, values[-1:]]) for name, values in actions.items()},
        "rows": {
            "rewards": rewards,
            "terminated": ends[0],
            "truncated": ends[1],
            "valid": np.arange(steps + 1) < steps,
            "ages": np.arange(steps + 1),  # rows since the beginning of the episode
        },
    }
    return part, int(differing.sum())


class _Stream:
    """The rows of episodes, one after the other, as one environment goes through them."""

    def __init__(self, spaces: Spaces, length: int) -> None:
        """`length` is T."""
        self._spaces, self._length = spaces, length
        self._parts: list[dict[str, _Values]] = []
        self._before: _Values = {}  # the frames before the first row, of its episode
        self.rows = self._number = 0

    def add(self, part: dict[str, _Values]) -> None:
        self._parts.append(part)
        self.rows += len(part["rows"]["rewards"])

    def taken(self, count: int) -> Rollout:
        """Remove the first rows, and return them as a rollout; the last column is filled up with rows that nobody
        learns from."""
        joined = {kind: self._joined([part[kind] for part in self._parts]) for kind in self._parts[0]}
        columns = -(-count // self._length)
        total = columns * self._length
        at = np.minimum(np.arange(total), count - 1)
        rows = {name: values[at].reshape(columns, -1).T for name, values in joined["rows"].items()}
        padded = (np.arange(total) >= count).reshape(columns, -1).T
        rollout = Rollout(
            identity=RolloutIdentity(actor="demonstrations", incarnation=0, sequence=self._number, learner_epoch=0),
            policy_version=0,
            frames=self._frames(joined["frames"], joined["rows"]["ages"], count, columns),
            initial_state=np.zeros((columns, 0), np.float32),
            actions={
                name: values[at].reshape(columns, self._length, -1).swapaxes(0, 1)
                for name, values in joined["actions"].items()
            },
            masks={},
            behaviour_log_probs=np.zeros((self._length, columns), np.float32),
            rewards=np.where(padded, np.float32(0.0), rows["rewards"]),
            terminated=rows["terminated"] & ~padded,
            truncated=rows["truncated"] & ~padded,
            valid=rows["valid"] & ~padded,
            episode_returns=np.zeros(0),
            episode_lengths=np.zeros(0, np.int32),
        )
        deepest = max(space.frames for space in self._spaces.observations.values()) - 1
        self._before = {name: values[max(count - deepest, 0) : count] for name, values in joined["frames"].items()}
        rest = {kind: {name: values[count:] for name, values in part.items()} for kind, part in joined.items()}
        self._parts, self._number = [rest], self._number + 1
        self.rows -= count
        return rollout

    @staticmethod
    def _joined(parts: Sequence[_Values]) -> _Values:
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _frames(self, frames: _Values, ages: np.ndarray, count: int, columns: int) -> _Values:
        """Return the frames [k-1 + T+1, E, ...] of each component: before row 0 those of its complete stack."""
        found = {}
        starts = np.arange(columns) * self._length
        for name, space in self._spaces.observations.items():
            before = self._before.get(name, frames[name][:0])
            values = np.concatenate([before, frames[name]])
            # Back to the first frame of the episode at most, which replaces those before it.
            back = np.minimum(np.arange(space.frames - 1, 0, -1)[:, None], ages[starts])  # [k-1, E]
            after = np.minimum(starts + np.arange(self._length + 1)[:, None], self._last(count, len(frames[name])))
            found[name] = values[np.concatenate([starts - back, after]) + len(before)]
        return found

    @staticmethod
    def _last(count: int, held: int) -> int:
        """Return the last row whose observation a rollout of `count` rows has."""
        return min(count, held - 1)
