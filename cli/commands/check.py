"""`daedalus check`: play an environment with random actions; report its faults, its speed and what train chooses."""

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from daedalus.actor.checking.check_report import EnvironmentReport, advice, never_ends
from daedalus.cli.arguments import command_parser
from daedalus.cli.settings_arguments import add_settings, run_choice
from daedalus.launch.environment_check import (
    CheckTimeoutError,
    EnvironmentCheck,
    check_in_process,
    with_measured_processes,
    with_preset,
)
from daedalus.launch.logs import print_error, say
from daedalus.launch.run_choice import RunChoice, check_learner_installed
from daedalus.learner.run.default_settings import default_settings
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.league import is_bot
from daedalus.protocol.lessons import extremes
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import short_number
from daedalus.transport.process_usage import available_processors

_DESCRIPTION = """\
Makes one environment, plays it with random actions, and checks whether reset and step keep to gymnasium's interface,
whether observations have the shape and the bounds of their space and a dtype that can be converted to its own, whether
all numbers are finite, whether episodes end, and how long a step takes. Then builds the network, and prints what
`daedalus train` with the same options would choose. `daedalus train` itself makes the first steps of this check before
it starts."""

_EXAMPLES = """\
examples:
  daedalus check --env my_module:MyEnv-v0        (my_module.py in this folder registers MyEnv-v0)
  daedalus check --env my_module:MyEnv-v0 --set environment.kwargs.size=8
  daedalus check mine.toml --seconds 60

exit status: 0 it can be trained on, 1 it cannot, 2 bad usage"""

_SECONDS, _ENV_STEPS = 10.0, 20_000
_MORE_SECONDS = 600.0  # for the start of a simulator, its resets and its last step


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus check`."""
    options = command_parser("check", _DESCRIPTION, _EXAMPLES)
    add_settings(options)
    options.add_argument(
        "--seconds",
        type=float,
        default=_SECONDS,
        metavar="S",
        help=f"play for this time, or for {_ENV_STEPS:,} env_steps (default: %(default)g)",
    )
    return options


def check(arguments: list[str]) -> int:
    """Run `daedalus check` and return its exit status."""
    parsed = parser().parse_args(arguments)
    try:
        choice = run_choice(parsed)
        spec = choice.spec()
    except SettingsError as error:
        print_error("check", error)
        return 2
    if not parsed.seconds > 0.0:
        print_error("check", f"--seconds is {parsed.seconds:g}: choose a number above 0")
        return 2
    lines = _checked(choice, spec, parsed.seconds)
    say("\n".join(f"{name:<14}{text}" for name, text in lines))
    return 1 if any(name == "problem" for name, _ in lines) else 0


def _checked(choice: RunChoice, spec: RunSpec, seconds: float) -> list[tuple[str, str]]:
    """Return the lines of the report, each with its name."""
    environment, modules = spec.environment, UserModules.of(spec.user_modules)
    check = EnvironmentCheck(
        spec=environment,
        modules=modules,
        seconds=seconds,
        env_steps=_ENV_STEPS,
        seed=spec.training.seed,
        most_seconds=seconds + _MORE_SECONDS,
        shown=True,
        notes=True,
        bots=tuple(filter(is_bot, spec.league.opponents)) if environment.is_game else (),
        lessons=extremes(spec.lessons, environment.parameters),
    )
    chosen = report = _report(check)
    processes = ""
    if choice.env is not None:
        leave_out = [*environment.leave_out, *report.constant_texts]
        defaults = default_settings(report.spaces, leave_out, report.seats, report.codes, report.maps)
        defaults, processes = with_measured_processes(choice.spec, defaults, report)
        spec = choice.spec(defaults)
        if spec.environment != environment and report.spaces is not None:
            chosen = _report(replace(check, spec=spec.environment, seconds=0.0, notes=False))
    network, fault = _network(spec, chosen.spaces, modules)
    problems = [*report.problems, *filter(None, (chosen.text_problem(spec), report.code_problem(spec), fault))]
    return [
        *_description(spec, report),
        *(_choices(spec, network) if chosen.spaces is not None else ()),
        *(("warning", text) for text in report.warnings),
        *(("note", text) for text in filter(None, (*report.notes, processes, *_advice(spec, report)))),
        *([("problem", with_preset(text, spec)) for text in problems] or [("result", _result(report))]),
    ]


def _report(check: EnvironmentCheck) -> EnvironmentReport:
    """Check an environment in a process of its own."""
    try:
        return check_in_process(check)
    except CheckTimeoutError as error:
        problem = f"environment {check.spec.id}: the check was {error}: a call does not return"
        return EnvironmentReport(problems=(problem,))


def _result(report: EnvironmentReport) -> str:
    count = len(report.warnings)
    return f"can be trained on, with {count} warning{'s' if count > 1 else ''}" if count else "no problem found"


def _description(spec: RunSpec, report: EnvironmentReport) -> Iterator[tuple[str, str]]:
    environment = spec.environment
    yield "environment", f"{environment.id} of {environment.backend}"
    if report.spaces is not None:
        yield "spaces", str(report.spaces)
    for name, text in report.constant_texts.items():
        yield "left out", f"observation component {name!r}: it is always {text!r} (environment.leave_out)"
    if report.lengths:
        lengths, returns = np.array(report.lengths), np.array(report.returns)
        yield (
            "episodes",
            f"{len(lengths):,} ended, after {lengths.min()} to {lengths.max()} env_steps; "
            "return {} to {}, mean {}".format(*map(short_number, (returns.min(), returns.max(), returns.mean()))),
        )
    if report.env_steps:
        yield (
            "speed",
            f"{report.step_seconds * 1000:.3g} ms a step, {report.reset_seconds * 1000:.3g} ms a reset, "
            f"over {report.env_steps:,} env_steps",
        )


def _choices(spec: RunSpec, network: str) -> Iterator[tuple[str, str]]:
    collection, training = spec.collection, spec.training
    target = f"target: {spec.target}" if spec.target else "no target"
    yield (
        "train",
        f"{training.algorithm}, {collection.actors} actors x {collection.envs_per_actor} environments, rollouts of "
        f"{collection.rollout_length} rows, {training.env_steps:,} env_steps, {target}",
    )
    if network:
        yield "network", network


def _advice(spec: RunSpec, report: EnvironmentReport) -> list[str]:
    if report.problems:
        return []
    endless = never_ends(report, spec)
    return [*([endless] if endless else []), *advice(report, spec, available_processors())]


def _network(spec: RunSpec, spaces: Spaces | None, modules: UserModules) -> tuple[str, str]:
    """Return a description of the network, and an empty string; or an empty string, and why it cannot be learned."""
    if spaces is None:
        return "", ""
    try:
        check_learner_installed()
    except SettingsError as error:
        return f"not tried: {error}", ""
    from daedalus.algorithms.gradients import GradientComputer
    from daedalus.policy.acting.program import export_program
    from daedalus.policy.component_inputs import coded_components
    from daedalus.policy.network.actor_critic import ActorCritic
    from daedalus.policy.network.encoders import encoder_names
    from daedalus.policy.user_modules import NetworkError
    from daedalus.protocol.algorithms import AlgorithmError

    try:
        network = ActorCritic(spec.policy, spaces, modules, spec.training)
        GradientComputer(spec.training, network, spaces, modules)  # tries an own algorithm
        export_program(network, spaces)
    except (AlgorithmError, NetworkError) as error:
        return "", str(error)
    memory = "" if spec.policy.memory == "none" else f", memory {spec.policy.memory}"
    parameters = sum(parameter.numel() for parameter in network.parameters())
    encoder = encoder_names(spec.policy, spaces.observations)
    coded = coded_components(spec.policy, spaces.observations)
    codes = "".join(f", {name} as one-hot codes ({' + '.join(map(str, each))})" for name, each in coded.items())
    return f"encoder {encoder}{codes}{memory}, {parameters:,} parameters", ""
