"""Which components of the observations a policy normalises. No torch: the learner checks gradients with it."""

from daedalus.protocol.spaces import ArraySpace, ObservationSpaces
from daedalus.protocol.spec import PolicySpec


def normalized_components(policy: PolicySpec, spaces: ObservationSpaces) -> dict[str, ArraySpace]:
    """Return the arrays that `normalize_observations` normalises: all but the bytes of an encoder for bytes.

    The encoders for images and those of users take `uint8` as it is. Only the multilayer perceptron reads bytes as
    numbers.
    """
    if not policy.normalize_observations:
        return {}
    arrays = {name: space for name, space in spaces.items() if isinstance(space, ArraySpace)}
    alone = len(spaces) == 1
    return {
        name: space
        for name, space in arrays.items()
        if space.dtype != "uint8" or _reads_numbers(policy, space, alone=alone)
    }


def _reads_numbers(policy: PolicySpec, space: ArraySpace, *, alone: bool) -> bool:
    """Return whether the multilayer perceptron reads an array of bytes."""
    if policy.encoder == "mlp":
        return True
    # A named encoder for images reads an array of any size if it is the only component.
    by_numbers = policy.encoder == "auto" or (":" not in policy.encoder and not alone)
    return by_numbers and not space.is_image
