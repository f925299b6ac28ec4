"""Trial of a user's encoder: whether actors, which play a recording of one call, compute what the learner computes."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn

from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, ObservationSpaces

_ROWS = 3  # not the number of rows of the recording
_TOLERANCE = 1e-3


class PositionalEncoder(nn.Module):
    """A module that takes the tensors of its components one by one, in the order of their names."""

    def __init__(self, module: nn.Module, call: Callable[[dict[str, Tensor]], Tensor], names: tuple[str, ...]) -> None:
        super().__init__()
        self.module, self._call, self._names = module, call, names

    def forward(self, *tensors: Tensor) -> Tensor:
        """Return the features of the observations."""
        return self._call(dict(zip(self._names, tensors, strict=True)))


def check_recording(encoder: PositionalEncoder, example: tuple[Tensor, ...], spaces: ObservationSpaces) -> None:
    """Raise NetworkError if the features of some observations are others in a recording of the call with an example.

    Torch records the operations of one call for the program of the actors: Python code that depends on values is not
    part of it. The network of the learner has its dropout, the program has none: that may differ.
    """
    training = [(module, module.training) for module in encoder.modules()]
    encoder.eval()  # as it is exported
    try:
        with torch.no_grad(), torch.random.fork_rng(devices=()), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the tracer
            recorded: Any = torch.jit.trace(encoder, example, check_trace=False)
            _compare(encoder, recorded, tuple(each.new_zeros((_ROWS, *each.shape[1:])) for each in example))
            for tensors in _observations(spaces):
                try:
                    _compare(encoder, recorded, tensors)
                except NetworkError:
                    raise
                except Exception:  # the environment has no such values: bytes that are indices of an embedding
                    continue
    finally:
        for module, mode in training:
            module.training = mode


def _compare(encoder: PositionalEncoder, recorded: Callable[..., Tensor], tensors: tuple[Tensor, ...]) -> None:
    features = encoder(*tensors)
    if not _equal(features, encoder(*tensors)):
        raise NetworkError(
            "returns other features when it is called again with the same observations: it must keep nothing from call "
            "to call, and draw no random numbers (a memory is policy.memory)"
        )
    if not _equal(features[:1], encoder(*(each[:1] for each in tensors))):
        raise NetworkError(
            "returns other features for an observation that is alone in its call: each of the N rows must be computed "
            "by itself (attention needs batch_first=True)"
        )
    if not _equal(features, _played(recorded, tensors)):
        raise NetworkError(
            "returns other features than its exported program: Python code that depends on the values of tensors (if, "
            "for, item(), NumPy) is not exported; use torch operations such as torch.where"
        )


def _played(recorded: Callable[..., Tensor], tensors: tuple[Tensor, ...]) -> Tensor:
    """Return the features of a recording; nothing if it cannot be played with this number of rows."""
    try:
        return recorded(*tensors)
    except RuntimeError:
        return torch.zeros(0)


def _equal(first: Tensor, second: Tensor) -> bool:
    if first.shape != second.shape:
        return False
    scale = float(first.abs().max()) if first.numel() else 0.0
    limit = _TOLERANCE * scale if scale < float("inf") else 0.0
    return torch.allclose(first, second, rtol=_TOLERANCE, atol=limit, equal_nan=True)


def _observations(spaces: ObservationSpaces) -> Iterator[tuple[Tensor, ...]]:
    """Yield random observations: of small whole numbers, then of larger ones of one sign, then of both."""
    generator = torch.Generator().manual_seed(0)

    def component(space: ArraySpace | DiscreteSpace, low: int, high: int) -> Tensor:
        if isinstance(space, DiscreteSpace):
            columns = [torch.randint(count, (_ROWS,), generator=generator) for count in space.counts]
            return torch.stack(columns, -1)
        shape = (_ROWS, *space.stacked_shape)
        if space.dtype == "uint8":
            return torch.randint(max(high, 2), shape, dtype=torch.uint8, generator=generator)
        if high == 2:
            return torch.randint(2, shape, generator=generator).to(torch.float32)
        return low + (high - low) * torch.rand(shape, generator=generator)

    for low, high in ((0, 2), (0, 256), (-10, 0), (-2, 3)):
        yield tuple(component(space, low, high) for space in spaces.values())
