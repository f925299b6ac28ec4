"""Received sequence numbers of one incarnation of an actor. State; no I/O, no threads."""

from dataclasses import dataclass, field

_REORDERING = 1024  # largest distance of sequence numbers that arrive out of order


@dataclass(slots=True)
class SequenceWindow:
    """Received sequence numbers of one incarnation. Each number is accepted at most once; gaps are counted."""

    low: int = 0  # all numbers below were received or given up
    gaps: int = 0  # numbers that were given up
    _above: set[int] = field(default_factory=set)  # received numbers that are at least `low`

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.low or sequence in self._above

    def add(self, sequence: int) -> None:
        """Mark a sequence number as received."""
        self._above.add(sequence)
        if sequence - self.low >= _REORDERING:
            low = sequence - _REORDERING + 1
            passed = {taken for taken in self._above if taken < low}
            self.gaps += low - self.low - len(passed)
            self._above -= passed
            self.low = low
        while self.low in self._above:
            self._above.remove(self.low)
            self.low += 1

    def give_up(self) -> None:
        """Give up all numbers below the highest received one."""
        end = max(self._above, default=self.low - 1) + 1
        self.gaps += end - self.low - len(self._above)
        self.low = end
        self._above.clear()
