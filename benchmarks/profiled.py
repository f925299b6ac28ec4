"""Run a learner or an actor and measure the CPU time of codec and transport; write the CPU seconds as JSON.

    PROFILE=out.json python -P benchmarks/profiled.py daedalus.cli.commands.actor --connect tcp/127.0.0.1:7447

Codec is the time in `encode` and `decode`. Transport is the time of our threads in calls of the transport, and all time
of the threads of Zenoh, including our callbacks.
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
from daedalus.transport import zenoh_declarations, zenoh_transport

SPENT: dict[str, float] = defaultdict(float)
ACTIVE = threading.local()


def is_ours() -> bool:
    """Return whether our own code started this thread, and not Zenoh for a callback."""
    return not isinstance(threading.current_thread(), threading._DummyThread)


def timed(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its CPU time added to `kind`. Nested calls are counted once."""

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
    """Return the CPU seconds of all threads of this process that our code did not start."""
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
        (zenoh_declarations.ZenohRequest, ("reply",)),
        (zenoh_declarations.ZenohInbox, ("take",)),
    ):
        for name in names:
            setattr(owner, name, timed("transport", getattr(owner, name)))
    close = zenoh_transport.ZenohTransport.close

    def close_and_report(self: zenoh_transport.ZenohTransport) -> None:
        # Before the session closes: its threads end then, and their times are lost.
        SPENT["transport"] += foreign_seconds()
        report = {**SPENT, "total": time.process_time()}
        Path(os.environ["PROFILE"]).write_text(json.dumps(report))
        close(self)

    zenoh_transport.ZenohTransport.close = close_and_report
    module = sys.argv.pop(1)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
