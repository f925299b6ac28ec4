"""Many simulated actors in one process, each with a session of its own and one recorded rollout.

    python -m benchmarks.fleet.swarm ADDRESS FIRST COUNT RATE SECONDS [pixels]

Rollouts are of CartPole or, with `pixels`, of frames that compress as well as those of Pong. The actors join with the
numbers FIRST to FIRST + COUNT - 1, print `ready`, and wait for a line on standard input. Then each actor sends at most
RATE rollouts per second for SECONDS, with at most one in flight; with `pixels` it fetches a snapshot for each, as
actors do, and else all snapshots are pushed. Prints the results as JSON.
"""

import json
import secrets
import sys
import threading
import time
from collections import Counter
from dataclasses import replace

import msgpack
import numpy as np

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import Conversation
from daedalus.actor.session.session_thread import SessionThread
from daedalus.actor.session.uploading import InFlightRollouts
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Snapshot, SnapshotRequest
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.connecting import connect_with_retry

VECTORS = Spaces(
    observations={"observation": ArraySpace(shape=(4,), dtype="float32")},
    actions={"action": DiscreteSpace(counts=(2,))},
)
PIXELS = Spaces(
    observations={"observation": ArraySpace(shape=(84, 84), dtype="uint8", frames=4)},
    actions={"action": DiscreteSpace(counts=(6,))},
)
ENVIRONMENTS = 16
_LIMITS = Limits()
_WAIT_SECONDS = 120.0


class Recording:
    """Encoded rollout that is sent again and again under new numbers. It is compressed once: actors share the cores."""

    def __init__(self, rollout: Rollout) -> None:
        data = encode(rollout)
        end = 12 + int.from_bytes(data[8:12], "little")
        self._prefix, self._header, self._body = data[:8], msgpack.unpackb(data[12:end]), data[end + -end % 8 :]

    def numbered(self, sequence: int, policy_version: int) -> bytes:
        """Return the message with a sequence number and a policy version."""
        fields = self._header["fields"]
        fields["identity"]["sequence"], fields["policy_version"] = sequence, policy_version
        header = msgpack.packb(self._header)
        assert header is not None
        return b"".join(
            (self._prefix, len(header).to_bytes(4, "little"), header, bytes(-(12 + len(header)) % 8), self._body)
        )


def recorded(rows: int, spaces: Spaces = VECTORS, seed: int = 1) -> Rollout:
    """Return a rollout of plausible values. Only its size matters."""
    random = np.random.default_rng(seed)
    shape = (rows, ENVIRONMENTS)
    (actions,) = spaces.actions.values()
    assert isinstance(actions, DiscreteSpace)
    frames = random.normal(0, 0.05, (rows + 1, ENVIRONMENTS, 4)).astype(np.float32)
    if spaces is PIXELS:
        frames = np.full((ENVIRONMENTS, rows + 4, 84, 84), 87, np.uint8).swapaxes(0, 1)  # as an actor's writer has them
        for row, environment in np.ndindex(frames.shape[:2]):  # two paddles and a ball, which move, with smooth edges
            for column, size in ((8, 8), (75, 8), ((3 * row + environment) % 80, 2)):
                top = (environment * 7 + row * random.integers(0, 3)) % 74
                frames[row, environment, top : top + size, column : column + 2] = 236
                frames[row, environment, top - 1 : top + size + 1 : size + 1, column : column + 2] = random.integers(
                    87, 236, 2
                )
    return Rollout(
        identity=RolloutIdentity(actor="", incarnation=0, sequence=0, learner_epoch=0),
        policy_version=0,
        frames={"observation": frames},
        initial_state=np.zeros((ENVIRONMENTS, 0), np.float32),
        actions={"action": random.integers(0, actions.choices, (*shape, 1)).astype(np.uint8)},
        masks={},
        behaviour_log_probs=np.full(shape, -0.7, np.float32),
        rewards=np.ones(shape, np.float32),
        terminated=np.zeros(shape, np.bool_),
        truncated=np.zeros(shape, np.bool_),
        valid=np.ones(shape, np.bool_),
        episode_returns=np.zeros(0, np.float32),
        episode_lengths=np.zeros(0, np.int32),
    )


class Simulated:
    """Actor with a session and without environments."""

    def __init__(self, address: str, name: str, spaces: Spaces) -> None:
        transport = connect_with_retry([address], threading.Event(), _WAIT_SECONDS)
        assert transport is not None  # the event is never set
        self._transport = transport
        self._changed = threading.Condition()
        self._in_flight = InFlightRollouts(window=1)
        self._sequence, self._version = 0, -1
        self._sent_at = 0.0
        self.latencies: list[float] = []
        self.came: list[tuple[int, float]] = []  # policy version and time of each snapshot received
        incarnation = secrets.randbits(62)
        self._talk = Conversation(ActorConfig(name=name, incarnation=incarnation, timeout=_WAIT_SECONDS))
        self._session = SessionThread(self._talk, transport, threading.Event())
        found = self._session.run(self._talk.find_learner())
        join = replace(self._talk.join, spaces=spaces, environments=ENVIRONMENTS)
        self._welcome = self._session.run(self._talk.confirm(found, join))
        run = self._welcome.run
        self._fetches, self._fetching = spaces is PIXELS, False  # those of CartPole measure how long a push takes
        if not self._fetches:
            self._inbox = self._transport.subscribe(keys.snapshots(run), self._on_news)
        self._key = keys.rollouts(run, name)
        identity = RolloutIdentity(
            actor=name, incarnation=incarnation, sequence=0, learner_epoch=self._welcome.learner_epoch
        )
        self._rollout = Recording(
            replace(recorded(self._welcome.spec.collection.rollout_length, spaces), identity=identity)
        )

    @property
    def verdicts(self) -> Counter[str]:
        """Number of answers by verdict."""
        return self._in_flight.verdicts

    @property
    def _may_send(self) -> bool:
        return self._in_flight.has_room and not self._fetching

    def has_policy(self) -> bool:
        """Query the newest snapshot and return whether there is one."""
        for message in self._session.run(self._talk.ask(keys.snapshots(self._welcome.run))):
            if isinstance(message, Snapshot):
                self._version = max(self._version, message.policy_version)
        return self._version >= 0

    def _on_news(self) -> None:
        data = self._inbox.take()
        if data is not None:
            self._note_snapshot(data)

    def _note_snapshot(self, data: bytes) -> None:
        # Decode only the header: a thousand simulated actors share these cores.
        content = msgpack.unpackb(data[12 : 12 + int.from_bytes(data[8:12], "little")])
        self._version = content["fields"].get("policy_version", self._version)
        self.came.append((self._version, time.monotonic()))

    def _fetch(self) -> None:
        """Request the newest snapshot, as an actor does while it plays."""
        name, self._fetching = self._talk.join.actor, True
        request = SnapshotRequest(actor=name, held_version=self._version, compact=False)
        key = keys.snapshots(self._welcome.run)
        self._transport.query_async(key, encode(request), timeout=10.0, on_answer=self._on_snapshot)

    def _on_snapshot(self, data: bytes | None) -> None:
        with self._changed:
            if data is not None:
                self._note_snapshot(data)
            self._fetching = False
            self._changed.notify_all()

    def play(self, rate: float, until: float) -> None:
        """Send rollouts at a rate until a time. Blocks the calling thread."""
        pause = 1 / rate
        due = time.monotonic() + np.random.default_rng().uniform(0, pause)
        while (now := time.monotonic()) < until:
            with self._changed:
                self._changed.wait(max(min(due, until) - now, 0.0)) if now < due else None
                if time.monotonic() < due:
                    continue
                self._changed.wait_for(lambda: self._may_send or self._in_flight.next_due() is not None, 1.0)
                if self._may_send:
                    self._in_flight.add(self._sequence, self._rollout.numbered(self._sequence, max(self._version, 0)))
                    self._sequence += 1
                    self._sent_at = time.monotonic()
                    due = max(due + pause, self._sent_at)
                    if self._fetches:
                        self._fetch()
                wanted = self._in_flight.next_due()
                self._changed.wait(max((wanted or 0.0) - time.monotonic(), 0.0)) if wanted else None
                ready = self._in_flight.take_due(time.monotonic())
            for sequence, payload in ready:
                self._transport.query_async(
                    self._key,
                    payload,
                    timeout=30.0,
                    on_answer=lambda data, sequence=sequence: self._on_answer(sequence, data),
                )

    def _on_answer(self, sequence: int, data: bytes | None) -> None:
        message = None if data is None else decode(data, _LIMITS)
        answer = message if isinstance(message, Acknowledgement) else None
        now = time.monotonic()
        with self._changed:
            self._in_flight.acknowledge(sequence, answer, now)
            if answer is not None and answer.verdict == "accepted":
                self.latencies.append(now - self._sent_at)  # from the first attempt, with the time of busy answers
            self._changed.notify_all()

    def close(self) -> None:
        """Close the session."""
        self._transport.close()


def main() -> None:
    address, first, count, rate, seconds = sys.argv[1], *map(float, sys.argv[2:6])
    spaces = PIXELS if sys.argv[6:] == ["pixels"] else VECTORS
    actors = [Simulated(address, f"sim-{number}", spaces) for number in range(int(first), int(first + count))]
    try:
        while not actors[0].has_policy():
            time.sleep(0.1)
        for actor in actors[1:]:
            actor._version = actors[0]._version
        print("ready", flush=True)
        sys.stdin.readline()
        until = time.monotonic() + seconds
        threads = [threading.Thread(target=actor.play, args=(rate, until), daemon=True) for actor in actors]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(seconds + 60.0)
        verdicts: Counter[str] = sum((actor.verdicts for actor in actors), Counter())
        result = {
            "verdicts": verdicts,
            "latencies": [latency for actor in actors for latency in actor.latencies],
            "came": [actor.came for actor in actors],
        }
        print(json.dumps(result), flush=True)
    finally:
        for actor in actors:
            actor.close()


if __name__ == "__main__":
    main()
