"""Orders of an operator: who gives them, to the learner of a run or to an actor that waits for a run."""

import secrets
import socket
from dataclasses import dataclass, replace
from typing import Self

from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS
from daedalus.protocol.messages import Acknowledgement, Order, OrderRequest, Refusal, RunStatus
from daedalus.protocol.releases import own_release
from daedalus.protocol.texts import MAX_ANSWER_TEXT, MAX_NAME, bounded_text
from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import Transport
from daedalus.transport.status_query import decoded

_ANSWER_SECONDS = 5.0


class OrderError(Exception):
    """An order was refused, or nobody answers it; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Operator:
    """An operator who gives orders over one transport."""

    name: str = keys.NO_OPERATOR  # in the certificate
    host: str = ""
    token: str = ""  # whose token the page of a gateway sent

    @classmethod
    def here(cls, credentials: Credentials | None) -> Self:
        """Return the operator of this process, which connects with these credentials."""
        named = credentials is not None and credentials.role == "operator"
        host = bounded_text(socket.gethostname(), MAX_NAME)
        return cls(name=credentials.name if credentials and named else keys.NO_OPERATOR, host=host)

    def with_token(self, token: str) -> Self:
        """Return the operator who gives an order on a page, with a token of this owner."""
        return replace(self, token=token)

    def give(self, transport: Transport, status: RunStatus, order: Order, actor: str = "") -> str:
        """Give an order to the learner with this status, and return what came of it. `drain` names an actor.

        Raises OrderError, TransportError or ProtocolError.
        """
        message = self._order(order, run=status.run, learner_epoch=status.learner_epoch, actor=actor)
        key = keys.orders(status.run, self.name)
        answers = transport.query(key, encode(message), timeout=_ANSWER_SECONDS)
        messages = decoded(answers, (Acknowledgement, Refusal), ACKNOWLEDGEMENT_LIMITS)
        for answer in messages:
            if isinstance(answer, Acknowledgement):
                return bounded_text(answer.reason, MAX_ANSWER_TEXT)
        for answer in messages:
            raise OrderError(bounded_text(answer.reason, MAX_ANSWER_TEXT))
        rights = "" if self.name == keys.NO_OPERATOR else ", or the router does not let this certificate order it"
        release = "" if status.software == own_release() else f", or another release than {own_release()}: use its own"
        raise OrderError(
            f"the learner of run {status.run!r} does not answer the order: it is busy or gone{rights}{release}"
        )

    def drain_waiting(self, transport: Transport, actor: str, incarnation: int) -> None:
        """Ask an actor that waits for a run to leave. Without an answer: its presence ends. Raises TransportError."""
        message = self._order("drain", run=keys.NO_RUN, actor=actor, incarnation=incarnation)
        transport.publish(keys.orders(keys.NO_RUN, self.name), encode(message))

    def _order(
        self, order: Order, *, run: str, actor: str, learner_epoch: int = 0, incarnation: int = 0
    ) -> OrderRequest:
        return OrderRequest(
            order=order,
            run=run,
            learner_epoch=learner_epoch,
            number=secrets.randbits(62),
            actor=actor,
            incarnation=incarnation,
            host=self.host,
            token=self.token,
        )


UNNAMED = Operator()
