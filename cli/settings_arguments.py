"""Options of a run's settings, which `daedalus train` and `daedalus learner` share, and the options of the learner."""

import argparse
from pathlib import Path
from typing import Any

from daedalus.cli.arguments import (
    add_allow_module,
    add_insecure,
    add_logging,
    add_processes,
    add_reset_statistics,
    add_tls,
    command_parser,
    whole_number,
)
from daedalus.launch.run_choice import (
    Choice,
    ChosenRun,
    named_directory,
    with_record,
)
from daedalus.learner.reporting.trackers.tracker import TRACKERS
from daedalus.learner.run import run_directory
from daedalus.learner.run.changes import differing, fixed_changes
from daedalus.learner.run.settings import SettingsError, override, preset_names
from daedalus.policy.user_modules import UserModules, modules_of
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

LISTEN = "tcp/127.0.0.1:7447"

DESCRIPTION = """\
Owns the weights of a run. Receives rollouts from actors, trains on them, and publishes snapshots of the weights. Actors
connect to a Zenoh router inside this process. With --connect, the learner uses another router instead."""

EXAMPLES = """\
examples:
  daedalus learner cartpole
  daedalus learner cartpole --actors 8 --algorithm impala --listen tcp/127.0.0.1:7447
  daedalus learner --env Acrobot-v1 --set training.learning_rate=0.001 --run-dir runs/acrobot
  daedalus learner cartpole --listen tls/0.0.0.0:7447 --tls certs/learner      (daedalus certs --help)
  daedalus learner cartpole --connect tcp/router:7447
  daedalus learner car_racing_article --processes 2
  daedalus learner cartpole --run-dir runs/mine --resume      (the same line for each start by systemd or Kubernetes)
  daedalus learner --run-dir runs/mine --resume --env-steps 3000000      (the whole budget, with the steps already done)

exit status: 0 the target was reached, all steps were done without a target to stop at, or a signal stopped the learner
and its checkpoint is saved; 3 the budget was used up before the target; 1 failed; 2 bad usage;
7 a newer learner of the run has taken over"""


def add_settings(
    options: argparse.ArgumentParser, seed_help: str = "seed of the network, the environments and the actions"
) -> None:
    """Add the options that define a run: a preset or an environment, and changes to its settings."""
    options.add_argument(
        "preset",
        nargs="?",
        metavar="PRESET",
        help=f"{', '.join(preset_names())}, or a TOML file such as the config.toml of a run",
    )
    options.add_argument(
        "--env", metavar="ID", help="any gymnasium environment, with default settings. Write module:Id for your own"
    )
    options.add_argument(
        "--algorithm",
        metavar="NAME",
        help=", ".join(f"{name} ({record.summary})" for name, record in ALGORITHMS.items())
        + ". Write module:Class for your own",
    )
    options.add_argument(
        "--actors",
        type=int,
        metavar="N",
        help="number of actor processes. `daedalus learner` starts none, but a2c waits for this number",
    )
    options.add_argument("--seed", type=int, metavar="S", help=seed_help)
    options.add_argument(
        "--env-steps", type=whole_number, metavar="N", help="budget: environment steps of all actors together"
    )
    options.add_argument(
        "--wrap",
        metavar="MODULE:FUNCTION",
        help="your function that takes each gymnasium environment and returns the one to play (environment.wrap)",
    )
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="any other setting, such as training.learning_rate=0.001. The config.toml of a run lists all settings",
    )


def add_new_run(options: argparse.ArgumentParser) -> None:
    """Add the options of a run that is started."""
    options.add_argument(
        "--init-from",
        type=Path,
        metavar="RUN_DIR",
        help="begin with the weights of another run, or of one of its checkpoints. The network and the spaces must be "
        "the same",
    )
    options.add_argument(
        "--allow-other-spaces",
        action="store_true",
        help="accept --init-from of a run whose observations or actions have other names, kinds or bounds: the weights "
        "are loaded if their shapes fit",
    )
    options.add_argument("--run-dir", type=Path, metavar="DIR", help="run directory (default: a new folder in runs/)")
    add_log(options)


def add_log(options: argparse._ActionsContainer) -> None:
    """Add --log, which may be given several times."""
    options.add_argument(
        "--log",
        action="append",
        default=[],
        choices=TRACKERS,
        help="log the run to this tracker too, in addition to metrics.csv and TensorBoard. May be given several times. "
        "`daedalus resume` continues the run there",
    )


def resolve(arguments: argparse.Namespace, defaults: dict[str, Any] | None = None) -> tuple[RunSpec, Path]:
    """Return the specification and the run directory that the arguments define. Raises SettingsError.

    `defaults` are the settings that --env begins with; None: those for spaces that are not known.
    """
    spec = resolve_spec(arguments, defaults)
    return spec, arguments.run_dir or named_directory(arguments.preset, spec)


def resolve_spec(arguments: argparse.Namespace, defaults: dict[str, Any] | None = None) -> RunSpec:
    """Return the specification that the arguments define. See resolve."""
    chosen = Choice(
        preset=arguments.preset,
        env=arguments.env,
        algorithm=arguments.algorithm,
        seed=arguments.seed,
        env_steps=arguments.env_steps,
        actors=arguments.actors,
        wrap=arguments.wrap,
    )
    return chosen.spec(lambda settings: override(settings, arguments.set), defaults)


def choose_run(arguments: argparse.Namespace) -> ChosenRun:
    """Return the run that the arguments of `daedalus learner` define.

    Modules that the command line itself names are allowed; those that only an existing config.toml names need
    --allow-module. Raises SettingsError or UserModuleError.
    """
    if arguments.reset_statistics and not arguments.resume:
        raise SettingsError("--reset-statistics needs --resume: a new run has no statistics")
    named = arguments.preset is not None or arguments.env is not None
    directory = arguments.prepared or (_directory_to_resume(arguments) if arguments.resume else None)
    if directory is None:
        spec, directory = resolve(arguments)
        run_directory.check_free(directory)
        changed = []
    else:
        before = run_directory.read_config(directory)
        spec = _resumed_spec(before, arguments, directory)
        changed = differing(before, spec)
    own = modules_of(spec.user_modules) if named else []
    modules = UserModules(frozenset({*arguments.allow_module, *own}), str(directory / run_directory.CONFIG))
    modules.check(spec.learner_modules)  # the learner makes no environment
    spec = with_record(spec, modules)
    exists = (directory / run_directory.CONFIG).exists()
    return ChosenRun(spec=spec, directory=directory, exists=exists, changed=changed, modules=modules)


def _resumed_spec(before: RunSpec, arguments: argparse.Namespace, directory: Path) -> RunSpec:
    """Return the specification of the run in `directory` with the settings that the command line changes.

    A preset must be that of the run. Raises SettingsError.
    """
    config = str(directory / run_directory.CONFIG)
    changes = argparse.Namespace(**{**vars(arguments), "preset": config, "env": None})
    named = arguments.preset is not None or arguments.env is not None
    # The settings that --env begins with depend on the environment, which need not be made for this.
    spec = resolve_spec(arguments if named else changes, before.model_dump(mode="json", exclude_none=True))
    other = fixed_changes(before, spec) or differing(resolve_spec(changes), spec)
    if other:
        raise SettingsError(
            f"the run in {directory} has other settings ({', '.join(other)}): leave out PRESET, --env and all settings "
            "to continue it, or name another --run-dir"
        )
    return spec


def _directory_to_resume(arguments: argparse.Namespace) -> Path | None:
    """Return the directory of a run that exists, or None if the run has to be started. Raises SettingsError."""
    if arguments.run_dir is None:
        raise SettingsError("--resume needs --run-dir DIR: name the directory of the run to start or to continue")
    return arguments.run_dir if (arguments.run_dir / run_directory.CONFIG).exists() else None


def learner_parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus learner`."""
    options = command_parser("learner", DESCRIPTION, EXAMPLES)
    add_settings(options)
    add_new_run(options)
    addresses = options.add_mutually_exclusive_group()
    addresses.add_argument(
        "--listen", action="append", metavar="tcp/HOST:PORT", help=f"address where actors connect (default: {LISTEN})"
    )
    addresses.add_argument(
        "--connect",
        action="append",
        metavar="tcp/HOST:PORT",
        help="address of a Zenoh router to use instead of the one inside this process",
    )
    options.add_argument(
        "--resume",
        action="store_true",
        help="continue the run in --run-dir from its newest checkpoint, or start the run if there is none. "
        "For a supervisor that repeats the same command. Another --env-steps or --set changes the run from then on",
    )
    add_reset_statistics(options, "with --resume: ")
    add_processes(options)
    add_allow_module(options, "config.toml of an existing run")
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    # Options for `daedalus train`, which has created the run directory and its config.toml.
    options.add_argument("--prepared", type=Path, help=argparse.SUPPRESS)
    options.add_argument("--started", type=float, help=argparse.SUPPRESS)
    options.add_argument("--no-progress", action="store_true", help=argparse.SUPPRESS)
    options.add_argument("--rows-to", type=int, help=argparse.SUPPRESS)
    options.add_argument("--confirm", action="store_true", help=argparse.SUPPRESS)
    options.add_argument("--spaces", type=Spaces.model_validate_json, help=argparse.SUPPRESS)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options
