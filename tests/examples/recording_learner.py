"""Learner for tests: it does not train, keeps the received rollouts, and gives the answers that a test sets."""

import queue
import time
from collections.abc import Callable

import numpy as np
import onnx
from processes import LIMIT

from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import program_hash
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Join, Program, Refusal, RunEnded, Snapshot, Welcome
from daedalus.protocol.spec import CollectionSpec, EnvironmentSpec, PolicySpec, RunSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryTransport

SPEC = RunSpec(
    environment=EnvironmentSpec(id="CartPole-v1", reward_scale=0.05, max_episode_steps=40),
    policy=PolicySpec(memory="gru", memory_units=8, hidden=(16,)),
    collection=CollectionSpec(envs_per_actor=6, rollout_length=48),
)
# Two rollouts in flight may arrive in any order.
ONE_AT_A_TIME = SPEC.model_copy(update={"collection": SPEC.collection.model_copy(update={"window": 1})})


class RecordingLearner:
    """Learner of the run `r` that records messages. A test changes `epoch` to simulate a new learner process."""

    def __init__(self, transport: MemoryTransport, spec: RunSpec = SPEC) -> None:
        self.spec, self.epoch, self.version = spec, 2**62 + 5, 0
        self.epsilon = 0.0  # of every actor
        self.joins: list[Join] = []
        self.rollouts: queue.SimpleQueue[Rollout] = queue.SimpleQueue()
        self.verdicts: queue.SimpleQueue[Acknowledgement] = (
            queue.SimpleQueue()
        )  # answers to the next rollouts, instead of accepting them
        self.refusals: queue.SimpleQueue[Refusal] = (
            queue.SimpleQueue()
        )  # answers to the next joins, instead of a welcome
        self.present: dict[tuple[str, int] | None, bool] = {}
        self._transport = transport
        self.model, self.weights = b"", {}
        transport.declare_presence(keys.learner("r"))
        transport.watch_presence(keys.presence("r", "*", "*"), self._on_presence)
        transport.serve(keys.snapshots("r"), lambda request: request.reply(self.snapshot()))
        transport.serve(keys.program("r", "*"), lambda request: request.reply(self._program()))
        transport.serve(keys.rollouts("r", "*"), self._on_rollout)
        transport.serve(keys.join("r", "*"), self._on_join)

    def snapshot(self) -> bytes:
        if not self.weights:
            return encode(Refusal(code="not_ready", reason="the learner has no policy yet"))
        name = program_hash(self.model)
        return encode(
            Snapshot(learner_epoch=self.epoch, policy_version=self.version, program=name, weights=self.weights)
        )

    def publish(self) -> None:
        self.version += 1
        self.weights = {name: (array * 1.01).astype(np.float32) for name, array in self.weights.items()}
        self.push(self.snapshot())

    def push(self, message: bytes) -> None:
        self._transport.publish(keys.snapshots("r"), message)

    def end_run(self) -> None:
        message = RunEnded(learner_epoch=self.epoch, outcome="finished", reason="the test is over")
        self._transport.publish(keys.run_end("r"), encode(message))

    def _program(self) -> bytes:
        return encode(Program(hash=program_hash(self.model), model=np.frombuffer(self.model, np.uint8)))

    def _on_presence(self, key: str, present: bool) -> None:
        self.present[keys.parse_presence(key)] = present

    def _on_join(self, request: Request) -> None:
        join = decode(request.payload, Limits())
        assert isinstance(join, Join)
        self.joins.append(join)
        if not self.refusals.empty():
            request.reply(encode(self.refusals.get()))
            return
        if join.spaces is not None:  # an actor declares its presence before it joins
            assert self.present[join.actor, join.incarnation]
        if join.spaces is not None and not self.weights:
            self.network = ActorCritic(self.spec.policy, join.spaces, training=self.spec.training)
            self.model = export_program(self.network, join.spaces)
            inputs = {entry.name for entry in onnx.load_model_from_string(self.model).graph.input}
            parameters = dict(self.network.named_parameters())
            self.weights = {name: parameters[name].detach().numpy().copy() for name in inputs & parameters.keys()}
        request.reply(encode(Welcome(run="r", learner_epoch=self.epoch, seed=11, epsilon=self.epsilon, spec=self.spec)))

    def _on_rollout(self, request: Request) -> None:
        rollout = decode(request.payload, Limits())
        assert isinstance(rollout, Rollout)
        assert keys.last_chunk(request.key) == rollout.identity.actor
        self.rollouts.put(rollout)
        try:
            verdict = self.verdicts.get_nowait()
        except queue.Empty:
            verdict = Acknowledgement(verdict="accepted", policy_version=self.version)
        request.reply(encode(verdict))

    def next(self) -> Rollout:
        return self.rollouts.get(timeout=LIMIT)

    def await_rollout(self, wanted: Callable[[Rollout], bool]) -> Rollout:
        deadline = time.monotonic() + LIMIT
        while not wanted(rollout := self.next()):
            assert time.monotonic() < deadline, "no rollout fulfilled the condition in time"
        return rollout
