"""The learner of one run as the page of a gateway reads it."""

from collections.abc import Callable

from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import METRICS_LIMITS
from daedalus.protocol.messages import EventsPage, MetricsReport, MetricsRequest, Order, RunStatus
from daedalus.transport.interface import Transport
from daedalus.transport.operator_orders import UNNAMED, Operator, OrderError
from daedalus.transport.status_query import ask, ask_events, decoded, newest_of_each_run

_ANSWER_SECONDS = 5.0


class LearnerSource:
    """A RunSource over a transport (gateway/watching/page_data.py)."""

    def __init__(
        self,
        transport: Transport,
        run: str = keys.ANY_RUN,
        chosen: Callable[[], str] = lambda: "",
        operator: Operator = UNNAMED,
    ) -> None:
        """Construct the source.

        Args:
          transport: the network.
          run: name of the run, or `*`.
          chosen: returns the run to prefer if several learners answer; empty if there is no preference.
          operator: gives the orders.
        """
        self._transport, self._run, self._chosen, self._operator = transport, run, chosen, operator

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

    def order(self, status: RunStatus, order: Order, token: str) -> tuple[bool, str]:
        """See RunSource."""
        try:
            return True, self._operator.with_token(token).give(self._transport, status, order)
        except OrderError as error:
            return False, str(error)
