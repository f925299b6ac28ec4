"""Texts for a person who reads them: those from outside, printable or bounded, and numbers. Pure functions.

Outside are peers, and whoever has sent a run directory: names, reasons, paths and errors. A terminal obeys control
characters; others reorder a line, hide in it or end it. `str.isprintable` knows them all, also those to come: controls,
formats such as the marks of direction and the tags, separators other than the space, halves of characters that stand
for the bytes of a file's name, and what Unicode has not assigned. Whatever reaches a terminal, a log or a file goes
through one of these functions.
"""

from daedalus.protocol.redaction import without_secrets

MAX_NAME, MAX_TEXT = 64, 300  # bytes in UTF-8: of a name, and of a reason or an event
MAX_ANSWER_TEXT = 1000  # bytes in UTF-8: of the reason in an answer to this process


def printable(text: str) -> str:
    """Return a text without secrets, and with every character that is not printable escaped but newlines and tabs."""
    text = without_secrets(text)
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() or character in "\n\t" else _escaped(character) for character in text
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def one_line(text: str) -> str:
    """Return a text in one line, printable."""
    return printable(" ".join(text.split()))


def bounded_text(text: str, most: int = MAX_TEXT) -> str:
    """Return a foreign text in one line, without secrets and unprintable characters, cut to `most` bytes in UTF-8.

    An unprintable character becomes a space, and several spaces become one. Whatever a peer sends, a learner can then
    keep the text, log it, and report it within the limits of its readers, which count bytes.
    """
    start = without_secrets(text[: 4 * most])[:most]
    printable = "".join(character if character.isprintable() else " " for character in start)
    return " ".join(printable.split()).encode()[:most].decode(errors="ignore")


def short_number(value: float) -> str:
    """Return a number of any size with at least three digits that count: 1,234,567, 987.1, 0.982 or 1.2e-05."""
    if abs(value) >= 1e15 or abs(value) < 10.0:
        return f"{value or 0.0:.3g}"
    return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:.1f}"


def exact_number(value: float | None) -> str:
    """Return the shortest text that is read as the same number: 475, 1000001, 2e-05 or 16777217.5; empty for None."""
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else repr(float(value)).removesuffix(".0")
