"""Learner that notes what it does: `python -m benchmarks.fleet.noting_learner [--no-gradients] FILE ARGUMENTS`.

FILE gets lines of `policy_version seconds` when it publishes, on the monotonic clock, which all processes of this
machine share. With --no-gradients it joins batches, and computes no gradients: rollouts meet the limit of the intake.
FILE then gets a line of JSON each second: CPU seconds since the start, by stage of a rollout, and the number of
rollouts.
"""

import functools
import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from benchmarks.profiled import foreign_seconds
from daedalus.cli.commands.learner import main
from daedalus.learner.serving import rollout_judge
from daedalus.learner.serving.rollout_intake import RolloutIntake
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.learner.training.learner import Learner
from daedalus.protocol import codec
from daedalus.transport.zenoh_declarations import ZenohRequest

# In the order of a rollout's way. The time of a stage inside another counts once, for the inner one.
STAGES: tuple[tuple[str, Any, str], ...] = (
    ("callback", ZenohRequest, "__init__"),
    ("callback", RolloutIntake, "offer"),
    ("copy", ZenohRequest, "payload"),
    ("decompress", codec, "_plain_body"),
    ("decode", rollout_judge, "decode"),
    ("check", rollout_judge.RolloutJudge, "read"),
    ("judge", RolloutIntake, "_decide"),
    ("answer", ZenohRequest, "reply"),
    ("take", RolloutIntake, "take_batch"),
    ("take", RolloutIntake, "count_trained"),
    ("join", Learner, "step"),
    ("publish", SnapshotPublisher, "publish"),
)


class Stages:
    """CPU seconds of this process by stage."""

    def __init__(self) -> None:
        self._spent: dict[str, float] = defaultdict(float)
        self._calls: dict[str, int] = defaultdict(int)
        self._inner = threading.local()
        for name, owner, attribute in STAGES:
            found: Any = vars(owner)[attribute]
            is_property = isinstance(found, property)
            timed = self._timed(name, getattr(found, "fget", found))
            setattr(owner, attribute, property(timed) if is_property else timed)

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            outer, self._inner.spent = getattr(self._inner, "spent", 0.0), 0.0
            began = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                took = time.thread_time() - began
                self._spent[name] += took - self._inner.spent
                self._calls[name] += 1
                self._inner.spent = outer + took

        return wrapper

    def note(self, path: str) -> None:
        """Append a line each second, for ever."""
        with open(path, "a", buffering=1) as notes:
            while True:
                zenoh = foreign_seconds() - self._spent["callback"]
                total = {"zenoh": zenoh, **self._spent, "all": time.process_time()}
                notes.write(json.dumps({"rollouts": self._calls["judge"], **total}) + "\n")
                time.sleep(1.0)


def note_publications(path: str) -> None:
    """Write each publication to a file, from now on."""
    notes = open(path, "a", buffering=1)  # noqa: SIM115 - open until the process ends
    publish = SnapshotPublisher.publish

    def noted(self: SnapshotPublisher, policy_version: int, weights: dict) -> None:
        notes.write(f"{policy_version} {time.monotonic()}\n")
        publish(self, policy_version, weights)

    SnapshotPublisher.publish = noted  # type: ignore[method-assign] - only in this process


if __name__ == "__main__":
    if sys.argv[1] == "--no-gradients":
        del sys.argv[1]
        Learner._make_updates = lambda *_: None  # type: ignore[method-assign] - only in this process
        threading.Thread(target=Stages().note, args=(sys.argv.pop(1),), daemon=True).start()
    else:
        note_publications(sys.argv.pop(1))
    sys.exit(main())
