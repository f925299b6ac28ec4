"""An encoder supplied by the user as `module:Class`: any torch.nn.Module that can be exported to ONNX.

The class is constructed with one argument, the shape of an observation, frame stack included. It is called with
observations [N, *shape], float32 or uint8, and returns features [N, F] float32. Observations are as the environment
returns them, but `policy.normalize_observations` normalises every float32 array. If the observation has several
components, the class is constructed with a map of shapes, and called with a map of tensors; discrete components are
int64 [N, D].
"""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from daedalus.policy.component_inputs import normalized_components
from daedalus.policy.network.layers import find_class
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import NetworkError, UserModuleError, UserModules
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, ObservationSpaces
from daedalus.protocol.spec import PolicySpec

_ROWS = 3  # not the number of rows of the recording
_TOLERANCE = 1e-3

_logger = logging.getLogger(__name__)


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
    part of it. The network of the learner has its dropout, the program has none: that is only warned of.
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


def _varies_in_training(encoder: PositionalEncoder, spaces: ObservationSpaces) -> bool:
    """Return whether the features of the same observations vary in the learner, as with dropout."""
    with torch.no_grad(), torch.random.fork_rng(devices=()):
        for tensors in _observations(spaces):
            with suppress(Exception):  # the environment has no such values
                return not _equal(encoder(*tensors), encoder(*tensors))
    return False


@cache  # a policy may have another one for its values
def _warn_of_dropout(name: str) -> None:
    _logger.warning(
        "policy.encoder=%s: its features vary from call to call in the learner, as with dropout, which actors do not "
        "have: the learner then takes their probabilities for others; set dropout=0.0, also in "
        "nn.TransformerEncoderLayer, whose default is 0.1",
        name,
    )


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
    played = _played(recorded, tensors)
    if played is None:
        raise NetworkError(
            "its exported program fails for another number of rows: write observations.shape[0] for N, because "
            "len(observations) is a constant there, as are values that Python code reads (item(), tolist(), NumPy)"
        )
    if not _equal(features, played):
        raise NetworkError(
            "returns other features than its exported program: Python code that depends on the values of tensors (if, "
            "for, item(), NumPy) is not exported; use torch operations such as torch.where"
        )


def _played(recorded: Callable[..., Tensor], tensors: tuple[Tensor, ...]) -> Tensor | None:
    """Return the features of a recording, or None if it cannot be played with this number of rows."""
    try:
        return recorded(*tensors)
    except RuntimeError:
        return None


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


class CustomEncoder(nn.Module):
    """The user's module, imported, constructed and checked."""

    def __init__(self, spec: PolicySpec, spaces: ObservationSpaces, modules: UserModules) -> None:
        """Raise NetworkError, naming the encoder, if it may not be imported, or cannot be constructed or called."""
        super().__init__()
        name = spec.encoder
        self._only = next(iter(spaces)) if len(spaces) == 1 else None
        shapes = {component: space.stacked_shape for component, space in spaces.items()}
        contract = ""  # for errors of the class, not for those of its module
        try:
            encoder = find_class("policy.encoder", name, nn.Module, modules)
            contract = f"; {_contract(spec, spaces)}"
            self.module = encoder(shapes if self._only is None else shapes[self._only])
            zeros = _zeros(spaces)
            self.features = _checked_features(self.module, self._inputs(zeros))
            encoder = PositionalEncoder(self.module, self.forward, tuple(zeros))
            check_recording(encoder, tuple(zeros.values()), spaces)
            if _varies_in_training(encoder, spaces):
                _warn_of_dropout(name)
        except UserModuleError as error:
            raise NetworkError(str(error)) from error.__cause__
        except NetworkError as error:
            raise NetworkError(f"policy.encoder={name}: {error}{contract}") from error.__cause__
        except Exception as error:  # the user's code may raise anything
            raise NetworkError(f"policy.encoder={name}: {first_line(error)}{place_of(error)}{contract}") from error

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode observations: {name: [N, *stacked_shape]} -> [N, features]."""
        return self.module(self._inputs(observations))

    def _inputs(self, observations: dict[str, Tensor]) -> Tensor | dict[str, Tensor]:
        return observations if self._only is None else observations[self._only]


def _zeros(spaces: ObservationSpaces) -> dict[str, Tensor]:
    return {
        name: torch.zeros(
            (2, *space.stacked_shape),
            dtype=torch.int64 if isinstance(space, DiscreteSpace) else getattr(torch, space.dtype),
        )
        for name, space in spaces.items()
    }


def _contract(spec: PolicySpec, spaces: ObservationSpaces) -> str:
    """Return the arguments of the constructor and of the calls."""
    normalized = normalized_components(spec, spaces)
    described = {name: _described(space, is_normalized=name in normalized) for name, space in spaces.items()}
    if len(spaces) == 1:
        (space,), (text,) = spaces.values(), described.values()
        return f"it is constructed with the shape {space.stacked_shape}, and called with observations {text}"
    parts = ", ".join(f"{name}: {text}" for name, text in described.items())
    return f"it is constructed with a dict of shapes by name, and called with a dict of observations: {parts}"


def _described(space: ArraySpace | DiscreteSpace, *, is_normalized: bool) -> str:
    sizes = ", ".join(map(str, space.stacked_shape))
    if isinstance(space, DiscreteSpace):
        return f"[N, {sizes}] of {space.dtype}, numbers of choices from 0 on"
    values = "uint8 from 0 to 255" if space.dtype == "uint8" else "float32"
    scale = "normalised by policy.normalize_observations" if is_normalized else "not scaled"
    stacked = f", {space.frames} frames first" if space.frames > 1 else ""
    return f"[N, {sizes}] of {values}, {scale}, axes as in the environment{stacked}"


def _checked_features(module: nn.Module, zeros: Tensor | dict[str, Tensor]) -> int:
    """Return the number of features, from a call with zeros. Raises NetworkError if the module is not an encoder."""
    buffers = [name for name, _ in module.named_buffers()]
    if buffers:
        raise NetworkError(
            f"its buffer {buffers[0]!r} would not reach the actors, which receive only parameters: avoid buffers "
            "(use LayerNorm instead of BatchNorm, and nn.Parameter with requires_grad=False for constants)"
        )
    with torch.no_grad():
        features = module(zeros)
    declared = getattr(module, "features", None)
    if not isinstance(features, Tensor) or features.ndim != 2 or len(features) != 2:
        shape = tuple(features.shape) if isinstance(features, Tensor) else type(features).__name__
        given = tuple(zeros.shape) if isinstance(zeros, Tensor) else {k: tuple(v.shape) for k, v in zeros.items()}
        raise NetworkError(f"returns {shape} for 2 observations {given}; it must return [2, features]")
    if features.dtype != torch.float32:
        raise NetworkError(f"returns {features.dtype}; it must return torch.float32")
    if isinstance(declared, int) and declared != features.shape[1]:
        raise NetworkError(f"has features={declared} but returns {tuple(features.shape)}; make them agree")
    return features.shape[1]
