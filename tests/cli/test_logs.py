"""What the log handler writes for a person, for the log of a service and for a log collector."""

import json
import logging
import re
import sys

import pytest

from daedalus.launch.logs import EVENTS, configure_logging, print_error

LOGGER = logging.getLogger("daedalus.test")
TIME = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z"


@pytest.fixture
def lines() -> list[str]:
    return []


def test_control_characters_of_a_remote_text_do_not_reach_the_terminal(lines: list[str]) -> None:
    """A peer's text is logged as it came; a terminal would obey its escape sequences."""
    configure_logging(write=lines.append)
    LOGGER.info("the learner refused: %s", "\x1b]0;owned\x07\x1b[2J\r\nfake line\x9b31m")
    assert lines == ["the learner refused: \\x1b]0;owned\\x07\\x1b[2J\\r\nfake line\\x9b31m"]


@pytest.mark.parametrize("text", ["return 12.5 +- 3", "a\tb", "naïve café 東京"])
def test_ordinary_text_is_unchanged(text: str, lines: list[str]) -> None:
    configure_logging(write=lines.append)
    LOGGER.info("%s", text)
    assert lines == [text]


def test_line_of_a_service_has_time_level_process_run_epoch_and_actor(lines: list[str]) -> None:
    context = {"actor": "arm-1"}
    configure_logging(process="actor", context=context, write=lines.append)
    LOGGER.info("waiting for a learner")
    context.update(run="mine", epoch="1f3a")
    LOGGER.warning("slow link")
    assert re.fullmatch(TIME + " info actor actor=arm-1: waiting for a learner", lines[0])
    assert re.fullmatch(TIME + " warning actor actor=arm-1 run=mine epoch=1f3a: slow link", lines[1])


def test_line_about_an_event_of_an_actor_names_it(lines: list[str]) -> None:
    configure_logging(process="learner", context={"run": "mine"}, write=lines.append)
    logging.getLogger(EVENTS).info("left", extra={"actor": "arm-1", "event": "left"})
    logging.getLogger(EVENTS).info("left", extra={"actor": 'x" run=other', "event": "left"})
    assert lines[0].endswith(" info learner run=mine actor=arm-1: left")
    assert lines[1].endswith(r' info learner run=mine actor="x\" run=other": left')


def test_every_line_of_a_longer_text_has_the_prefix(lines: list[str]) -> None:
    """A text of a peer cannot imitate another record."""
    configure_logging(process="learner", context={"run": "mine"}, write=lines.append)
    LOGGER.info("refused: %s", "x\n2026-01-01T00:00:00.000Z info learner run=mine: all is well")
    first, second = lines[0].split("\n")
    assert re.fullmatch(TIME + " info learner run=mine: refused: x", first)
    assert re.fullmatch(TIME + " info learner run=mine: 2026-01-01.*", second)


def test_line_on_a_terminal_is_short(lines: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    configure_logging(process="actor", context={"actor": "arm-1", "run": "mine"}, write=lines.append)
    LOGGER.info("joined")
    LOGGER.warning("slow link")
    assert re.fullmatch(r"\d\d:\d\d:\d\d actor arm-1: joined", lines[0])
    assert re.fullmatch(r"\d\d:\d\d:\d\d actor arm-1: warning: slow link", lines[1])


def test_json_has_the_fields_of_the_context_and_the_kind_of_an_event(lines: list[str]) -> None:
    configure_logging(as_json=True, context={"run": "mine", "epoch": "1f"}, write=lines.append)
    logging.getLogger(EVENTS).warning("refused", extra={"actor": "arm-1", "event": "refused"})
    record = json.loads(lines[0])
    assert re.fullmatch(TIME, record["time"])
    assert [record[name] for name in ("level", "run", "epoch", "actor", "event", "message")] == [
        *("warning", "mine", "1f", "arm-1", "refused", "refused")
    ]


def test_command_for_a_person_shows_messages_alone_and_only_events_that_need_attention(lines: list[str]) -> None:
    for level in ("info", "debug"):
        configure_logging(level, write=lines.append)
        logging.getLogger(EVENTS).info("joined", extra={"actor": "arm-1", "event": "joined"})
        logging.getLogger(EVENTS).warning("refused", extra={"actor": "arm-1", "event": "refused"})
        LOGGER.info("resuming")
    assert lines == ["arm-1: refused", "resuming", "arm-1: joined", "arm-1: refused", "resuming"]


def test_control_characters_of_an_error_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    print_error("actor", ValueError("no\x1b[2J"))
    assert capsys.readouterr().err == "daedalus actor: no\\x1b[2J\n"


def test_secrets_are_hidden_in_log_lines_and_errors(lines: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for as_json in (False, True):
        configure_logging(as_json=as_json, write=lines.append)
        logging.getLogger("daedalus.x").warning("%s", "mlflow: https://ada:pa55w0rd@host failed")
    print_error("train", "https://ada:pa55w0rd@host")
    shown = "".join([*lines, capsys.readouterr().err])
    assert shown.count("https://***@host") == 3
    assert "pa55w0rd" not in shown
