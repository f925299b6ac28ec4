"""`daedalus plot`: draw the learning curves of one or more runs from their metrics.csv."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from daedalus.analysis.charts import COLUMNS, INSTALL, draw_curves, draw_profiles
from daedalus.analysis.recorded_run import ENV_STEPS, SECONDS
from daedalus.analysis.run_groups import environment_of, select
from daedalus.cli.arguments import command_parser
from daedalus.cli.commands.compare import add_axis, add_runs, parse_groups
from daedalus.launch.logs import print_error, say
from daedalus.learner.run.run_files import RunDataError

_DESCRIPTION = """\
Draws return, entropy, value loss and policy lag of runs. Runs with equal settings apart from the seed are one curve:
their interquartile mean, with its 95 % bootstrap interval; or you name the runs of each curve, with `--` between them.
A folder of run directories stands for all of them. With runs of several environments, each has a picture of its own,
with its name in that of the file."""

_EXAMPLES = """\
examples:
  daedalus plot runs/cartpole-impala-s1-20261121-101500 --output curve.png
  daedalus plot runs --output algorithms.png --by minutes
  daedalus plot --output change.png runs/old-* -- runs/new-*
  daedalus plot sweeps/cartpole-rollout_length --output profiles.png --profile

A finished run keeps its last value, because runs that reach their target end early.

exit status: 0 done, 1 failed, 2 bad usage"""

_PICTURES = (".png", ".svg", ".pdf")
_LONGEST_NAME = 100  # of an environment, in the name of a file


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus plot`."""
    options = command_parser("plot", _DESCRIPTION, _EXAMPLES)
    options.usage = "daedalus plot [-h] --output FILE [--by env_steps|minutes] [--profile] RUN_DIR... [-- RUN_DIR...]"
    add_runs(options, "draw")
    options.add_argument(
        "--output", type=_picture, required=True, metavar="FILE", help="picture to write: .png, .svg or .pdf"
    )
    add_axis(options)
    options.add_argument(
        "--profile",
        action="store_true",
        help="draw the share of the finished runs whose final return is higher than each return, instead of curves",
    )
    return options


def _picture(word: str) -> Path:
    path = Path(word)
    if path.suffix.lower() not in _PICTURES:
        raise argparse.ArgumentTypeError(f"{path}: the name must end with {', '.join(_PICTURES)}")
    return path


def plot(arguments: list[str]) -> int:
    """Run `daedalus plot` and return its exit status: 0 done, 1 failed. Bad usage raises SystemExit(2)."""
    parsed, parts = parse_groups(parser(), arguments)
    try:
        columns = () if parsed.profile else COLUMNS if parsed.by == ENV_STEPS else (*COLUMNS, SECONDS)
        environments, problems = select(parts, finished=parsed.profile, columns=columns)
        for problem in problems:
            print_error("plot", problem)
        outputs = _outputs(parsed.output, [environment_of(groups) for groups in environments])
        for groups, output in zip(environments, outputs, strict=True):
            if parsed.profile:
                draw_profiles(groups, output)
            else:
                draw_curves(groups, output, parsed.by)
            say(f"wrote {output}")
    except ModuleNotFoundError:
        print_error("plot", INSTALL)
        return 1
    except OSError as error:
        print_error("plot", f"{parsed.output}: {error.strerror or error}")
        return 1
    except RunDataError as error:
        print_error("plot", error)
        return 1
    return 0


def _outputs(output: Path, environments: Sequence[str]) -> list[Path]:
    """Return the picture of each environment: `output`, or with several a name with that of the environment."""
    if len(environments) == 1:
        return [output]
    names = [re.sub(r"[^\w.-]", "-", name)[:_LONGEST_NAME] or "unknown" for name in environments]
    if len(set(names)) < len(names):
        names = [f"{name}-{number}" for number, name in enumerate(names, start=1)]
    return [output.with_stem(f"{output.stem}-{name}") for name in names]
