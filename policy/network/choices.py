"""The choices of several discrete variables side by side, as in logits, masks and one-hot encodings. Needs torch."""

from collections.abc import Sequence

import torch
from torch import Tensor


def variables_and_values(counts: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the variable and the value of each choice, both [choices] int64.

    Of variables with 2 and 3 choices they are 0 0 1 1 1 and 0 1 0 1 2.
    """
    sizes = torch.tensor(counts)
    variables = torch.arange(len(counts)).repeat_interleave(sizes)
    return variables, torch.arange(len(variables)) - (sizes.cumsum(0) - sizes)[variables]
