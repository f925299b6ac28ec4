"""Environments from their specification: `make_environments`."""

from collections.abc import Callable

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.interface import BackendEnvironments, VectorEnvironment
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.protocol.spec import EnvironmentSpec


def make_environments(
    spec: EnvironmentSpec,
    count: int,
    *,
    wrap: str | None = None,
    render_mode: str | None = None,
    camera: Callable[[np.ndarray], None] | None = None,
) -> VectorEnvironment:
    """`count` environments of one kind, by the backend that the specification names.

    Args:
      spec: what to play and what to do to it.
      count: E.
      wrap: `module:function` (gymnasium.Env -> gymnasium.Env), applied to each before the specification's transforms.
      render_mode: gymnasium's; "human" opens a window, "rgb_array" is what a camera needs.
      camera: called with the picture [H, W, 3] uint8 after the reset and after every step of the environment's own,
        the repeated ones too. One environment only.

    The last three are for the gymnasium backend only.

    Raises EnvironmentSetupError with one line that says what is wrong and what to do.
    """
    if spec.backend != "gymnasium":
        _refuse_what_only_gymnasium_does(spec, {"wrap": wrap, "render_mode": render_mode, "camera": camera})
    bare, rest = _make_bare(spec, count, wrap, render_mode, camera)
    try:
        return TransformedEnvironment(bare, rest)
    except EnvironmentSetupError:
        bare.close()
        raise


def _make_bare(
    spec: EnvironmentSpec,
    count: int,
    wrap: str | None,
    render_mode: str | None,
    camera: Callable[[np.ndarray], None] | None,
) -> tuple[BackendEnvironments, EnvironmentSpec]:
    """The backend's environments, and the specification with the transforms that are left to do."""
    match spec.backend:
        case "envpool":
            from daedalus.actor.environments.envpool_backend import (
                make_envpool,  # a backend is imported when it is played
            )

            return make_envpool(spec, count)
        case "ale":
            from daedalus.actor.environments.ale_backend import make_ale

            return make_ale(spec, count)
        case "gymnasium" | "fast":
            from daedalus.actor.environments.gymnasium_backend import make_gymnasium

            return make_gymnasium(spec, count, wrap=wrap, render_mode=render_mode, camera=camera), spec


def _refuse_what_only_gymnasium_does(spec: EnvironmentSpec, asked: dict[str, object]) -> None:
    names = [name for name, value in asked.items() if value is not None]
    if names:
        raise EnvironmentSetupError(
            f"environment.backend={spec.backend} does not do {' and '.join(names)}: "
            "leave it out, or play gymnasium's (--set environment.backend=gymnasium)"
        )
