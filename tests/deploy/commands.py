"""Check that the command lines in deployment files are valid."""

from collections.abc import Sequence

import pytest

from daedalus.cli.commands import actor, certs, exporter, learner, router, status, train
from daedalus.cli.settings_arguments import run_choice
from daedalus.learner.run.settings import SettingsError
from daedalus.transport.addresses import AddressError, check_listening

PARSERS = {
    "actor": actor.parser,
    "certs": certs.parser,
    "exporter": exporter.parser,
    "learner": learner.parser,
    "router": router.parser,
    "status": status.parser,
    "train": train.train_parser,
}


def check(words: Sequence[str]) -> str:
    """Fail if `daedalus WORDS` is invalid; return the command."""
    command, *arguments = words
    assert command in PARSERS, f"`daedalus {command}` is not a command for deployments"
    try:
        parsed = PARSERS[command]().parse_args(arguments)
        if command in ("learner", "train"):
            run_choice(parsed).spec()
        if command == "actor":
            actor.actor_options(parsed).config(None)
        if command == "router":
            check_listening(parsed.listen, tls=parsed.tls is not None, insecure=parsed.insecure)
    except (SystemExit, SettingsError, AddressError, ValueError) as error:
        pytest.fail(f"`daedalus {' '.join(words)}` is invalid: {error}")
    return command
