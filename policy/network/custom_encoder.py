"""An encoder supplied by the user as `module:Class`: any torch.nn.Module that can be exported to ONNX.

The class is constructed with one argument, the shape of an observation, frame stack included. It is called with
observations [N, *shape] as the environment returns them, float32 or uint8, and returns features [N, F] float32.
"""

import torch
from torch import Tensor, nn

from daedalus.policy.network.errors import NetworkError
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol.spaces import ArraySpace


class CustomEncoder(nn.Module):
    """The user's module, imported, constructed and checked."""

    def __init__(self, name: str, space: ArraySpace, modules: UserModules) -> None:
        """Raise NetworkError, naming the encoder, if it may not be imported, or cannot be constructed or called."""
        super().__init__()
        contract = ""  # for errors of the class, not for those of its module
        try:
            found = _find(name, modules)
            contract = f"; {_contract(space)}"
            self.module = found(space.stacked_shape)
            self.features = _checked_features(self.module, space)
        except UserModuleError as error:
            raise NetworkError(str(error)) from error.__cause__
        except NetworkError as error:
            raise NetworkError(f"policy.encoder={name}: {error}{contract}") from error.__cause__
        except Exception as error:  # the user's code may raise anything
            first_line = next(iter(str(error).strip().splitlines()), "")
            raise NetworkError(f"policy.encoder={name}: {type(error).__name__}: {first_line}{contract}") from error

    def forward(self, observations: Tensor) -> Tensor:
        """Encode observations: [N, *stacked_shape] -> [N, features]."""
        return self.module(observations)


def _contract(space: ArraySpace) -> str:
    """Return the arguments of the constructor and of the calls."""
    shape = space.stacked_shape
    scale = "uint8 from 0 to 255" if space.dtype == "uint8" else "float32"
    stacked = f", {space.frames} frames first" if space.frames > 1 else ""
    return (
        f"it is constructed with the shape {shape}, and called with observations "
        f"[N, {', '.join(map(str, shape))}] of {scale}, not scaled, axes as in the environment{stacked}"
    )


def _find(name: str, modules: UserModules) -> type[nn.Module]:
    found = modules.attribute("policy.encoder", name)
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise NetworkError("it is not a class of torch.nn.Module: name a class of your module")
    return found


def _checked_features(module: nn.Module, space: ArraySpace) -> int:
    """Return the number of features, from a call with zeros. Raises NetworkError if the module is not an encoder."""
    buffers = [name for name, _ in module.named_buffers()]
    if buffers:
        raise NetworkError(
            f"its buffer {buffers[0]!r} would not reach the actors, which receive only parameters: avoid buffers "
            "(use LayerNorm instead of BatchNorm)"
        )
    zeros = torch.zeros((2, *space.stacked_shape), dtype=getattr(torch, space.dtype))
    with torch.no_grad():
        features = module(zeros)
    declared = getattr(module, "features", None)
    if not isinstance(features, Tensor) or features.ndim != 2 or len(features) != 2:
        shape = tuple(features.shape) if isinstance(features, Tensor) else type(features).__name__
        raise NetworkError(f"returns {shape} for 2 observations {tuple(zeros.shape)}; it must return [2, features]")
    if features.dtype != torch.float32:
        raise NetworkError(f"returns {features.dtype}; it must return torch.float32")
    if isinstance(declared, int) and declared != features.shape[1]:
        raise NetworkError(f"has features={declared} but returns {tuple(features.shape)}; make them agree")
    return features.shape[1]
