"""What an actor decides for itself. Everything else comes from the learner."""

from dataclasses import dataclass
from typing import Literal

from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol import keys

LinkChoice = Literal["auto", "lan", "wan"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorConfig:
    """Everything that an actor decides for itself."""

    name: str
    incarnation: int
    run: str = keys.ANY_RUN
    environments: int | None = None  # E; None: as many as the learner's specification says
    runtime: Literal["onnx", "torch"] = "onnx"
    modules: UserModules = NO_MODULES  # that may be imported for environments
    link: LinkChoice = "auto"  # wan: fetch compact snapshots; lan: as on a fast link; auto: measure the link and decide
    timeout: float | None = None  # seconds to look for a learner; None: for ever
    waits_for_return: bool = False  # whether to look for ever for a learner that has gone, whatever the timeout
    max_policy_age: float | None = None  # seconds within which the learner must confirm the policy; None: no limit
    any_run: bool = False  # whether the actor may change to another run when its learner has gone

    def run_to_join(self, followed: str) -> str:
        """Return the run to look for; `followed` is the run that the actor joined before, or an empty text."""
        return self.run if self.any_run or not followed else followed
