"""The demonstrations of a run on the disk: the folder `demonstrations` of a run directory, with rollouts.

Each part is a sealed directory (policy/saving/sealed.py) with one encoded rollout (protocol/codec.py), which is checked
as one that an actor sends. The launcher makes them of a dataset once; a learner reads them at each start.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel, Field, ValidationError

from daedalus.learner.run.resuming import differing_spaces
from daedalus.learner.run.run_directory import DEMONSTRATIONS
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.upload_checks import first_component_violation, number_violation
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, write_sealed
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec
from daedalus.protocol.texts import mebibytes
from daedalus.protocol.uploads import Rollout
from daedalus.transport.process_usage import available_memory

MEMORY_SHARE = 0.75  # of what is available
PART_BYTES = 16 << 20  # about the largest part in memory
MOST_ROWS = 64  # of a rollout
_FILE = "rollout"
_SLACK_BYTES = 1 << 20


class PartContent(BaseModel):
    """What the manifest of a part says of it."""

    dataset: str
    rows: int = Field(ge=1, le=MOST_ROWS)  # T, the same in all parts
    columns: int = Field(ge=1, le=1 << 31)  # E
    steps: int = Field(ge=0, le=1 << 62)  # that can be learned from
    spaces: Spaces | None = None  # of the dataset, after the transforms of the run; absent in those of earlier versions
    last: bool = False


def rows_of_rollout(spaces: Spaces) -> int:
    """Return T for demonstrations: large observations make it small."""
    frame = spaces.replay_bytes(1) - spaces.replay_bytes(0)
    deepest = max(space.frames for space in spaces.observations.values())
    return max(min(MOST_ROWS, PART_BYTES // frame), min(deepest, MOST_ROWS), 1)


def check_memory(steps: int, size: int, taken: int = 0) -> None:
    """Raise SettingsError if demonstrations do not fit into memory: it names how many steps would.

    Args:
      steps: their number.
      size: bytes that they take.
      taken: bytes that other buffers of the learner will take.
    """
    available = available_memory()
    if available is None:
        return
    most = max(int(MEMORY_SHARE * available) - taken, 0)
    if size > most:
        fitting = int(steps * (most / size))
        needed, left = mebibytes(size, most)
        raise SettingsError(
            f"demonstrations of {steps:,} steps take {needed} MiB of memory, and {left} MiB are left for them: "
            f"{fitting:,} steps fit; use a smaller dataset, or set training.replay_transitions lower"
        )


def check_spaces(dataset: str, spaces: Spaces, of_run: Spaces) -> None:
    """Raise SettingsError unless the spaces of a dataset are those of the run, apart from masks."""
    there, here = spaces.without_masks(), of_run.without_masks()
    if there != here:
        differing = "; ".join(differing_spaces(there, here))
        raise SettingsError(f"dataset {dataset} (there) has other spaces than the run (here): {differing}")


class DemonstrationsWriter:
    """Writes the demonstrations of a run: all of them, or none."""

    def __init__(self, directory: Path, dataset: str, spaces: Spaces) -> None:
        """`directory` is that of the run; `dataset` is the name of what they come from, and `spaces` its spaces."""
        self._folder, self._dataset, self._spaces = directory / DEMONSTRATIONS, dataset, spaces
        self._partial = directory / f".{DEMONSTRATIONS}.partial"
        shutil.rmtree(self._partial, ignore_errors=True)
        self._parts = 0

    def add(self, rollout: Rollout, *, last: bool) -> None:
        """Write a rollout; the last one makes the demonstrations complete. Raises OSError."""
        content = PartContent(
            dataset=self._dataset,
            rows=rollout.rows,
            columns=rollout.environments,
            steps=rollout.agent_steps,
            spaces=self._spaces,
            last=last,
        )
        write_sealed(self._partial / f"{self._parts:08d}", {_FILE: encode(rollout)}, content.model_dump())
        self._parts += 1
        if last:
            self._partial.rename(self._folder)

    def discard(self) -> None:
        """Remove what is not complete."""
        shutil.rmtree(self._partial, ignore_errors=True)


class DemonstrationFiles:
    """The demonstrations in a run directory; empty if there are none."""

    def __init__(self, directory: Path) -> None:
        """Read the manifests of all parts. Raises DamagedError if a part is missing or damaged."""
        folder = directory / DEMONSTRATIONS
        paths = sorted(path for path in folder.iterdir() if path.name.isdigit()) if folder.is_dir() else []
        self._parts = [(path, SealedDirectory(path)) for path in paths]
        try:
            self._contents = [PartContent.model_validate(part.content) for _, part in self._parts]
        except ValidationError:
            raise DamagedError(f"{folder}: a manifest is not that of demonstrations") from None
        complete = [path.name for path in paths] == [f"{number:08d}" for number in range(len(paths))]
        if folder.is_dir() and not (complete and paths and self._contents[-1].last):
            raise DamagedError(f"{folder}: a part is missing: restore it, or remove the folder to go on without")
        if len({content.rows for content in self._contents}) > 1:
            raise DamagedError(f"{folder}: the parts have rollouts of different lengths")

    @property
    def dataset(self) -> str:
        """Name of what they come from; empty if there are none."""
        return self._contents[0].dataset if self._contents else ""

    @property
    def rows(self) -> int:
        """T of each rollout."""
        return self._contents[0].rows

    @property
    def columns(self) -> int:
        """E of all rollouts together."""
        return sum(content.columns for content in self._contents)

    @property
    def steps(self) -> int:
        """Number of steps that can be learned from."""
        return sum(content.steps for content in self._contents)

    def rollouts(self, spaces: Spaces, policy: PolicySpec) -> Iterator[Rollout]:
        """Yield all rollouts, each checked. Raises DamagedError, or SettingsError if they do not fit the run."""
        size = max(2 * PART_BYTES, spaces.replay_bytes(self.rows) if self._contents else 0) + _SLACK_BYTES
        for (path, part), content in zip(self._parts, self._contents, strict=True):
            if content.spaces is not None:
                check_spaces(content.dataset, content.spaces, spaces)
            try:
                rollout = decode(part.read(_FILE, size), Limits(max_bytes=size))
            except ProtocolError as error:
                raise DamagedError(f"{path}: {error}") from None
            if not isinstance(rollout, Rollout):
                raise DamagedError(f"{path}: it holds no rollout")
            if (rollout.rows, rollout.environments, rollout.agent_steps) != (
                content.rows,
                content.columns,
                content.steps,
            ):
                raise DamagedError(f"{path}: the rollout is not that of its manifest")
            violation = first_component_violation(rollout, spaces.without_masks(), policy) or number_violation(rollout)
            if violation:
                raise SettingsError(f"the demonstrations of {content.dataset} do not fit the run: {violation}")
            yield rollout
