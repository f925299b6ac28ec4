"""A curve in one line of text."""

from collections.abc import Sequence
from itertools import pairwise

BLOCKS, ASCII = "▁▂▃▄▅▆▇█", "_.-=+*#@"


def sparkline(values: Sequence[float], width: int, levels: str = BLOCKS) -> str:
    """Return a curve of at most `width` characters.

    Args:
      values: finite numbers. If there are more than `width`, each character is the mean of neighbours.
      width: in characters.
      levels: characters from the lowest to the highest.
    """
    if not values or width < 1:
        return ""
    columns = min(width, len(values))
    edges = [len(values) * index // columns for index in range(columns + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in pairwise(edges)]
    low, high = min(means), max(means)
    scale = (len(levels) - 1) / (high - low) if high > low else 0.0
    return "".join(levels[round((mean - low) * scale)] for mean in means)
