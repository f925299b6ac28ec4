"""Numbers of an environment that float32, which policies and learners have, cannot tell apart. State; no I/O."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from daedalus.actor.environments.components import leaves

_NOISE = 1e-12  # relative: smaller differences may be the rounding of float64 itself
_FEW_STEPS = 1000  # of float32, from bound to bound or from the smallest to the largest value: too coarse to act on
_MANY_STEPS = 2**16  # enough, however slowly a value changes
_SMALL_CHANGE = 8  # steps of float32: a change that is smaller is rounded by more than a tenth
_WHOLE = 2**24  # beyond it float32 does not have every whole number
_MOST_WHOLE = 2.0**50  # beyond it every float64 is whole, or nearly
_REWARD_REMEDY = "in a wrapper (--wrap), scale it or subtract a constant before it becomes float32"
_REMEDY = (
    "in a wrapper (--wrap), subtract a reference, such as the first value of the episode, before it becomes float32; "
    "policy.normalize_observations comes too late for that"
)


class Precision:
    """The numbers that one environment showed, and what float32 keeps of them."""

    def __init__(self, space: gymnasium.Space) -> None:
        """Construct from the observation space."""
        boxes = [leaf for leaf in leaves(space, "observation") if isinstance(leaf.space, gym.Box)]
        self._leaves = [leaf for leaf in boxes if leaf.space.dtype != np.uint8]
        self._seen: dict[str, _Seen] = {}
        self._of_bounds = {leaf.name: text for leaf in self._leaves if (text := _bounds_text(leaf.space))}

    def add(self, observation: Any, *, starts: bool = False) -> None:
        """Take note of an observation, as the environment returned it. `starts`: it is the first of an episode."""
        if starts:
            for seen in self._seen.values():
                seen.last = None
        for leaf in self._leaves:
            self._add(leaf.name, leaf.of(observation))

    def add_reward(self, reward: Any) -> None:
        """Take note of a reward."""
        self._add("", np.asarray(reward))

    def _add(self, name: str, values: np.ndarray) -> None:
        # Numbers of fewer bytes are the same in float32.
        if values.dtype.kind in "fiu" and values.dtype.itemsize >= 4 and values.dtype != np.float32:
            self._seen.setdefault(name, _Seen()).add(values)

    @property
    def warnings(self) -> dict[str, str]:
        """Return what float32 loses, one text for each component at fault; that of the reward has an empty name."""
        found = {**self._of_bounds, **{name: seen.text for name, seen in self._seen.items() if seen.text}}
        return {
            name: f"observation component {name!r} {text}: {_REMEDY}"
            if name
            else f"the reward {text}: {_REWARD_REMEDY}"
            for name, text in found.items()
        }


_MOST_WATCHED = 1000  # observations


class FirstLosses:
    """What float32 loses of the first observations of a client's loop."""

    def __init__(self, space: gymnasium.Space, told: set[str]) -> None:
        """Construct from the observation space, of the components that are read, and those that were warned of."""
        self._precision, self._watched, self._told = Precision(space), 0, told

    def add(self, observation: Any) -> list[str]:
        """Take note of an observation, and return the warnings that are new, one for each component at fault."""
        if self._watched >= _MOST_WATCHED:
            return []
        self._watched += 1
        self._precision.add(observation)
        new = {name: text for name, text in self._precision.warnings.items() if name not in self._told}
        self._told.update(new)
        return [*new.values()]


class _Seen:
    """The numbers of one component."""

    def __init__(self) -> None:
        self.text = ""  # the first loss
        self.last: np.ndarray | None = None  # of this episode
        self._low = self._high = self._changes = self._changed_by = np.zeros(0)

    def add(self, values: np.ndarray) -> None:
        with np.errstate(all="ignore"):
            if self.text or not np.isfinite(rounded := values.astype(np.float32)).all():  # others report the latter
                return
            numbers = values.astype(np.float64)
            whole = (numbers == np.rint(numbers)) & ((np.abs(numbers) < _MOST_WHOLE) | (values.dtype.kind != "f"))
            if (lost := whole & (rounded.astype(np.float64) != numbers)).any():
                number = int(values[lost].flat[0])
                self.text = f"has the value {number:,}, which becomes {int(rounded[lost].flat[0]):,} in float32"
                return
            if self._low.shape != numbers.shape:
                self._low = self._high = numbers
                self._changes = self._changed_by = np.zeros_like(numbers)
            change = np.zeros_like(numbers) if self.last is None else np.abs(numbers - self.last)
            self._changes, self._changed_by = self._changes + (change > 0.0), self._changed_by + change
            self._low, self._high = np.minimum(self._low, numbers), np.maximum(self._high, numbers)
            self.last = numbers
            self._judge()

    def _judge(self) -> None:
        largest, spread = np.maximum(np.abs(self._low), np.abs(self._high)), self._high - self._low
        step = np.spacing(largest.astype(np.float32)).astype(np.float64)
        mean_change = self._changed_by / np.maximum(self._changes, 1)
        coarse = (mean_change < _SMALL_CHANGE * step) & (spread < _MANY_STEPS * step)
        found = coarse & (self._changes >= 3) & (spread > _NOISE * largest)
        if found.any():
            self.text = (
                f"has the value {_number(self.last[found].flat[0])} and changes by about "  # pyright: ignore[reportOptionalSubscript]
                f"{mean_change[found].flat[0]:.3g}, but there the values of float32 are {step[found].flat[0]:.3g} apart"
            )


def _bounds_text(space: gymnasium.Space) -> str:
    """Return what the bounds of a Box say about float32, or an empty string."""
    if not isinstance(space, gym.Box) or space.dtype in (np.float32, np.float16) or space.dtype.itemsize < 4:
        return ""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    with np.errstate(all="ignore"):
        largest = np.maximum(np.abs(low), np.abs(high))
        step = np.spacing(largest.astype(np.float32)).astype(np.float64)
        coarse = np.isfinite(step) & (low < high) & (high - low < _FEW_STEPS * step)
        if space.dtype.kind in "iu":
            coarse &= step > 1.0  # below, every whole number has its own
            coarse |= (np.sign(low) == np.sign(high)) & (np.minimum(np.abs(low), np.abs(high)) > _WHOLE) & (low < high)
    if not coarse.any():
        return ""
    numbers = (_number(low[coarse].flat[0]), _number(high[coarse].flat[0]))
    return f"goes from {numbers[0]} to {numbers[1]}, where the values of float32 are {step[coarse].flat[0]:.3g} apart"


def _number(value: float) -> str:
    """Return a number with the digits that float32 would lose."""
    return f"{value:.12g}"
