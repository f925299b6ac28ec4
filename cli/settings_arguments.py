"""The settings half of a command line: what `daedalus train` and `daedalus learner` both take."""

import argparse
from pathlib import Path

from daedalus.cli.arguments import add_insecure, add_tls, command_parser
from daedalus.cli.logs import add_logging
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError, choose_algorithm, override, preset_names, read_preset, run_spec
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spec import RunSpec

LISTEN = "tcp/127.0.0.1:7447"

DESCRIPTION = """\
Owns the weights: takes rollouts from actors, learns, publishes snapshots. Embeds a Zenoh router that actors
connect to, unless told to use another."""

EXAMPLES = """\
examples:
  daedalus learner cartpole
  daedalus learner cartpole --actors 8 --algorithm impala --listen tcp/127.0.0.1:7447
  daedalus learner --env Acrobot-v1 --set training.learning_rate=0.001 --run-dir runs/acrobot
  daedalus learner cartpole --listen tls/0.0.0.0:7447 --tls certs/learner      (daedalus certs --help)
  daedalus learner cartpole --connect tcp/router:7447
  daedalus learner cartpole --run-dir runs/mine --resume      (from systemd or Kubernetes: the same line each time)"""


def add_settings(options: argparse.ArgumentParser) -> None:
    """Adds what decides the run: a preset or an environment, and what departs from it."""
    options.add_argument(
        "preset",
        nargs="?",
        metavar="PRESET",
        help=f"{', '.join(preset_names())}, or a TOML file such as a run's config.toml",
    )
    options.add_argument(
        "--env", metavar="ID", help="any gymnasium environment with default settings; module:Id for your own"
    )
    options.add_argument(
        "--algorithm",
        metavar="NAME",
        help=", ".join(f"{algorithm.name} ({algorithm.summary})" for algorithm in ALGORITHMS.values()),
    )
    options.add_argument(
        "--actors",
        type=int,
        metavar="N",
        help="actor processes (the learner alone starts none, but a2c waits for as many)",
    )
    options.add_argument("--seed", type=int, metavar="S", help="of the network, the environments and the actions")
    options.add_argument("--env-steps", type=int, metavar="N", help="the budget, in environment steps over all actors")
    options.add_argument(
        "--run-dir", type=Path, metavar="DIR", help="where the run goes (default: a new folder in runs/)"
    )
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="any other setting, such as training.learning_rate=0.001; config.toml of a run lists them all",
    )


def resolve(arguments: argparse.Namespace) -> tuple[RunSpec, Path]:
    """The specification and the run directory that the arguments ask for. Raises SettingsError."""
    if (arguments.preset is None) == (arguments.env is None):
        raise SettingsError(f"name a preset ({', '.join(preset_names())}) or an environment with --env ID")
    settings = {"environment": {"id": arguments.env}} if arguments.env else read_preset(arguments.preset)
    choose_algorithm(settings, arguments.algorithm)
    shortcuts = {
        ("training", "seed"): arguments.seed,
        ("training", "env_steps"): arguments.env_steps,
        ("collection", "actors"): arguments.actors,
    }
    for (section, key), value in shortcuts.items():
        if value is not None:
            settings.setdefault(section, {})[key] = value
    override(settings, arguments.set)
    spec = run_spec(settings)
    name = Path(arguments.preset).stem if arguments.preset else spec.environment.id
    return spec, arguments.run_dir or run_directory.default_directory(name, spec)


def resolve_again(arguments: argparse.Namespace) -> tuple[RunSpec, Path, bool]:
    """The same for `daedalus learner --resume`, and whether its run was begun before. Raises SettingsError."""
    if arguments.run_dir is None:
        raise SettingsError("--resume needs --run-dir: the folder of the run to begin or to go on with")
    if not (arguments.run_dir / run_directory.CONFIG).exists():
        return *resolve(arguments), False
    spec = run_directory.read_config(arguments.run_dir)
    if (arguments.preset is not None or arguments.env is not None) and resolve(arguments)[0] != spec:
        raise SettingsError(
            f"{arguments.run_dir} was begun with other settings: leave them out to go on with its own, "
            "or name another --run-dir"
        )
    return spec, arguments.run_dir, True


def learner_parser() -> argparse.ArgumentParser:
    """Parses what `daedalus learner` takes."""
    options = command_parser("learner", DESCRIPTION, EXAMPLES)
    add_settings(options)
    where = options.add_mutually_exclusive_group()
    where.add_argument(
        "--listen", action="append", metavar="tcp/HOST:PORT", help=f"where actors connect (default: {LISTEN})"
    )
    where.add_argument(
        "--connect",
        action="append",
        metavar="tcp/HOST:PORT",
        help="use the Zenoh router there instead of an own one",
    )
    options.add_argument(
        "--resume",
        action="store_true",
        help="go on from the newest checkpoint in --run-dir if there is one, else begin there: "
        "for a supervisor that starts the same command again",
    )
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    # What the launcher says to the learner it starts: a directory with config.toml that is there already.
    options.add_argument("--prepared", type=Path, help=argparse.SUPPRESS)
    options.add_argument("--started", type=float, help=argparse.SUPPRESS)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options
