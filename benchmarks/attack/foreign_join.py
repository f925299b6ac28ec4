"""Attack: the first actor that joins reports spaces that the environment of the run does not have.

    python -m benchmarks.attack.foreign_join

It must be refused, and the honest actor that comes later must train.
"""

import sys
from contextlib import closing

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, scene
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import Join, Refusal
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.transport.zenoh_transport import connect

_FOREIGN = tuple(
    Spaces(
        observations={"observation": ArraySpace(shape=shape, dtype="float32")},
        actions={"action": DiscreteSpace(counts=(choices,))},
    )
    for shape, choices in (((5,), 2), ((4,), 65_536), ((2048, 4096), 2))
)
_TIMEOUT = 30.0


def foreign_join() -> Verdict:
    """Join with each of the spaces, then let an honest actor join; return whether only that one took part."""
    with scene() as here:
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
        here.wait("a learner that serves", here.status)
        with closing(connect([here.address])) as stranger:
            refused = 0
            for spaces in _FOREIGN:
                join = encode(Join(actor="stranger", incarnation=1, spaces=spaces, environments=1))
                answers: list[bytes] = []
                while not answers:  # the learner may serve its status before it serves joins
                    answers = list(stranger.query(keys.join("run", "stranger"), join, timeout=_TIMEOUT))
                refused += sum(isinstance(decode(answer, LEARNER_LIMITS), Refusal) for answer in answers)
            here.start("actor", "--connect", here.address, "--name", "honest")
            here.wait_for_training("honest")
    return Verdict(
        refused == len(_FOREIGN),
        f"{refused} of {len(_FOREIGN)} joins with other spaces refused; the honest actor trains",
    )


if __name__ == "__main__":
    verdict = foreign_join()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
