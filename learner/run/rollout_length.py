"""Whether the rollouts of a run are long enough for its algorithm and its spaces. Pure."""

from daedalus.learner.run.settings import SettingsError
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec


def check_rollout_length(spec: RunSpec, spaces: Spaces) -> None:
    """Raise SettingsError if no row would have the mask of the next one, which action values bootstrap with."""
    if spec.algorithm.heads == "action_values" and spaces.masks and spec.collection.rollout_length < 2:
        raise SettingsError(
            f"collection.rollout_length is 1, but {spec.training.algorithm} needs the mask of the next row, and the "
            "actions of this environment are masked: make it at least 2"
        )
