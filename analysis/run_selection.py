"""Which runs a command means: run directories, folders of them, and tags; and the tags and the note of a run.

Both are in labels.json of the run directory, and so go with it. `FOLDER@TAG` stands for the runs of a folder that have
a tag, and `@TAG` for those of runs/."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from daedalus.learner.run.run_directory import CONFIG, LABELS, METRICS, write_json
from daedalus.learner.run.run_files import RunDataError, read_json
from daedalus.protocol.keys import check_name, is_name
from daedalus.protocol.texts import bounded_text

RUNS = Path("runs")  # where new runs are, unless their user says otherwise
_MOST_TAGS = 32
_LONGEST_NOTE = 2000  # bytes


@dataclass(frozen=True, slots=True)
class Labels:
    """What a person has written about a run."""

    tags: tuple[str, ...] = ()  # sorted
    note: str = ""


def find_runs(paths: Iterable[Path]) -> list[Path]:
    """Return the run directories that paths name. A folder of run directories, such as runs/, stands for all of them.

    A folder with @TAG stands for those with the tag. A run that has several paths is returned once, by the first of
    them. Raises RunDataError for a path that is none of these.
    """
    try:
        return _found(paths)
    except OSError as error:  # such as a name that is too long
        raise RunDataError(f"{error.filename}: {error.strerror}") from None


def _found(paths: Iterable[Path]) -> list[Path]:
    found: list[Path] = []
    for path in paths:
        if is_run(path):
            found.append(path)
            continue
        folder, tag = split_tag(path)
        if tag and is_run(folder):
            raise RunDataError(f"{folder} is a run directory: a tag is that of runs in a folder, such as runs@{tag}")
        inside = _runs_in(folder)
        if not inside:
            raise RunDataError(
                f"{folder} is not a run directory: it has neither {CONFIG} nor {METRICS}; "
                "name a run directory, or a folder of run directories"
                if folder.exists()
                else f"{folder} does not exist: name a run directory, or a folder of run directories"
            )
        found += _with_tag(folder, inside, tag) if tag else inside
    runs: dict[Path, Path] = {}
    for path in found:  # links give a run further paths
        runs.setdefault(path.resolve(), path)
    return list(runs.values())


def one_run(directory: Path) -> Path:
    """Return a path that is a run directory. Raises RunDataError for any other path."""
    if find_runs([directory]) != [directory]:
        raise RunDataError(f"{directory} is a folder of run directories: name one of them")
    return directory


def is_run(path: Path) -> bool:
    """Return whether a path is a run directory."""
    return (path / CONFIG).exists() or (path / METRICS).exists()


def split_tag(path: Path) -> tuple[Path, str]:
    """Return the folder and the tag of FOLDER@TAG, and for any other path the path and an empty text.

    What exists under the whole name is no tag. Raises RunDataError for a tag that no run can have.
    """
    name, at, tag = path.name.rpartition("@")
    if not at or path.exists():
        return path, ""
    folder = path.parent / name if name else RUNS if path.parent == Path() else path.parent
    return folder, checked_tag(tag)


def checked_tag(tag: str) -> str:
    """Return a tag. Raises RunDataError for one with other characters than a name may have."""
    try:
        return check_name(tag, "the tag")
    except ValueError as error:
        raise RunDataError(str(error)) from None


def _runs_in(folder: Path) -> list[Path]:
    """Return the runs of a folder, and those of the roles of a game in it, links last.

    A hidden one is being restored or removed.
    """
    found = [each.parent for each in folder.glob(f"*/{CONFIG}")]
    found += [each.parent for each in folder.glob(f"*/*/{CONFIG}") if not is_run(each.parent.parent)]
    found = [each for each in found if not any(part.startswith(".") for part in each.relative_to(folder).parts)]
    return sorted(found, key=lambda run: (run.is_symlink(), run))


def _with_tag(folder: Path, runs: list[Path], tag: str) -> list[Path]:
    tags = {run: read_labels(run).tags for run in runs}
    if found := [run for run in runs if tag in tags[run]]:
        return found
    known = sorted({each for of_run in tags.values() for each in of_run})
    there = f"the tags there are {', '.join(known)}" if known else f"give it with: daedalus runs tag {tag} RUN_DIR"
    raise RunDataError(f"no run in {folder} has the tag {tag!r}: {there}")


def read_labels(run: Path) -> Labels:
    """Return the tags and the note of a run; none without the file. Raises RunDataError for a damaged file."""
    content = read_json(run / LABELS) or {}
    tags, note = content.get("tags", []), content.get("note", "")
    if not (
        isinstance(tags, list)
        and len(tags) <= _MOST_TAGS
        and all(isinstance(tag, str) and is_name(tag) for tag in tags)
        and isinstance(note, str)
    ):
        raise RunDataError(f"{run / LABELS} is damaged: it has no tags and note; delete the file")
    return Labels(tuple(sorted(set(tags))), bounded_text(note, _LONGEST_NOTE))


def change_tag(run: Path, tag: str, *, remove: bool) -> bool:
    """Give a run a tag, or take it away, and return whether that changes its tags. Raises RunDataError."""
    before = read_labels(run)
    tags = {*before.tags} - {tag} if remove else {*before.tags, checked_tag(tag)}
    if len(tags) > _MOST_TAGS:
        raise RunDataError(
            f"{run} has {_MOST_TAGS} tags, which is the most: take one away with `daedalus runs tag TAG {run} --remove`"
        )
    if tags == {*before.tags}:
        return False
    _write(run, replace(before, tags=tuple(sorted(tags))))
    return True


def change_note(run: Path, note: str) -> None:
    """Replace the note of a run, which is one line; an empty one removes it. Raises RunDataError."""
    plain = " ".join(note.split())
    if len(plain.encode(errors="replace")) > _LONGEST_NOTE:
        raise RunDataError(
            f"the note has more than {_LONGEST_NOTE:,} bytes: shorten it, or keep a file in the directory"
        )
    if bounded_text(plain, _LONGEST_NOTE) != plain:
        raise RunDataError("the note has a password, a token, or characters that cannot be printed: leave them out")
    _write(run, replace(read_labels(run), note=plain))


def _write(run: Path, labels: Labels) -> None:
    try:
        write_json(run / LABELS, {"tags": list(labels.tags), "note": labels.note})
    except OSError as error:
        raise RunDataError(f"{run / LABELS} cannot be written: {error.strerror}") from None
