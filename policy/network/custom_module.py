"""Finding a class that the user supplies as `module:Class`."""

import importlib
import os
import sys
from typing import TypeVar

from torch import nn

from daedalus.policy.network.errors import NetworkError

Module = TypeVar("Module", bound=nn.Module)


def find_class(reference: str, base: type[Module]) -> type[Module]:
    """Import `module:Class`. Raises NetworkError if there is no such module, or no such class derived from `base`."""
    module_name, class_name = reference.split(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise NetworkError(f"{error}; install it, or run in the folder of {module_name}.py") from error
    found = getattr(module, class_name, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        kind = "torch.nn.Module" if base is nn.Module else base.__name__
        raise NetworkError(f"{module.__file__} has no {kind} {class_name!r}; name one of its classes")
    return found
