"""A clock for a loop with a fixed rate, which counts the deadlines that the loop missed."""

import math
import time
from collections.abc import Callable
from types import TracebackType


class Clock:
    """The ticks of a loop, a fixed time apart. Each tick is the deadline for the work of the one before.

        with client.clock(rate=20) as clock:
            while clock.wait():
                ...

    A loop that comes too late goes on at the next tick that is still to come. It never hurries to catch up: the ticks
    in between are counted as missed.
    """

    def __init__(
        self,
        rate: float,
        *,
        is_over: Callable[[], bool] = lambda: False,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Construct the clock; its first tick is the first `wait`.

        Args:
          rate: ticks a second, above 0.
          is_over: whether to end the loop; asked at each tick.
          now, sleep: replaced in tests.

        Raises ValueError if the rate is not above 0.
        """
        if not 0.0 < rate < math.inf:
            raise ValueError(f"the rate is {rate}: it must be above 0 ticks a second")
        self._period, self._is_over, self._now, self._sleep = 1.0 / rate, is_over, now, sleep
        self._began: float | None = None
        self.deadlines = 0  # that have passed
        self.missed_deadlines = 0

    def wait(self) -> bool:
        """Wait for the next tick; return False if the loop shall end."""
        if self._began is None:
            self._began = self._now()
            return not self._is_over()
        due = self._began + (self.deadlines + 1) * self._period
        missed = max(math.ceil((self._now() - due) / self._period), 0)
        due += missed * self._period
        while (early := due - self._now()) > 0.0:
            self._sleep(early)
        missed += math.floor((self._now() - due) / self._period)  # if the operating system woke the loop so late
        self.missed_deadlines += missed
        self.deadlines += 1 + missed
        return not self._is_over()

    def __enter__(self) -> "Clock":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the loop. There is nothing to release."""
