"""Orders to the learner's thread, of operators and of a newer learner. State; other threads give them."""

import threading

from daedalus.protocol.orders import Order


class Orders:
    """The orders that were not carried out yet."""

    def __init__(self, stop: threading.Event) -> None:
        """`stop` ends the run."""
        self._stop, self._save = stop, threading.Event()
        self.stopped = False  # whether an operator stopped the run
        self.superseded_by: int | None = None  # epoch of a newer learner of the run, for which this one steps down

    def give(self, order: Order) -> None:
        """Note an order."""
        if order == "checkpoint":
            self._save.set()
        else:
            self.stopped = True
            self._stop.set()

    def step_down(self, newer: int) -> None:
        """Stop the run here: a learner of it with a newer epoch answers."""
        self.superseded_by = newer
        self._stop.set()

    def take_checkpoint(self) -> bool:
        """Return whether a checkpoint was ordered since the last call."""
        ordered = self._save.is_set()
        self._save.clear()
        return ordered
