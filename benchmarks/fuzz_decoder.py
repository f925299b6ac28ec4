"""Fuzz the decoder, guided by coverage. Every exception that it finds is a bug.

    pip install -c constraints.txt ".[fuzz]"
    python -m benchmarks.fuzz_decoder CORPUS tests/protocol/fuzz_corpus [-max_total_time=600] [-jobs=2] ...

CORPUS is a folder: it starts with the golden messages of tests/protocol and grows with each input that reaches new
code. The other options are those of libFuzzer. A decoded rollout is also checked against the specification of a run, as
in the learner. The weights of a decoded compact snapshot are also unpacked, as in an actor.
"""

import contextlib
import importlib
import shutil
import sys
from pathlib import Path
from typing import Any

atheris: Any = importlib.import_module("atheris")  # from the extra `fuzz`; its names exist only at run time

with atheris.instrument_imports(include=["daedalus", "msgpack"]):
    from daedalus.learner.serving.fleet import Fleet
    from daedalus.learner.serving.rollout_judge import RolloutJudge
    from daedalus.protocol.codec import PROTOCOL_VERSION, ProtocolError, decode
    from daedalus.protocol.compact import bits_of
    from daedalus.protocol.limits import Limits
    from daedalus.protocol.messages import CompactSnapshot, Join
    from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
    from daedalus.protocol.spec import RunSpec

_GOLDEN = Path(__file__).parents[1] / "tests" / "protocol" / "golden"
_LIMITS = Limits(max_bytes=1 << 20)


def _judge() -> RolloutJudge:
    """Return a judge that accepts the golden rollout of arrays."""
    spec = RunSpec.model_validate(
        {"environment": {"id": "CartPole-v1"}, "collection": {"rollout_length": 3, "envs_per_actor": 2}}
    )
    spaces = Spaces(
        observations={"observation": ArraySpace(shape=(4,), dtype="float32")},
        actions={"action": DiscreteSpace(counts=(6,))},
    )
    fleet = Fleet(1, spaces)
    fleet.join(Join(actor="wing-1", incarnation=2**61 + 1, spaces=spaces, environments=2), 0.0)
    judge = RolloutJudge(spec, 2**60 + 3, fleet)
    judge.state_size = 2
    return judge


_JUDGE = _judge()


def one_input(data: bytes) -> None:
    """Decode one input of libFuzzer, as of this version: the kept inputs stay useful when the version changes."""
    data = data[:4] + PROTOCOL_VERSION.to_bytes(2, "little") + data[6:]
    try:
        message = decode(data, _LIMITS)
    except ProtocolError:
        return
    if isinstance(message, CompactSnapshot):
        with contextlib.suppress(ValueError):
            bits_of(message.weights, None)
    _JUDGE.decide("wing-1", _JUDGE.read("wing-1", data), 81, 0.0)


if __name__ == "__main__":
    corpus = [argument for argument in sys.argv[1:] if not argument.startswith("-")]
    if not corpus:
        raise SystemExit(__doc__)
    Path(corpus[0]).mkdir(parents=True, exist_ok=True)
    newest = max(_GOLDEN.iterdir(), key=lambda folder: int(folder.name[1:]))
    for message in newest.glob("*.bin"):
        shutil.copy(message, Path(corpus[0]) / message.name)
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
