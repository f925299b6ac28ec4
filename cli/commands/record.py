"""`daedalus record`: record episodes of an environment into a Minari dataset."""

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.cli.arguments import add_allow_module, add_logging, command_parser, print_policy_error, whole_number
from daedalus.launch.logs import configure_logging, print_error, say
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.saving.saved_policy import NoPolicyError
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import UserModules, modules_of
from daedalus.protocol.league import is_bot
from daedalus.protocol.spec import EnvironmentSpec

if TYPE_CHECKING:
    from daedalus.actor.environments.minari_files import MinariWriter

_KEYS, _GAMEPAD = "keys", "gamepad"

_DESCRIPTION = """\
Plays episodes and records them into a Minari dataset, with the id of the environment. The player is the policy of a
run, a bot of your own, random actions, or you, with the keyboard or a gamepad. `daedalus train` learns from the dataset
with --demonstrations. An episode is recorded when it ends; after Ctrl-C, or when the window is closed, the dataset has
the episodes that ended before.

With --by gamepad, an axis moves a number of the action. At rest the number is that of --idle. To the right, down, or
pressed, it goes up to its highest; to the left or up, it goes down to its lowest. Axes: leftx, lefty, rightx, righty,
lefttrigger, righttrigger. Buttons: a, b, x, y, back, guide, start, leftstick, rightstick, leftshoulder, rightshoulder,
dpup, dpdown, dpleft, dpright; a direction of a stick is a button, too, such as leftx- for left. The program prints what
each does, and the name of a button when you first press it."""

_EXAMPLES = """\
examples:
  daedalus record runs/pendulum-sac-s1-20261121-101500 --out pendulum/mine-v0
  daedalus record --env MountainCarContinuous-v0 --by my_module:Pump --out ./car
  daedalus record --env CarRacing-v3 --by keys --key a=[-1,0.2,0] --key d=[1,0.2,0] --key w=[0,1,0] --out ./laps
  daedalus record --env CarRacing-v3 --by gamepad --axis leftx=0 --axis righttrigger=1 --axis lefttrigger=2 --out ./laps
  daedalus record --env LunarLander-v3 --by gamepad --key a=2 --key leftx-=1 --key leftx+=3 --out ./landings

exit status: 0 all episodes are recorded, 1 failed or stopped, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus record`."""
    options = command_parser("record", _DESCRIPTION, _EXAMPLES)
    options.add_argument(
        "directory",
        type=Path,
        nargs="?",
        metavar="RUN_DIR",
        help="a run, or one of its checkpoints, whose policy plays",
    )
    options.add_argument("--env", metavar="ID", help="environment to play without a run. Write module:Id for your own")
    options.add_argument(
        "--by",
        metavar="PLAYER",
        help="who plays it: module:Bot, a class with act(observation, action_mask), or `random`; `keys` or `gamepad` "
        "for you",
    )
    options.add_argument(
        "--out",
        required=True,
        metavar="DATASET",
        help="the new dataset: a folder that begins with ./, / or ~, or an id in Minari's local folder, with a version",
    )
    options.add_argument(
        "--episodes", type=whole_number, default=25, metavar="N", help="episodes to record (default: %(default)s)"
    )
    options.add_argument(
        "--seed", type=whole_number, default=1, metavar="S", help="seed of the first episode; the next has the next"
    )
    options.add_argument("--sampled", action="store_true", help="sample the policy's actions (default: greedy ones)")
    options.add_argument("--newest", action="store_true", help="play the newest checkpoint of the run, not the best")
    options.add_argument(
        "--key",
        action="append",
        default=[],
        metavar="K=ACTION",
        help="with --by keys: the action, as JSON, while a key is pressed, or several together, as in wa=[-1,1,0]; "
        "with --by gamepad: a button, or several together, as in dpup,a=4. May be given several times (default: the "
        "keys that the environment names, and no button)",
    )
    options.add_argument(
        "--axis",
        action="append",
        default=[],
        metavar="AXIS=N",
        help="with --by gamepad: the axis moves number N of a Box, from 0; -N: the other way round. May be given "
        "several times (default, without --key: triggers for numbers whose lowest is 0, sticks for others)",
    )
    options.add_argument(
        "--idle",
        metavar="ACTION",
        help="with --by keys or gamepad: the action without a key (default: zeros)",
    )
    options.add_argument("--rate", type=whole_number, metavar="N", help="with --by keys or gamepad: steps a second")
    add_allow_module(options, "the run")
    add_logging(options)
    return options


def record(arguments: list[str]) -> int:
    """Run `daedalus record` and return its exit status."""
    parsed = parser().parse_args(arguments)
    configure_logging(parsed.log_level, as_json=parsed.log_json, command="record")
    try:
        keys, idle, axes = *_actions(parsed), _axes(parsed.axis)
    except ValueError as error:
        print_error("record", error)
        return 2
    if (parsed.directory is None) == (parsed.env is None) or (parsed.env is None) != (parsed.by is None):
        print_error("record", "name either a run directory, or --env ID and --by PLAYER")
        return 2
    if fault := _unfit_option(parsed):
        print_error("record", fault)
        return 2
    from daedalus.actor.environments.minari_files import DatasetError, new_dataset_folder

    try:
        new_dataset_folder(parsed.out)
    except DatasetError as error:
        print_error("record", error)
        return 2
    try:
        with redirect_stdout(sys.stderr):  # the environment may print
            return _record(parsed, keys, idle, axes)
    except (DamagedError, DatasetError, EnvironmentSetupError, NoPolicyError, PolicyError) as error:
        return print_policy_error("record", error, arguments)


def _unfit_option(parsed: argparse.Namespace) -> str:
    """Return why an option would have no effect or has no fitting value, or an empty string."""
    given = {
        "a RUN_DIR": {"--sampled": parsed.sampled, "--newest": parsed.newest},
        "--by keys or gamepad": {"--key": parsed.key, "--idle": parsed.idle, "--rate": parsed.rate},
        "--by gamepad": {"--axis": parsed.axis},
    }
    played = {"a RUN_DIR": parsed.env is None, "--by keys or gamepad": parsed.by in (_KEYS, _GAMEPAD)}
    played["--by gamepad"] = parsed.by == _GAMEPAD
    for player, options in given.items():
        for option, value in options.items():
            if value and not played[player]:
                return f"{option} is for {player}: leave it out"
    if not (parsed.by is None or parsed.by in (_KEYS, _GAMEPAD) or is_bot(parsed.by)):
        return f"--by {parsed.by} is no player: write module:Bot, random, {_KEYS} or {_GAMEPAD}"
    for option, value, least in (("episodes", parsed.episodes, 1), ("seed", parsed.seed, 0), ("rate", parsed.rate, 1)):
        if value is not None and value < least:
            return f"--{option} {value} must be at least {least}"
    return ""


def _actions(parsed: argparse.Namespace) -> tuple[dict[str, Any] | None, Any]:
    """Return the actions of keys, and the one without a key. Raises ValueError."""
    keys: dict[str, Any] = {}
    for each in parsed.key:
        key, equals, action = each.partition("=")
        if not (key and equals):
            raise ValueError(f"--key {each}: write K=ACTION, such as a=[-1]")
        keys[key] = _json(action, f"--key {each}")
    return keys or None, None if parsed.idle is None else _json(parsed.idle, f"--idle {parsed.idle}")


def _axes(words: Sequence[str]) -> list[tuple[str, int, bool]]:
    """Return the axes as Gamepad has them. Raises ValueError."""
    axes = []
    for each in words:
        axis, _, number = each.partition("=")
        digits = number.removeprefix("-")
        if not (axis and digits.isdecimal()):
            raise ValueError(f"--axis {each}: write AXIS=N, such as leftx=0")
        axes.append((axis, int(digits), number.startswith("-")))
    return axes


def _json(text: str, where: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        raise ValueError(f"{where}: the action is no JSON: write a number or a list of numbers") from None


def _record(
    parsed: argparse.Namespace, keys: dict[str, Any] | None, idle: Any, axes: Sequence[tuple[str, int, bool]]
) -> int:
    from daedalus.actor.environments.minari_files import DatasetError, MinariWriter
    from daedalus.actor.evaluation.dataset_recorder import (
        BotPlayer,
        PolicyPlayer,
        Recorder,
        action_of,
        recorded_environment,
        spec_to_record,
    )
    from daedalus.actor.evaluation.episodes import LONGEST
    from daedalus.actor.evaluation.gamepad import Gamepad
    from daedalus.actor.evaluation.loaded_policy import load_policy

    by_person, player, longest = parsed.by in (_KEYS, _GAMEPAD), None, LONGEST
    if parsed.directory is not None:
        policy = load_policy(parsed.directory, newest=parsed.newest, allow_modules=parsed.allow_module)
        spec, who = policy.spec.environment, f"the policy of {parsed.directory}, version {policy.policy_version}"
        modules = UserModules(frozenset(parsed.allow_module), str(parsed.directory))
        player = PolicyPlayer(policy, sampled=parsed.sampled)
        longest = policy.spec.evaluation.max_episode_env_steps * spec.action_repeat
    else:
        spec, who = EnvironmentSpec(id=parsed.env), "a person" if by_person else parsed.by
        # The command line itself names them.
        named = modules_of({word: word for word in (parsed.env, parsed.by) if ":" in word})
        modules = UserModules(frozenset({*named, *parsed.allow_module}), "the command line")
    environment = recorded_environment(spec, modules, for_person=by_person)
    try:
        gamepad = None
        if parsed.by == _GAMEPAD:
            space = environment.action_space
            pressed = {frozenset(names.split(",")): action_of(space, action) for names, action in (keys or {}).items()}
            gamepad = Gamepad(space, action_of(space, idle), pressed, axes)
        if player is None and not by_person:
            player = BotPlayer(parsed.by, environment.action_space, modules)
        spaces = environment.observation_space, environment.action_space
        writer = MinariWriter(parsed.out, *spaces, spec_to_record(environment), algorithm=who)
        recorder = Recorder(environment, writer, episodes=parsed.episodes, seed=parsed.seed, longest=longest)
        stopped = False
        try:
            if player is None:
                recorder.play_in_window(keys, idle, parsed.rate, gamepad)
            else:
                recorder.play(player)
        except KeyboardInterrupt:
            stopped = True
        except (DatasetError, EnvironmentSetupError):
            if writer.episodes:
                _say_what_is_recorded(writer, recorder.returns)
            raise
    finally:
        environment.close()
    _say_what_is_recorded(writer, recorder.returns)
    if writer.episodes < parsed.episodes:
        how = "stopped" if stopped else "ended"
        print_error("record", f"{how} after {writer.episodes} of {parsed.episodes} episodes")
        return 1
    return 0


def _say_what_is_recorded(writer: "MinariWriter", returns: Sequence[float]) -> None:
    mean = f"; return {np.mean(returns):g} +- {np.std(returns):g}" if returns else ""
    say(f"{writer.folder}: {writer.steps:,} steps in {writer.episodes:,} episodes{mean}", sys.__stdout__)
