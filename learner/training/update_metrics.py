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

    They are read once for each metrics row, because reading them after each update would wait for the device. What is
    counted of a batch itself is counted in main memory, where the batch comes from.
    """

    def __init__(self, spaces: Spaces, device: torch.device, max_gradient_norm: float) -> None:
        """Construct it. `max_gradient_norm`: the norm above which gradients are clipped."""
        self._max_norm = max_gradient_norm
        arrays = {name: space for name, space in spaces.observations.items() if isinstance(space, ArraySpace)}
        self._image = next((name for name, space in arrays.items() if _shows_image(space)), None)
        self._image_space = arrays.get(self._image or "")
        self.update_sums = torch.zeros(len(_UPDATE_METRICS), device=device)
        self._updates = 0
        self._batch_sums = torch.zeros(len(BATCH_METRICS), device=device)
        self._batches = torch.zeros(len(BATCH_METRICS), device=device)  # that have the metric
        self._actions = ActionCounts(spaces, torch.device("cpu"))
        self._newest: Tensor | None = None  # the first image of the newest batch

    def add_update(self, terms: Terms, norm: Tensor) -> None:
        """Add the metrics of an update: the terms of its loss and the norm of its gradient. Reads no value."""
        self.update_sums.add_(torch.stack([*terms, norm, torch.gt(norm, self._max_norm, out=torch.empty_like(norm))]))

    def count_updates(self, number: int) -> None:
        """Count updates whose metrics were added."""
        self._updates += number

    def add_batch_metrics(self, metrics: Tensor) -> None:
        """Add BATCH_METRICS of a batch, or of the rollout of a gradient; nan for a metric that it does not have."""
        known = ~metrics.isnan()
        self._batch_sums += metrics.nan_to_num(0.0, math.inf, -math.inf)
        self._batches += known

    def add_batch(self, batch: Batch) -> None:
        """Count the actions of a batch in main memory, and keep one of its observations."""
        if self._image is not None:
            seen = batch.observations[self._image]
            depth = batch.depths.get(self._image)
            self._newest = seen[0, 0] if depth is None else seen[:depth, 0]
        self._actions.add(batch)

    def add_action_counts(self, counts: dict[str, Tensor]) -> None:
        """Add how often each choice of each discrete component was made, [choices] int64."""
        self._actions.merge(counts)

    def take_means(self) -> dict[str, float]:
        """Return means over the updates, or batches, since the last call, by name; empty without updates."""
        if not self._updates:
            return {}
        means = [each / self._updates for each in self.update_sums.tolist()]
        batch_means = (self._batch_sums / self._batches).tolist()  # nan without batches that have the metric
        for values in (self.update_sums, self._batch_sums, self._batches):
            values.zero_()
        self._updates = 0
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
