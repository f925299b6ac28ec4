"""Minari datasets: recorded episodes of an environment, as numbers. Read with h5py, written with Minari's library.

Minari's own reader makes the environment that the metadata name, where they name no spaces: it imports any module that
the author of a dataset has chosen. This reader imports nothing, and reads arrays of numbers alone, whose sizes are
checked before memory is allocated for them. h5py and minari are the extra `demonstrations`.
"""

import io
import json
import math
import shutil
import string
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from daedalus.actor.environments.components import LeftOut, dtype_misfit, is_text, leaves, nested, without
from daedalus.policy.saving.regular_files import read_regular, replace_text
from daedalus.protocol.spaces import LARGEST_REWARD, unfit_number
from daedalus.protocol.texts import bounded_text

if TYPE_CHECKING:
    import h5py
    from minari.dataset.minari_storage import MinariStorage

_METADATA_BYTES = 64 << 20  # the bounds of an image's pixels are listed one by one
EPISODE_BYTES = 1 << 30  # of one array of an episode
_FREE_BYTES = 16 << 20  # of the disk, beside twice an episode, for it to be written
_DTYPES = frozenset(f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)) | {"bool"}
_INSTALL = 'pip install "daedalus-rl[demonstrations]"'
_ALGORITHM = "algorithm_name"  # of Minari's metadata


class DatasetError(Exception):
    """Error of a dataset that cannot be used. The message is one line."""


class Episode(NamedTuple):
    """One recorded episode of L steps. Values of a nested space have the first axis in each component."""

    observations: Any  # [L+1, ...]; the last one follows the last action. None for components that are left out
    actions: Any  # [L, ...]
    rewards: np.ndarray  # [L] float64
    terminated: bool  # by the environment, at the last step
    truncated: bool  # by a limit


def dataset_folder(name: str) -> Path:
    """Return the folder of a dataset, which need not exist: `name` is a path, or an id of Minari's local datasets."""
    if _is_path(name):
        return Path(name).expanduser().absolute()  # Minari joins the parts of others twice
    _import_minari()
    from minari.storage.datasets_root_dir import get_dataset_path

    return Path(get_dataset_path(name))


def _is_path(name: str) -> bool:
    return name.startswith((".", "/", "~")) or Path(name).is_dir()


def new_dataset_folder(name: str) -> Path:
    """Return the folder of a dataset that is to be written.

    Raises DatasetError if it exists, if it is no id that Minari can list beside the others, or if Minari is missing.
    """
    _import_minari()
    if not _is_path(name):
        from minari.dataset.minari_dataset import parse_dataset_id

        try:
            parse_dataset_id(name)
        except (ValueError, TypeError):  # TypeError: without a version
            raise DatasetError(
                f"dataset {name} has no id of Minari: write NAME-v0 or NAMESPACE/NAME-v0, or ./NAME for a folder here"
            ) from None
    folder = dataset_folder(name)
    if (folder / "data").exists():
        raise DatasetError(f"dataset {name} exists at {folder}: choose another name, or remove it")
    return folder


def _import_minari() -> None:
    try:
        import h5py  # noqa: F401  # minari works without
        import minari  # noqa: F401
    except ImportError as error:
        raise DatasetError(
            f"datasets of demonstrations need {error.name}, which is not installed: {_INSTALL}"
        ) from None


class MinariReader:
    """A dataset that is open for reading: `with MinariReader(name) as dataset`."""

    def __init__(self, name: str, leave_out: Sequence[str] = ()) -> None:
        """Open a dataset and check the kinds and sizes of all its arrays, without reading them.

        Args:
          name: see dataset_folder.
          leave_out: components of the observation that are not read.

        Raises DatasetError, and EnvironmentSetupError if the observation has no such component.
        """
        self.name, folder = name, dataset_folder(name)
        data = folder if (folder / "metadata.json").is_file() else folder / "data"
        if not (data / "metadata.json").is_file():
            raise DatasetError(
                f"{name} is no Minari dataset: give a folder with data/metadata.json, or an id of `minari list local` "
                "(`minari download ID` fetches a public one)"
            )
        _import_minari()
        content = self._metadata(data / "metadata.json")
        made_from = _env_spec(content.get("env_spec"))
        self.environment = bounded_text(str(made_from.get("id", "")), 200)  # empty if it is unknown
        self.environment_kwargs = made_from.get("kwargs")  # arguments of its constructor; any JSON
        self.observation_space = without(self._space(content, "observation_space"), leave_out)
        self.action_space = self._space(content, "action_space")
        self._has_jpegs = content.get("jpeg_encoding", True) is not False
        if content.get("data_format", "hdf5") != "hdf5":
            shown = bounded_text(str(content["data_format"]), 40)
            raise DatasetError(f"dataset {name} has the format {shown}, and only hdf5 is read: write it as hdf5")
        import h5py

        with self._faults():
            self._file = h5py.File(data / "main_data.hdf5", "r")
        try:
            with self._faults():
                stated, found = content.get("total_episodes"), len(self._file)
                if stated not in (found, found - 1):  # a writer that was killed had not stated its last one
                    raise self._error(f"its metadata state {stated} episodes, and it has {found}")
                self._lengths = [self._checked(group) for group in self._groups(stated)]
            if not self._lengths:
                raise self._error("it has no episodes")
        except BaseException:
            self._file.close()
            raise

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self._lengths)

    @property
    def steps(self) -> int:
        """Number of steps of all episodes."""
        return sum(self._lengths)

    def rows(self, repeat: int) -> int:
        """Return the number of rows of all episodes where each has the steps of one repeated action."""
        return sum(-(-length // repeat) for length in self._lengths)

    @property
    def has_images_as_jpeg(self) -> bool:
        """Whether images of the observations lost detail when they were written."""
        return any(self._is_jpeg(leaf.space) for leaf in leaves(self.observation_space, "observation"))

    def __iter__(self) -> Iterator[Episode]:
        """Yield the episodes in their order. Raises DatasetError."""
        for number in range(len(self._lengths)):
            with self._faults():
                yield self._episode(number)

    def _episode(self, number: int) -> Episode:
        group: Any = self._file[f"episode_{number}"]
        terminated, truncated = (np.asarray(group[name][()]).astype(bool) for name in ("terminations", "truncations"))
        rewards = np.asarray(group["rewards"][()]).astype(np.float64)
        if terminated[:-1].any() or truncated[:-1].any():
            raise self._error(f"episode {number} goes on after a step that ends it")
        if not np.isfinite(rewards).all():
            raise self._error(f"episode {number} has a reward that is not finite")
        return Episode(
            observations=self._values(group["observations"], self.observation_space, "observation"),
            actions=self._values(group["actions"], self.action_space, "action"),
            rewards=rewards,
            terminated=bool(terminated[-1]),
            truncated=bool(truncated[-1]),
        )

    def _values(self, group: Any, space: gymnasium.Space, whole: str) -> Any:
        parts: dict[tuple[str | int, ...], Any] = {}
        for leaf in leaves(space, whole):
            found = group
            for key in () if isinstance(leaf.space, LeftOut) else leaf.path:
                found = found[_key(key)]
            if isinstance(leaf.space, LeftOut):
                parts[leaf.path] = None
            elif self._is_jpeg(leaf.space):
                parts[leaf.path] = np.stack([self._decoded(found, number, leaf.space) for number in range(len(found))])
            else:
                parts[leaf.path] = found[()]
        return nested(space, (), parts)

    def _is_jpeg(self, space: gymnasium.Space) -> bool:
        from minari.dataset.minari_storage import is_image_space

        return self._has_jpegs and not isinstance(space, LeftOut) and is_image_space(space)

    def _decoded(self, files: "h5py.Dataset", number: int, space: gymnasium.Space) -> np.ndarray:
        """Return an image of the space's shape. Raises DatasetError, before it is decoded, for any other."""
        from PIL import Image

        try:
            with Image.open(io.BytesIO(files[number].tobytes()), formats=["JPEG"]) as image:
                shape = (image.height, image.width, *((len(image.getbands()),) if len(space.shape or ()) > 2 else ()))
                if shape == space.shape and image.mode in ("L", "RGB"):
                    return np.asarray(image, np.uint8).reshape(shape)
                reason = f"it is {image.mode} {image.width} x {image.height}, not of shape {space.shape}"
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            reason = str(error)
        raise self._error(f"image {number} of {files.name} cannot be read: {reason}")

    # -------------------------------------------------------------------------------------------- checks

    def _groups(self, episodes: int) -> Iterator["h5py.Group"]:
        for number in range(episodes):
            yield self._member(self._file, f"episode_{number}", is_group=True)

    def _checked(self, group: "h5py.Group") -> int:
        """Return the length of an episode. Raises DatasetError unless all its arrays are numbers of fitting shapes."""
        rewards = self._member(group, "rewards")
        steps = rewards.shape[0] if len(rewards.shape) == 1 else 0
        if not steps:
            raise self._error(f"{rewards.name} has the shape {rewards.shape}: it must have one number for each step")
        for name in ("rewards", "terminations", "truncations"):
            self._check_array(self._member(group, name), (steps,))
        for name, space, rows in (
            ("observations", self.observation_space, steps + 1),
            ("actions", self.action_space, steps),
        ):
            for leaf in leaves(space, name):
                if isinstance(leaf.space, LeftOut):
                    continue
                found = group
                for key in (name, *map(_key, leaf.path[:-1])) if leaf.path else ():
                    found = self._member(found, key, is_group=True)
                found = self._member(found, _key(leaf.path[-1]) if leaf.path else name)
                if self._is_jpeg(leaf.space):
                    self._check_jpegs(found, rows, leaf.space)
                else:
                    self._check_array(found, (rows, *(leaf.space.shape or ())))
        return steps

    def _member(self, group: Any, name: str, *, is_group: bool = False) -> Any:
        """Return a part of the file that is in the file itself, and not a link to another."""
        import h5py

        link = group.get(name, getlink=True) if "/" not in name else None
        if not isinstance(link, h5py.HardLink):
            raise self._error(f"{group.name} has no {bounded_text(name, 64)} of its own")
        found = group.get(name)
        if not isinstance(found, h5py.Group if is_group else h5py.Dataset):
            raise self._error(f"{found.name} is no {'group' if is_group else 'array'}")
        return found

    def _check_jpegs(self, array: "h5py.Dataset", rows: int, space: gymnasium.Space) -> None:
        """Check an array of files, in bytes: [rows, n], or [rows] of as many bytes as each has."""
        import h5py

        if h5py.check_vlen_dtype(array.dtype) != np.uint8:
            self._check_array(array, (rows, *array.shape[1:2]))
        elif array.is_virtual or array.external or array.shape != (rows,):
            raise self._error(f"{array.name} has the shape {array.shape}, not {(rows,)}, or is in another file")
        if (size := rows * math.prod(space.shape or ())) > EPISODE_BYTES:
            raise self._error(f"{array.name} has {size:,} bytes of pixels: an episode may have {EPISODE_BYTES:,}")

    def _check_array(self, array: "h5py.Dataset", shape: tuple[int, ...]) -> None:
        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
            raise self._error(f"{array.name} holds {array.dtype}, and only numbers are read")
        if array.is_virtual or array.external:
            raise self._error(f"{array.name} is in another file")
        if array.shape != shape:
            raise self._error(f"{array.name} has the shape {array.shape}, not {shape}")
        size = max(math.prod(shape), math.prod(array.chunks or ())) * array.dtype.itemsize
        if size > EPISODE_BYTES:
            raise self._error(f"{array.name} has {size:,} bytes: an episode may have {EPISODE_BYTES:,}")

    def _metadata(self, path: Path) -> dict[str, Any]:
        try:
            data = read_regular(path, _METADATA_BYTES + 1)
            if len(data) > _METADATA_BYTES:
                raise self._error(f"its metadata have more than {_METADATA_BYTES:,} bytes")
            content = json.loads(data)
        except (OSError, ValueError, RecursionError) as error:
            raise self._error(f"its metadata cannot be read: {error}") from None
        if not isinstance(content, dict):
            raise self._error("its metadata are no table")
        return content

    def _space(self, content: Mapping[str, Any], name: str) -> gymnasium.Space:
        from minari.serialization import deserialize_space

        if not isinstance(content.get(name), str):
            raise self._error(f"its metadata have no {name}: record it with a newer release of Minari")
        try:
            described = json.loads(content[name])
            _check_space(described)
            return deserialize_space(described)
        except (
            *(ValueError, TypeError, KeyError, AttributeError, AssertionError),
            *(NotImplementedError, RecursionError, OverflowError),
        ) as error:
            raise self._error(f"its {name} cannot be read: {type(error).__name__}: {error}") from None

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:  # as h5py raises
            raise self._error(f"it is damaged or no HDF5 file: {error}") from None

    def _error(self, reason: str) -> DatasetError:
        return DatasetError(bounded_text(f"dataset {self.name}: {reason}", 500))

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def __enter__(self) -> "MinariReader":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _key(key: str | int) -> str:
    return f"_index_{key}" if isinstance(key, int) else key


def _check_space(described: Any) -> None:
    """Raise ValueError for a space with other numbers than machines have, or with very many."""
    if described.get("dtype", "int64") not in _DTYPES:
        raise ValueError(f"dtype {bounded_text(str(described['dtype']), 40)}")
    if math.prod(described.get("shape", ())) > _METADATA_BYTES:
        raise ValueError("it is too large")
    parts = described.get("subspaces", ())
    for part in parts.values() if isinstance(parts, dict) else parts:
        _check_space(part)


def _env_spec(text: Any) -> dict[str, Any]:
    """Return the specification of an environment; empty without any."""
    try:
        found = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


class MinariWriter:
    """A new dataset. Each episode is on the disk when `add` returns: a recording that is cut short keeps the others.

    Only a kill while HDF5 writes (1 of 40 kills of a process that did nothing else) damages them.
    """

    def __init__(
        self,
        name: str,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        env_spec: Any = None,
        *,
        algorithm: str = "",
    ) -> None:
        """Begin a dataset, whose folder is made with the first episode.

        Args:
          name: see dataset_folder; an id needs a version, such as `cartpole/mine-v0`.
          observation_space, action_space: of the environment that was played.
          env_spec: gymnasium's specification of it (EnvSpec), which `minari` makes it from again; None: unknown.
          algorithm: who played, for the metadata.

        Raises DatasetError if it exists, or Minari has no form for the spaces.
        """
        self.folder = new_dataset_folder(name)
        self._name, self.episodes, self.steps = name, 0, 0
        self._spaces, self._env_spec, self._algorithm = (observation_space, action_space), env_spec, algorithm
        self._written = _written_space(observation_space), _written_space(action_space)
        self._check_spaces()
        self._storage: MinariStorage | None = None
        self._failure = ""

    def _check_spaces(self) -> None:
        from minari.serialization import serialize_space

        reason = ""
        for space, written in zip(self._spaces, self._written, strict=True):
            try:
                serialize_space(written)
            except NotImplementedError as error:
                reason = str(error)
            # Also the order of keys is that of the written ones, which numbers the components with like names.
            names = {tuple(map(_written_key, leaf.path)): leaf.name for leaf in leaves(space, "value")}
            if names != {leaf.path: leaf.name for leaf in leaves(written, "value")}:
                reason = "two keys differ only by a slash, or by characters that no component's name has: rename one"
        if reason:
            raise DatasetError(bounded_text(f"dataset {self._name} cannot be written: {reason}", 500))

    def _created(self) -> "MinariStorage":
        from minari.dataset.minari_storage import MinariStorage

        self.folder.mkdir(parents=True, exist_ok=True)
        storage = MinariStorage.new(self.folder / "data", *self._written, self._env_spec, jpeg_encoding=False)
        # Minari empties the file first: a process that is killed then would lose all episodes.
        storage.update_metadata = partial(_update_metadata, self.folder / "data" / "metadata.json")
        known = {_ALGORITHM: self._algorithm} if self._algorithm else {}
        storage.update_metadata(
            {"dataset_id": _dataset_id(self._name), "minari_version": metadata.version("minari"), **known}
        )
        return storage

    def add(self, episode: Episode, seed: int | None = None) -> None:
        """Write an episode. Raises DatasetError, also before a write that would fill the disk and damage the dataset,
        and for an episode that nothing could learn from.

        After a write that has failed, each call does: HDF5 may then crash the process.
        """
        from minari.data_collector import EpisodeBuffer

        if self._failure:
            raise DatasetError(self._failure)
        steps = len(episode.rewards)
        ends = np.zeros((2, steps), np.bool_)
        ends[:, -1] = episode.terminated, episode.truncated
        if not (np.abs(episode.rewards) <= LARGEST_REWARD).all():  # false for nan, too
            reason = f"an episode has a reward that is not finite or beyond +-{LARGEST_REWARD:g}, and is not written"
            raise DatasetError(f"dataset {self._name}: {reason}")
        buffer = EpisodeBuffer(
            seed=seed,
            observations=self._as_written(0, episode.observations, "observation"),
            actions=self._as_written(1, episode.actions, "action"),
            rewards=[*episode.rewards],
            terminations=[*ends[0]],
            truncations=[*ends[1]],
        )
        with self._faults():
            self._storage = self._storage or self._created()
            self._check_disk(episode)
            self._storage.update_episodes([buffer])
        self.episodes, self.steps = self.episodes + 1, self.steps + steps

    def _as_written(self, which: int, values: Any, what: str) -> Any:
        """Return values of a space as Minari writes them. Raises DatasetError for those that are none to learn from."""
        parts: dict[tuple[str | int, ...], Any] = {}
        for leaf in leaves(self._spaces[which], what):
            array, path = leaf.of(values), tuple(map(_written_key, leaf.path))
            if is_text(leaf.space):
                parts[path] = [*map(str, array)]
                continue
            parts[path] = array
            misfit = dtype_misfit(leaf.space, array)
            if array.shape[1:] != leaf.space.shape:
                misfit = f"has the shape {array.shape[1:]}, not {leaf.space.shape}"
            elif array.nbytes > EPISODE_BYTES:
                misfit = f"has {array.nbytes:,} bytes, of which an episode may have {EPISODE_BYTES:,}"
            if array.dtype == np.float16:  # has no number as large as the limit
                array = array.astype(np.float32)
            if misfit := misfit or unfit_number(array):
                where = f"{what} {leaf.name!r}" if leaf.path else what
                reason = f"an episode is not written, because its {where} {misfit}"
                raise DatasetError(bounded_text(f"dataset {self._name}: {reason}", 500))
        return nested(self._written[which], (), parts)

    def _check_disk(self, episode: Episode) -> None:
        values = zip(self._spaces, (episode.observations, episode.actions), strict=True)
        size = sum(leaf.of(value).nbytes for space, value in values for leaf in leaves(space, "value"))
        if shutil.disk_usage(self.folder).free < _FREE_BYTES + 2 * size:
            raise DatasetError(f"dataset {self._name}: its disk has less than {_FREE_BYTES >> 20} MiB left")

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError, RuntimeError) as error:  # as h5py raises
            self._failure = bounded_text(f"dataset {self._name} cannot be written: {error}", 500)
            raise DatasetError(self._failure) from None


def _written_space(space: gymnasium.Space) -> gymnasium.Space:
    """Return the space of what is written: with keys that HDF5 has, and gymnasium's Text in place of other texts."""
    if isinstance(space, gymnasium.spaces.Dict):
        return gymnasium.spaces.Dict({_written_key(key): _written_space(part) for key, part in space.spaces.items()})
    if isinstance(space, gymnasium.spaces.Tuple):
        return gymnasium.spaces.Tuple([_written_space(part) for part in space.spaces])
    return gymnasium.spaces.Text(_METADATA_BYTES, charset=string.printable) if is_text(space) else space


def _written_key(key: Any) -> Any:
    """Return a key without slashes, which would be groups: of such as dm_control's, which name the same component."""
    return key.replace("/", "_") if isinstance(key, str) else key


def _update_metadata(path: Path, metadata: dict[str, Any]) -> None:
    replace_text(path, json.dumps(json.loads(path.read_bytes()) | metadata))


def _dataset_id(name: str) -> str:
    """Return an id that Minari accepts."""
    kept = "".join(character if character.isalnum() or character in "-_/" else "-" for character in name).strip("-/")
    last = kept.rpartition("-v")[2]
    return kept if last.isdigit() else f"{kept or 'dataset'}-v0"
