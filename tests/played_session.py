"""An ActorSession in given time: its actions are performed at once, by a learner that answers as the test says."""

from collections.abc import Callable
from typing import Any

import numpy as np
from plain import vector_spaces

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import Ask, Query, Reopen, Wait, Work
from daedalus.actor.session.session_engine import ActorSession, Begin, Collect, Encode, Load, Prepare
from daedalus.learner.serving.snapshot_publisher import CompactSnapshotCache
from daedalus.policy.acting.runtime import program_hash
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Join, Message, Program, Refusal, Snapshot, SnapshotRequest
from daedalus.protocol.messages import Welcome as WelcomeMessage
from daedalus.protocol.spec import RunSpec

SPACES = vector_spaces(4, 2)
SPEC = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}, "collection": {"window": 2}})
PROGRAM = b"program"


def welcome(run: str = "r", epoch: int = 1, spec: RunSpec = SPEC) -> WelcomeMessage:
    return WelcomeMessage(run=run, learner_epoch=epoch, seed=1, spec=spec.for_actors())


class PlayedSession:
    """The session of an actor `a`, and the learners that it meets.

    Attributes:
      learners: answers to a request to join, by run.
      silent: nobody answers a query, which then takes the whole time it waits.
      seconds: how long each kind of action takes, by its type.
      performed: all actions so far, besides Work.
    """

    def __init__(self, config: ActorConfig | None = None, *, weights: int = 8) -> None:
        self.session = ActorSession(config or ActorConfig(name="a", incarnation=7))
        self.learners: dict[str, list[Message]] = {"r": [welcome()]}
        self.seconds: dict[type, float] = {}
        self.silent = False
        self.performed: list[Any] = []
        self.now = 1000.0
        self.verdict: Any = "accepted"  # of each rollout; None: there is no answer
        self.version = 0
        self._weights = {"w": np.zeros(weights, np.float32)}
        self._compact = CompactSnapshotCache(1)
        self._steps, self._came = self.session.play(), None

    def of(self, kind: type[Any]) -> list[Any]:
        """Return the actions of a kind."""
        return [action for action in self.performed if isinstance(action, kind)]

    def requests(self, kind: type[Any]) -> list[Any]:
        """Return the messages of a kind that were sent as queries."""
        payloads = [action.payload for action in self.performed if isinstance(action, Ask | Query)]
        messages = [decode(payload, Limits()) for payload in payloads if payload not in (b"", b"rollout")]
        return [message for message in messages if isinstance(message, kind)]

    def go(self, is_over: Callable[[], bool], steps: int = 2000) -> None:
        """Let the session go on until something holds. Raises what the session raises."""
        for _ in range(steps):
            self.session.now = self.now
            action = self._steps.send(self._came)
            self._act()
            if not isinstance(action, Work):
                self.performed.append(action)
            self.now += self.seconds.get(type(action), 0.001)
            self._came = self._come_of(action)
            if is_over():
                return
        raise AssertionError(f"not within {steps} steps; the last: {self.performed[-5:]}")

    def event(self, event: Callable[..., None], *arguments: Any) -> None:
        self.session.now = self.now
        event(*arguments)
        self._act()

    def _act(self) -> None:
        while actions := self.session.take_actions():
            for action in actions:
                self.performed.append(action)
                if isinstance(action, Query):
                    self._answer(action)

    def _answer(self, query: Query) -> None:
        answer: Message | bytes | None = None
        if "/rollouts/" in query.key:
            if self.verdict is None:
                return
            answer = Acknowledgement(verdict=self.verdict, policy_version=self.version)
        elif query.key == keys.snapshots(self.session.run):
            request = decode(query.payload, Limits())
            assert isinstance(request, SnapshotRequest)
            newest = encode(self.snapshot())
            answer = self._compact.answer(request, newest) if request.compact else newest
        data = answer if isinstance(answer, bytes) or answer is None else encode(answer)
        query.on_answer(data, self.now)

    def snapshot(self) -> Snapshot:
        return Snapshot(
            learner_epoch=self.session.learner_epoch,
            policy_version=self.version,
            program=program_hash(PROGRAM),
            weights=self._weights,
        )

    def _come_of(self, action: Any) -> Any:
        match action:
            case Ask() if self.silent:
                self.now += action.timeout
                return []
            case Ask(key):
                return [encode(message) for message in self._answers(key, action.payload)]
            case Wait(until):
                assert until is None or until < self.now + 100.0
                self.now = max(self.now, until or 0.0)
            case Work(call):
                return call()
            case Prepare():
                return SPACES, 2
            case Collect():
                return object()
            case Encode():
                return b"rollout"
            case _:
                assert isinstance(action, Load | Begin | Reopen)
        return None

    def _answers(self, key: str, payload: bytes) -> list[Message]:
        if "/program/" in key:
            return [Program(hash=program_hash(PROGRAM), model=np.frombuffer(PROGRAM, np.uint8))]
        if key == keys.snapshots(self.session.run):
            return [self.snapshot()]
        assert isinstance(decode(payload, Limits()), Join)
        return [answer for run, there in self.learners.items() for answer in there if keys_match(key, run)]


def keys_match(key: str, run: str) -> bool:
    return key in (keys.join(run, "a"), keys.join(keys.ANY_RUN, "a"))


def refusal(code: Any) -> list[Message]:
    return [Refusal(code=code, reason="why")]
