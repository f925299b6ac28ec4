"""Drawing actions from the distributions of a policy, in numpy. policy/network/distributions.py has them in torch."""

from typing import Protocol

import numpy as np

LOGITS = "logits"


class RandomSource(Protocol):
    """Source of the random numbers of one batch of rows: a numpy.random.Generator, or one generator for each row."""

    def random(self, size: int, dtype: type[np.float32]) -> np.ndarray:
        """Return one uniform number from [0, 1) for each of `size` rows."""
        ...


class ActionSampler(Protocol):
    """Draws actions from the parameters that a program computes."""

    def sample(self, parameters: np.ndarray, random: RandomSource) -> tuple[np.ndarray, np.ndarray]:
        """Draw one action for each row.

        Args:
          parameters: [E, P] float32.
          random: source of the random numbers.

        Returns: actions [E] and their log-probabilities [E] float32.
        """
        ...

    def mode(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the most probable action of each row and its log-probability; shapes as for `sample`."""
        ...


class CategoricalSampler:
    """Samples softmax policies; the parameters are logits."""

    def sample(self, parameters: np.ndarray, random: RandomSource) -> tuple[np.ndarray, np.ndarray]:
        """Draw one action from each softmax policy, by inverting its cumulative distribution.

        Args:
          parameters: logits [E, A] float32.
          random: source of one uniform number for each row.

        Returns: actions [E] int64 and their log-probabilities [E] float32.
        """
        shifted = parameters - parameters.max(axis=-1, keepdims=True)
        cumulative = np.exp(shifted).cumsum(axis=-1)  # [E, A], not normalised
        total = cumulative[:, -1]
        threshold = random.random(len(parameters), dtype=np.float32) * total
        # Without the last column: rounding must never push a sample past the last action.
        actions = (cumulative[:, :-1] <= threshold[:, None]).sum(axis=-1)
        return actions, shifted[np.arange(len(parameters)), actions] - np.log(total)

    def mode(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the most probable action of each softmax policy; shapes as for `sample`."""
        shifted = parameters - parameters.max(axis=-1, keepdims=True)
        actions = shifted.argmax(axis=-1)
        return actions, -np.log(np.exp(shifted).sum(axis=-1))


# By the name of the program's output that holds the parameters.
SAMPLERS: dict[str, ActionSampler] = {LOGITS: CategoricalSampler()}
