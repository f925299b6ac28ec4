"""`daedalus runs`: keep a folder of runs in order: list, tag, find the best, archive, restore and prune."""

import argparse
import json
import shlex
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.cli.arguments import command_parser, whole_number
from daedalus.launch.logs import print_error, say
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.settings import SettingsError
from daedalus.protocol.texts import aligned, one_line

if TYPE_CHECKING:
    from daedalus.analysis.run_archive import RunArchive

_DESCRIPTION = """\
Keeps runs in order: shows them, gives them tags and notes, finds the best, writes a run to one file and restores it,
and removes what nobody needs. There is no database: all of it is in the run directories. A folder of run directories
stands for all of them, FOLDER@TAG for those with a tag, and @TAG for those in runs/. The commands compare, plot, report
and status take tags, too."""

_EXAMPLES = """\
examples:
  daedalus runs list
  daedalus runs tag paper runs/cartpole-impala-s1-20261121-101500
  daedalus compare runs@old -- runs@new
  daedalus runs note RUN_DIR "without normalisation; the third seed diverged"
  daedalus runs best runs
  daedalus runs archive RUN_DIR cartpole.tar
  daedalus runs restore cartpole.tar runs/again
  daedalus runs prune runs                    (shows what it would remove)
  daedalus runs prune runs --yes

exit status: 0 done, 1 failed, 2 bad usage"""

_NO_REPLAY = "leave the replay buffer out, from which `sac` learns: a resumed run then begins with an empty one"


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus runs`."""
    options = command_parser("runs", _DESCRIPTION, _EXAMPLES)
    verbs = options.add_subparsers(dest="verb", required=True, metavar="VERB")
    listed = verbs.add_parser("list", help="print a line about each run")
    _add_runs(listed)
    listed.add_argument("--json", action="store_true", help="print each run as one JSON object per line")
    shown = verbs.add_parser("show", help="print what a run or an archive is")
    shown.add_argument("path", type=Path, metavar="RUN", help="run directory, or archive, whose checksums are compared")
    tag = verbs.add_parser("tag", help="give runs a tag, or take it away")
    tag.add_argument("tag", metavar="TAG", help="letters, digits, '.', '_' and '-'")
    _add_runs(tag, required=True)
    tag.add_argument("--remove", action="store_true", help="take the tag away")
    note = verbs.add_parser("note", help="replace the note of a run")
    note.add_argument("directory", type=Path, metavar="RUN_DIR", help="the run")
    note.add_argument("text", metavar="TEXT", help="the note; '' removes it")
    best = verbs.add_parser("best", help="print the path of the best run of each task")
    _add_runs(best)
    archive = verbs.add_parser("archive", help="write one file with everything to repeat or resume a run")
    archive.add_argument("directory", type=Path, metavar="RUN_DIR", help="a run that nobody trains now")
    archive.add_argument("output", type=Path, metavar="OUT.tar", help="file to write; it must not exist")
    archive.add_argument("--no-replay", action="store_true", help=_NO_REPLAY)
    restore = verbs.add_parser("restore", help="write the run directory that is in an archive")
    restore.add_argument("archive", type=Path, metavar="FILE.tar", help="file of `daedalus runs archive`")
    restore.add_argument(
        "directory", type=Path, nargs="?", metavar="RUN_DIR", help="must not exist (default: the run's name, in runs/)"
    )
    prune = verbs.add_parser("prune", help="remove runs that are neither tagged nor the best; at first only show them")
    _add_runs(prune)
    prune.add_argument("--yes", action="store_true", help="remove them (default: show what would be removed)")
    prune.add_argument(
        "--best",
        type=whole_number,
        default=1,
        metavar="N",
        help="best runs of each task to keep (default: %(default)s)",
    )
    prune.add_argument(
        "--unfinished", action="store_true", help="also remove runs that could be resumed, and those without a result"
    )
    return options


def _add_runs(options: argparse.ArgumentParser, *, required: bool = False) -> None:
    options.add_argument(
        "directories",
        nargs="+" if required else "*",
        type=Path,
        default=None if required else [Path("runs")],
        metavar="RUN_DIR",
        help="run directories, folders of them, or FOLDER@TAG" + ("" if required else " (default: runs)"),
    )


def runs(arguments: list[str]) -> int:
    """Run `daedalus runs` and return its exit status: 0 done, 1 failed. Bad usage raises SystemExit(2)."""
    from daedalus.analysis.run_archive import ArchiveError

    options = parser()
    parsed = options.parse_args(arguments)
    if parsed.verb == "prune" and parsed.best < 0:
        options.error(f"--best {parsed.best} must be at least 0")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # nothing half done is left
    verbs = {"list": _list, "show": _show, "tag": _tag, "note": _note, "best": _best}
    verbs |= {"archive": _archive, "restore": _restore, "prune": _prune}
    try:
        return verbs[parsed.verb](parsed)
    except (ArchiveError, RunDataError, SettingsError) as error:
        print_error("runs", error)
    except OSError as error:
        print_error("runs", f"{error.filename or parsed.verb}: {error.strerror or error}")
    except KeyboardInterrupt:
        print_error("runs", "stopped")
    return 1


def _list(parsed: argparse.Namespace) -> int:
    from daedalus.analysis.run_folder import RunEntry, best_runs, read_entry
    from daedalus.analysis.run_selection import find_runs

    entries = [read_entry(directory) for directory in find_runs(parsed.directories)]
    best = {entry.directory for entry in best_runs(entries)}

    def values(entry: RunEntry) -> dict[str, object]:
        score = entry.score
        return {
            "directory": str(entry.directory),
            "environment": entry.environment,
            "status": entry.status,
            "return": None if score is None else score.value,
            "of": None if score is None else score.of,
            "best": entry.directory in best,
            "env_steps": entry.env_steps,
            "bytes": entry.size,
            "made_by": entry.made_by,
            "written_by": entry.written_by,
            "tags": list(entry.labels.tags),
            "note": entry.labels.note,
            "problem": entry.problem,
        }

    if parsed.json:
        for entry in entries:
            say(json.dumps(values(entry)))
        return 0
    rows = [("run", "environment", "status", "return", "env_steps", "MiB", "release", "tags")]
    for entry in entries:
        mark = ", the best" if entry.directory in best else ""
        rows.append(
            (
                str(entry.directory),
                entry.environment or "-",
                entry.status,
                "-" if entry.score is None else f"{entry.score}{mark}",
                f"{entry.env_steps:,}",
                _mib(entry.size),
                entry.written_by.removeprefix("daedalus-rl ") or "-",
                " ".join(entry.labels.tags),
            )
        )
    for line in aligned([[one_line(cell) for cell in row] for row in rows]):
        say(line)
    for entry in entries:
        if entry.problem:
            print_error("runs", entry.problem)
    return 0


def _mib(size: int) -> str:
    return f"{size / 2**20:,.1f}"


def _show(parsed: argparse.Namespace) -> int:
    if parsed.path.is_file():
        from daedalus.analysis.run_archive import listed_paths, read_archive

        archive = read_archive(parsed.path)
        archive.verify()
        say(f"{_described(parsed.path, archive)}; all checksums are right")
        if archive.left_out:
            say(f"  not in it: {listed_paths(archive.left_out)}")
        say(f"  restore it with: {shlex.join(['daedalus', 'runs', 'restore', str(parsed.path)])}")
        return 0
    from daedalus.analysis.run_folder import described, read_entry
    from daedalus.analysis.run_selection import one_run

    entry = read_entry(one_run(parsed.path))
    for line in described(entry):
        say(line)
    return 1 if entry.problem else 0


def _described(path: Path, archive: "RunArchive") -> str:
    return (
        f"{path}: run {archive.run}, {len(archive.members):,} files, {_mib(archive.size)} MiB, written by daedalus-rl "
        f"{archive.release}"
    )


def _tag(parsed: argparse.Namespace) -> int:
    from daedalus.analysis.run_selection import change_tag, checked_tag, find_runs

    checked_tag(parsed.tag)
    for directory in find_runs(parsed.directories):
        if change_tag(directory, parsed.tag, remove=parsed.remove):
            say(f"{directory}: tag {parsed.tag} {'removed' if parsed.remove else 'added'}")
        else:
            say(f"{directory}: it {'has no' if parsed.remove else 'has the'} tag {parsed.tag}; nothing changed")
    return 0


def _note(parsed: argparse.Namespace) -> int:
    from daedalus.analysis.run_selection import change_note, one_run

    change_note(one_run(parsed.directory), parsed.text)
    say(f"{parsed.directory}: note {'replaced' if parsed.text.strip() else 'removed'}")
    return 0


def _best(parsed: argparse.Namespace) -> int:
    """Print paths only, for a shell; what they are the best of goes to standard error."""
    from daedalus.analysis.run_folder import best_runs, read_entry
    from daedalus.analysis.run_selection import find_runs

    entries = [read_entry(directory) for directory in find_runs(parsed.directories)]
    found = best_runs(entries)
    evaluated = {entry.task for entry in found if entry.is_evaluated}
    for entry in found:
        if entry.is_evaluated or entry.task not in evaluated:
            print_error("runs", f"{entry.environment}: return {entry.score}")
            say(str(entry.directory))
    if not found:
        raise RunDataError("no run has a return that can be compared: evaluate one with --record, or let it train on")
    return 0


def _archive(parsed: argparse.Namespace) -> int:
    from daedalus.analysis.run_archive import write_archive

    archive, notes = write_archive(parsed.directory, parsed.output, replay=not parsed.no_replay)
    say(f"{_described(parsed.output, archive)}; read again, and all checksums are right")
    for note in notes:
        say(f"  {note}")
    return 0


def _restore(parsed: argparse.Namespace) -> int:
    from daedalus.analysis.run_archive import read_archive
    from daedalus.analysis.run_folder import described, read_entry
    from daedalus.analysis.run_selection import RUNS

    archive = read_archive(parsed.archive)
    directory = parsed.directory or RUNS / archive.run
    archive.restore(directory)
    say(f"restored to {directory}: {len(archive.members):,} files, all checksums are right")
    for line in described(read_entry(directory)):
        say(line)
    return 0


def _prune(parsed: argparse.Namespace) -> int:
    from daedalus.analysis.run_folder import prune_plan, read_entry, remove_interrupted, remove_run
    from daedalus.analysis.run_selection import find_runs

    entries = [read_entry(directory) for directory in find_runs(parsed.directories)]
    plan = prune_plan(entries, best=parsed.best, unfinished=parsed.unfinished)
    for verdict in plan:
        if verdict.kept:
            say(f"keeps   {verdict.entry.directory}: {verdict.kept}")
    removed = [verdict.entry for verdict in plan if not verdict.kept]
    freed, failed = 0, False
    for folder in {entry.directory.resolve().parent for entry in entries if parsed.yes}:
        remove_interrupted(folder)
    for entry in removed:
        if parsed.yes:
            try:
                remove_run(entry.directory)
            except (OSError, RunDataError, SettingsError) as error:
                what = f"{entry.directory} is not removed: {error.strerror}" if isinstance(error, OSError) else error
                print_error("runs", what)
                failed = True
                continue
        freed += entry.size
        score = f", return {entry.score}" if entry.score else ""
        say(
            f"{'removed' if parsed.yes else 'removes'} {entry.directory}: {_mib(entry.size)} MiB, {entry.status}{score}"
        )
    did = "freed" if parsed.yes else "nothing is removed yet; with --yes this would free"
    whole = _mib(sum(entry.size for entry in entries))
    say(f"{did} {_mib(freed)} of {whole} MiB, {len(removed)} of {len(plan)} runs")
    return 1 if failed else 0
