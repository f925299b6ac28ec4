"""Action distributions in numpy, for acting. policy/network/distributions.py is the same in torch."""

import numpy as np


def sample_categorical(logits: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One action from each softmax policy, by inverting its cumulative distribution.

    Args:
      logits: [E, A] float32.
      random: where the one uniform number for each row comes from.

    Returns: actions [E] int64 and their log-probabilities [E] float32.
    """
    shifted = logits - logits.max(axis=-1, keepdims=True)
    cumulative = np.exp(shifted).cumsum(axis=-1)  # [E, A], not normalised
    total = cumulative[:, -1]
    threshold = random.random(len(logits), dtype=np.float32) * total
    # The last column is left out: rounding may never push a sample past the last action.
    actions = (cumulative[:, :-1] <= threshold[:, None]).sum(axis=-1)
    return actions, shifted[np.arange(len(logits)), actions] - np.log(total)


def greedy_categorical(logits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The most probable action of each softmax policy; same shapes as `sample_categorical`."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    actions = shifted.argmax(axis=-1)
    return actions, -np.log(np.exp(shifted).sum(axis=-1))
