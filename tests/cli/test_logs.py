"""What the log handler lets through to a terminal."""

import logging

import pytest

from daedalus.cli.logs import configure_logging


def test_control_characters_of_a_remote_text_do_not_reach_the_terminal() -> None:
    """A peer's text is logged as it came; a terminal would obey its escape sequences."""
    lines: list[str] = []
    configure_logging(write=lines.append)
    logging.getLogger("daedalus.test").info("the learner refused: %s", "\x1b]0;owned\x07\x1b[2J\r\nfake line\x9b31m")
    assert lines == ["the learner refused: \\x1b]0;owned\\x07\\x1b[2J\\x0d\nfake line\\x9b31m"]


@pytest.mark.parametrize("text", ["return 12.5 +- 3", "a\tb", "naïve café 東京"])
def test_ordinary_text_is_unchanged(text: str) -> None:
    lines: list[str] = []
    configure_logging(write=lines.append)
    logging.getLogger("daedalus.test").info("%s", text)
    assert lines == [text]
