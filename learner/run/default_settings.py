"""Default settings of an environment without a preset, chosen by its observations, actions and seats."""

import importlib.resources
import math
import tomllib
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

from daedalus.protocol.spaces import ArraySpace, Spaces

Kind = Literal["vectors_discrete", "vectors_continuous", "images", "large_images"]
_UNKNOWN: Kind = "vectors_discrete"  # for an environment whose spaces are not known
_LARGE = 128  # pixels of the longer side
_RGB = 3  # colours, which environment.grey takes
_MAX_ROLLOUT_BYTES = 48 << 20  # of observations; service.queue_megabytes is 64
_SHORT = 16  # rows: before a rollout becomes shorter, an actor gets fewer environments
_FULL_SEATS = 2  # of a game: if there are more, an actor plays fewer copies, for as many rows
_FULL_NOISE = 2  # numbers of an action: if there are more, each is explored less


def default_settings(
    spaces: Spaces | None,
    leave_out: Sequence[str] = (),
    seats: int = 1,
    codes: Mapping[str, tuple[int, ...]] = MappingProxyType({}),
    maps: Collection[str] = (),
) -> dict[str, Any]:
    """Return the default settings for the spaces of an environment, as a preset has them.

    Args:
      spaces: of the environment without transforms; None if they are not known.
      leave_out: components of the observation that are not in `spaces`.
      seats: agents of a game that the policy plays: each has rows of its own.
      codes: components of the observation that are codes, as `policy.codes` has them.
      maps: components of the observation that are maps of a few cells.
    """
    kind = _UNKNOWN if spaces is None else kind_of(spaces, codes)
    file = importlib.resources.files("daedalus.learner.run.defaults") / f"{kind}.toml"
    settings = tomllib.loads(file.read_text("utf-8"))
    if kind == "large_images" and spaces is not None and any(space.image_shape[0] != _RGB for space in _images(spaces)):
        del settings["environment"]["grey"]
    if spaces is not None and spaces.continuous_numbers:
        # The bonus would widen a Gaussian for nothing: noise beyond the bounds is clipped (docs/results.md).
        settings["training"]["entropy_bonus"] = 0.0
        settings["training"].pop("entropy_bonus_final", None)
    if kind == "vectors_discrete" and maps:
        settings["policy"]["encoder"] = "grid"
        # In half of the time, and no worse on four of MinAtar's games (docs/results.md).
        settings["training"] |= {"passes": 4, "learning_rate": 1e-3, "learning_rate_final": 0.0}
    if kind == "vectors_continuous" and spaces is not None:
        settings["policy"]["initial_std"] = round(settings["policy"]["initial_std"] * _noise_scale(spaces), 2)
    for section, values in settings.pop("for_two_seats", {}).items():
        if seats == _FULL_SEATS:
            settings[section] |= values
    if seats > 1:
        for name in ("learning_rate_final", "entropy_bonus", "curiosity"):  # were not measured in games
            settings["with_memory"]["training"].pop(name, None)
    if seats > _FULL_SEATS:
        for collection in (settings["collection"], settings["with_memory"]["collection"]):
            collection["envs_per_actor"] = max(1, collection["envs_per_actor"] * _FULL_SEATS // seats)
        settings["training"]["mean_first_value"] = True  # a team unlearns late what it explores (docs/results.md)
    if spaces is not None:
        _fit_rollouts(settings, spaces, seats)
    if codes:
        settings["policy"]["codes"] = {name: list(numbers) for name, numbers in codes.items()}
        if kind == "vectors_discrete":
            # When a grid is solved, what is left of the advantages is noise, and the policy is nearly certain: with
            # PPO's clipping it is lost within a batch (docs/results.md).
            settings["training"]["surrogate"] = "spo"
            settings["with_memory"]["training"]["surrogate"] = "clip"  # the other was not measured with one
    if leave_out:
        settings.setdefault("environment", {})["leave_out"] = list(leave_out)
    return settings


def _fit_rollouts(settings: dict[str, Any], spaces: Spaces, seats: int) -> None:
    """Make rollouts shorter, and then the environments of an actor fewer, until a message can carry a rollout."""
    environment = settings.get("environment", {})
    resized, grey = environment.get("resize"), environment.get("grey", False)
    row = 0  # bytes of one seat
    for space in spaces.observations.values():
        if not isinstance(space, ArraySpace):
            continue
        if resized is None or not space.is_image:
            row += space.observation_bytes
        else:
            row += math.prod(resized) * (1 if grey else space.image_shape[0])
    base, with_memory = settings["collection"], settings["with_memory"]["collection"]
    for collection in (base, with_memory):
        while collection["rollout_length"] * collection["envs_per_actor"] * seats * row > _MAX_ROLLOUT_BYTES:
            if collection["rollout_length"] > _SHORT or collection["envs_per_actor"] == 1:
                if collection["rollout_length"] == 1:
                    break
                collection["rollout_length"] //= 2
            else:
                collection["envs_per_actor"] //= 2
    for each in settings["for_algorithm"].values():  # with either number of environments
        shortest = min(base["rollout_length"], with_memory["rollout_length"])
        each["collection"]["rollout_length"] = min(each["collection"]["rollout_length"], shortest)


def kind_of(spaces: Spaces, coded: Collection[str] = ()) -> Kind:
    """Return the kind of spaces: with an image, else with continuous actions, else with discrete ones only.

    A component in `coded` is no image.
    """
    images = _images(spaces, coded)
    if images:
        return "large_images" if any(max(space.image_shape[1:]) > _LARGE for space in images) else "images"
    return "vectors_continuous" if spaces.continuous_numbers else "vectors_discrete"


def _noise_scale(spaces: Spaces) -> float:
    """Return the factor of the noise with which the norm over all numbers of an action is that of two at most.

    With the noise that MountainCarContinuous needs in its one number, Ant hardly learns with eight (docs/results.md).
    """
    return min(1.0, math.sqrt(_FULL_NOISE / spaces.continuous_numbers))


def _images(spaces: Spaces, coded: Collection[str] = ()) -> list[ArraySpace]:
    observed = [space for name, space in spaces.observations.items() if name not in coded]
    return [space for space in observed if isinstance(space, ArraySpace) and space.is_image]
