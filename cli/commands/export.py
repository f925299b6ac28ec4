"""`daedalus export`: write the policy of a run as one ONNX file, for use without Daedalus."""

import argparse
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import get_args

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.cli.arguments import add_allow_module, add_logging, command_parser, print_policy_error, whole_number
from daedalus.launch.logs import configure_logging, print_error, say
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.saving.hub import HubError, RepositoryNameError
from daedalus.policy.saving.onnx_graph import ExportError, Quantization
from daedalus.policy.saving.saved_policy import NoPolicyError
from daedalus.policy.saving.sealed import DamagedError
from daedalus.protocol.texts import short_number

_CHECKED_STEPS, _EPISODES = 100, 10
_SEED = 1

_DESCRIPTION = """\
Writes the policy of a run as one ONNX file that needs onnxruntime alone, in any language: it takes the observations of
the environment itself and gives its actions, the most probable ones unless --sampled. Frame stacks, pixel transforms,
normalisation, action tables and bounds are inside. By default it is the best checkpoint of the run, as in `daedalus
evaluate`. The guide "Use the policy elsewhere" has the ten lines that run it in Python, C and a browser."""

_EXAMPLES = """\
examples:
  daedalus export runs/cartpole-impala-s1-20261121-101500 cartpole.onnx --check
  daedalus export RUN_DIR policy.onnx --rows 1             (for a microcontroller)
  daedalus export RUN_DIR policy.onnx --quantize int8
  daedalus export RUN_DIR policy.onnx --sampled
  daedalus export --pretrained car_racing car.onnx --licence Apache-2.0

exit status: 0 done, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus export`."""
    options = command_parser("export", _DESCRIPTION, _EXAMPLES)
    options.add_argument(
        "directory", type=Path, nargs="?", metavar="RUN_DIR", help="a run directory, or one of its checkpoints"
    )
    options.add_argument("output", type=Path, metavar="OUT.onnx", help="file to write; it must not exist")
    options.add_argument("--pretrained", metavar="NAME", help="a policy that is part of the package, instead of a run")
    options.add_argument("--from-hub", metavar="USER/NAME", help="a policy on the Hugging Face Hub, instead of a run")
    options.add_argument("--newest", action="store_true", help="use the newest checkpoint of the run, not the best")
    options.add_argument(
        "--sampled",
        action="store_true",
        help="sample the actions: the file then takes uniform random numbers as an input (default: greedy actions)",
    )
    options.add_argument(
        "--rows",
        type=whole_number,
        metavar="N",
        help="observations of each call, in fixed shapes: converters for microcontrollers need 1 (default: any number)",
    )
    options.add_argument(
        "--quantize",
        choices=get_args(Quantization),
        help="convert the network to smaller numbers, and play with both files to show the return before and after",
    )
    options.add_argument(
        "--episodes",
        type=whole_number,
        default=_EPISODES,
        metavar="N",
        help="episodes that --quantize plays with each file (default: %(default)s)",
    )
    options.add_argument(
        "--check",
        action="store_true",
        help=f"play {_CHECKED_STEPS} steps with plain onnxruntime before the file is written, and compare each action "
        "with that of the run's policy",
    )
    options.add_argument("--licence", default="", metavar="TEXT", help="licence for the metadata, such as Apache-2.0")
    add_allow_module(options, "the run")
    add_logging(options)
    return options


def export(arguments: list[str]) -> int:
    """Run `daedalus export` and return its exit status: 0 done, 1 failed, 2 bad usage."""
    parsed = parser().parse_args(arguments)
    configure_logging(parsed.log_level, as_json=parsed.log_json, command="export")
    if sum(each is not None for each in (parsed.directory, parsed.pretrained, parsed.from_hub)) != 1:
        print_error("export", "name either a run directory, or --pretrained or --from-hub, and then the file to write")
        return 2
    if parsed.episodes < 1:
        print_error("export", f"--episodes {parsed.episodes} must be at least 1")
        return 2
    try:
        with redirect_stdout(sys.stderr):  # the environment may print
            lines = _export(parsed)
    except RepositoryNameError as error:
        print_error("export", error)
        return 2
    except (DamagedError, EnvironmentSetupError, ExportError, HubError, NoPolicyError, PolicyError) as error:
        return print_policy_error("export", error, arguments)
    except KeyboardInterrupt:
        print_error("export", "stopped")
        return 1
    say("\n".join(lines))
    return 0


def _export(parsed: argparse.Namespace) -> list[str]:
    """Write the file, and return what to say of it."""
    from daedalus.actor.evaluation.export_check import play_exported
    from daedalus.actor.evaluation.exported_policy import ExportOptions, check_new, inputs_and_outputs, write_new
    from daedalus.actor.evaluation.loaded_policy import exported_bytes, load_policy

    options = ExportOptions(sampled=parsed.sampled, rows=parsed.rows, quantize=parsed.quantize, licence=parsed.licence)
    check_new(parsed.output)
    policy = load_policy(
        parsed.directory,
        newest=parsed.newest,
        pretrained=parsed.pretrained,
        from_hub=parsed.from_hub,
        allow_modules=parsed.allow_module,
    )
    model = exported_bytes(policy, options)
    notes = []
    if parsed.check:
        played = play_exported(policy, model, sampled=parsed.sampled, seed=_SEED, steps=_CHECKED_STEPS)
        if played.different and parsed.quantize is None:
            raise ExportError(f"the file does not play as the policy does, and is not written: {played}")
        notes.append(f"check: in {played.steps} steps, {played}")
    if parsed.quantize is not None:
        plain = exported_bytes(policy, ExportOptions(sampled=parsed.sampled, rows=parsed.rows))
        before, after = (
            play_exported(policy, each, sampled=parsed.sampled, seed=_SEED, episodes=parsed.episodes)
            for each in (plain, model)
        )
        notes.append(
            f"return over {parsed.episodes} episodes: {short_number(before.mean_return)} before, "
            f"{short_number(after.mean_return)} after {parsed.quantize}; {after}; {len(plain):,} bytes before"
        )
    write_new(parsed.output, model)
    actions = "sampled" if parsed.sampled else "greedy"
    written = f"{parsed.output}: {len(model):,} bytes, {actions} actions of policy version {policy.policy_version}"
    return [written, *inputs_and_outputs(model), *notes]
