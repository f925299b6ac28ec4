"""The command lines of the child processes of a run."""

import time

from daedalus.cli.running.local_run import LocalRun
from daedalus.learner.run import run_directory
from daedalus.policy.user_modules import allow_settings


def learner_arguments(run: LocalRun, address: str, *, first: bool) -> list[str]:
    """Return the arguments of the learner, which also listens at an address for the children of this machine.

    Args:
      run: the run.
      address: private address of this machine.
      first: whether this is the first learner. After a crash, the next one resumes from the newest checkpoint.
    """
    since = run.started if first else time.monotonic()
    addresses = [address, run.listen] if run.listen else [address]
    arguments = ["--prepared", str(run.directory)]
    arguments += [word for each in addresses for word in ("--listen", each)]
    if run.tls:
        arguments += ["--tls", str(run.tls)]
    if run.insecure:
        arguments.append("--insecure")
    arguments += ["--started", repr(since), *_logging(run.log_level, run.log_json), *run.observer.learner_options]
    arguments += allow_settings(run.spec.learner_modules)
    if run.spaces is not None:
        arguments += ["--spaces", run.spaces.model_dump_json()]
    if run.init_from is not None:
        arguments += ["--init-from", str(run.init_from)]
    if run.spec.training.target_return is not None:
        arguments.append("--confirm")
    if run.resume or not first:
        arguments.append("--resume")
    if run.reset_statistics and first:
        arguments.append("--reset-statistics")
    return arguments


def actor_arguments(run: LocalRun) -> tuple[str, ...]:
    """Return the arguments of this machine's actors and of the evaluator."""
    # The learner reports the progress of all actors: the records of each one are for debugging.
    level = "debug" if run.log_level == "debug" else "warning"
    return *_logging(level, run.log_json), *allow_settings(run.spec.actor_modules)


def evaluation_arguments(run: LocalRun) -> list[str]:
    """Return the arguments of every `daedalus evaluate`."""
    return [*_logging(run.log_level, run.log_json), *allow_settings(run.spec.environment.user_modules)]


def gateway_arguments(run: LocalRun) -> tuple[str, ...]:
    """Return the arguments of the gateway with the page."""
    level = "debug" if run.log_level == "debug" else "warning"  # it prints its address at any level
    filming = [*allow_settings(run.spec.user_modules), "--checkpoints", str(run.directory)]
    camera = filming if run.camera else ["--no-camera"]
    token = ("--operator-token", str(run.directory / run_directory.OPERATOR_TOKEN))
    return *_logging(level, run.log_json), *token, *camera, *([] if run.clients else ["--page-only"])


def _logging(level: str, as_json: bool) -> tuple[str, ...]:
    return "--log-level", level, *(["--log-json"] if as_json else [])
