"""How a policy reads each component of the observations: normalised, as codes, as a map. No torch: the learner checks
gradients with it.
"""

from daedalus.protocol.spaces import ArraySpace, ObservationSpaces
from daedalus.protocol.spec import PolicySpec


def normalized_components(policy: PolicySpec, spaces: ObservationSpaces) -> dict[str, ArraySpace]:
    """Return the arrays that `normalize_observations` normalises: numbers that the multilayer perceptron reads.

    Codes are normalised as one-hot numbers: without that, a policy with memory takes several times as many updates to
    learn whether two codes are the same. The encoders for images and those of users take `uint8` as it is, and a map of
    planes has the same scale everywhere.
    """
    if not policy.normalize_observations:
        return {}
    encoded = encoded_spaces(policy, spaces)
    arrays = {name: space for name, space in encoded.items() if isinstance(space, ArraySpace)}
    maps = grid_components(policy, spaces)
    alone = len(spaces) == 1
    return {
        name: space
        for name, space in arrays.items()
        if name not in maps and (space.dtype != "uint8" or _reads_numbers(policy, space, alone=alone))
    }


def _reads_numbers(policy: PolicySpec, space: ArraySpace, *, alone: bool) -> bool:
    """Return whether the multilayer perceptron reads an array of bytes."""
    if policy.encoder == "mlp":
        return True
    # A named encoder for images reads an array of any size if it is the only component.
    by_numbers = policy.encoder in ("auto", "grid") or (":" not in policy.encoder and not alone)
    return by_numbers and not space.is_image


def coded_components(policy: PolicySpec, spaces: ObservationSpaces) -> dict[str, tuple[int, ...]]:
    """Return how many codes each place of the last axis has, of the components in `policy.codes`.

    A user's encoder receives the bytes themselves. Components that `codes_problem` names are left out.
    """
    if ":" in policy.encoder:
        return {}
    arrays = {name: space for name in policy.codes if isinstance(space := spaces.get(name), ArraySpace)}
    return {
        name: codes if len(codes) > 1 else codes * space.shape[-1]
        for name, space in arrays.items()
        if not _misfit(space, codes := policy.codes[name])
    }


def codes_problem(policy: PolicySpec, spaces: ObservationSpaces) -> str:
    """Return which of `policy.codes` do not fit the spaces, or an empty string."""
    for name, codes in policy.codes.items():
        if name not in spaces:
            return f"policy.codes names {name!r}, but the components of the observation are {', '.join(spaces)}"
        if misfit := _misfit(spaces[name], codes):
            return f"policy.codes.{name} {misfit}"
    return ""


def _misfit(space: object, codes: tuple[int, ...]) -> str:
    if not isinstance(space, ArraySpace) or space.dtype != "uint8":
        return f"is for an array of bytes, not for {space}: leave it out"
    if len(codes) not in (1, space.shape[-1]):
        return (
            f"has {len(codes)} numbers, but the last axis of a {space} has {space.shape[-1]} places: give a number for "
            "each of them, or one for all"
        )
    return ""


def encoded_spaces(policy: PolicySpec, spaces: ObservationSpaces) -> ObservationSpaces:
    """Return the spaces of the components as the encoder reads them: one-hot planes in place of codes."""
    coded = coded_components(policy, spaces)
    return {name: _planes(space, coded[name]) if name in coded else space for name, space in spaces.items()}


def _planes(space: object, codes: tuple[int, ...]) -> ArraySpace:
    assert isinstance(space, ArraySpace)
    return ArraySpace(shape=(*space.shape[:-1], sum(codes)), dtype="float32", frames=space.frames)


def grid_components(policy: PolicySpec, spaces: ObservationSpaces) -> dict[str, ArraySpace]:
    """Return the maps that the `grid` encoder convolves: arrays of three axes, the last one the planes or codes."""
    if policy.encoder != "grid":
        return {}
    return {name: space for name, space in spaces.items() if isinstance(space, ArraySpace) and len(space.shape) == 3}
