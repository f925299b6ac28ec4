"""Tensors by the component of the observations or actions that they belong to."""

from collections.abc import Callable

from torch import Tensor

Components = dict[str, Tensor]


def map_components(components: Components, function: Callable[[Tensor], Tensor]) -> Components:
    """Return the components with `function` applied to each."""
    return {name: function(values) for name, values in components.items()}
