"""Encoders of images. `uint8` observations are scaled to [0, 1]."""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from daedalus.policy.network.layers import BytesConv2d, PReLU, orthogonal
from daedalus.policy.user_modules import NetworkError
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
        if self.shape[0] == 1 and not torch.onnx.is_in_onnx_export():
            # One channel is contiguous in both formats, and torch would take the other, in which a CPU pools ten times
            # as slowly: let the strides say which it is.
            return frames.reshape(-1, *self.shape[1:], 1).permute(0, 3, 1, 2)
        return frames.flatten(1, 2).contiguous(memory_format=torch.channels_last)


def as_floats(observations: Tensor) -> Tensor:
    """Convert observations to the precision of convolutions. A byte is exact in bfloat16, a byte / 255 is not."""
    device = observations.device.type
    # Separate from the change of layout: one call for both takes twice as long.
    return observations.to(torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32)


_GAIN = math.sqrt(2.0)  # of a layer followed by a ReLU
_FILTERS, _SMALLEST_UNPADDED = 16, 5  # of the convolution of maps; cells of a side


class ImageEncoder(nn.Module):
    """Convolutions, then a head on their flattened output: [N, *stacked_shape] -> [N, features]."""

    def __init__(
        self, layout: ImageLayout, convolutions: nn.Sequential, head: Callable[[int], tuple[nn.Module, int]]
    ) -> None:
        """Build the encoder.

        Args:
          layout: how observations become images.
          convolutions: [N, C, H, W] -> [N, C', H', W'].
          head: takes the number of inputs; returns the head and its number of outputs.

        Raises NetworkError if the images are too small for the convolutions.
        """
        super().__init__()
        self.layout = layout
        self.convolutions = convolutions
        try:
            with torch.no_grad():
                self._inputs = convolutions(torch.zeros(1, *layout.shape)).numel()
        except RuntimeError:
            raise NetworkError(
                f"the encoder {layout.encoder!r} needs images larger than a {layout.space}: enlarge them "
                "(environment.resize) or set policy.encoder to impala"
            ) from None
        self.replace_head(head)

    def replace_head(self, head: Callable[[int], tuple[nn.Module, int]]) -> None:
        """Take another head, as in the constructor."""
        self.head, self.features = head(self._inputs)

    def forward(self, observations: Tensor) -> Tensor:
        """Encode observations: [N, *stacked_shape], or what `convolve` returns of them -> [N, features]."""
        return self.head(observations if observations.dim() == 2 else self.convolve(observations))

    def convolve(self, observations: Tensor, *, shifted: bool = False) -> Tensor:
        """Return the outputs of the convolutions: [N, *stacked_shape] -> [N, F].

        `shifted`: shift each image by random numbers of pixels before.
        """
        images = self.layout.arrange(self.prepare(observations))
        return self.convolutions(_shifted(images) if shifted else images).flatten(1)

    def prepare(self, observations: Tensor) -> Tensor:
        """Convert observations to the numbers that the first convolution takes; that convolution scales bytes."""
        return as_floats(observations)


def _shifted(images: Tensor) -> Tensor:
    """Shift each image [N, C, H, W] at random, by at most 4 of 84 pixels; what comes in at a border is repeated.

    Kostrikov et al. (2021), "Image Augmentation Is All You Need", section 3.1.
    """
    count, _, height, width = images.shape
    most = -(-4 * min(height, width) // 84)
    down, right = torch.randint(-most, most + 1, (2, count, 1)).to(images.device)
    rows = (torch.arange(height, device=images.device) + down).clamp_(0, height - 1)  # [N, H]
    columns = (torch.arange(width, device=images.device) + right).clamp_(0, width - 1)
    rows += height * torch.arange(count, device=images.device)[:, None]
    pixels = images.permute(0, 2, 3, 1).flatten(0, 2)  # [N * H * W, C]
    shifted = pixels.index_select(0, (width * rows[:, :, None] + columns[:, None]).flatten())
    return shifted.view(count, height, width, -1).permute(0, 3, 1, 2)


def nature(space: ArraySpace) -> ImageEncoder:
    """Build the network of Mnih et al. (2015), "Human-level control through deep reinforcement learning"."""
    return _atari("nature", space, ((32, 8, 4), (64, 4, 2), (64, 3, 1)), 512)


def small(space: ArraySpace) -> ImageEncoder:
    """Build the network of Mnih et al. (2013), also used by A3C: a third of the computation of `nature`."""
    return _atari("small", space, ((16, 8, 4), (32, 4, 2)), 256)


def impala(space: ArraySpace) -> ImageEncoder:
    """Build the residual network of Espeholt et al. (2018), figure 3 right, without its LSTM."""
    layout = ImageLayout("impala", space)
    first = _first(space)
    stages = [_stage(first(layout.shape[0], 16, 3, padding=1))]
    stages += [_stage(nn.Conv2d(inputs, outputs, 3, padding=1)) for inputs, outputs in ((16, 32), (32, 32))]
    return ImageEncoder(layout, nn.Sequential(*stages, nn.ReLU()), lambda inputs: _rectified(inputs, 256))


class GridConvolution(nn.Module):
    """The convolution of Young and Tian (2019), "MinAtar": 16 filters of 3 x 3, with a ReLU.

    For maps (height, width, planes) of a few cells, read as the numbers they are. A map with a side below 5 is padded.
    """

    def __init__(self, space: ArraySpace) -> None:
        super().__init__()
        height, width, planes = space.shape
        padding = 0 if min(height, width) >= _SMALLEST_UNPADDED else 1
        self._split = (space.frames, height, width, planes)
        self.convolution = orthogonal(nn.Conv2d(space.frames * planes, _FILTERS, 3, padding=padding), _GAIN)
        self.width = _FILTERS * (height - 2 + 2 * padding) * (width - 2 + 2 * padding)

    def forward(self, maps: Tensor) -> Tensor:
        """Return the outputs of all filters: maps [N, *stacked_shape] -> [N, width]."""
        planes = maps.reshape(-1, *self._split).permute(0, 1, 4, 2, 3).flatten(1, 2)  # [N, k * C, H, W]
        return self.convolution(as_floats(planes)).relu().flatten(1)


class ArticleEncoder(ImageEncoder):
    """The network of the article that this project follows, to be combined with a memory.

    Each batch normalisation of the article is replaced by a normalisation of each image by itself, which gives the same
    result for one row and for many. The first has no weights: the next convolution can represent them, and computing
    gradients through it is slow.
    """

    def __init__(self, space: ArraySpace) -> None:
        layout = ImageLayout("article", space)
        layers: list[nn.Module] = []
        for inputs, kernel in ((layout.shape[0], 4), (32, 3), (32, 3), (32, 3)):
            convolution = nn.Conv2d(inputs, 32, kernel, stride=2, padding=1)
            nn.init.xavier_uniform_(convolution.weight, nn.init.calculate_gain("leaky_relu"))
            nn.init.constant_(convolution.get_parameter("bias"), 0.01)
            layers += [convolution, PReLU()]
        super().__init__(layout, nn.Sequential(*layers), lambda inputs: (nn.LayerNorm(inputs), inputs))
        unit = 255.0 if space.dtype == "uint8" else 1.0
        self._epsilon = 1e-5 * unit**2  # below the variance of any image that is not uniform

    def prepare(self, observations: Tensor) -> Tensor:
        """Normalise each image to mean 0 and variance 1."""
        # One group of one channel: torch normalises channels_last images far more slowly.
        images = as_floats(observations).flatten(1).unsqueeze(1)
        return functional.group_norm(images, 1, eps=self._epsilon)


def _atari(name: str, space: ArraySpace, convolutions: tuple[tuple[int, int, int], ...], units: int) -> ImageEncoder:
    """Build convolutions (filters, kernel, stride) with ReLUs, then a fully connected layer of `units` with a ReLU."""
    layout = ImageLayout(name, space)
    inputs, make, layers = layout.shape[0], _first(space), []
    for filters, kernel, stride in convolutions:
        layers += [orthogonal(make(inputs, filters, kernel, stride), _GAIN), nn.ReLU()]
        inputs, make = filters, nn.Conv2d
    return ImageEncoder(layout, nn.Sequential(*layers), lambda inputs: _rectified(inputs, units))


class _Residual(nn.Module):
    """Residual block x + conv(relu(conv(relu(x)))): [N, C, H, W] -> the same shape."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.ReLU(),
            orthogonal(nn.Conv2d(channels, channels, 3, padding=1)),
            nn.ReLU(),
            orthogonal(nn.Conv2d(channels, channels, 3, padding=1)),
        )

    def forward(self, inputs: Tensor) -> Tensor:
        return inputs + self.layers(inputs)


def _stage(convolution: nn.Conv2d) -> nn.Sequential:
    """Build a convolution, max pooling to half the size, and two residual blocks."""
    channels = convolution.out_channels
    return nn.Sequential(
        orthogonal(convolution), nn.MaxPool2d(3, 2, padding=1), _Residual(channels), _Residual(channels)
    )


def _rectified(inputs: int, units: int) -> tuple[nn.Module, int]:
    return nn.Sequential(orthogonal(nn.Linear(inputs, units), _GAIN), nn.ReLU()), units


def _first(space: ArraySpace) -> type[nn.Conv2d]:
    return BytesConv2d if space.dtype == "uint8" else nn.Conv2d
