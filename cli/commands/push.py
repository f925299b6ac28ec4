"""`daedalus push`: upload the policy of a run to the Hugging Face Hub."""

import argparse
from pathlib import Path

from daedalus.cli.arguments import add_logging, command_parser
from daedalus.launch.logs import configure_logging, print_error, say
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.hub import HubError, RepositoryNameError
from daedalus.policy.saving.saved_policy import NoPolicyError
from daedalus.policy.saving.sealed import DamagedError

_DESCRIPTION = """\
Uploads the policy of a run that `daedalus evaluate` uses, the best, to the Hugging Face Hub: the program (ONNX), the
weights (safetensors), the settings, the metrics, the recorded evaluation, the newest video of the run directory, and a
model card with the results. Nothing in the upload can execute. Names of actors and hosts are not part of it."""

_EXAMPLES = """\
examples:
  daedalus push runs/cartpole-impala-s1-20261121-101500 USER/cartpole
  daedalus push RUN_DIR USER/NAME --private

before it:
  hf auth login
  daedalus evaluate RUN_DIR --video RUN_DIR/replay.mp4

The policy on another machine: daedalus evaluate --from-hub USER/NAME

exit status: 0 done, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus push`."""
    options = command_parser("push", _DESCRIPTION, _EXAMPLES)
    options.add_argument("directory", type=Path, metavar="RUN_DIR", help="run whose policy to upload")
    options.add_argument("repository", metavar="USER/NAME", help="repository; it is created if it does not exist")
    options.add_argument("--private", action="store_true", help="create the repository as a private one")
    add_logging(options)
    return options


def push(arguments: list[str]) -> int:
    """Run `daedalus push` and return its exit status: 0 done, 1 failed, 2 bad usage."""
    from daedalus.analysis.hub_upload import push as upload

    parsed = parser().parse_args(arguments)
    configure_logging(parsed.log_level, as_json=parsed.log_json, command="push")
    try:
        address = upload(parsed.directory, parsed.repository, private=parsed.private)
    except RepositoryNameError as error:
        print_error("push", error)
        return 2
    except (HubError, RunDataError, NoPolicyError, DamagedError) as error:
        print_error("push", error)
        return 1
    except KeyboardInterrupt:
        print_error("push", "stopped")
        return 1
    say(f"pushed to {address}")
    return 0
