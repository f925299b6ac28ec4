"""Normalisation of observations by statistics that the learner keeps, as part of the network."""

import torch
from torch import Tensor, nn

from daedalus.protocol.spaces import ArraySpace, DiscreteSpace

_LARGEST = 10.0  # normalised values are clipped to +- this value
_SMALLEST_VARIANCE = 1e-8


class ObservationNormalizer(nn.Module):
    """Shift and scale of every array that is not an image: (x - mean) / std, clipped to +-10.

    The statistics are parameters without gradients: they travel in snapshots and are saved in checkpoints like
    weights, so that actors and evaluations use exactly those that their snapshot was made with.
    """

    def __init__(self, spaces: dict[str, ArraySpace | DiscreteSpace]) -> None:
        super().__init__()
        self._names = tuple(
            name for name, space in spaces.items() if isinstance(space, ArraySpace) and not space.is_image
        )
        shapes = [spaces[name].stacked_shape for name in self._names]
        self.means = nn.ParameterList([_constant(torch.zeros(shape)) for shape in shapes])
        self.scales = nn.ParameterList([_constant(torch.ones(shape)) for shape in shapes])  # 1 / std

    @property
    def names(self) -> tuple[str, ...]:
        """The components that are normalised."""
        return self._names

    def forward(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Normalise observations {name: [N, *stacked_shape]}; images and discrete components are left as they are."""
        normalized = dict(observations)
        for name, mean, scale in zip(self._names, self.means, self.scales, strict=True):
            normalized[name] = ((observations[name].to(torch.float32) - mean) * scale).clamp(-_LARGEST, _LARGEST)
        return normalized

    def statistics(self, name: str) -> tuple[Tensor, Tensor]:
        """Return mean and variance [*stacked_shape] of one component."""
        index = self._names.index(name)
        return self.means[index].detach(), self.scales[index].detach().square().reciprocal() - _SMALLEST_VARIANCE

    @torch.no_grad()
    def set_statistics(self, name: str, mean: Tensor, variance: Tensor) -> None:
        """Set the statistics of one component: mean and variance [*stacked_shape]."""
        index = self._names.index(name)
        self.means[index].copy_(mean)
        self.scales[index].copy_((variance + _SMALLEST_VARIANCE).rsqrt())


def _constant(values: Tensor) -> nn.Parameter:
    return nn.Parameter(values, requires_grad=False)
