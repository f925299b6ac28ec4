"""The command line of `daedalus evaluate`."""

import argparse
import os
import re
import sys
from pathlib import Path
from typing import get_args

from daedalus.actor.evaluation.video import FORMATS
from daedalus.cli.arguments import add_allow_module, command_parser
from daedalus.launch.logs import add_logging
from daedalus.protocol.spec import Backend

DESCRIPTION = """\
Plays new episodes with the policy of a run and reports their returns, with unscaled rewards. By default it uses the
best checkpoint of the run: by the evaluations during training, or by its training episodes where there were none. If
there is no best one, it uses the newest. Name the folder of a checkpoint to use that one."""

EXAMPLES = """\
examples:
  daedalus evaluate runs/cartpole-impala-s1-20261121-101500
  daedalus evaluate RUN_DIR --episodes 1000 --record
  daedalus evaluate RUN_DIR --seed 7 --actions sampled
  daedalus evaluate RUN_DIR/checkpoints/0000000143
  daedalus evaluate RUN_DIR --backend gymnasium --episodes 100
  daedalus evaluate RUN_DIR --video drive.gif --max-seconds 20
  daedalus evaluate RUN_DIR --render
  daedalus evaluate --from-hub USER/NAME --revision main
  daedalus evaluate RUN_DIR --allow-module corridor      (the run plays corridor:Corridor-v0)

exit status: 0 done, 1 failed or stopped, 2 bad usage"""

_EPISODES = 100  # without --video and --render
_MOST_EPISODES = 1_000_000  # their results are held in memory
_WIDTHS = range(16, 4097)


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus evaluate`."""
    options = command_parser("evaluate", DESCRIPTION, EXAMPLES)
    options.add_argument(
        "directory", type=Path, nargs="?", metavar="RUN_DIR", help="a run directory, or one of its checkpoints"
    )
    options.add_argument(
        "--pretrained",
        metavar="NAME",
        help="a policy that is part of the package, instead of a run: car_racing or car_racing_continuous",
    )
    options.add_argument(
        "--from-hub", metavar="USER/NAME", help="a policy on the Hugging Face Hub (daedalus push), instead of a run"
    )
    options.add_argument(
        "--revision", metavar="REVISION", help="branch, tag or commit of --from-hub (default: the newest of main)"
    )
    options.add_argument("--newest", action="store_true", help="use the newest checkpoint of the run, not the best")
    options.add_argument(
        "--episodes",
        type=int,
        metavar="N",
        help=f"number of episodes (default: {_EPISODES}, or 1 with --video or --render)",
    )
    options.add_argument(
        "--seed", type=int, metavar="S", help="seed of the environments (default: a seed that training did not use)"
    )
    options.add_argument(
        "--actions",
        choices=("greedy", "sampled"),
        help="greedy: the most probable actions. sampled: as in training (default: evaluation.actions of the run)",
    )
    options.add_argument(
        "--backend",
        choices=get_args(Backend),
        help="implementation of the environment (default: evaluation.final_backend of the run, or the backend of "
        "the training)",
    )
    options.add_argument(
        "--envs",
        type=int,
        metavar="E",
        help="number of environments to step together (default: as many as training had, at most one for each episode)",
    )
    options.add_argument(
        "--wrap",
        metavar="MODULE:FUNCTION",
        help="your function that takes each gymnasium environment and returns the one to play, or none (default: "
        "environment.wrap of the run)",
    )
    add_allow_module(options, "the run")
    options.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options.add_argument(
        "--record",
        action="store_true",
        help="keep the result in the run directory, as the evaluation that report, compare and push show "
        "(evaluation.json)",
    )
    _add_watching(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def _add_watching(options: argparse.ArgumentParser) -> None:
    """Add the options for videos and windows."""
    watching = options.add_argument_group("watching", "with one environment, on gymnasium's implementation")
    watching.add_argument("--video", type=Path, metavar="FILE", help="record the episodes as FILE.mp4 or FILE.gif")
    watching.add_argument(
        "--width",
        type=int,
        metavar="W",
        help="width of the video in pixels (default: as rendered, for a gif at most 320)",
    )
    watching.add_argument(
        "--max-seconds", type=float, metavar="S", help="length of the video. The evaluation ends with it"
    )
    watching.add_argument("--render", action="store_true", help="show the episodes in a window, at human speed")


def check(arguments: argparse.Namespace) -> None:
    """Set the defaults that depend on other options. Raises ValueError for options that cannot be used."""
    watched = "--video" if arguments.video else "--render" if arguments.render else None
    if arguments.episodes is None:
        arguments.episodes = 1 if watched else _EPISODES
    if sum(source is not None for source in (arguments.directory, arguments.pretrained, arguments.from_hub)) != 1:
        raise ValueError(
            "name either a run directory (or one of its checkpoints), or --pretrained NAME, or --from-hub USER/NAME"
        )
    if arguments.revision is not None and arguments.from_hub is None:
        raise ValueError("--revision is that of a policy on the Hub: add --from-hub USER/NAME, or leave it out")
    if arguments.record and arguments.directory is None:
        raise ValueError("--record keeps the result in a run directory: name the directory of a run")
    if arguments.record and arguments.max_seconds is not None:
        raise ValueError("--record keeps whole episodes, and --max-seconds cuts them: use one of the two")
    if not 1 <= arguments.episodes <= _MOST_EPISODES:
        raise ValueError(f"--episodes is {arguments.episodes}: choose a number from 1 to {_MOST_EPISODES:,}")
    if arguments.envs is not None and not 1 <= arguments.envs <= 4096:
        raise ValueError(f"--envs is {arguments.envs}: choose a number from 1 to 4096")
    if arguments.seed is not None and arguments.seed < 0:
        raise ValueError(f"--seed is {arguments.seed}: choose 0 or more")
    if arguments.wrap not in (None, "none") and re.fullmatch(r"\w+(\.\w+)*:\w+", arguments.wrap) is None:
        raise ValueError(f"--wrap is {arguments.wrap}: write MODULE:FUNCTION, or none")
    if arguments.video and arguments.video.suffix.lower() not in FORMATS:
        raise ValueError(f"--video is {arguments.video}: the name must end with {' or '.join(FORMATS)}")
    if arguments.video and arguments.render:
        raise ValueError("--video and --render cannot be used together: run the command twice with the same --seed")
    if not arguments.video and (arguments.width is not None or arguments.max_seconds is not None):
        raise ValueError("--width and --max-seconds need --video FILE: add it, or leave them out")
    if arguments.width is not None and arguments.width not in _WIDTHS:
        raise ValueError(f"--width is {arguments.width}: choose a number from {_WIDTHS[0]} to {_WIDTHS[-1]}")
    if arguments.max_seconds is not None and not arguments.max_seconds > 0:
        raise ValueError(f"--max-seconds is {arguments.max_seconds:g}: choose a number above 0")
    if watched and arguments.backend not in (None, "gymnasium"):
        raise ValueError(f"{watched} needs gymnasium's implementation: leave out --backend {arguments.backend}")
    if watched and arguments.envs not in (None, 1):
        raise ValueError(f"{watched} shows one environment: leave out --envs {arguments.envs}")
    if arguments.render and not _has_screen():
        raise ValueError(
            "--render needs a screen, and this machine has none: record the episodes with --video FILE.mp4"
        )


def _has_screen() -> bool:
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
