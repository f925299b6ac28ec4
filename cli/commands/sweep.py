"""`daedalus sweep`: train runs of several settings and seeds on this machine, and compare them."""

import argparse
import re
import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomli_w

from daedalus.analysis.sweep_execution import Display, RunProcesses, Sweep, report
from daedalus.analysis.sweep_plan import Axis, Choices, Planner, read_axis
from daedalus.analysis.sweep_search import INSTALL, GridSearch, SampledSearch, Search, import_optuna
from daedalus.cli.arguments import command_parser
from daedalus.cli.settings_arguments import add_log, add_settings, run_choice
from daedalus.launch.environment_check import EnvironmentProblemError, checked_defaults, checked_spaces
from daedalus.launch.logs import configure_logging, print_error, say
from daedalus.launch.process_lifecycle import stop_on_signals
from daedalus.launch.run_choice import RunChoice
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.run_lock import RunInUseError, RunLock
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.regular_files import replace_text

_DESCRIPTION = """\
Trains runs of several settings, each with several seeds, one after another or side by side (--jobs). Ends with a table
of the settings (see daedalus compare --help) and a picture of their curves. Each run has its run directory in the
folder of the sweep. The same command again continues a sweep that was interrupted, repeats no run that has ended, and
tries failed runs again; more values or seeds add runs."""

_EXAMPLES = """\
examples:
  daedalus sweep cartpole --over collection.rollout_length=1,5,20,64
  daedalus sweep cartpole --over collection.rollout_length=5,20 --over training.learning_rate=0.001,0.003 --seeds 10
  daedalus sweep cartpole --over training.algorithm=a2c,a3c,impala --jobs 4
  daedalus sweep --env Acrobot-v1 --over "policy.hidden=[64],[64,64]" --env-steps 500000 --folder sweeps/hidden
  daedalus sweep cartpole --over training.learning_rate=1e-4..1e-2 --sampler --trials 30 --seeds 3

A setting with LOW..HIGH is a range of numbers, for --sampler; it is searched on a logarithmic scale if it spans more
than a factor of 10. For an argument of the environment, its numbers are whole if both ends are. With --sampler, Optuna
chooses the values by the results so far. It ranks runs that stop at a target return by their env_steps, and others by
their final return.

exit status: 0 all runs have ended, 1 a run failed or the sweep was stopped, 2 bad usage"""

_SWEEP = "sweep.toml"


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus sweep`."""
    options = command_parser("sweep", _DESCRIPTION, _EXAMPLES)
    add_settings(options, seed_help="first seed; the others follow it (default: that of the preset)")
    options.add_argument(
        "--over",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUES",
        help="setting to vary: values with commas between them, or LOW..HIGH with --sampler. May be given several "
        "times; the sweep then makes all combinations. A comma inside brackets belongs to the value",
    )
    options.add_argument(
        "--seeds", type=_count, default=5, metavar="N", help="number of runs of each setting (default: %(default)s)"
    )
    options.add_argument(
        "--jobs",
        type=_count,
        default=1,
        metavar="N",
        help="runs side by side; each has a learner and its actors (default: %(default)s)",
    )
    add_log(options)
    options.add_argument("--folder", type=Path, metavar="DIR", help="folder for the results (default: one in sweeps/)")
    options.add_argument(
        "--sampler",
        action="store_true",
        help="let Optuna choose the values, in place of all combinations (needs the extra analysis)",
    )
    options.add_argument(
        "--trials", type=_count, metavar="N", help="number of settings that --sampler tries (default: 20)"
    )
    return options


def sweep(arguments: list[str]) -> int:
    """Run `daedalus sweep` and return its exit status."""
    parsed = parser().parse_args(arguments)
    configure_logging()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, until the sweep has handlers of its own
    try:
        axes = _axes(parsed)
        folder = parsed.folder or _default_folder(parsed, axes)
        if parsed.sampler:
            import_optuna()  # before the check, which takes seconds
        planner, seeds = _planner(parsed, axes, folder)
        search: Search | None = None
        if not parsed.sampler:  # before the folder is made: the settings may be invalid
            search = GridSearch(planner, [axis for axis in axes if isinstance(axis, Choices)], seeds)
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            search = search or SampledSearch(planner, axes, seeds, trials=parsed.trials or 20, folder=folder)
            _record(folder, parsed)
            return _run(search, folder, axes, parsed, arguments)
    except ModuleNotFoundError as error:
        if error.name != "optuna":
            raise
        return _failed(INSTALL, 2)
    except (EnvironmentProblemError, RunDataError, RunInUseError) as error:
        return _failed(str(error), 1)
    except SettingsError as error:
        return _failed(str(error), 2)
    except OSError as error:
        return _failed(f"{error.filename or 'sweep'}: {error.strerror}", 1)


def _failed(message: str, status: int) -> int:
    print_error("sweep", message)
    return status


def _axes(parsed: argparse.Namespace) -> list[Axis]:
    """Return what the sweep varies. Raises SettingsError."""
    axes = [read_axis(text) for text in parsed.over]
    keys = [axis.key for axis in axes]
    twice = next((key for index, key in enumerate(keys) if key in keys[:index]), None)
    if twice is not None:
        raise SettingsError(f"--over {twice} is there twice: write all its values after one --over")
    fixed = {text.partition("=")[0].strip() for text in parsed.set}
    if parsed.algorithm is not None:
        fixed.add("training.algorithm")
    both = next((key for key in keys if key in fixed), None)
    if both is not None:
        raise SettingsError(f"{both} is varied and also set to one value: remove one of the two")
    if parsed.sampler and not axes:
        raise SettingsError("--sampler needs a setting to choose: add --over SECTION.KEY=LOW..HIGH")
    if not parsed.sampler:
        if parsed.trials is not None:
            raise SettingsError("--trials is for --sampler: without it, the sweep makes all combinations")
        for axis in axes:
            if not isinstance(axis, Choices):
                raise SettingsError(f"--over {axis.key}: a range needs --sampler; without it, write the values")
    return axes


def _default_folder(parsed: argparse.Namespace, axes: Sequence[Axis]) -> Path:
    """Return sweeps/NAME-SETTINGS: the same for the same command, so that it continues."""
    base = parsed.env if parsed.preset is None else Path(parsed.preset).stem
    parts = [base or "", parsed.algorithm or "", *(axis.key.rpartition(".")[2] for axis in axes)]
    words = [*parts, "sampler" if parsed.sampler else ""]
    return Path("sweeps") / "-".join(re.sub(r"[^\w.]+", "-", word).strip("-.") for word in words if word)


def _planner(parsed: argparse.Namespace, axes: Sequence[Axis], folder: Path) -> tuple[Planner, range]:
    """Check the environment, and return the planner of the runs, and their seeds.

    Raises SettingsError, EnvironmentProblemError.
    """
    choice = run_choice(parsed)
    try:
        defaults, first = _checked(choice)
    except (SettingsError, EnvironmentProblemError):
        if not axes:
            raise
        # The environment, or another setting, may need one that the sweep varies.
        varied = (f"{axis.key}={axis.first}" for axis in axes)
        defaults, first = _checked(replace(choice, assignments=(*choice.assignments, *varied)))
    return Planner(choice, parsed.log, folder, defaults), range(first, first + parsed.seeds)


def _checked(choice: RunChoice) -> tuple[dict[str, Any] | None, int]:
    """Check the environment, and return the settings that it begins with, if it has no preset, and the seed."""
    defaults = None
    if choice.env is None:
        checked_spaces(choice.spec(), fork=True)
    else:
        _, defaults = checked_defaults(choice.spec, fork=True)
    return defaults, choice.spec(defaults).training.seed


def _locked(folder: Path) -> RunLock:
    """Return a lock on the folder. Raises RunInUseError if another sweep has locked it."""
    try:
        return RunLock(folder)
    except RunInUseError:
        raise RunInUseError(f"{folder} is in use by another sweep: stop it first, or choose another --folder") from None


def _record(folder: Path, parsed: argparse.Namespace) -> None:
    """Write what the sweep is to sweep.toml, for its reader."""
    content = {key: str(value) if isinstance(value, Path) else value for key, value in vars(parsed).items()}
    known = {key: value for key, value in content.items() if value is not None}
    replace_text(folder / _SWEEP, tomli_w.dumps(known))


def _run(search: Search, folder: Path, axes: Sequence[Axis], parsed: argparse.Namespace, arguments: list[str]) -> int:
    """Make all runs, print the results, and return the exit status."""
    display = Display(sys.stdout, search.total)
    display.say(f"{search.total} runs in {folder}, {parsed.jobs} at a time; the output of each is in {folder / 'logs'}")
    end = Sweep(search, RunProcesses(parsed.jobs), display).run(stop_on_signals())
    if end.stopped:
        again = shlex.join(["daedalus", "sweep", *arguments])
        say(f"stopped: {len(end.done)} of {search.total} runs have ended; continue with: {again}")
        return 1
    say(report(folder, search.planned, end, [axis.key for axis in axes], ranked=parsed.sampler))
    return 1 if end.failed else 0


def _count(text: str) -> int:
    if not re.fullmatch(r"[1-9]\d{0,3}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 9999")
    return int(text)
