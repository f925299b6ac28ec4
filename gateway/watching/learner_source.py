"""The learner of one run as the page of a gateway reads it."""

from collections.abc import Callable

from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS, METRICS_LIMITS
from daedalus.protocol.messages import (
    Acknowledgement,
    EventsPage,
    MetricsReport,
    MetricsRequest,
    Order,
    OrderRequest,
    Refusal,
    RunStatus,
)
from daedalus.transport.interface import Transport
from daedalus.transport.status_query import ask, ask_events, decoded, newest_of_each_run

_ANSWER_SECONDS = 5.0


class LearnerSource:
    """A RunSource over a transport (gateway/watching/page_data.py)."""

    def __init__(self, transport: Transport, run: str = keys.ANY_RUN, chosen: Callable[[], str] = lambda: "") -> None:
        """Construct the source.

        Args:
          transport: the network.
          run: name of the run, or `*`.
          chosen: returns the run to prefer if several learners answer; empty if there is no preference.
        """
        self._transport, self._run, self._chosen = transport, run, chosen

    def status(self, max_actors: int) -> RunStatus | None:
        """See RunSource."""
        statuses = newest_of_each_run(ask(self._transport, self._run, max_actors=max_actors))
        chosen = self._chosen()
        return min(statuses, key=lambda status: (status.run != chosen, status.run), default=None)

    def events(self, status: RunStatus) -> EventsPage | None:
        """See RunSource."""
        return ask_events(self._transport, status)

    def metrics(self, status: RunStatus, first: int) -> MetricsReport | None:
        """See RunSource."""
        request = encode(MetricsRequest(first=first))
        answers = self._transport.query(keys.status(status.run), request, timeout=_ANSWER_SECONDS)
        for report in decoded(answers, MetricsReport, METRICS_LIMITS):
            if report.page.learner_epoch == status.learner_epoch:
                return report
        return None

    def order(self, status: RunStatus, order: Order) -> tuple[bool, str]:
        """See RunSource."""
        request = encode(OrderRequest(order=order))
        answers = self._transport.query(keys.orders(status.run), request, timeout=_ANSWER_SECONDS)
        for accepted in decoded(answers, Acknowledgement, ACKNOWLEDGEMENT_LIMITS):
            return True, accepted.reason
        for refusal in decoded(answers, Refusal, ACKNOWLEDGEMENT_LIMITS):
            return False, refusal.reason
        return False, "the learner does not answer: try again later"
