"""A learner that knows the spaces of its run before the first actor joins."""

import io
import threading
from pathlib import Path

from building import SPACES, run_spec
from log_lines import LINES
from processes import LIMIT, until

from daedalus.learner.reporting.progress import Progress
from daedalus.learner.service import LearnerService, Outcome, Outputs
from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, Message, Program, Refusal, Welcome
from daedalus.protocol.spaces import ArraySpace
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


def test_a_foreign_join_that_comes_first_is_refused_and_leaves_no_trace(tmp_path: Path) -> None:
    network, stop = MemoryNetwork(), threading.Event()
    directory = tmp_path / "run"
    directory.mkdir()
    outcomes: list[Outcome] = []

    def learn() -> None:
        progress = Progress(io.StringIO(), 1)
        context = RunContext.begin(directory, run_spec(), stop, spaces=SPACES)
        service = LearnerService(context, MemoryTransport(network), Outputs(progress=progress))
        outcomes.append(service.run())

    def ask(key: str, payload: bytes = b"") -> Message:
        return decode(client.query(key, payload, timeout=LIMIT)[0], Limits(max_bytes=1 << 24))

    client = MemoryTransport(network)
    thread = threading.Thread(target=learn, daemon=True)
    thread.start()
    try:
        until(lambda: client.query(keys.program("run", "*"), timeout=1.0))
        # The policy is ready before an actor joins.
        until(lambda: isinstance(ask(keys.program("run", "*")), Program))
        foreign = SPACES.model_copy(update={"observations": {"observation": ArraySpace(shape=(5,), dtype="float32")}})
        refusal = ask(
            keys.join("run", "stranger"), encode(Join(actor="stranger", incarnation=1, spaces=foreign, environments=1))
        )
        assert isinstance(refusal, Refusal)
        assert refusal.code == "mismatch"
        assert str(foreign) in refusal.reason
        assert str(SPACES) in refusal.reason
        until(lambda: sum("waiting for the first actor: start one with" in line for line in LINES) == 1)
        honest = encode(Join(actor="honest", incarnation=1, environments=0))
        assert isinstance(ask(keys.join("run", "honest"), honest), Welcome)
        until(lambda: any("waiting for the first actor: honest makes its environments" in line for line in LINES))
        failed = encode(Join(actor="honest", incarnation=1, failure="no simulator"))
        assert isinstance(ask(keys.join("run", "honest"), failed), Refusal)
        until(lambda: sum("waiting for the first actor: start one with" in line for line in LINES) == 2)
    finally:
        stop.set()
        thread.join(LIMIT)
    assert outcomes
    assert not outcomes[0].finished
    assert not list(directory.iterdir())  # nobody has joined: nothing was trained
