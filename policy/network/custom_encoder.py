"""The user's own encoder, `module:Class`: any torch.nn.Module that a program can be made of.

The class is constructed with one argument, the shape of an observation, frame stack included. It is called with
observations [N, *shape] just as the environment shows them, float32 or uint8, and returns features [N, F] float32.
"""

import importlib
import os
import sys

import torch
from torch import Tensor, nn

from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import ArraySpace


class CustomEncoder(nn.Module):
    """The user's module, found, constructed and tried."""

    def __init__(self, name: str, space: ArraySpace) -> None:
        """Raises NetworkError, naming the encoder, if there is none of that name or it is no encoder."""
        super().__init__()
        try:
            self.module = _find(name)(space.stacked_shape)
            self.features = _tried(self.module, space)
        except NetworkError as error:
            raise NetworkError(f"policy.encoder={name}: {error}") from error.__cause__
        except Exception as error:  # the user's code may raise anything
            first_line = next(iter(str(error).strip().splitlines()), "")
            raise NetworkError(f"policy.encoder={name}: {type(error).__name__}: {first_line}") from error

    def forward(self, observations: Tensor) -> Tensor:
        """[N, *stacked_shape] -> [N, features]."""
        return self.module(observations)


def _find(name: str) -> type[nn.Module]:
    module_name, class_name = name.split(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise NetworkError(f"{error}; install it, or run where {module_name}.py lies") from error
    found = getattr(module, class_name, None)
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise NetworkError(f"{module.__file__} has no torch.nn.Module {class_name!r}; name one of its classes")
    return found


def _tried(module: nn.Module, space: ArraySpace) -> int:
    """The features it makes of observations of zeros; raises NetworkError if it is not fit for an encoder."""
    buffers = [name for name, _ in module.named_buffers()]
    if buffers:
        raise NetworkError(
            f"its buffer {buffers[0]!r} would not reach the actors, whom only parameters are sent: do without "
            "(LayerNorm in place of BatchNorm)"
        )
    zeros = torch.zeros((2, *space.stacked_shape), dtype=getattr(torch, space.dtype))
    with torch.no_grad():
        features = module(zeros)
    said = getattr(module, "features", None)
    if not isinstance(features, Tensor) or features.ndim != 2 or len(features) != 2:
        shape = tuple(features.shape) if isinstance(features, Tensor) else type(features).__name__
        raise NetworkError(f"makes {shape} of 2 observations {tuple(zeros.shape)}; it must return [2, features]")
    if features.dtype != torch.float32:
        raise NetworkError(f"returns {features.dtype}; it must return torch.float32")
    if isinstance(said, int) and said != features.shape[1]:
        raise NetworkError(f"says features={said} but returns {tuple(features.shape)}; make them agree")
    return features.shape[1]
