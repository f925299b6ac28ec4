"""Metrics of updates and batches since the last metrics row. State; no I/O."""

import math

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import BATCH_METRICS, ActionCounts
from daedalus.algorithms.gradients import Terms
from daedalus.protocol.spaces import ArraySpace, Spaces

GRADIENT_NORM = "gradient_norm"
GRADIENT_CLIPPED_FRACTION = "gradient_clipped_fraction"  # share of the updates
_UPDATE_METRICS = (*Terms._fields, GRADIENT_NORM, GRADIENT_CLIPPED_FRACTION)
METRICS = (*_UPDATE_METRICS, *BATCH_METRICS)


class UpdateMetrics:
    """Sums over updates, on the learner's device.

    They are read once for each metrics row, because reading them after each update would wait for the device.
    """

    def __init__(self, spaces: Spaces, device: torch.device) -> None:
        arrays = {name: space for name, space in spaces.observations.items() if isinstance(space, ArraySpace)}
        self._image = next((name for name, space in arrays.items() if _shows_image(space)), None)
        self._image_space = arrays.get(self._image or "")
        self._sums = torch.zeros(len(Terms._fields), device=device)
        self._norms = 0.0
        self._batch_sums = torch.zeros(len(BATCH_METRICS), device=device)
        self._batches = torch.zeros(len(BATCH_METRICS), device=device)  # that have the metric
        self._updates = self._clipped_updates = 0
        self._actions = ActionCounts(spaces, device)
        self._newest: Tensor | None = None  # the first image of the newest batch

    def add_update(self, terms: Terms, gradient_norm: float, clipped: bool) -> None:
        """Add the metrics of an update that changed the parameters, with a clipped gradient or not."""
        self._sums += torch.stack(terms)
        self._norms += gradient_norm
        self._updates += 1
        self._clipped_updates += clipped

    def add_batch_metrics(self, metrics: Tensor) -> None:
        """Add BATCH_METRICS of a batch, or of the rollout of a gradient; nan for a metric that it does not have."""
        known = ~metrics.isnan()
        self._batch_sums += metrics.where(known, 0.0)
        self._batches += known

    def add_batch(self, batch: Batch) -> None:
        """Count the actions of a batch, and keep one of its observations."""
        if self._image is not None:
            self._newest = batch.observations[self._image][0, 0]
        self._actions.add(batch)

    def add_action_counts(self, counts: dict[str, Tensor]) -> None:
        """Add how often each choice of each discrete component was made, [choices] int64."""
        self._actions.merge(counts)

    def take_means(self) -> dict[str, float]:
        """Return means over the updates, or batches, since the last call, by name; empty without updates."""
        if not self._updates:
            return {}
        means = (self._sums / self._updates).tolist()
        means += [self._norms / self._updates, self._clipped_updates / self._updates]
        batch_means = (self._batch_sums / self._batches).tolist()  # nan without batches that have the metric
        self._sums.zero_()
        self._norms = 0.0
        self._batch_sums.zero_()
        self._batches.zero_()
        self._updates = self._clipped_updates = 0
        known = {name: mean for name, mean in zip(BATCH_METRICS, batch_means, strict=True) if not math.isnan(mean)}
        return dict(zip(_UPDATE_METRICS, means, strict=True)) | known

    def take_action_counts(self) -> dict[str, list[int]]:
        """Return how often each choice of each discrete component was chosen in the batches since the last call."""
        return self._actions.take()

    def take_observation_image(self) -> np.ndarray | None:
        """Return an observation of the newest batch, with its frames side by side: uint8 [H, W] or [H, W, 3].

        Returns None if observations are not images, or without a batch since the last call.
        """
        newest, self._newest = self._newest, None
        if newest is None or self._image_space is None:
            return None
        space = self._image_space
        frames = newest.cpu().numpy().reshape(space.frames, *space.shape)
        side_by_side = np.concatenate(list(frames), axis=1)  # [H, k * W, ...]
        return side_by_side[..., 0] if space.shape[2:] == (1,) else side_by_side


def _shows_image(space: ArraySpace) -> bool:
    colours = space.shape[2:] in ((1,), (3,))
    return space.dtype == "uint8" and (len(space.shape) == 2 or colours)
