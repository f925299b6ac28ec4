"""What an actor needs besides the weights to compute a gradient as the learner would: it travels in each snapshot.

The numbers are among the weights of the snapshot, under names that no parameter has. Compact snapshots have the
precision of bfloat16: each number is therefore a sum of bfloat16 numbers, which is exact. Pure functions.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

NAME = "gradient_inputs"
TARGET = "target_network/"  # followed by the name of a parameter: its value in the target network
_PARTS = 7  # bfloat16 numbers, of 8 bits each, that make a float64


class GradientInputs(NamedTuple):
    """Numbers of the learner that change from version to version."""

    entropy_bonus: float
    # Moments of all discounted returns so far (algorithms/normalization.py); 0 if rewards are not normalised.
    returns_count: float
    returns_mean: float
    returns_squares: float


def packed(inputs: GradientInputs) -> np.ndarray:
    """Return the numbers as float32 [4, parts], each of which bfloat16 can represent."""
    return exact(torch.tensor(inputs, dtype=torch.float64))


def unpacked(array: np.ndarray) -> GradientInputs:
    """Return the numbers from the result of `packed`. Raises ValueError if the array is none."""
    return GradientInputs(*restored(array, (len(GradientInputs._fields),)).tolist())


def exact(values: Tensor) -> np.ndarray:
    """Return values [*shape] as float32 [*shape, parts], each of which bfloat16 can represent."""
    parts, rest = [], values.detach().to("cpu", torch.float64)
    for _ in range(_PARTS):
        parts.append(rest.to(torch.bfloat16).to(torch.float32))
        rest = rest - parts[-1].to(torch.float64)
        rest = rest.where(rest.isfinite(), 0.0)  # the first part has what is not finite
    return torch.stack(parts, -1).numpy()


def restored(array: np.ndarray, shape: tuple[int, ...]) -> Tensor:
    """Return float64 values [*shape] from the result of `exact`. Raises ValueError if the array is none."""
    if array.shape != (*shape, _PARTS) or array.dtype != np.float32:
        raise ValueError(f"expected float32 {[*shape, _PARTS]}, not {array.dtype} {list(array.shape)}")
    return torch.from_numpy(array.astype(np.float64)).flip(-1).sum(-1)
