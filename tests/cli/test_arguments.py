"""cli/arguments.py, and options of single commands: words that are refused, with the error of the option."""

import argparse
from collections.abc import Callable

import pytest

from daedalus.cli.commands import actor, orders, router


@pytest.mark.parametrize("parser", [actor.parser, orders.drain_parser])
@pytest.mark.parametrize("text", ["nan", "-1", "-inf", "soon", ""])
def test_a_timeout_that_is_no_duration_is_refused(
    parser: Callable[[], argparse.ArgumentParser], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["--connect", "tcp/127.0.0.1:1", f"--timeout={text}"])
    assert f"argument --timeout: {text!r} is not a number of seconds, 0 or more" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["x", "", "nan", "0.5", "2000"])
def test_a_message_size_that_is_no_number_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        router.parser().parse_args([f"--max-message-megabytes={text}"])
    assert f"argument --max-message-megabytes: {text!r} is not a number from 1 to 1024" in capsys.readouterr().err
