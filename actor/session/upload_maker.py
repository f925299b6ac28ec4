"""What an actor uploads of its rollouts: the rollouts themselves, or their gradients. No threads."""

from typing import Protocol

import numpy as np

from daedalus.actor.errors import ActorError
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec, UnsupportedRunError
from daedalus.protocol.uploads import Rollout, Upload


class UploadMaker(Protocol):
    """Maker of the messages that an actor uploads in one session."""

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Use the weights of a snapshot for the next rollouts. Raises PolicyError if they do not fit."""
        ...

    def compute(self, rollout: Rollout) -> Upload:
        """Return what to upload of the next rollout."""
        ...


class RolloutUploadMaker:
    """UploadMaker of the rollouts themselves."""

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See UploadMaker. Rollouts need no weights."""

    def compute(self, rollout: Rollout) -> Upload:
        """See UploadMaker."""
        return rollout


def make_upload_maker(spec: ActorSpec, spaces: Spaces, modules: UserModules) -> UploadMaker:
    """Return what makes the uploads that a run asks for. Only gradients import torch.

    `modules` may be imported for the network and the algorithm. Raises ActorError if the actor cannot compute
    gradients.
    """
    if not spec.uploads_gradients:
        return RolloutUploadMaker()
    try:
        learning = spec.learning_settings
        modules.check(learning.user_modules)
        from daedalus.algorithms.rollout_gradients import RolloutGradients
        from daedalus.policy.user_modules import NetworkError
        from daedalus.protocol.algorithms import AlgorithmError
    except (UnsupportedRunError, UserModuleError) as error:
        raise ActorError(str(error)) from None
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        raise ActorError(
            "this run takes gradients (collection.upload), which an actor computes with torch: install it with "
            "pip install 'daedalus-rl[learner]', or set collection.upload=rollouts"
        ) from None
    try:
        return RolloutGradients(learning, spaces, modules)
    except (AlgorithmError, NetworkError) as error:
        raise ActorError(str(error)) from None
