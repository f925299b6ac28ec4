"""The command line of `daedalus evaluate`."""

import argparse
import os
import sys
from pathlib import Path
from typing import get_args

from daedalus.cli.arguments import command_parser
from daedalus.protocol.spec import Backend

DESCRIPTION = """\
Plays episodes with the policy of a run and reports their returns: true rewards, episodes that
training never saw. Takes the run's best checkpoint if it has one, else its newest; or the one whose folder is named."""

EXAMPLES = """\
examples:
  daedalus evaluate runs/cartpole-impala-s1-20261121-101500
  daedalus evaluate RUN_DIR --episodes 1000 --seed 7 --actions sampled
  daedalus evaluate RUN_DIR/checkpoints/0000000143
  daedalus evaluate RUN_DIR --backend gymnasium --episodes 100
  daedalus evaluate RUN_DIR --video drive.gif --max-seconds 20
  daedalus evaluate RUN_DIR --render

exit status: 0 done, 1 failed or stopped, 2 bad usage"""

_EPISODES = 100  # unless they are watched
_WIDTHS = range(16, 4097)


def parser() -> argparse.ArgumentParser:
    """Parses what `daedalus evaluate` takes."""
    options = command_parser("evaluate", DESCRIPTION, EXAMPLES)
    options.add_argument(
        "directory", type=Path, nargs="?", metavar="RUN_DIR", help="a run directory, or one of its checkpoints"
    )
    options.add_argument("--pretrained", metavar="NAME", help="a policy that ships with the package, not a run's")
    options.add_argument("--newest", action="store_true", help="the newest checkpoint of the run, not its best")
    options.add_argument(
        "--episodes", type=int, metavar="N", help=f"episodes to play (default: {_EPISODES}; to watch, 1)"
    )
    options.add_argument(
        "--seed", type=int, metavar="S", help="of the environments (default: one that training never used)"
    )
    options.add_argument(
        "--actions",
        choices=("greedy", "sampled"),
        help="the most probable, or sampled as in training (default: evaluation.actions of the run)",
    )
    options.add_argument(
        "--backend",
        choices=get_args(Backend),
        help="whose implementation of the environment to play (default: evaluation.final_backend, "
        "else the one that was trained on)",
    )
    options.add_argument(
        "--envs", type=int, metavar="E", help="environments to step together (default: as many as help)"
    )
    options.add_argument(
        "--wrap",
        metavar="MODULE:FUNCTION",
        help="your own transform: takes each gymnasium environment and returns the one to play",
    )
    options.add_argument("--json", action="store_true", help="print the result as one JSON object")
    watching = options.add_argument_group("watching", "on gymnasium's implementation, one environment")
    watching.add_argument("--video", type=Path, metavar="FILE", help="record the episodes as FILE.mp4 or FILE.gif")
    watching.add_argument(
        "--width", type=int, metavar="W", help="of the video in pixels (default: as drawn; gif: 320 at most)"
    )
    watching.add_argument(
        "--max-seconds", type=float, metavar="S", help="cut the video after so long; the episodes are played out"
    )
    watching.add_argument("--render", action="store_true", help="show the episodes in a window, at human speed")
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def check(arguments: argparse.Namespace) -> None:
    """Fills in what depends on the rest. Raises ValueError with one line that says what cannot be asked for."""
    watched = "--video" if arguments.video else "--render" if arguments.render else None
    if arguments.episodes is None:
        arguments.episodes = 1 if watched else _EPISODES
    if (arguments.directory is None) == (arguments.pretrained is None):
        raise ValueError("name a run directory, one of its checkpoints, or --pretrained NAME, and one of them only")
    if arguments.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, not {arguments.episodes}")
    if arguments.envs is not None and not 1 <= arguments.envs <= 4096:
        raise ValueError(f"--envs must be from 1 to 4096, not {arguments.envs}")
    if arguments.seed is not None and arguments.seed < 0:
        raise ValueError(f"--seed must not be negative, and is {arguments.seed}")
    if arguments.video and arguments.render:
        raise ValueError("--video and --render cannot go together: play twice with the same --seed")
    if not arguments.video and (arguments.width is not None or arguments.max_seconds is not None):
        raise ValueError("--width and --max-seconds are for --video FILE")
    if arguments.width is not None and arguments.width not in _WIDTHS:
        raise ValueError(f"--width must be from {_WIDTHS[0]} to {_WIDTHS[-1]}, not {arguments.width}")
    if arguments.max_seconds is not None and not arguments.max_seconds > 0:
        raise ValueError(f"--max-seconds must be above 0, not {arguments.max_seconds:g}")
    if watched and arguments.backend not in (None, "gymnasium"):
        raise ValueError(f"{watched} is for gymnasium's implementation: leave out --backend {arguments.backend}")
    if watched and arguments.envs not in (None, 1):
        raise ValueError(f"{watched} shows one environment: leave out --envs {arguments.envs}")
    if arguments.render and not _has_screen():
        raise ValueError("--render needs a screen, and there is none here: record the episodes with --video FILE.mp4")


def _has_screen() -> bool:
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
