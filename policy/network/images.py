"""Arranging image observations in the memory layout on which convolutions are fast."""

import torch
from torch import Tensor

from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import ArraySpace, colours_last


class ImageLayout:
    """Conversion of the observations of a space to [N, channels, height, width].

    A frame is (H, W), (H, W, C) or (C, H, W), as the space says. Stacked frames become channels, oldest first.
    """

    def __init__(self, encoder: str, space: ArraySpace) -> None:
        """Raise NetworkError, naming the encoder and the space, if a frame has none of these shapes."""
        if len(space.shape) not in (2, 3):
            raise NetworkError(
                f"the encoder {encoder!r} takes images, (H, W), (H, W, C) or (C, H, W), not a {space}: "
                "set policy.encoder to mlp or to your own module:Class"
            )
        self.encoder, self.space = encoder, space
        frame = space.shape if len(space.shape) == 3 else (1, *space.shape)
        self._split = (space.frames, *frame)
        colours, height, width = space.image_shape
        self.shape = (space.frames * colours, height, width)

    def arrange(self, observations: Tensor) -> Tensor:
        """Convert [N, *stacked_shape] to [N, channels, height, width] in the memory format channels_last."""
        frames = observations.reshape(-1, *self._split)  # [N, k, C, H, W] or [N, k, H, W, C]
        if colours_last(self.space.shape):
            frames = frames.permute(0, 1, 4, 2, 3)
        return frames.flatten(1, 2).contiguous(memory_format=torch.channels_last)


def as_floats(observations: Tensor) -> Tensor:
    """Convert observations to the precision of convolutions. A byte is exact in bfloat16, a byte / 255 is not."""
    device = observations.device.type
    # Separate from the change of layout: one call for both takes twice as long.
    return observations.to(torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32)
