"""Overload of the learner, a stopped subscriber, and damaged messages."""

import os
import random
import signal
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from faults import Sender

from benchmarks.chaos.scene import ENDLESS, FailedError, Scene, resident_mib, say, scene
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import Limits

_QUEUE_MIB = 16
# Slow updates, so that one machine can send ten times more rollouts than the learner can train on.
_SLOW = (
    "--algorithm=appo",
    "--set=policy.hidden=[256,256]",
    "--set=training.passes=8",
    f"--set=service.queue_megabytes={_QUEUE_MIB}",
)
_ENVIRONMENTS = 128


class _Flood:
    """Sender of rollouts at a constant rate, which ignores the answers unless it is windowed."""

    def __init__(self, address: str, name: str, rate: float, windowed: bool) -> None:
        self._sender = Sender(address, name, _ENVIRONMENTS)
        self.name = name
        self._rate, self._windowed = rate, windowed
        self.sent, self.version, self.answers = 0, self._sender.version(), Counter[str]()
        self._lock = threading.Lock()
        self._room = threading.Semaphore(4)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        payload, due = b"", time.monotonic()
        while not self._stop.is_set():
            if self._windowed and not self._room.acquire(timeout=0.1):
                continue
            payload = self._sender.rollout(self.sent, self.version)
            self._sender.transport.query_async(self._sender.key, payload, timeout=60.0, on_answer=self._on_answer)
            self.sent += 1
            due += 1.0 / self._rate
            self._stop.wait(max(due - time.monotonic(), 0.0))

    def _on_answer(self, answer: bytes | None) -> None:
        message = None if answer is None else decode(answer, Limits())
        with self._lock:
            self.answers[getattr(message, "verdict", "none")] += 1
            self.version = max(self.version, getattr(message, "policy_version", 0))
        if self._windowed:
            self._room.release()

    def stop(self) -> None:
        """Stop sending and wait for all answers."""
        self._stop.set()
        self._thread.join()
        deadline = time.monotonic() + 60.0
        while self.answers.total() < self.sent and time.monotonic() < deadline:
            time.sleep(0.05)
        self._sender.close()


def overload(measured_seconds: float) -> list[tuple[str, str]]:
    """Send ten times the rollouts that the learner can train on, from senders that ignore the answers."""
    with scene() as here:
        running = here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *_SLOW, *ENDLESS)
        here.wait("the learner", lambda: here.status() is not None)
        learner = running.process.pid
        calm = [_Flood(here.address, f"calm-{number}", 1000.0, windowed=True) for number in range(2)]
        here.wait_for_training("calm-0")
        time.sleep(5.0)
        unloaded, taken = _rates(here, measured_seconds / 3)
        memory = resident_mib(learner)
        for flood in calm:
            flood.stop()
        rate = 10 * taken
        say(f"unloaded: {unloaded:.1f} updates/s from {taken:.1f} rollouts/s; now {rate:.0f} are sent each second")
        wild = [_Flood(here.address, f"wild-{number}", rate / 4, windowed=False) for number in range(4)]
        peak = _PeakMemory(learner)
        time.sleep(5.0)
        sent = sum(flood.sent for flood in wild)
        loaded, _ = _rates(here, measured_seconds)
        sent = (sum(flood.sent for flood in wild) - sent) / measured_seconds
        for flood in wild:
            flood.stop()
        grown = peak.stop() - memory
        answers = sum((flood.answers for flood in wild), Counter[str]())
        total = sum(flood.sent for flood in wild)
        status = here.status()
        assert status is not None
        flooding = [each for each in status.actors if each.actor.startswith("wild")]
        accepted, busy = sum(each.rollouts_accepted for each in flooding), sum(each.busy_answers for each in flooding)
    kept = answers["accepted"] + answers["busy"] + answers["rejected"] == total
    if not kept or (answers["accepted"], answers["busy"]) != (accepted, busy):
        raise FailedError(f"{total} sent; answers {dict(answers)}; the learner counts {accepted} and {busy}")
    return [
        ("overload", f"{sent / taken:.1f} times the rate of the learner, for {measured_seconds:g} s, answers ignored"),
        ("updates per second, of the unloaded rate", f"{loaded:.1f} of {unloaded:.1f}: {loaded / unloaded:.0%}"),
        (f"memory beyond the unloaded learner's (queue {_QUEUE_MIB} MiB)", f"{grown:.0f} MiB"),
        (
            "rollouts sent = accepted + busy + stale",
            f"{total:,} = {answers['accepted']:,} + {answers['busy']:,} + {answers['rejected']:,}; "
            "the learner counts the same",
        ),
    ]


def _rates(here: Scene, measured_seconds: float) -> tuple[float, float]:
    """Measure updates and rollouts per second."""
    before, began = here.status(), time.monotonic()
    time.sleep(measured_seconds)
    after, ended = here.status(), time.monotonic()
    assert before is not None
    assert after is not None
    rollouts = sum(each.env_steps for each in after.actors) - sum(each.env_steps for each in before.actors)
    per_rollout = _ENVIRONMENTS * 32
    return (after.updates - before.updates) / (ended - began), rollouts / per_rollout / (ended - began)


class _PeakMemory:
    """Maximum resident memory of a process while this object measures."""

    def __init__(self, pid: int) -> None:
        self._pid, self._peak, self._stop = pid, 0.0, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._stop.wait(0.1):
            self._peak = max(self._peak, resident_mib(self._pid))

    def stop(self) -> float:
        self._stop.set()
        self._thread.join()
        return self._peak


def slow_subscriber(measured_seconds: float) -> list[tuple[str, str]]:
    """Stop one of three actors: the others must receive snapshots as before."""
    with scene() as here:
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *_SLOW[1:2], *ENDLESS)
        actors = {name: here.start("actor", "--connect", here.address, "--name", name) for name in ("a", "b", "c")}
        for name in actors:
            here.wait_for_training(name)
        time.sleep(3.0)
        before = _lag(here, measured_seconds)
        actors["c"].process.send_signal(signal.SIGSTOP)
        try:
            after = _lag(here, measured_seconds)
        finally:
            actors["c"].process.send_signal(signal.SIGCONT)
    return [
        (
            "policy lag of two actors, and snapshots per second",
            f"with the third playing {before[0]:.1f} and {before[1]:.0f}, "
            f"with it stopped {after[0]:.1f} and {after[1]:.0f}",
        )
    ]


def _lag(here: Scene, measured_seconds: float) -> tuple[float, float]:
    lags, before = [], here.status()
    ended = time.monotonic() + measured_seconds
    while time.monotonic() < ended:
        lags += [actor.policy_lag for name in ("a", "b") if (actor := here.actor(name)) is not None]
        time.sleep(0.1)
    after = here.status()
    assert before is not None
    assert after is not None
    return sum(lags) / len(lags), (after.updates - before.updates) / measured_seconds


def fuzz(count: int) -> list[tuple[str, str]]:
    """Decode randomly damaged messages of every kind."""
    began = time.monotonic()
    workers = os.cpu_count() or 1
    outcomes, grown = Counter[str](), []
    with ProcessPoolExecutor(workers) as pool:
        for found, growth in pool.map(_mutate, [count // workers] * workers, range(workers)):
            outcomes.update(found)
            grown.append(growth)
    taken = time.monotonic() - began
    unexpected = {name: number for name, number in outcomes.items() if name not in ("decoded", "refused")}
    if unexpected:
        raise FailedError(f"unexpected exceptions: {unexpected}")
    return [
        (
            "mutated messages through the decoder",
            f"{outcomes.total():,} in {taken:.0f} s: {outcomes['refused']:,} refused, {outcomes['decoded']:,} decoded "
            f"(still valid), 0 other exceptions; memory grew by {max(grown):.1f} MiB at most",
        )
    ]


def _mutate(count: int, seed: int) -> tuple[Counter[str], float]:
    golden = Path(__file__).parents[2] / "tests" / "protocol" / "golden"
    newest = max(golden.iterdir(), key=lambda folder: int(folder.name[1:]))
    messages = [path.read_bytes() for path in sorted(newest.glob("*.bin"))]
    choose, outcomes, limits = random.Random(seed), Counter[str](), Limits(max_bytes=1 << 20)
    settled = 0.0
    for number in range(count):
        try:
            decode(_mutated(choose.choice(messages), messages, choose), limits)
            outcomes["decoded"] += 1
        except ProtocolError:
            outcomes["refused"] += 1
        except Exception as error:
            outcomes[f"{type(error).__name__}: {error}"[:200]] += 1
        if number == count // 10:
            settled = resident_mib(os.getpid())
    return outcomes, resident_mib(os.getpid()) - settled


def _mutated(message: bytes, others: list[bytes], choose: random.Random) -> bytes:
    data = bytearray(message)
    for _ in range(choose.choice([1, 1, 1, 2, 4, 16])):
        place = choose.randrange(len(data)) if data else 0
        # Most fields are in the header, which comes first.
        if choose.random() < 0.5 and len(data) > 12:
            place = choose.randrange(min(len(data), 200))
        kind = choose.randrange(7)
        if kind == 0 and data:
            data[place] ^= 1 << choose.randrange(8)
        elif kind == 1 and data:
            data[place] = choose.choice([0, 1, 0x7F, 0x80, 0x90, 0xC0, 0xC1, 0xD9, 0xDD, 0xDF, 0xFF])
        elif kind == 2:
            data[place:place] = choose.randbytes(choose.randrange(1, 9))
        elif kind == 3:
            del data[place : place + choose.randrange(1, 9)]
        elif kind == 4:
            del data[place:]
        elif kind == 5:
            other = choose.choice(others)
            start = choose.randrange(len(other))
            data[place : place + 16] = other[start : start + 16]
        elif len(data) >= 12:
            data[8:12] = choose.choice([0, 1, 11, len(data), 2**31, 2**32 - 1]).to_bytes(4, "little")
    return bytes(data)
