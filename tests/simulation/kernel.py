"""Virtual time, and threads that run one at a time in an order that a seed decides.

The code under test runs on real threads, but exactly one of them runs at any moment. A thread hands over control where
it waits: for a lock, a condition, an event, or time. The thread that hands over decides itself who is next. Time
advances only when no thread is ready.
"""

import _thread
import heapq
import sys
import threading
from collections.abc import Callable
from random import Random
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .process import Process

_MAX_STEPS = 400_000  # of one simulation; one that goes on is a livelock
_LINE_RARITY = 10.0  # a line is so much less often interrupted than a lock
_SLOW_SECONDS = 0.05  # longest time for which a preempted thread does not run


class Killed(BaseException):
    """Ends a thread whose process was killed; no `except Exception` catches it."""


class SimulationError(Exception):
    """The simulation cannot go on, for example because all threads wait for ever."""


class Task:
    """One thread of a process."""

    __slots__ = ("done", "joiners", "killed", "lock", "name", "parked", "process", "serial", "target", "woken")

    def __init__(self, process: "Process | None", name: str, target: Callable[[], Any] | None) -> None:
        self.process, self.name, self.target = process, name, target
        self.lock: _thread.LockType = None  # type: ignore[assignment] - of the worker that runs it
        self.parked = self.woken = self.done = self.killed = False
        self.serial = 0  # of its waits: a timeout of an earlier wait is ignored
        self.joiners: list[Task] = []

    @property
    def may_wait(self) -> bool:
        """Whether this is a thread that can hand over control."""
        return self.lock is not None


class _Worker:
    """A real thread, which runs one task after the other."""

    idle: list["_Worker"] = []  # noqa: RUF012 - shared by all simulations of this process: starting a thread is slow

    def __init__(self) -> None:
        self.lock = _thread.allocate_lock()
        self.lock.acquire()
        self.kernel: Kernel = None  # type: ignore[assignment] - set with the task
        self.task: Task = None  # type: ignore[assignment]
        threading.Thread(target=self._work, name="simulated", daemon=True).start()

    def _work(self) -> None:
        while True:
            self.lock.acquire()
            task, kernel = self.task, self.kernel
            try:
                if not task.killed:
                    assert task.target is not None
                    if kernel.fine_files:
                        sys.settrace(kernel.trace_call)
                    task.target()
            except Killed:
                pass
            except BaseException as error:
                kernel.fail(error)
            if kernel.fine_files:
                sys.settrace(None)
            self.task = self.kernel = None  # type: ignore[assignment]
            _Worker.idle.append(self)
            kernel.finish(task)


class Kernel:
    """Scheduler of one simulation. The thread that creates it is the driver: it is no thread of any process."""

    def __init__(self, random: Random, preemption: float, fine_files: frozenset[str] = frozenset()) -> None:
        """Construct the kernel.

        Args:
          random: decides everything that is left to chance.
          preemption: probability that a thread is interrupted where it meets a lock or the network.
          fine_files: source files in which a thread is interrupted at any line, with a tenth of that probability.
        """
        self.random, self.now, self.preemption = random, 0.0, preemption
        self.chance = random.random
        self.fine_files = fine_files
        self.failure: BaseException | None = None
        self._events: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._event_count = self._steps = 0
        self._ready: list[Task] = []
        self._tasks: list[Task] = []
        self._unwinding = False
        self._driver = Task(None, "driver", None)
        self._driver.lock = _thread.allocate_lock()
        self._driver.lock.acquire()
        self.current = self._driver
        self._no_thread = Task(None, "event", None)  # current while an event happens
        self.trace: list[tuple[float, str, tuple[Any, ...]]] = []

    def log(self, event: str, *facts: Any) -> None:
        """Add an event to the trace."""
        self.trace.append((self.now, event, facts))

    # ------------------------------------------------------------------------------------------------ events

    def after(self, seconds: float, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function after so much virtual time. The function must not wait."""
        self._event_count += 1
        heapq.heappush(self._events, (self.now + seconds, self._event_count, function, arguments))

    def sleep(self, seconds: float) -> None:
        """Let virtual time pass for the current thread."""
        self.park(seconds)

    # ----------------------------------------------------------------------------------------------- threads

    def spawn(self, process: "Process", name: str, target: Callable[[], Any]) -> Task:
        """Start a thread of a process."""
        task = Task(process, name, target)
        worker = _Worker.idle.pop() if _Worker.idle else _Worker()
        worker.task, worker.kernel, task.lock = task, self, worker.lock
        self._tasks.append(task)
        self.enqueue(task)
        return task

    def park(self, timeout: float | None) -> bool:
        """Wait until `wake`; return False if `timeout` seconds pass first."""
        task = self.current
        if not task.may_wait:
            raise SimulationError(f"a callback of the transport waits in {task.process.name if task.process else ''}")
        if task.killed:
            raise Killed
        task.serial += 1
        task.parked, task.woken = True, False
        if timeout is not None:
            self.after(max(timeout, 0.0), self._time_out, task, task.serial)
        self._switch(task)
        return task.woken

    def wake(self, task: Task) -> None:
        """End the wait of a thread, if it waits."""
        if task.parked:
            task.parked, task.woken = False, True
            self.enqueue(task)

    def perhaps_preempt(self, rarity: float = 1.0) -> None:
        """Let other threads run first, with the probability of a preemption."""
        if self.preemption and self.chance() < self.preemption / rarity:
            self.preempt()

    def preempt(self) -> None:
        """Let other threads run first, for no time or for a short one."""
        task = self.current
        if task.killed:
            raise Killed
        if task.lock is None or task.process is None:
            return
        if self.chance() < 0.2:
            self.park(self.chance() * _SLOW_SECONDS)
            return
        self.enqueue(task)
        self._switch(task)

    def trace_call(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        """Decide whether the lines of a function are traced. See sys.settrace."""
        return self._trace_line if frame.f_code.co_filename in self.fine_files else None

    def _trace_line(self, _frame: FrameType, event: str, _argument: Any) -> Any:
        if event == "line" and not self.current.killed:
            self.perhaps_preempt(_LINE_RARITY)
        return self._trace_line

    def enqueue(self, task: Task) -> None:
        """Make a thread ready to run."""
        process = task.process
        if process is None or not process.frozen:
            if process is None or process.alive:
                self._ready.append(task)
        else:
            process.hold(task)

    def withdraw(self, process: "Process") -> list[Task]:
        """Make the ready threads of a process not ready, and return them."""
        withdrawn = [task for task in self._ready if task.process is process]
        if withdrawn:
            self._ready = [task for task in self._ready if task.process is not process]
        return withdrawn

    def finish(self, task: Task) -> None:
        """Note the end of a thread, and run another one. Called on the worker of that thread."""
        task.done = True
        if self._unwinding:
            self._driver.lock.release()
            return
        for joiner in task.joiners:
            self.wake(joiner)
        following = self._next()
        self.current = following
        following.lock.release()

    def fail(self, error: BaseException) -> None:
        """End the simulation with an error; the first one counts."""
        if self.failure is None:
            self.failure = error

    def close(self) -> None:
        """End all threads. Call on the driver's thread, once."""
        self._unwinding = True
        for task in self._tasks:
            if not task.done:
                task.killed = True
                self.current = task
                task.lock.release()
                self._driver.lock.acquire()

    def _switch(self, task: Task) -> None:
        """Run another thread until it is this one's turn."""
        following = self._next()
        if following is not task:
            self.current = following
            following.lock.release()
            task.lock.acquire()
        if task.killed:
            raise Killed
        if self.failure is not None and task is self._driver:
            raise self.failure
        self.current = task

    def _next(self) -> Task:
        """Return the next thread to run; until there is one, let events happen."""
        events = self._events
        while self.failure is None:
            self._steps += 1
            if self._steps > _MAX_STEPS:
                self.fail(SimulationError(f"livelock: {_MAX_STEPS} steps in {self.now:.1f} virtual seconds"))
                break
            ready = self._ready
            if ready:
                index = int(self.random.random() * len(ready)) if len(ready) > 1 else 0
                ready[index], ready[-1] = ready[-1], ready[index]
                return ready.pop()
            if not events:
                self.fail(SimulationError("deadlock: every thread waits without a time limit"))
                break
            self.now, _, function, arguments = heapq.heappop(events)
            self.current = self._no_thread
            try:
                function(*arguments)
            except BaseException as error:
                self.fail(error)
        return self._driver

    def _time_out(self, task: Task, serial: int) -> None:
        if task.parked and task.serial == serial:
            task.parked = False
            self.enqueue(task)
