"""Actor that writes each rollout to a journal before it sends it: `python journal.py ADDRESS NAME FILE [twice]`.

With `twice` each rollout is sent two times at once, and the actor receives the answer to the first.
"""

import os
import secrets
import sys
from collections.abc import Callable
from typing import Any, cast

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.launch.logs import configure_logging
from daedalus.launch.process_lifecycle import stop_on_signals
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.uploads import Rollout
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.interface import Transport


class JournalTransport:
    """Transport that writes each rollout and its answer to a file before it continues."""

    def __init__(self, transport: Transport, path: str, *, twice: bool) -> None:
        self._transport, self._twice = transport, twice
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def query_async(
        self, key: str, payload: bytes, *, timeout: float, on_answer: Callable[[bytes | None], None]
    ) -> None:
        """See Transport."""
        rollout = decode(payload, Limits()) if payload else None
        if not isinstance(rollout, Rollout):
            self._transport.query_async(key, payload, timeout=timeout, on_answer=on_answer)
            return
        identity = rollout.identity
        name = f"{identity.learner_epoch}/{identity.incarnation}/{identity.sequence}"
        counts = () if rollout.matches is None else rollout.matches.counts
        matches = sum(each.wins + each.draws + each.losses for each in counts)
        os.write(self._file, f"sent {name} {matches}\n".encode())

        def note(answer: bytes | None) -> None:
            message = None if answer is None else decode(answer, Limits())
            if isinstance(message, Acknowledgement):
                os.write(self._file, f"answered {name} {message.verdict} {message.reason}\n".encode())

        def answered(answer: bytes | None) -> None:
            note(answer)
            on_answer(answer)

        self._transport.query_async(key, payload, timeout=timeout, on_answer=answered)
        if self._twice:
            self._transport.query_async(key, payload, timeout=timeout, on_answer=note)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


if __name__ == "__main__":
    configure_logging()
    stop = stop_on_signals()
    transport = connect_with_retry([sys.argv[1]], stop)
    if transport is None:
        raise SystemExit(0)
    try:
        config = ActorConfig(name=sys.argv[2], incarnation=secrets.randbits(62))
        journal = cast(Transport, JournalTransport(transport, sys.argv[3], twice="twice" in sys.argv[4:]))
        ActorService(config, journal, stop).run()
    finally:
        transport.close()
