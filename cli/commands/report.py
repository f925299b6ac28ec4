"""`daedalus report`: write one HTML file about one or more runs."""

import argparse
from pathlib import Path

from daedalus.analysis.charts import INSTALL
from daedalus.analysis.recorded_run import ENV_STEPS, SECONDS, read_record
from daedalus.analysis.run_groups import select
from daedalus.analysis.run_report import comparison_page, run_page
from daedalus.cli.arguments import command_parser
from daedalus.cli.commands.compare import add_axis, add_runs, parse_groups
from daedalus.launch.logs import print_error, say
from daedalus.learner.run.run_directory import REPORT
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.regular_files import replace_text

_DESCRIPTION = """\
Writes one HTML file about a run: settings, curves, statistics and a histogram of the evaluation, a video if there is
one in the run directory, versions, and what failed meanwhile. Of several runs, the file shows a table and the curves
together, for each environment: runs with equal settings apart from the seed are one curve; or you name the runs of each
curve, with `--` between them. A folder of run directories stands for all of them. The file loads nothing from other
hosts and runs no script: you can send it to others."""

_EXAMPLES = """\
examples:
  daedalus report runs/cartpole-impala-s1-20261121-101500
  daedalus report runs --output algorithms.html --by minutes
  daedalus report --output change.html runs/old-* -- runs/new-*

A video for the report: daedalus evaluate RUN_DIR --video RUN_DIR/replay.mp4

exit status: 0 done, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus report`."""
    options = command_parser("report", _DESCRIPTION, _EXAMPLES)
    options.usage = (
        "daedalus report [-h] [--output FILE] [--by env_steps|minutes] [--threshold RETURN] RUN_DIR... [-- RUN_DIR...]"
    )
    add_runs(options, "report")
    options.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help=f"file to write (default: {REPORT} in the directory of the run, or here for several runs)",
    )
    add_axis(options)
    options.add_argument(
        "--threshold",
        type=float,
        metavar="RETURN",
        help="mean return to reach, for several runs (default: training.target_return, if all runs have the same)",
    )
    return options


def write_report(directory: Path) -> Path:
    """Write the report of one run into its directory, and return the path.

    Raises RunDataError or OSError, and ModuleNotFoundError without matplotlib.
    """
    ((group,), *_), _ = select([[directory]], finished=False, columns=[SECONDS], read=read_record)
    replace_text(directory / REPORT, run_page(group, ENV_STEPS))
    return directory / REPORT


def report(arguments: list[str]) -> int:
    """Run `daedalus report` and return its exit status: 0 done, 1 failed."""
    parsed, parts = parse_groups(parser(), arguments)
    try:
        environments, problems = select(parts, finished=False, columns=[SECONDS], read=read_record)
        for problem in problems:
            print_error("report", problem)
        groups = [group for groups in environments for group in groups]
        if len(groups) == 1 and len(groups[0].runs) == 1 and not problems:
            page, output = run_page(groups[0], parsed.by), parsed.output or groups[0].runs[0].directory / REPORT
        else:
            page = comparison_page(environments, parsed.by, threshold=parsed.threshold, left_out=problems)
            output = parsed.output or Path(REPORT)
    except RunDataError as error:
        print_error("report", error)
        return 1
    except ModuleNotFoundError:
        print_error("report", INSTALL)
        return 1
    try:
        replace_text(output, page)
    except OSError as error:
        print_error("report", f"{output}: {error.strerror}; choose another file with --output")
        return 1
    say(f"wrote {output}")
    return 0
