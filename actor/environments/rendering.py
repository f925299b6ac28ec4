"""Rendering to pictures: on hosts without a display, and how many of them a second an environment means."""

import os
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from daedalus.policy.user_code import first_line
from daedalus.protocol.texts import bounded_text

_GUESS = 30.0  # frames a second of an environment that does not say
_RATES = 0.1, 10_000.0  # that a video can have
_ATARI_FRAMES_PER_SECOND = 60.0


class FrameRate(NamedTuple):
    """How many frames a second an environment shows, one for each of its own steps."""

    per_second: float = _GUESS
    guess: str = ""  # why it is a guess, for the user


class CountedSteps(gymnasium.Wrapper):
    """A wrapper that counts steps: a wrapper of the user around it may skip frames."""

    steps = 0

    def step(self, action: Any) -> Any:
        """See gymnasium.Env."""
        self.steps += 1
        return self.env.step(action)


def frame_rate(environment: Any, below: gymnasium.Env | None = None, skipped: int = 1) -> FrameRate:
    """Return the rate at which the steps of an environment are meant to be shown.

    Args:
      environment: of gymnasium or PettingZoo, as it is stepped. Its own metadata count, not those of its class:
        MuJoCo's depend on `frame_skip`.
      below: the environment without the user's wrapper.
      skipped: how many steps of `below` one step makes. It divides the rate, unless the wrapper states a rate.
    """
    stated = _stated(environment)
    if below is not None and repr(stated) == repr(_stated(below)):
        rate = frame_rate(below)
        return rate._replace(per_second=max(rate.per_second / max(skipped, 1), _RATES[0]))
    registered = getattr(environment, "spec", None)  # PettingZoo's have none
    if registered is not None and str(registered.entry_point).startswith("ale_py"):  # states 30 for any frameskip
        frames = registered.kwargs.get("frameskip", 4)  # of a tuple, a random number from the first to below the second
        mean = frames if isinstance(frames, int) else (frames[0] + frames[1] - 1) / 2
        return FrameRate(_ATARI_FRAMES_PER_SECOND / mean)
    if stated is None:
        return FrameRate(guess=f"the environment states no render_fps: {_GUESS:g} frames a second are a guess")
    # A bool is a number for Python.
    if (
        isinstance(stated, int | float | np.number)
        and not isinstance(stated, bool)
        and _RATES[0] <= stated <= _RATES[1]
    ):
        return FrameRate(float(stated))
    return FrameRate(
        guess=f"the environment states render_fps {bounded_text(repr(stated), 60)}, which is not a number from "
        f"{_RATES[0]:g} to {_RATES[1]:,.0f}: {_GUESS:g} frames a second are a guess"
    )


def _stated(environment: Any) -> Any:
    """Return what an environment states as `render_fps`, of any type; None if it states nothing."""
    try:
        metadata = environment.metadata
        return metadata.get("render_fps") if isinstance(metadata, Mapping) else None
    except Exception as error:  # of the user's code: a property
        return first_line(error)


def render_without_display() -> None:
    """Let SDL and MuJoCo render without a window, unless the user has set otherwise.

    Call this before an environment is made.
    """
    for name in ("SDL_VIDEODRIVER", "SDL_AUDIODRIVER"):
        os.environ.setdefault(name, "dummy")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")
