"""A simulated process, and the deliveries of the network to its callbacks."""

from collections import deque
from collections.abc import Callable
from typing import Any

from .kernel import Kernel, Task


class Process:
    """A simulated process: threads that are frozen and killed together."""

    def __init__(self, kernel: Kernel, name: str, *, has_threads: bool = True) -> None:
        """Construct the process. One without threads only reacts to deliveries."""
        self.has_threads = has_threads
        self.kernel, self.name = kernel, name
        self.alive, self.frozen = True, False
        self.locks_held = 0  # by threads of this process that do not run now
        self.callbacks = Task(self, "callback", None)  # the thread of callbacks that do not wait
        self._ready: list[Task] = []  # threads that became ready while the process was frozen
        self._deliveries: list[tuple[Channel, Callable[..., None], tuple[Any, ...]]] = []

    def freeze(self) -> None:
        """Stop to run this process's threads, as SIGSTOP does."""
        self.frozen = True
        self._ready += self.kernel.withdraw(self)

    def thaw(self) -> None:
        """Run the threads again, and deliver what came in the meantime."""
        self.frozen = False
        ready, self._ready = self._ready, []
        deliveries, self._deliveries = self._deliveries, []
        for task in ready:
            self.kernel.enqueue(task)
        for channel, function, arguments in deliveries:
            channel.deliver(function, *arguments)

    def kill(self) -> None:
        """Never run this process's threads again, as SIGKILL does."""
        self.alive = False
        self.kernel.withdraw(self)

    def hold(self, task: Task) -> None:
        """Keep a thread that became ready while the process is frozen."""
        self._ready.append(task)

    def defer(self, channel: "Channel", function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        """Keep a delivery to the frozen process."""
        self._deliveries.append((channel, function, arguments))


class Channel:
    """Deliveries to one callback of a process: one after the other, as on a thread of its own.

    A callback that cannot meet a lock in use runs at once, without a thread: that is faster.
    """

    def __init__(self, process: Process, name: str) -> None:
        self._process, self._name = process, name
        self._waiting: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._busy = False

    def deliver(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call the function on a thread of the process. Call this method in an event."""
        process = self._process
        kernel = process.kernel
        if not process.alive:
            return
        if process.frozen:
            process.defer(self, function, arguments)
            return
        if process.has_threads and (
            self._busy or process.locks_held or kernel.fine_files or kernel.random.random() < 0.1
        ):
            self._waiting.append((function, arguments))
            if not self._busy:
                self._busy = True
                kernel.spawn(process, self._name, self._drain)
            return
        previous, kernel.current = kernel.current, process.callbacks
        try:
            function(*arguments)
        finally:
            kernel.current = previous

    def _drain(self) -> None:
        while self._waiting:
            function, arguments = self._waiting.popleft()
            function(*arguments)
        self._busy = False
