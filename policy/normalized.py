"""Which components of the observations a policy normalises. No torch: the learner checks gradients with it."""

from daedalus.protocol.spaces import ArraySpace, DiscreteSpace
from daedalus.protocol.spec import PolicySpec


def normalized_components(policy: PolicySpec, spaces: dict[str, ArraySpace | DiscreteSpace]) -> dict[str, ArraySpace]:
    """Return the arrays that `normalize_observations` normalises: all but images, and bytes of an encoder for bytes.

    The encoders for images and those of users take `uint8` as it is. Only the multilayer perceptron reads bytes that
    are no image as numbers.
    """
    if not policy.normalize_observations:
        return {}
    # A named encoder for images reads an array of any size if it is the only component.
    by_numbers = policy.encoder in ("auto", "mlp") or (":" not in policy.encoder and len(spaces) > 1)
    return {
        name: space
        for name, space in spaces.items()
        if isinstance(space, ArraySpace) and not space.is_image and (by_numbers or space.dtype != "uint8")
    }
