"""Changes of the system clock, by an hour forward and back, for all processes of a run."""

import time
from pathlib import Path

from benchmarks.chaos.scene import ENDLESS, FailedError, Scene, say, scene
from benchmarks.running import COMMAND

_LIBRARIES = (  # Debian's package faketime
    "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1",
    "/usr/lib/aarch64-linux-gnu/faketime/libfaketimeMT.so.1",
)
_SETTLE_SECONDS = 3.0  # the library reads the pretended time once a second


def steps(measured_seconds: float) -> list[tuple[str, str]]:
    """Measure the training speed before each change of the clock and after it."""
    library = next((path for path in _LIBRARIES if Path(path).exists()), None)
    if library is None:
        say("SKIPPED: libfaketime is not installed (Debian: apt install faketime)")
        return [("clock steps", "SKIPPED: libfaketime is not installed")]
    with scene() as here:
        pretended = here.folder / "time"
        pretended.write_text("+0\n")
        preload = [
            "env",
            f"LD_PRELOAD={library}",
            f"FAKETIME_TIMESTAMP_FILE={pretended}",
            "FAKETIME_CACHE_DURATION=1",
            "FAKETIME_DONT_FAKE_MONOTONIC=1",
            "DONT_FAKE_MONOTONIC=1",
        ]
        learner = ("learner", "cartpole", "--listen", here.address, "--run-dir", "run")
        here.run([*preload, *COMMAND, *learner, *map(str, ENDLESS), "--set", "service.checkpoint_seconds=1"])
        for name in ("a", "b"):
            here.run([*preload, *COMMAND, "actor", "--connect", here.address, "--name", name])
        for name in ("a", "b"):
            here.wait_for_training(name)
        rates = {"before": _rate(here, measured_seconds)}
        for step in ("+3600", "-3600", "+0"):
            pretended.write_text(step + "\n")
            time.sleep(_SETTLE_SECONDS)
            clock = here.run([*preload, "date", "+%s"])
            clock.wait()
            off = int(clock.output) - time.time()
            if abs(off - int(step)) > 60:
                raise FailedError(f"the clock is off by {off:.0f} s instead of {step} s")
            rates[f"off by {step} s"] = _rate(here, measured_seconds)
        status = here.status()
        assert status is not None
        lives = max(actor.lives for actor in status.actors)
        age = status.checkpoint_age_seconds
        if lives != 1 or age is None or age > 60 or status.rollouts_rejected.keys() - {"stale"}:
            raise FailedError(
                f"processes per actor {lives}, last checkpoint {age} s ago, rejected {status.rollouts_rejected}"
            )
    return [("clock steps", "; ".join(f"{when} {rate:,.0f} env_steps/s" for when, rate in rates.items()))]


def _rate(here: Scene, measured_seconds: float) -> float:
    before, began = here.env_steps(), time.monotonic()
    time.sleep(measured_seconds)
    return (here.env_steps() - before) / (time.monotonic() - began)
