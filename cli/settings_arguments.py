"""Options of a run's settings, which `daedalus train`, `daedalus learner` and others share."""

import argparse
from pathlib import Path

from daedalus.cli.arguments import whole_number
from daedalus.launch.run_choice import NewRun, RunChoice
from daedalus.learner.reporting.trackers.tracker import TRACKERS, tracker_name
from daedalus.learner.run.settings import preset_names
from daedalus.protocol.algorithms import ALGORITHMS


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
    options.add_argument(
        "--demonstrations",
        metavar="DATASET",
        help="learn from recorded episodes, too: a Minari dataset, as a folder or an id of `minari list local`, with "
        "the spaces of the environment. Its episodes are copied into the run directory. For appo and sac",
    )
    options.add_argument("--run-dir", type=Path, metavar="DIR", help="run directory (default: a new folder in runs/)")
    add_log(options)


def add_log(options: argparse._ActionsContainer) -> None:
    """Add --log, which may be given several times."""
    options.add_argument(
        "--log",
        action="append",
        default=[],
        type=_tracker_name,
        metavar="NAME",
        help=f"log the run to this tracker too ({', '.join(TRACKERS)}), in addition to metrics.csv and TensorBoard, or "
        "to a metrics writer of your own (module:Class). May be given several times. `daedalus resume` continues the "
        "run at a tracker by itself",
    )


def _tracker_name(name: str) -> str:
    try:
        return tracker_name(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def run_choice(arguments: argparse.Namespace) -> RunChoice:
    """Return what the options of `add_settings` choose. Raises SettingsError for two values of one setting."""
    choice = RunChoice(
        preset=arguments.preset,
        env=arguments.env,
        algorithm=arguments.algorithm,
        seed=arguments.seed,
        env_steps=arguments.env_steps,
        actors=arguments.actors,
        wrap=arguments.wrap,
        assignments=tuple(arguments.set),
    )
    choice.refuse_two_values()
    return choice


def new_run(arguments: argparse.Namespace) -> NewRun:
    """Return the run that the options of `add_settings` and `add_new_run` define."""
    return NewRun(
        choice=run_choice(arguments),
        directory=arguments.run_dir,
        init_from=arguments.init_from,
        other_spaces=arguments.allow_other_spaces,
        demonstrations=arguments.demonstrations,
    )
