"""Attack: one connection joins under thousands of names, some of them of one owner, and is present under all of them.

    python -m benchmarks.attack.many_names

`daedalus status` must list them, and an honest actor must still join and train.
"""

import contextlib
import sys
import time

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, Refusal
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.transport.zenoh_transport import connect

_CARTPOLE = Spaces(observation=ArraySpace(shape=(4,), dtype="float32"), action=DiscreteSpace(count=2))
SLOW = True
_OWNERS, _OF_ONE_OWNER = 905, 400
_MOST_STATUS_SECONDS = 10.0  # with the start of the process, on a busy machine


def many_names() -> Verdict:
    """Join under the names, and return whether the status and training still work."""
    with scene() as here:
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
        here.start("actor", "--connect", here.address, "--name", "early")
        here.wait_for_training("early")
        with contextlib.closing(connect([here.address])) as stranger:
            names = [f"name-{number}" for number in range(_OWNERS)]
            names += [f"owner.{number}" for number in range(_OF_ONE_OWNER)]
            refused = 0
            for name in names:
                stranger.declare_presence(keys.presence("run", name, 1))
                join = encode(Join(actor=name, incarnation=1, spaces=_CARTPOLE, environments=1))
                (answer,) = stranger.query(keys.join("run", name), join, timeout=60.0)
                refused += isinstance(decode(answer, Limits()), Refusal)
            seconds, status, lines = _status(here)
            here.start("actor", "--connect", here.address, "--name", "late")
            here.wait_for_training("late", "early")
    joined = len(names) - refused
    return Verdict(
        status == 0 and lines > joined and refused == 0 and seconds < _MOST_STATUS_SECONDS,
        f"{joined:,} names joined; `daedalus status` listed {lines:,} lines in "
        f"{seconds:.1f} s with exit status {status}; an honest actor joined and trained",
    )


def _status(here: Scene) -> tuple[float, int, int]:
    """Run `daedalus status`; return the seconds that it took, its exit status, and how many lines it printed."""
    began = time.monotonic()
    running = here.start("status", "--connect", here.address)
    status = running.wait()
    return time.monotonic() - began, status, len(running.lines)


if __name__ == "__main__":
    verdict = many_names()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
