"""Actor that writes each rollout to a journal before it sends it: `python journal.py ADDRESS NAME FILE [WORD...]`.

With `twice` each rollout is sent two times at once, and the actor receives the answer to the first. With `rows` the
journal has a digest of each row to learn from. Any other word is a module that the environment may be imported from.
"""

import hashlib
import os
import secrets
import sys
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.launch.logs import configure_logging
from daedalus.launch.process_lifecycle import stop_on_signals
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.uploads import Rollout
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.interface import Transport

_WORDS = frozenset({"twice", "rows"})


def digests(observations: np.ndarray, actions: np.ndarray, rewards: np.ndarray, learned: np.ndarray) -> list[str]:
    """Return a digest of each row that is learned from, of arrays [T or T+1, E, ...] with one row after the other."""
    rows = np.argwhere(learned)
    parts = ((each[t, e].tobytes() for each in (observations, actions, rewards)) for t, e in rows)
    return [hashlib.blake2b(b"".join(part), digest_size=8).hexdigest() for part in parts]


class JournalTransport:
    """Transport that writes each rollout and its answer to a file before it continues."""

    def __init__(self, transport: Transport, path: str, *, twice: bool, rows: bool) -> None:
        self._transport, self._twice, self._rows = transport, twice, rows
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
        if self._rows:
            (observations,), (actions,) = rollout.frames.values(), rollout.actions.values()
            rows = " ".join(digests(observations, actions, rollout.rewards, rollout.learned))
            os.write(self._file, f"rows {name} {rows}\n".encode())

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
        words = set(sys.argv[4:])
        modules = UserModules(allowed=frozenset(words - _WORDS))
        config = ActorConfig(name=sys.argv[2], incarnation=secrets.randbits(62), modules=modules)
        writing = JournalTransport(transport, sys.argv[3], twice="twice" in words, rows="rows" in words)
        journal = cast(Transport, writing)
        ActorService(config, journal, stop).run()
    finally:
        transport.close()
