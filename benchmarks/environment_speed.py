"""Measure env_steps per CPU second of CarRacing and Pong, with transforms and random actions.

python -m benchmarks.environment_speed
"""

import argparse
import time

import numpy as np

from benchmarks.random_actions import random_actions
from benchmarks.running import machine, table
from daedalus.actor.environments.make import make_environments
from daedalus.learner.run.settings import read_preset, run_spec

CASES = (
    ("car_racing", "fast"),
    ("car_racing", "envpool"),
    ("car_racing", "gymnasium"),
    ("pong", "envpool"),
    ("pong", "ale"),
)
_ENVIRONMENTS = 8


def rate(preset: str, backend: str, seconds: float) -> float:
    """Return env_steps per CPU second of eight environments in this process."""
    spec = run_spec(read_preset(preset)).environment.model_copy(update={"backend": backend, "processes": False})
    environments = make_environments(spec, _ENVIRONMENTS)
    try:
        environments.reset(1)
        random = np.random.default_rng(1)
        steps, began, ends = 0, time.process_time(), time.monotonic() + seconds
        while time.monotonic() < ends:
            environments.step(random_actions(environments.spaces, _ENVIRONMENTS, random))
            steps += _ENVIRONMENTS
        return steps / (time.process_time() - began)
    finally:
        environments.close()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument(
        "--seconds", type=float, default=6.0, help="duration of each measurement (default: %(default)g)"
    )
    parsed = options.parse_args()
    rows = [(preset, backend, f"{rate(preset, backend, parsed.seconds):,.0f}") for preset, backend in CASES]
    print(machine())
    print(table(("preset", "backend", "env_steps per CPU second"), rows))


if __name__ == "__main__":
    main()
