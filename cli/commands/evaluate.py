"""`daedalus evaluate`: play episodes with a policy and print their returns."""

import argparse
import json
import sys
import threading
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn, TextIO, get_args

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.evaluation.episodes import EvaluationStoppedError
from daedalus.actor.evaluation.video import VideoError
from daedalus.cli.arguments import add_allow_module, add_logging, allowing, command_parser
from daedalus.cli.terminal_match import play_at_terminal
from daedalus.launch.evaluation import run_evaluation
from daedalus.launch.evaluation_options import EPISODES, GAMES, EvaluationOptions
from daedalus.launch.logs import configure_logging, print_error, say
from daedalus.launch.match_evaluation import MatchScores
from daedalus.launch.process_lifecycle import (
    exit_on_thread_exceptions,
    exit_status,
    open_standard_streams,
    reserved_stdout,
    stop_on_signals,
)
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.saving.best_checkpoints import is_best_in_training
from daedalus.policy.saving.hub import HubError, RepositoryNameError
from daedalus.policy.saving.saved_policy import NoPolicyError
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import ModuleNotAllowedError
from daedalus.protocol.spec import Backend
from daedalus.protocol.texts import aligned, bounded_text, short_number

_FAILURES = (
    EvaluationStoppedError,
    DamagedError,
    EnvironmentSetupError,
    HubError,
    NoPolicyError,
    PolicyError,
    VideoError,
)


_SIDE_WIDTH = 30

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
  daedalus evaluate RUN_DIR --against random
  daedalus evaluate RUN_DIR --against my_players:Minimax --games 1000 --openings 4
  daedalus evaluate RUN_DIR --play
  daedalus evaluate --from-hub USER/NAME --revision main
  daedalus evaluate RUN_DIR --allow-module corridor      (the run plays corridor:Corridor-v0)

exit status: 0 done, 1 failed or stopped, 2 bad usage"""


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
        "--games",
        type=int,
        metavar="N",
        help=f"number of episodes (default: {EPISODES}; 1 with --video or --render; {GAMES} with --against)",
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
    _add_opponent(options)
    _add_watching(options)
    add_logging(options)
    return options


def _add_opponent(options: argparse.ArgumentParser) -> None:
    """Add the options for games with several agents."""
    opponent = options.add_argument_group("games with several agents")
    opponent.add_argument(
        "--against",
        metavar="OPPONENT",
        help="play games against a run directory or checkpoint, a kept version of the run (v120), random, module:Bot "
        "for your own, or USER/NAME on the Hub. The policy plays from every side in turn, and win, draw and loss are "
        "counted",
    )
    opponent.add_argument(
        "--openings",
        type=int,
        default=0,
        metavar="K",
        help="begin each game with K random moves: two players without chance play one game only otherwise (default: "
        "0)",
    )
    opponent.add_argument(
        "--play", action="store_true", help="play against the policy yourself, in this terminal, match after match"
    )
    opponent.add_argument("--seat", metavar="NAME", help="your agent in the game, with --play (default: you are asked)")


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


def main(
    command_line: Sequence[str] | None = None, stop: threading.Event | None = None, output: TextIO | None = None
) -> int:
    """Run `daedalus evaluate` and return its exit status: 0 done, 1 failed or stopped, 2 bad usage.

    Args:
      command_line: the words after `daedalus evaluate`; default: those of this process.
      stop: ends the evaluation.
      output: receives the result, and nothing else (default: standard output).
    """
    output = output or sys.stdout
    words = sys.argv[1:] if command_line is None else command_line
    with redirect_stdout(output):  # for --help
        arguments = parser().parse_args(words)
    configure_logging(arguments.log_level, as_json=arguments.log_json, command="evaluate")
    stop = stop or threading.Event()
    try:
        options = evaluation_options(arguments)
    except ValueError as error:
        print_error("evaluate", error)
        return 2
    if arguments.record and not (arguments.directory / "config.toml").is_file():
        print_error("evaluate", f"--record: {arguments.directory} is not a run directory: it has no config.toml")
        return 2
    try:
        with redirect_stdout(sys.stderr):  # the environment may print
            if arguments.play:
                play_at_terminal(options, arguments.seat, stop, output or sys.stdout)
                return 0
            result = run_evaluation(options, stop, sys.stderr)
    except ModuleNotAllowedError as error:
        print_error("evaluate", allowing(error, ["daedalus", "evaluate", *words]))
        return 2
    except RepositoryNameError as error:
        print_error("evaluate", error)
        return 2
    except _FAILURES as error:
        # The signal may also have ended the processes of the environments: their errors are not the reason then.
        print_error("evaluate", "stopped" if stop.is_set() else error)
        return 1
    say(json.dumps(result, default=asdict) if arguments.json else _text(result), output)
    return 0 if not arguments.record or _record(result, arguments.directory) else 1


def evaluation_options(arguments: argparse.Namespace) -> EvaluationOptions:
    """Return what the command line asks for. Raises ValueError for options that cannot be used."""
    if arguments.record and arguments.directory is None:
        raise ValueError("--record keeps the result in a run directory: name the directory of a run")
    if arguments.record and arguments.against is not None:
        raise ValueError("--record keeps episodes of the policy alone: leave it out, or --against")
    if arguments.record and arguments.max_seconds is not None:
        raise ValueError("--record keeps whole episodes, and --max-seconds cuts them: use one of the two")
    if arguments.play:
        others = {"--episodes": arguments.episodes, "--against": arguments.against, "--video": arguments.video}
        others |= {"--render": arguments.render, "--json": arguments.json, "--record": arguments.record}
        for name, value in others.items():
            if value:
                raise ValueError(f"--play and {name} cannot be used together: leave one out")
    elif arguments.seat is not None:
        raise ValueError("--seat is yours in a game with --play: add it, or leave --seat out")
    return EvaluationOptions(
        directory=arguments.directory,
        pretrained=arguments.pretrained,
        from_hub=arguments.from_hub,
        revision=arguments.revision,
        newest=arguments.newest,
        episodes=arguments.episodes,
        seed=arguments.seed,
        actions=arguments.actions,
        backend=arguments.backend,
        envs=arguments.envs,
        wrap=arguments.wrap,
        allowed_modules=frozenset(arguments.allow_module),
        video=arguments.video,
        width=arguments.width,
        max_seconds=arguments.max_seconds,
        render=arguments.render,
        against=arguments.against,
        openings=arguments.openings,
    )


def _record(result: dict[str, Any], directory: Path) -> bool:
    """Keep a result in a run directory, as the final evaluation does, and return whether that was possible."""
    from daedalus.launch.final_evaluation import evaluation_summary
    from daedalus.learner.run import run_directory  # a policy of another place needs no code of the learner
    from daedalus.learner.run.settings import SettingsError

    path = directory / run_directory.EVALUATION
    try:
        run_directory.write_json(path, result)
        with suppress(SettingsError):  # training goes on, or was killed: there is no summary
            path = directory / run_directory.SUMMARY
            summary = run_directory.read_json(path)
            run_directory.write_json(path, {**summary, **evaluation_summary(result)})
    except OSError as error:
        print_error("evaluate", f"{path} cannot be written: {error.strerror}")
        return False
    return True


def _text(result: dict[str, Any]) -> str:
    scores: MatchScores | None = result.get("matches")
    best = "best checkpoint, " if result["best_checkpoint"] else ""
    if is_best_in_training(Path(result["checkpoint"])):
        best = "best checkpoint by its training episodes, "
    if scores is not None:
        return "\n".join([*_lines_of(scores, result, best), *result["notes"]])
    text = (
        f"{result['environment']} (backend {result['backend']}), {best}policy version {result['policy_version']}: "
        f"return {short_number(result['return_mean'])} +- {short_number(result['return_std'])} "
        f"(from {short_number(result['return_min'])} to {short_number(result['return_max'])}) "
        f"over {result['episodes']} {result['actions']} episodes"
    )
    if "video" in result:
        text += f"\nvideo: {result['video']}, {result['video_seconds']:.1f} s"
    return "\n".join([text, *result["notes"]])


def _lines_of(scores: MatchScores, result: dict[str, Any], best: str) -> list[str]:
    """Return the results against an opponent as a table."""
    version = "" if scores.opponent_version is None else f" (policy version {scores.opponent_version})"
    openings = f", each after {scores.openings} random moves" if scores.openings else ""
    rows = [("side", "games", "win", "draw", "loss", "return", "opponent's")]
    rows += [
        (
            bounded_text(", ".join(score.agents), _SIDE_WIDTH) or "all",
            str(score.games),
            _percent(score.wins, score.games, score.win_interval),
            _percent(score.draws, score.games, score.draw_interval),
            _percent(score.losses, score.games, score.loss_interval),
            short_number(score.return_mean),
            short_number(score.opponent_return_mean),
        )
        for score in (*scores.sides, scores.total)
    ]
    return [
        f"{result['environment']}, {best}policy version {result['policy_version']}, against {scores.opponent}"
        f"{version}: {scores.total.games} {result['actions']} games{openings}, seed {result['seed']}",
        *aligned(rows),
        f"in brackets: Wilson's interval at 95 %; distinct games: {scores.distinct_games}",
    ]


def _percent(count: int, games: int, interval: tuple[float, float]) -> str:
    return f"{100 * count / games:.1f} % ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"


def run_process() -> NoReturn:
    """Run the command of this process, and end it."""
    exit_on_thread_exceptions(plays=True)
    open_standard_streams()  # before descriptors are opened
    stopped, result = stop_on_signals(exit_if_stuck=True), reserved_stdout()
    sys.exit(exit_status(lambda: main(stop=stopped, output=result), result))


if __name__ == "__main__":
    run_process()
