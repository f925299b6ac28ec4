"""Metrics of updates and batches since the last metrics row. State; no I/O."""

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.gradients import Terms
from daedalus.protocol.spaces import ArraySpace, Spaces

GRADIENT_NORM = "gradient_norm"
GRADIENT_CLIPPED_FRACTION = "gradient_clipped_fraction"  # share of the updates
METRICS = (*Terms._fields, GRADIENT_NORM, GRADIENT_CLIPPED_FRACTION)


class UpdateMetrics:
    """Sums over updates, on the learner's device.

    They are read once for each metrics row, because reading them after each update would wait for the device.
    """

    def __init__(self, spaces: Spaces, device: torch.device) -> None:
        self._observation = spaces.observation
        self._sums = torch.zeros(len(METRICS) - 1, device=device)
        self._updates = self._clipped_updates = 0
        self._action_counts = torch.zeros(spaces.action.count, dtype=torch.int64, device=device)
        self._newest: Tensor | None = None  # the first observation of the newest batch

    def add_update(self, terms: Terms, gradient_norm: Tensor, clipped: bool) -> None:
        """Add the metrics of an update that changed the parameters, with a clipped gradient or not."""
        self._sums += torch.stack([*terms, gradient_norm])
        self._updates += 1
        self._clipped_updates += clipped

    def add_batch(self, batch: Batch) -> None:
        """Count the actions of a batch, and keep one of its observations."""
        self._newest = batch.observations[0, 0]
        chosen = torch.bincount(batch.actions.flatten(), batch.valid.flatten(), len(self._action_counts))
        self._action_counts += chosen.to(torch.int64)

    def take_means(self) -> dict[str, float]:
        """Return means over the updates since the last call, by name; empty if there were no updates."""
        if not self._updates:
            return {}
        means = [*(self._sums / self._updates).tolist(), self._clipped_updates / self._updates]
        self._sums.zero_()
        self._updates = self._clipped_updates = 0
        return dict(zip(METRICS, means, strict=True))

    def take_action_counts(self) -> list[int]:
        """Return the number of times each action was chosen in the batches since the last call."""
        counts = self._action_counts.tolist()
        self._action_counts.zero_()
        return counts

    def take_observation_image(self) -> np.ndarray | None:
        """Return an observation of the newest batch, with its frames side by side: uint8 [H, W] or [H, W, 3].

        Returns None if observations are not images, or without a batch since the last call.
        """
        newest, self._newest = self._newest, None
        return None if newest is None else _image(newest, self._observation)


def _image(observation: Tensor, space: ArraySpace) -> np.ndarray | None:
    colours = space.shape[2:] in ((1,), (3,))
    if space.dtype != "uint8" or not (len(space.shape) == 2 or colours):
        return None
    frames = observation.cpu().numpy().reshape(space.frames, *space.shape)
    side_by_side = np.concatenate(list(frames), axis=1)  # [H, k * W, ...]
    return side_by_side[..., 0] if space.shape[2:] == (1,) else side_by_side
