"""Drives a conversation on the caller's thread, which waits, and on the transport's threads, which bring events."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, cast

from daedalus.actor.errors import ActorError
from daedalus.actor.session.conversation import (
    Ask,
    AtOnce,
    Conversation,
    DeclarePresence,
    Query,
    Reopen,
    RunOverError,
    Steps,
    Subscribe,
    Unsubscribe,
    Wait,
    WatchPresence,
    WithdrawPresence,
    Work,
)
from daedalus.transport.interface import Declaration, Inbox, QuerySender, RefusedError, Transport, TransportError
from daedalus.transport.slow_calls import SlowCall

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.2  # how soon a wait notices `stop`

Result = TypeVar("Result")


class SessionThread:
    """One conversation over one transport.

    A lock makes each step and each event of the conversation one after the other. It is not held while an action is
    performed: decoding megabytes does not keep the transport's threads waiting.
    """

    def __init__(self, conversation: Conversation, transport: Transport, stop: threading.Event) -> None:
        """`stop` ends every wait, with RunOverError. The caller closes the transport."""
        self._conversation, self._transport, self._stop = conversation, transport, stop
        self._changed = threading.Condition()
        self._events = 0  # how many have come: one that comes between a step and its wait ends the wait at once
        self._seen_events = 0  # before the last step
        self._inboxes: dict[str, Inbox] = {}  # by key
        self._logged = ""  # why no other session could be opened
        self._watched: set[str] = set()  # keys of presence
        self._declared: dict[str, Declaration] = {}  # likewise

    def run(
        self, steps: Steps[Result], perform: Callable[[Any], Any] = lambda _: None, *, to_the_end: bool = False
    ) -> Result:
        """Perform the actions of a part of the conversation, and return its result.

        Args:
          steps: the part.
          perform: performs the actions that are not of every conversation, and returns what came of each.
          to_the_end: whether to go on after `stop`.

        Raises what `steps` and `perform` raise, RunOverError after `stop`, and TransportError.
        """
        came: Any = None
        events = self._events
        while True:
            if not to_the_end:
                self._check_stop()
            try:
                action = self._step(partial(steps.send, came))
            except StopIteration as end:
                return cast(Result, end.value)
            if isinstance(action, Wait):
                came, events = None, self._wait(action.until, events)
            else:
                came = self._perform(action, perform)

    def call(self, step: Callable[[], None]) -> None:
        """Make one step of the conversation that takes no time, on the thread of `run`. Raises as `run` does."""
        self._check_stop()
        self._step(step)

    def call_after_events(self, step: Callable[[], None]) -> None:
        """Call a step if an event has come since the last one; raises as `run` does. This is fast: for every row."""
        self._check_stop()
        if self._events != self._seen_events:
            self._step(step)

    def notify(self, event: Callable[..., None], *arguments: Any) -> None:
        """Let an event come to the conversation. From any thread."""
        with self._changed:
            self._conversation.now = time.monotonic()
            event(*arguments)
            self._events += 1
            self._changed.notify_all()
            actions = self._conversation.take_actions()
        self._act(actions)

    def send(self, query: Query, sender: QuerySender, *, wakes: bool = False) -> None:
        """Send a query of any conversation that shares the lock of this one; `wakes`: its answer ends a wait."""
        answered = partial(self.notify if wakes else self._note, query.on_answer)
        try:
            sender.query_async(
                query.key,
                query.payload,
                timeout=query.timeout,
                on_answer=lambda data: answered(data, time.monotonic()),
            )
        except TransportError:
            answered(None, time.monotonic())

    def _note(self, event: Callable[..., None], *arguments: Any) -> None:
        with self._changed:
            event(*arguments)

    def _check_stop(self) -> None:
        if self._stop.is_set():
            raise RunOverError("this process was stopped")

    def _step(self, step: Callable[[], Any]) -> Any:
        """Pass on the time and what was published, and make a step; return its action."""
        actions = list[AtOnce]()
        try:
            with self._changed:
                self._conversation.now, self._seen_events = time.monotonic(), self._events
                for key, inbox in self._inboxes.items():
                    data = inbox.take()
                    if data is not None:
                        self._conversation.received(key, data)
                try:
                    return step()
                finally:
                    actions = self._conversation.take_actions()
        finally:
            self._act(actions)

    def _wait(self, until: float | None, events: int) -> int:
        """Wait until a time or an event, or for a while; return how many events have come."""
        with self._changed:
            if self._events == events:
                left = _POLL_SECONDS if until is None else min(until - time.monotonic(), _POLL_SECONDS)
                self._changed.wait(max(left, 0.0))
            return self._events

    def _perform(self, action: Any, perform: Callable[[Any], Any]) -> Any:
        match action:
            case Work(call):
                return call()
            case Ask(key, payload, timeout):
                try:
                    return self._transport.query(key, payload, timeout=timeout)
                except TransportError:
                    return []
            case Reopen():
                return self._reopen()
            case _:
                return perform(action)

    def _reopen(self) -> None:
        """Open another session. Raises ActorError if the certificate is refused."""
        try:
            SlowCall(self._transport.reopen).wait(lambda: self.call(self._conversation.check_over))
        except RefusedError as error:  # it was revoked or has expired since the start
            raise ActorError(str(error)) from None
        except TransportError as error:  # no router now: the present session keeps trying
            if str(error) != self._logged:
                _logger.info("%s; waiting for it", error)
            self._logged = str(error)

    def _act(self, actions: list[AtOnce]) -> None:
        """Perform what is to be done at once. Without the lock."""
        for action in actions:
            self._perform_at_once(action)

    def _perform_at_once(self, action: AtOnce) -> None:
        match action:
            case Query():
                self.send(action, self._transport, wakes=True)
            case Subscribe(key):
                if key not in self._inboxes:
                    self._inboxes[key] = self._transport.subscribe(key, self._on_news)
            case Unsubscribe(key):
                if key in self._inboxes:
                    self._inboxes.pop(key).close()
            case WatchPresence(key):
                if key not in self._watched:
                    self._transport.watch_presence(key, self._on_presence)
                    self._watched.add(key)
            case DeclarePresence(key):
                if key not in self._declared:
                    self._declared[key] = self._transport.declare_presence(key)
            case WithdrawPresence(key):
                if key in self._declared:
                    self._declared.pop(key).close()

    def _on_news(self) -> None:
        self.notify(lambda: None)

    def _on_presence(self, _key: str, present: bool) -> None:
        self.notify(self._conversation.presence_changed, present)
