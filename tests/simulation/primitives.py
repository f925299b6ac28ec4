"""The parts of `threading`, `time` and `queue` that the services use, on a kernel."""

import queue as real_queue
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace, TracebackType
from typing import Any

from .kernel import Kernel, Killed, Task


class Lock:
    """threading.Lock, or threading.RLock if `reentrant`."""

    def __init__(self, kernel: Kernel, *, reentrant: bool = False) -> None:
        self._kernel, self._reentrant = kernel, reentrant
        self._owner: Task | None = None
        self._depth = 0
        self._waiters: deque[Task] = deque()

    def acquire(self) -> bool:
        kernel = self._kernel
        task = kernel.current
        if task.killed:
            raise Killed
        if self._owner is task and self._reentrant:
            self._depth += 1
            return True
        if kernel.preemption and kernel.chance() < kernel.preemption:
            kernel.preempt()
        while self._owner is not None:
            self._waiters.append(task)
            kernel.park(None)
        self._owner, self._depth = task, 1
        if task.process is not None:
            task.process.locks_held += 1
        return True

    __enter__ = acquire  # faster than a method that calls it

    def release(self) -> None:
        task = self._kernel.current
        if task.killed:
            return
        assert self._owner is task, "a lock is released by a thread that does not hold it"
        self._depth -= 1
        if self._depth == 0:
            self._free(task)

    def _free(self, task: Task) -> None:
        self._owner = None
        if task.process is not None:
            task.process.locks_held -= 1
        while self._waiters:
            waiter = self._waiters.popleft()
            if waiter.process is None or waiter.process.alive:
                self._kernel.wake(waiter)
                break

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


class Condition(Lock):
    """threading.Condition with a lock of its own."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(kernel, reentrant=True)
        self._sleepers: list[Task] = []

    def wait(self, timeout: float | None = None) -> bool:
        task, depth = self._kernel.current, self._depth
        assert self._owner is task, "a condition is waited for without its lock"
        self._sleepers.append(task)
        self._depth = 0
        self._free(task)
        woken = self._kernel.park(timeout)
        if not woken and task in self._sleepers:
            self._sleepers.remove(task)
        self.acquire()
        self._depth = depth
        return woken

    def wait_for(self, predicate: Callable[[], Any], timeout: float | None = None) -> Any:
        end = None if timeout is None else self._kernel.now + timeout
        while not (result := predicate()):
            left = None if end is None else end - self._kernel.now
            if left is not None and left <= 0.0:
                break
            self.wait(left)
        return result

    def notify_all(self) -> None:
        sleepers, self._sleepers = self._sleepers, []
        for sleeper in sleepers:
            self._kernel.wake(sleeper)

    def notify(self, count: int = 1) -> None:
        for sleeper in self._sleepers[:count]:
            self._kernel.wake(sleeper)
        del self._sleepers[:count]


class Event:
    """threading.Event."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._set = False
        self._waiters: list[Task] = []

    def is_set(self) -> bool:
        if self._kernel.current.killed:
            raise Killed
        return self._set

    def set(self) -> None:
        self._set = True
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            self._kernel.wake(waiter)

    def clear(self) -> None:
        self._set = False

    def wait(self, timeout: float | None = None) -> bool:
        if not self._set:
            self._waiters.append(self._kernel.current)
            self._kernel.park(timeout)
            if not self._set and self._kernel.current in self._waiters:
                self._waiters.remove(self._kernel.current)
        return self._set


class Thread:
    """threading.Thread, in the process of the thread that starts it."""

    def __init__(self, kernel: Kernel, *, target: Callable[[], Any], name: str = "", daemon: bool = False) -> None:
        self._kernel, self._target, self.name, self.daemon = kernel, target, name, daemon
        self._task: Task | None = None

    def start(self) -> None:
        process = self._kernel.current.process
        assert process is not None, "a simulated thread is started outside of all processes"
        self._task = self._kernel.spawn(process, self.name, self._target)

    def is_alive(self) -> bool:
        return self._task is not None and not self._task.done

    def join(self, timeout: float | None = None) -> None:
        assert self._task is not None
        if not self._task.done:
            self._task.joiners.append(self._kernel.current)
            self._kernel.park(timeout)


class SimpleQueue:
    """queue.SimpleQueue."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._items: deque[Any] = deque()
        self._waiters: deque[Task] = deque()

    def put(self, item: Any) -> None:
        self._items.append(item)
        if self._waiters:
            self._kernel.wake(self._waiters.popleft())
        self._kernel.perhaps_preempt()

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        end = None if timeout is None else self._kernel.now + timeout
        while not self._items:
            left = None if end is None else end - self._kernel.now
            if not block or (left is not None and left <= 0.0):
                raise real_queue.Empty
            self._waiters.append(self._kernel.current)
            if not self._kernel.park(left) and self._kernel.current in self._waiters:
                self._waiters.remove(self._kernel.current)
        return self._items.popleft()

    def get_nowait(self) -> Any:
        return self.get(block=False)

    def empty(self) -> bool:
        return not self._items

    def qsize(self) -> int:
        return len(self._items)


def modules(kernel: Kernel) -> dict[str, SimpleNamespace]:
    """Return replacements of the modules, by name. A part that is missing here raises AttributeError in its user."""

    def monotonic() -> float:
        return 1000.0 + kernel.now

    return {
        "threading": SimpleNamespace(
            Lock=lambda: Lock(kernel),
            RLock=lambda: Lock(kernel, reentrant=True),
            Condition=lambda: Condition(kernel),
            Event=lambda: Event(kernel),
            Thread=lambda **arguments: Thread(kernel, **arguments),
        ),
        "time": SimpleNamespace(monotonic=monotonic, perf_counter=monotonic, time=monotonic, sleep=kernel.sleep),
        "queue": SimpleNamespace(SimpleQueue=lambda: SimpleQueue(kernel), Empty=real_queue.Empty),
    }
