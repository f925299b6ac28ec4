"""Normalisation of observations by statistics that the learner keeps, as part of the network."""

import torch
from torch import Tensor, nn

from daedalus.protocol.spaces import ArraySpace

_LARGEST = 10.0  # normalised values are clipped to +- this value
_SMALLEST_VARIANCE = 1e-12  # smaller deviations may be the rounding of float32 numbers near one
_PARTS = 3  # bfloat16 numbers, of 8 bits each, that make a float32


class ObservationNormalizer(nn.Module):
    """Shift and scale of arrays: (x - mean) / std, clipped to +-10.

    The statistics are parameters without gradients: they travel in snapshots and are saved in checkpoints like
    weights, so that actors and evaluations use exactly those that their snapshot was made with. Compact snapshots have
    the precision of bfloat16, which is too little for a mean that is large beside the deviation: every number here is
    one that bfloat16 can represent, and a mean is the sum of three.
    """

    def __init__(self, spaces: dict[str, ArraySpace]) -> None:
        """Construct the statistics of these components; see normalized_components."""
        super().__init__()
        self._names = tuple(spaces)
        shapes = [space.stacked_shape for space in spaces.values()]
        self.means = nn.ParameterList([_constant(torch.zeros(_PARTS, *shape)) for shape in shapes])  # summands
        self.scales = nn.ParameterList([_constant(torch.ones(shape)) for shape in shapes])  # 1 / std

    @property
    def names(self) -> tuple[str, ...]:
        """The components that are normalised."""
        return self._names

    def forward(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Normalise observations {name: [..., *stacked_shape]}; other components are left as they are."""
        normalized = dict(observations)
        for name, mean, scale in zip(self._names, self.means, self.scales, strict=True):
            centred = observations[name].to(torch.float32) - mean.sum(0)
            normalized[name] = (centred * scale).clamp(-_LARGEST, _LARGEST)
        return normalized

    def statistics(self, name: str) -> tuple[Tensor, Tensor]:
        """Return mean and variance [*stacked_shape] of one component."""
        index = self._names.index(name)
        mean, scale = self.means[index].detach().sum(0), self.scales[index].detach()
        return mean, scale.square().reciprocal() - _SMALLEST_VARIANCE

    @torch.no_grad()
    def set_statistics(self, name: str, mean: Tensor, variance: Tensor) -> None:
        """Set the statistics of one component: mean and variance [*stacked_shape]."""
        index = self._names.index(name)
        rest = mean.to(torch.float64)
        for part in self.means[index]:
            rounded = rest.to(torch.bfloat16)
            part.copy_(rounded)  # may be on a GPU, unlike the statistics
            rest = rest - rounded.to(torch.float64)
        self.scales[index].copy_((variance + _SMALLEST_VARIANCE).rsqrt().to(torch.bfloat16))


def _constant(values: Tensor) -> nn.Parameter:
    return nn.Parameter(values, requires_grad=False)
