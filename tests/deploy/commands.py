"""Check that the command lines in deployment files are valid."""

from collections.abc import Sequence

import pytest

from daedalus.cli import settings_arguments as learner_options
from daedalus.cli.commands import actor_arguments as actor_options
from daedalus.cli.commands import certs, exporter, router, status, train
from daedalus.learner.run.settings import SettingsError
from daedalus.transport.addresses import AddressError, check_listening

PARSERS = {
    "actor": actor_options.parser,
    "certs": certs.parser,
    "exporter": exporter.parser,
    "learner": learner_options.learner_parser,
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
            learner_options.resolve(parsed)
        if command == "actor":
            actor_options.config(parsed, None)
        if command == "router":
            check_listening([parsed.listen], tls=parsed.tls is not None, insecure=parsed.insecure)
    except (SystemExit, SettingsError, AddressError, ValueError) as error:
        pytest.fail(f"`daedalus {' '.join(words)}` is invalid: {error}")
    return command
