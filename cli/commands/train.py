"""`daedalus train` and `daedalus resume`: a learner and actors on this machine, watched to their end."""

import argparse
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from daedalus.cli.arguments import add_insecure, add_tls, command_parser
from daedalus.cli.logs import configure_logging
from daedalus.cli.processes import process_started, stop_on_signals
from daedalus.cli.select_best import EvaluationFailedError, play, select_best
from daedalus.cli.settings_arguments import add_settings, resolve
from daedalus.cli.supervisor import FailedError, Supervised, start, stop, supervised_actor
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError
from daedalus.protocol.spec import RunSpec
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_listen

_POLL_SECONDS = 0.05
_EVALUATOR = "evaluator"

_TRAIN = """\
Starts a learner and actors as processes of this machine and shows how they learn. Stops when the target is
reached or the budget is used up, then plays 100 episodes (evaluation.final_episodes) with the best policy
that was found, or with the last. Where the run was evaluated on a schedule (evaluation.seconds), the best is
chosen among the three that scored highest and the last, by as many fresh episodes of each."""

_TRAIN_EXAMPLES = """\
examples:
  daedalus train cartpole
  daedalus train cartpole --algorithm a2c --actors 4 --seed 7
  daedalus train --env Acrobot-v1 --env-steps 500000
  daedalus train --env my_module:MyEnv-v0        (my_module.py in this folder registers MyEnv-v0)
  daedalus train cartpole --set training.stop_when_solved=false --env-steps 5000000

exit status: 0 the target was reached or the asked-for steps were done, 3 the budget ended without the target,
1 failed or stopped, 2 bad usage"""

_RESUME = """\
Continues a run from its newest checkpoint that is whole: weights, optimiser, counters and random state go on
as they were; the environments start new episodes."""

_RESUME_EXAMPLES = """\
examples:
  daedalus resume runs/cartpole-impala-s1-20261121-101500
  daedalus resume RUN_DIR --env-steps 3000000      (the whole budget, the steps already done included)"""


def train(arguments: list[str]) -> int:
    """Runs `daedalus train`."""
    started = process_started()
    options = command_parser("train", _TRAIN, _TRAIN_EXAMPLES)
    add_settings(options)
    _add_where(options)
    parsed = options.parse_args(arguments)
    try:
        _check_listening(parsed)
        spec, directory = resolve(parsed)
        run_directory.create(directory, spec)
    except (SettingsError, *SECURITY_ERRORS) as error:
        print(f"daedalus train: {error}", file=sys.stderr)
        return 2
    return _run(directory, spec, parsed, started, resume=False)


def resume(arguments: list[str]) -> int:
    """Runs `daedalus resume`."""
    started = process_started()
    options = command_parser("resume", _RESUME, _RESUME_EXAMPLES)
    options.add_argument("directory", type=Path, metavar="RUN_DIR", help="the run to continue")
    options.add_argument("--env-steps", type=int, metavar="N", help="a new budget (default: the one it had)")
    _add_where(options)
    parsed = options.parse_args(arguments)
    try:
        _check_listening(parsed)
        spec = run_directory.read_config(parsed.directory)
        if parsed.env_steps is not None:
            spec = run_directory.with_budget(spec, parsed.env_steps)
            run_directory.write_config(parsed.directory, spec)
    except (SettingsError, *SECURITY_ERRORS) as error:
        print(f"daedalus resume: {error}", file=sys.stderr)
        return 2
    return _run(parsed.directory, spec, parsed, started, resume=True)


def _add_where(options: argparse.ArgumentParser) -> None:
    options.add_argument(
        "--listen",
        metavar="tcp/HOST:PORT",
        help="where more actors may join (default: a free port of this machine)",
    )
    add_tls(options)
    add_insecure(options)
    options.add_argument(
        "--wrap",
        metavar="MODULE:FUNCTION",
        help="your own transform, for this machine's actors: takes each gymnasium environment, returns the one to play",
    )


def _check_listening(parsed: argparse.Namespace) -> None:
    credentials_to_listen([parsed.listen] if parsed.listen else [], parsed.tls, "learner", insecure=parsed.insecure)


def _run(directory: Path, spec: RunSpec, parsed: argparse.Namespace, started: float, *, resume: bool) -> int:
    """Everything between the settings and the exit status."""
    configure_logging()
    stopping = stop_on_signals()
    wrap = parsed.wrap
    listening, address = _where(parsed)
    learner = _supervised_learner(directory, listening, started, resume)
    actors: list[Supervised] = []
    try:
        names = [f"actor-{index}" for index in range(spec.collection.actors)]
        options = ("--wrap", wrap) if wrap else ()
        actors += [supervised_actor(name, address, options) for name in names]
        training = spec.training
        print(
            f"{spec.environment.id}: {training.algorithm}, seed {training.seed}, {len(actors)} actors"
            f" x {spec.collection.envs_per_actor} environments at {address}; run directory {directory}",
            flush=True,
        )
        if spec.evaluation.seconds is not None:
            actors.append(supervised_actor(_EVALUATOR, address, (*options, "--evaluator")))
        status = _watch(learner, actors, spec, stopping)
    except FailedError as error:
        print(f"daedalus train: {error}", file=sys.stderr)
        status = 1
    finally:
        stop([learner.process, *(actor.process for actor in actors)])
    if stopping.is_set():
        print(f"stopped; continue with: daedalus resume {directory}")
        return 1
    if status not in (0, 3):
        return status
    if not _evaluate(directory, spec, wrap, stopping):
        return 1
    _report(directory, spec)
    return status


def _where(parsed: argparse.Namespace) -> tuple[list[str], str]:
    """What the learner is told about listening, and where this machine's own actors connect: never over TLS."""
    own = f"tcp/127.0.0.1:{_free_port()}" if parsed.listen is None or parsed.tls else parsed.listen
    addresses = [own] if parsed.listen in (None, own) else [own, parsed.listen]
    listening = [word for address in addresses for word in ("--listen", address)]
    if parsed.tls:
        listening += ["--tls", str(parsed.tls)]
    return [*listening, *(["--insecure"] if parsed.insecure else [])], own


def _supervised_learner(directory: Path, listening: list[str], started: float, resume: bool) -> Supervised:
    """A learner that goes on from its newest checkpoint when it was killed."""

    def begin(first: bool) -> subprocess.Popen[bytes]:
        since = started if first else time.monotonic()
        arguments = ["--prepared", str(directory), *listening, "--started", repr(since)]
        return start("daedalus.cli.commands.learner", *arguments, *(["--resume"] if resume or not first else []))

    return Supervised("the learner", begin, ended={0, 3})


def _watch(learner: Supervised, actors: list[Supervised], spec: RunSpec, stopping: threading.Event) -> int:
    """Waits for the learner's end, restarting what dies meanwhile; the learner's exit status.

    Raises FailedError if the learner failed for good, or no actor is left to play.
    """
    while not stopping.wait(_POLL_SECONDS):
        status = learner.process.poll()
        if status is not None and (status in learner.ended or learner.failed_at_once):
            return status
        _say(learner.check())
        for actor in list(actors):
            try:
                _say(actor.check())
            except FailedError as error:
                actors.remove(actor)
                playing = sum(other.name != _EVALUATOR for other in actors)
                needed = not playing or spec.algorithm.synchronous  # a2c waits for all at its start
                if needed and actor.name != _EVALUATOR:
                    raise
                _say(f"{error}; going on without it")
    return 1


def _say(news: str | None) -> None:
    if news:
        print(f"\n{news}", flush=True)


def _evaluate(directory: Path, spec: RunSpec, wrap: str | None, stopping: threading.Event) -> bool:
    """Chooses the best checkpoint and plays the final episodes with it; puts the results into summary.json."""
    began = time.monotonic()
    options = ["--episodes", str(spec.evaluation.final_episodes), *(["--wrap", wrap] if wrap else [])]
    try:
        chosen = select_best(directory, spec, options, stopping)
        (evaluation,) = play([[str(directory), *options]], stopping)
    except EvaluationFailedError:
        return False
    summary = run_directory.read_json(directory / run_directory.SUMMARY)
    summary["evaluation_return_mean"] = evaluation["return_mean"]
    summary["evaluation_return_std"] = evaluation["return_std"]
    summary["evaluation"] = {**evaluation, "select_best": chosen, "seconds": time.monotonic() - began}
    run_directory.write_json(directory / run_directory.SUMMARY, summary)
    return True


def _report(directory: Path, spec: RunSpec) -> None:
    summary: dict[str, Any] = run_directory.read_json(directory / run_directory.SUMMARY)
    target = spec.training.target_return
    if summary["solved"]:
        print(
            f"solved: mean return {target:g} reached after {summary['seconds_to_target']:.1f} s, "
            f"{summary['env_steps']:,} env_steps, {summary['updates']:,} updates"
        )
    else:
        goal = "" if target is None else f" (the target {target:g} was not reached)"
        print(f"done: {summary['env_steps']:,} env_steps, {summary['updates']:,} updates{goal}")
    evaluation = summary["evaluation"]
    print(
        f"evaluation: return {evaluation['return_mean']:.1f} +- {evaluation['return_std']:.1f} "
        f"over {evaluation['episodes']} {evaluation['actions']} episodes of the "
        f"{'best' if evaluation['best_checkpoint'] else 'newest'} checkpoint "
        f"on {evaluation['backend']}'s {evaluation['environment']}"
    )
    print(f"all of it lies in {directory}; draw it with: daedalus plot {directory} --output curve.png")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
