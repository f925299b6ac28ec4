"""A disk that becomes slow: every fsync of the learner takes seconds."""

import re
import tempfile
import time
from pathlib import Path

from benchmarks.chaos.scene import ENDLESS, FailedError, Scene, say, scene
from benchmarks.running import COMMAND

# Loaded by Python before anything else of the learner: the file SECONDS says how long each fsync takes.
_SLOW = """
import os, time
_fsync = os.fsync
def fsync(descriptor):
    with open({file!r}) as seconds:
        time.sleep(float(seconds.read() or 0))
    _fsync(descriptor)
os.fsync = fsync
"""
_MOST_STOP_SECONDS = 25.0  # docs/operations.md: 20 s for the last checkpoint, and what is around it


def slow(seconds: float, window: float) -> list[tuple[str, str]]:
    """Train for `window` seconds on a good disk and as long on a slow one; then stop the learner by SIGTERM."""
    with tempfile.TemporaryDirectory() as folder, scene() as here:
        file = Path(folder) / "seconds"
        file.write_text("0")
        (Path(folder) / "sitecustomize.py").write_text(_SLOW.format(file=str(file)))
        saving = ("--set", "service.checkpoint_seconds=5", "--set", "service.log_seconds=1")
        words = ["learner", "cartpole", "--listen", here.address, "--run-dir", "run", *saving, *ENDLESS]
        learner = here.run(["env", f"PYTHONPATH={folder}", *COMMAND, *map(str, words)])
        here.start("actor", "--connect", here.address, "--name", "a")
        here.wait_for_training()
        before, _, _ = _rate(here, window)
        file.write_text(str(seconds))
        after, gap, problems = _rate(here, window)
        began = time.monotonic()
        learner.process.terminate()
        learner.wait()
        stopped = time.monotonic() - began
        say("\n".join(learner.lines[-5:]))
        checkpoints = [entry.name for entry in (here.folder / "run" / "checkpoints").glob("0*")]
    if stopped > _MOST_STOP_SECONDS or not checkpoints or not problems:
        raise FailedError(f"stopped after {stopped:.0f} s, {len(checkpoints)} checkpoints, problems {problems}")
    return [
        (f"updates per second, every fsync takes {seconds:g} s", f"{after:.1f}, against {before:.1f} without"),
        ("the longest time without an update", f"{gap:.1f} s"),
        ("problems in the status", "; ".join(sorted(problems))),
        ("SIGTERM, until the learner has ended", f"{stopped:.1f} s; {len(checkpoints)} checkpoints"),
    ]


def _rate(here: Scene, window: float) -> tuple[float, float, set[str]]:
    """Return the updates per second, the longest time without one in seconds, and the kinds of problems shown."""
    first = status = here.status()
    began = changed = time.monotonic()
    gap, problems = 0.0, set[str]()
    while time.monotonic() < began + window:
        time.sleep(0.2)
        newest = here.status()
        if newest is None or status is None or first is None:
            raise FailedError("the learner does not answer")
        if newest.updates != status.updates:
            changed = time.monotonic()
        gap = max(gap, time.monotonic() - changed)
        problems |= {re.sub(r"\d+ s", "N s", problem) for problem in newest.problems}
        status = newest
    assert first is not None
    assert status is not None
    return (status.updates - first.updates) / (time.monotonic() - began), gap, problems
