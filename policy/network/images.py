"""Observations as images: from the layouts that environments show to the one that convolutions are fast on."""

import torch
from torch import Tensor

from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import ArraySpace

_MAX_COLOURS = 4  # a last axis of at most so many holds the colours of a pixel


class ImageLayout:
    """How the observations of a space become [N, channels, height, width].

    A frame is (H, W), (H, W, C) with C <= 4, or (C, H, W). Stacked frames become channels, oldest first.
    """

    def __init__(self, encoder: str, space: ArraySpace) -> None:
        """Raises NetworkError, naming the encoder and the space, if a frame is none of these."""
        if len(space.shape) not in (2, 3):
            raise NetworkError(
                f"the encoder {encoder!r} sees images, (H, W), (H, W, C) or (C, H, W), and not a {space}: "
                "set policy.encoder to mlp or to your own module:Class"
            )
        self.encoder, self.space = encoder, space
        frame = space.shape if len(space.shape) == 3 else (1, *space.shape)
        self._split = (space.frames, *frame)
        self._colours_last = len(space.shape) == 3 and frame[-1] <= _MAX_COLOURS
        colours, height, width = (frame[-1], *frame[:-1]) if self._colours_last else frame
        self.shape = (space.frames * colours, height, width)

    def arrange(self, observations: Tensor) -> Tensor:
        """[N, *stacked_shape] -> [N, channels, height, width], lying in memory pixel by pixel (channels_last)."""
        frames = observations.reshape(-1, *self._split)  # [N, k, C, H, W] or [N, k, H, W, C]
        if self._colours_last:
            frames = frames.permute(0, 1, 4, 2, 3)
        return frames.flatten(1, 2).contiguous(memory_format=torch.channels_last)


def as_floats(observations: Tensor) -> Tensor:
    """The same numbers in the precision of convolutions. A byte is exact in bfloat16, its 255th part is not."""
    device = observations.device.type
    # Not in one call with the change of layout: that takes twice as long.
    return observations.to(torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32)
