"""Rendering to pictures on hosts without a display."""

import os
import sys


def render_without_display() -> None:
    """Let SDL and MuJoCo render without a window, unless the user has set otherwise.

    Call this before an environment is made.
    """
    for name in ("SDL_VIDEODRIVER", "SDL_AUDIODRIVER"):
        os.environ.setdefault(name, "dummy")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")
