"""What an actor reads of `info`: the masks, and the scalars at the end of an episode. State; no I/O."""

from typing import Any

import numpy as np

from daedalus.actor.environments.masks import MASK_KEY
from daedalus.protocol.keys import is_name
from daedalus.protocol.uploads import LARGEST_EPISODE_NUMBER, MAX_INFO_NAMES, MAX_INFO_VALUES


def info_to_keep(info: dict[Any, Any], *, ended: bool) -> dict[str, Any]:
    """Return what an actor reads of the `info` of one environment: the masks, and the scalars if the episode ended.

    gymnasium cannot batch other entries, such as numbers that are beyond an int64 or texts in some environments only,
    and not every entry can leave the process of an environment.
    """
    kept: dict[str, Any] = {}
    if ended:
        for name, value in info.items():
            scalar = _scalar(value) if _is_scalars_name(name) else None
            if scalar is not None:
                kept[name] = scalar
    if MASK_KEY in info:
        kept[MASK_KEY] = info[MASK_KEY]
    return kept


def _is_scalars_name(name: Any) -> bool:
    return isinstance(name, str) and not name.startswith("_") and is_name(name)


def _scalar(value: Any) -> float | None:
    """Return a number or a bool as a float, or None for anything else."""
    if isinstance(value, np.ndarray) and value.shape == ():
        value = value[()]
    if not isinstance(value, (int, float, np.integer, np.floating, np.bool_)):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


class EpisodeInfo:
    """The scalars of the episodes that ended since the last `take`, by name.

    A scalar is a finite number or a bool under a name of 1 to 64 letters, digits, '.', '_' or '-'. Other entries of
    `info`, more than MAX_INFO_NAMES names and more than MAX_INFO_VALUES values of a name are left out.
    """

    def __init__(self) -> None:
        self._values: dict[str, list[float]] = {}

    def add(self, info: dict[str, Any], ended: np.ndarray) -> None:
        """Add the scalars of the last step of the episodes that ended with it.

        Args:
          info: of a gymnasium vector environment: `name` [E], and `_name` [E] bool where only some gave a value.
          ended: [E] bool.
        """
        if not ended.any():
            return
        for name, values in info.items():
            if not isinstance(values, np.ndarray) or values.shape != ended.shape or values.dtype.kind not in "biuf":
                continue
            known = name in self._values or len(self._values) < MAX_INFO_NAMES
            if not known or not _is_scalars_name(name):
                continue
            given = ended & np.asarray(info.get(f"_{name}", True), np.bool_)
            scalars = values[given].astype(np.float64)
            scalars = scalars[np.abs(scalars) <= LARGEST_EPISODE_NUMBER]  # not nan
            if len(scalars):
                kept = self._values.setdefault(name, [])
                kept.extend(scalars[: MAX_INFO_VALUES - len(kept)].tolist())

    def take(self) -> dict[str, np.ndarray]:
        """Return the scalars since the last call: name -> [n] float64, n at least 1."""
        values, self._values = self._values, {}
        return {name: np.array(kept, np.float64) for name, kept in values.items()}
