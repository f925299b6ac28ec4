"""Runs the learner or an actor with its codec and transport timed; writes the CPU seconds as JSON when it ends.

    PROFILE=out.json python -P benchmarks/profiled.py actor --connect tcp/127.0.0.1:7447

Counted as codec: `encode` and `decode`. Counted as transport: what our own threads spend in calls to it, and
everything that threads which are not ours spend: Zenoh's own, and those on which it calls us back.
"""

import functools
import json
import os
import runpy
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daedalus.protocol import codec
from daedalus.transport import zenoh_transport

SPENT: dict[str, float] = defaultdict(float)
ACTIVE = threading.local()


def is_ours() -> bool:
    """Whether this thread was started by our own code, and not by Zenoh to call us back."""
    return not isinstance(threading.current_thread(), threading._DummyThread)


def timed(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, its CPU time on this thread added to `kind`; calls within such calls are not added twice."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        if getattr(ACTIVE, "inside", False) or not is_ours():
            return function(*args, **kwargs)
        ACTIVE.inside = True
        began = time.thread_time()
        try:
            return function(*args, **kwargs)
        finally:
            SPENT[kind] += time.thread_time() - began
            ACTIVE.inside = False

    return wrapper


def foreign_seconds() -> float:
    """CPU seconds of all threads of this process that are not ours."""
    ours = {thread.native_id for thread in threading.enumerate() if not isinstance(thread, threading._DummyThread)}
    ticks = 0
    for task in Path("/proc/self/task").iterdir():
        if int(task.name) not in ours:
            fields = (task / "stat").read_text().rsplit(")", 1)[1].split()
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def main() -> None:
    for name in ("encode", "decode"):
        setattr(codec, name, timed("codec", getattr(codec, name)))
    for owner, names in (
        (zenoh_transport.ZenohTransport, ("query_async", "publish", "query")),
        (zenoh_transport._ZenohRequest, ("reply",)),
        (zenoh_transport._ZenohInbox, ("take",)),
    ):
        for name in names:
            setattr(owner, name, timed("transport", getattr(owner, name)))
    close = zenoh_transport.ZenohTransport.close

    def close_and_report(self: zenoh_transport.ZenohTransport) -> None:
        # Before the session closes: its threads, and the time they took, vanish with it.
        SPENT["transport"] += foreign_seconds()
        report = {**SPENT, "total": time.process_time()}
        Path(os.environ["PROFILE"]).write_text(json.dumps(report))
        close(self)

    zenoh_transport.ZenohTransport.close = close_and_report
    module = sys.argv.pop(1)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
