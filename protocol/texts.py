"""Texts of peers, bounded for a person who reads them. Pure functions."""

MAX_NAME, MAX_TEXT = 64, 300  # bytes in UTF-8: of a name, and of a reason or an event


def bounded_text(text: str, most: int = MAX_TEXT) -> str:
    """Return a foreign text in one line, without unprintable characters, cut to `most` bytes in UTF-8.

    An unprintable character becomes a space, and several spaces become one. Whatever a peer sends, a learner can then
    keep the text, log it, and report it within the limits of its readers, which count bytes.
    """
    start = text[:most]
    printable = "".join(character if character.isprintable() else " " for character in start)
    return " ".join(printable.split()).encode()[:most].decode(errors="ignore")
