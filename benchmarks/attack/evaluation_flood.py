"""Attack: evaluators that request policies much faster than anybody can play them.

    python -m benchmarks.attack.evaluation_flood

The learner saves a checkpoint of a policy before it hands it out for an evaluation, on the thread that trains. The
attack sends requests under several names and compares the training rate with the rate before it.
"""

import sys
import threading
import time

import numpy as np

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import EvaluationRequest, Snapshot
from daedalus.transport.zenoh_transport import connect

_REQUESTS_PER_SECOND = 93
_NAMES = 8
_WINDOW_SECONDS, _WINDOWS = 3.0, 3
_LEAST_SHARE = 0.5  # of the training rate without the attack: the machine may be busy with other work
_MOST_POLICIES_PER_SECOND = 3.0 * _NAMES  # handed out, to all names together


def evaluation_flood() -> Verdict:
    """Flood a learner that trains with two actors, and return whether it trained on."""
    with scene() as here:
        here.start("train", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
        here.wait_for_training()
        quiet, flooded, policies = [], [], []
        for _ in range(_WINDOWS):  # alternately, because the speed of the machine changes
            quiet.append(_rate(here))
            with _Flood(here) as flood:
                flooded.append(_rate(here))
            policies.append(flood.policies / _WINDOW_SECONDS)
    share, handed_out = float(np.sum(flooded) / np.sum(quiet)), float(np.mean(policies))
    return Verdict(
        share >= _LEAST_SHARE and handed_out <= _MOST_POLICIES_PER_SECOND,
        f"{np.mean(quiet):,.0f} env_steps/s without, {np.mean(flooded):,.0f} with {_REQUESTS_PER_SECOND} requests/s "
        f"({share:.0%}); {handed_out:.1f} policies/s handed out to {_NAMES} names",
    )


def _rate(here: Scene) -> float:
    before, began = here.env_steps(), time.monotonic()
    time.sleep(_WINDOW_SECONDS)
    return (here.env_steps() - before) / (time.monotonic() - began)


class _Flood:
    """Requests at a fixed rate, from construction as a context to its end."""

    def __init__(self, here: Scene) -> None:
        self._transport = connect([here.address])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self.policies = 0  # received in answers

    def __enter__(self) -> "_Flood":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._transport.close()

    def _send(self) -> None:
        number = 0
        while not self._stop.wait(1.0 / _REQUESTS_PER_SECOND):
            name = f"flood-{number % _NAMES}"
            request = encode(EvaluationRequest(evaluator=name))
            self._transport.query_async(keys.evaluations("run", name), request, timeout=60.0, on_answer=self._count)
            number += 1

    def _count(self, answer: bytes | None) -> None:
        if answer is not None and isinstance(decode(answer, LEARNER_LIMITS), Snapshot):
            self.policies += 1


if __name__ == "__main__":
    verdict = evaluation_flood()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
