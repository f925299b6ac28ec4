"""An actor that is authorised and hostile: it joins a run on CartPole, and sends whatever rollouts it is told to."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import Acknowledgement, Join, Message, Welcome
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout, RolloutIdentity, Upload
from daedalus.transport.zenoh_transport import connect

_SPACES = Spaces(
    observations={"observation": ArraySpace(shape=(4,), dtype="float32")},
    actions={"action": DiscreteSpace(counts=(2,))},
)
_TIMEOUT = 30.0


class HostileActor:
    """One actor, on a session of its own."""

    spaces = _SPACES

    def __init__(self, address: str, name: str, environments: int = 1) -> None:
        self._transport, self.environments = connect([address]), environments
        self._name, self._incarnation = name, 0
        self._version = 0  # the newest policy version that an answer named
        try:
            self.join()
        except RuntimeError:
            self.close()  # or this process would not end
            raise

    def join(self) -> None:
        """Join as a new incarnation, with a clean record."""
        self._incarnation += 1
        self._sequence = 0
        join = Join(actor=self._name, incarnation=self._incarnation, spaces=_SPACES, environments=self.environments)
        welcome = self._ask(keys.join("run", self._name), join)
        if not isinstance(welcome, Welcome):
            raise RuntimeError(f"the learner refused the actor: {welcome}")
        self._epoch, self.spec = welcome.learner_epoch, welcome.spec
        self.rows = welcome.spec.collection.rollout_length

    def be_present(self) -> None:
        """Declare presence: from now on the learner regards this actor as live."""
        self._transport.declare_presence(keys.presence("run", self._name, self._incarnation))

    def send(self, **replaced: Any) -> Acknowledgement:
        """Send a rollout in which no episode ends, with some arrays replaced, until the learner decides on it."""
        rows, count = self.rows, self.environments
        cells = (rows, count)
        content: dict[str, Any] = {
            "frames": {"observation": np.zeros((rows + 1, count, 4), np.float32)},
            "initial_state": np.zeros((count, 0), np.float32),
            "actions": {"action": np.zeros((*cells, 1), np.uint8)},
            "masks": {},
            "behaviour_log_probs": np.full(cells, -0.7, np.float32),
            "rewards": np.full(cells, 0.05, np.float32),
            "terminated": np.zeros(cells, np.bool_),
            "truncated": np.zeros(cells, np.bool_),
            "valid": np.ones(cells, np.bool_),
            "episode_returns": np.zeros(0, np.float32),
            "episode_lengths": np.zeros(0, np.int32),
        }
        made = {**content, **replaced}
        return self.upload(lambda identity, version: Rollout(identity=identity, policy_version=version, **made))

    def upload(self, make: Callable[[RolloutIdentity, int], Upload], *, wait: bool = True) -> Acknowledgement:
        """Send what `make` returns for an identity and a policy version; `wait` until the learner decides on it."""
        while True:
            identity = RolloutIdentity(
                actor=self._name, incarnation=self._incarnation, sequence=self._sequence, learner_epoch=self._epoch
            )
            self._sequence += 1
            answer = self._ask(keys.rollouts("run", self._name), make(identity, self._version))
            if not isinstance(answer, Acknowledgement):
                raise RuntimeError(f"the learner answered {answer}")
            self._version = max(self._version, answer.policy_version)
            if not wait or (answer.verdict != "busy" and not answer.reason.startswith("policy lag")):
                return answer
            time.sleep(0.01)

    def close(self) -> None:
        """End the session."""
        self._transport.close()

    def _ask(self, key: str, message: Message) -> Message | None:
        answers = self._transport.query(key, encode(message), timeout=_TIMEOUT)
        return decode(answers[0], LEARNER_LIMITS) if answers else None
