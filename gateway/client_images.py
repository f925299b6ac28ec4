"""A limit on the images of a client that the gateway transforms: its event loop does that. Pure functions."""

import contextlib

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.pixels import Pixels
from daedalus.gateway.client_spaces import UniformBox
from daedalus.gateway.errors import ClientError
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec

MAX_IMAGE_BYTES = 8 << 20  # 1920 x 1080 pixels in RGB fit
MAX_SIDE = 8192  # pixels


def check_images(spaces: Spaces, spec: EnvironmentSpec) -> None:
    """Raise ClientError if an image of a client is too large for the pixel transforms of the run.

    Call it for spaces that the transforms fit: images that they do not fit are not transformed.
    """
    if spec.crop is None and not spec.grey and spec.resize is None:
        return
    for name, space in spaces.observations.items():
        if isinstance(space, ArraySpace) and space.dtype == "uint8" and name not in spec.leave_out:
            with contextlib.suppress(EnvironmentSetupError):
                _check_image(name, space, spec)


def _check_image(name: str, space: ArraySpace, spec: EnvironmentSpec) -> None:
    size = Pixels(spec, UniformBox(0, 255, space.shape, np.uint8)).largest_bytes
    if size > MAX_IMAGE_BYTES or max(space.shape) > MAX_SIDE:
        raise ClientError(
            "refused",
            f"{name} is an image of shape {space.shape}, for which the transforms of the run need {size:,} bytes: send "
            f"images of at most {MAX_SIDE:,} pixels a side that need at most {MAX_IMAGE_BYTES:,} bytes",
        )
