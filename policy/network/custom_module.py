"""Finding a class that the user supplies as `module:Class`."""

from typing import TypeVar

from torch import nn

from daedalus.policy.network.errors import NetworkError
from daedalus.policy.user_modules import UserModules

Module = TypeVar("Module", bound=nn.Module)


def find_class(setting: str, reference: str, base: type[Module], modules: UserModules) -> type[Module]:
    """Return the class `module:Class` that a setting names.

    Raises UserModuleError if the module may not be imported or has no such name, and NetworkError if it names something
    else than a class derived from `base`.
    """
    found = modules.attribute(setting, reference)
    if not (isinstance(found, type) and issubclass(found, base)):
        kind = "torch.nn.Module" if base is nn.Module else base.__name__
        raise NetworkError(f"it is not a class of {kind}: name a class of your module")
    return found
