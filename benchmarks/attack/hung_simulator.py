"""Attack: an actor that is connected and never sends a rollout, in a run of a2c. It takes more than a minute.

    python -m benchmarks.attack.hung_simulator

A batch of a2c is one rollout of every live actor. The learner must name the actor and train without it.
"""

import sys
import time
from contextlib import closing

from benchmarks.attack._hostile_actor import HostileActor
from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene

SLOW = True

_MOST_SECONDS = 90.0  # without an update


def hung_simulator() -> Verdict:
    """Let an actor hang, and return whether the learner trains on."""
    settings = ("--algorithm", "a2c", "--set", "collection.actors=1", *ENDLESS)
    with scene() as here:
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *settings)
        here.start("actor", "--connect", here.address, "--name", "honest")
        here.wait_for_training("honest")
        with closing(HostileActor(here.address, "hung")) as hung:
            hung.be_present()
            seconds, problems = _seconds_until_training(here)
            held = seconds <= _MOST_SECONDS and any("hung" in problem for problem in problems)
            late = hung.send().verdict
            here.wait_for_training("hung" if late == "accepted" else "honest")
    return Verdict(held, f"no update for {seconds:.0f} s; problems: {', '.join(problems) or 'none'}")


def _seconds_until_training(here: Scene) -> tuple[float, tuple[str, ...]]:
    """Wait until updates stop and go on; return how long they stopped, and the problems that the status shows then."""
    last, changed = here.env_steps(), time.monotonic()
    while time.monotonic() < changed + _MOST_SECONDS:
        time.sleep(0.2)
        status = here.status()
        steps = last if status is None else status.env_steps
        if steps != last:
            paused = time.monotonic() - changed
            last, changed = steps, time.monotonic()
            if paused > 5.0 and status is not None:
                return paused, status.problems
    return _MOST_SECONDS + 1.0, ()


if __name__ == "__main__":
    verdict = hung_simulator()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
