"""`daedalus compare`: print a table of groups of runs, with intervals."""

import argparse
import itertools
from pathlib import Path

from daedalus.analysis.comparison import as_csv, as_text, compare_groups
from daedalus.analysis.recorded_run import ENV_STEPS, SECONDS
from daedalus.analysis.run_groups import select
from daedalus.cli.arguments import command_parser
from daedalus.launch.logs import print_error, say
from daedalus.learner.run.run_files import RunDataError

_DESCRIPTION = """\
Compares finished runs, in one table for each environment. Runs with equal settings apart from the seed are one group,
which is named after the settings in which they differ; or you name the groups, with `--` between them. A table shows
the final return, env_steps and minutes until the mean return of the training episodes reached a threshold, and the
probability that a run is better than one of the first group. Where training plays another task than evaluations
(environment.training_kwargs, environment.no_reward_limit, lessons), evaluations have to reach the threshold. A folder
of run directories stands for all of them. Runs that are left out have a line with the reason."""

_EXAMPLES = """\
examples:
  daedalus compare runs
  daedalus compare runs/cartpole-* --threshold 400
  daedalus compare runs/old-* -- runs/new-*
  daedalus compare runs@old -- runs@new          (tags, of `daedalus runs tag`)
  daedalus compare sweeps/cartpole-rollout_length --csv table.csv

The statistics are those of Agarwal et al. (2021), "Deep Reinforcement Learning at the Edge of the Statistical
Precipice": the interquartile mean (a quarter of the runs is left out at each end) and 95 % bootstrap intervals. Train
at least 5 seeds of each setting: intervals of 3 runs are too narrow.

exit status: 0 done, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus compare`."""
    options = command_parser("compare", _DESCRIPTION, _EXAMPLES)
    options.usage = "daedalus compare [-h] [--threshold RETURN] [--csv FILE] RUN_DIR... [-- RUN_DIR...]"
    add_runs(options, "compare")
    options.add_argument(
        "--threshold",
        type=float,
        metavar="RETURN",
        help="mean return to reach (default: training.target_return, if all runs have the same)",
    )
    options.add_argument("--csv", type=Path, metavar="FILE", help="also write the table to this file, as CSV")
    return options


def add_runs(options: argparse.ArgumentParser, verb: str) -> None:
    """Add the run directories of a command; `verb` says what it does with the runs."""
    options.add_argument(
        "directories",
        nargs="+",
        type=Path,
        metavar="RUN_DIR",
        help=f"runs to {verb}; FOLDER@TAG: those in a folder that have a tag (daedalus runs)",
    )


def add_axis(options: argparse.ArgumentParser) -> None:
    """Add --by, for commands that draw curves."""
    options.add_argument(
        "--by", choices=(ENV_STEPS, "minutes"), default=ENV_STEPS, help="horizontal axis (default: %(default)s)"
    )


def compare(arguments: list[str]) -> int:
    """Run `daedalus compare` and return its exit status: 0 done, 1 failed."""
    parsed, parts = parse_groups(parser(), arguments)
    try:
        environments, problems = select(parts, finished=True, columns=[SECONDS])
        for problem in problems:
            print_error("compare", problem)
        comparisons = [compare_groups(groups, parsed.threshold) for groups in environments]
        if parsed.csv is not None:
            parsed.csv.write_text(as_csv(comparisons), "utf-8", newline="")
    except RunDataError as error:
        print_error("compare", error)
        return 1
    except OSError as error:
        print_error("compare", f"{parsed.csv}: {error.strerror}")
        return 1
    say(as_text(comparisons))
    return 0


_BETWEEN = "\x1f"  # stands for `--`, which argparse would remove


def parse_groups(options: argparse.ArgumentParser, arguments: list[str]) -> tuple[argparse.Namespace, list[list[Path]]]:
    """Return the parsed options and the groups of `directories` that `--` separates. The options may be anywhere."""
    parsed = options.parse_intermixed_args([_BETWEEN if word == "--" else word for word in arguments])
    groups = itertools.groupby(parsed.directories, lambda directory: directory == Path(_BETWEEN))
    parts = [list(part) for between, part in groups if not between]
    if not parts:
        options.error("name at least one run directory")
    return parsed, parts
