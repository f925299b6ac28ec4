"""The random numbers that a policy program makes samples from."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class NoiseSize(NamedTuple):
    """How many random numbers one sample takes."""

    uniform: int  # U
    normal: int  # G


class Noise(NamedTuple):
    """The noise of one row of E environments."""

    uniform: np.ndarray  # [E, U] float32, from 0 to 1, 1 excluded
    normal: np.ndarray  # [E, G] float32, standard normal


def draw_noise(size: NoiseSize, rows: int, random: np.random.Generator) -> Noise:
    """Return noise for sampled actions."""
    return Noise(
        uniform=random.random((rows, size.uniform), np.float32),
        normal=random.standard_normal((rows, size.normal), np.float32)
        if size.normal
        else np.zeros((rows, 0), np.float32),
    )


def joined_noise(parts: Sequence[Noise]) -> Noise:
    """Return the noise of the rows of several parts, one part after the other."""
    return Noise(
        uniform=np.concatenate([part.uniform for part in parts]),
        normal=np.concatenate([part.normal for part in parts]),
    )


def no_exploration(rows: int) -> np.ndarray:
    """Return the epsilon of rows that do not explore, [rows, 1]."""
    return np.zeros((rows, 1), np.float32)


def neutral_noise(size: NoiseSize, rows: int) -> Noise:
    """Return the noise that gives greedy actions."""
    return Noise(
        uniform=np.full((rows, size.uniform), 0.5, np.float32),
        normal=np.zeros((rows, size.normal), np.float32),
    )
