"""A terminal that remembers its lines: what a person sees after a program has written escape sequences."""

import io
import re

_SEQUENCE = re.compile(r"\x1b\[(\?25[hl]|\d*[A-Za-z]|[\d;]*m)")


class TerminalStream(io.StringIO):
    """Stream that is a terminal."""

    def isatty(self) -> bool:
        return True


class Terminal:
    """Lines of a terminal without end, with a cursor. It knows the sequences that the displays use, and no others."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self.lines = [""]
        self._row = self._column = 0
        self.cursor_shown = True
        self.wrapped = 0  # how often a character did not fit into its line
        self._rest = ""

    def feed(self, text: str) -> None:
        text, self._rest = self._rest + text, ""
        at = 0
        while at < len(text):
            if text[at] == "\x1b":
                found = _SEQUENCE.match(text, at)
                if found is None:
                    assert len(text) - at < 8, f"unknown sequence {text[at : at + 12]!r}"
                    self._rest = text[at:]
                    return
                self._obey(found[1])
                at = found.end()
                continue
            self._put(text[at])
            at += 1

    def _put(self, character: str) -> None:
        if character == "\r":
            self._column = 0
        elif character == "\n":
            self._down()
        elif character >= " ":
            if self._column == self._columns:
                self.wrapped += 1
                self._column = 0
                self._down()
            line = self.lines[self._row].ljust(self._column)
            self.lines[self._row] = line[: self._column] + character + line[self._column + 1 :]
            self._column += 1
        else:
            raise AssertionError(f"control character {character!r}")

    def _down(self) -> None:
        self._row += 1
        if self._row == len(self.lines):
            self.lines.append("")

    def _obey(self, sequence: str) -> None:
        if sequence in ("?25h", "?25l"):
            self.cursor_shown = sequence == "?25h"
        elif sequence == "2K":
            self.lines[self._row] = ""
        elif sequence == "K":
            self.lines[self._row] = self.lines[self._row][: self._column]
        elif sequence.endswith("A"):
            self._row = max(self._row - int(sequence[:-1] or 1), 0)
        else:
            assert sequence.endswith("m"), f"unknown sequence {sequence!r}"
