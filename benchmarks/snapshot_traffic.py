"""Measure the traffic between a learner and actors with slow environments on a fast link.

    python -m benchmarks.snapshot_traffic --actors 12 --step-milliseconds 4

All actors are threads of one process, each with a session of its own through a TCP proxy that counts bytes. The network
is a small multilayer perceptron for CartPole. Each case runs with a learner of its own.
"""

import argparse
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.chaos.scene import ENDLESS, Scene, say, scene
from benchmarks.running import machine, table
from benchmarks.slow_actors import MODULE, provide_environment
from daedalus.actor.session.actor_config import LinkChoice
from daedalus.protocol.messages import RunStatus

_UNLIMITED = 1e12  # bytes per second


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Results of one case, after the warm-up."""

    env_steps: float  # per second, of all actors
    rollouts: float  # accepted, per second, of all actors
    updates: float  # per second
    lag: float  # updates, of the rollouts trained on
    up: float  # bytes per hour, of all actors, as the link carries them
    down: float
    learner_cpu: float  # cores


def measure(arguments: argparse.Namespace, link: LinkChoice) -> Measured:
    """Measure one case."""
    from faults import SlowProxy  # a module of the tests: benchmarks.chaos adds its folder to the path

    with scene() as here:
        provide_environment(here.folder)
        settings = [
            f"environment.kwargs={{seconds={arguments.step_milliseconds / 1000}}}",
            f"collection.envs_per_actor={arguments.envs}",
            f"collection.rollout_length={arguments.rollout_length}",
            f"training.algorithm={arguments.algorithm}",
        ]
        words = [word for setting in settings for word in ("--set", setting)]
        learner = here.start(
            "learner",
            "--env",
            f"{MODULE}:Slow-v0",
            "--listen",
            here.address,
            "--run-dir",
            "run",
            *words,
            *ENDLESS,
        )
        here.wait("the learner", here.status)
        proxy = SlowProxy(here.address, up=_UNLIMITED, down=_UNLIMITED, delay=0.0)
        try:
            playing = ["benchmarks.slow_actors", proxy.address, str(arguments.actors), "--link", link, "--stagger", "1"]
            here.run([sys.executable, "-m", *playing])
            here.wait("all actors", lambda: _trained(here) == arguments.actors)
            time.sleep(arguments.warm_up)
            first, carried, cpu, began = _status(here), dict(proxy.carried), _cpu(learner.process.pid), time.monotonic()
            lags, last = [], first
            while time.monotonic() < began + arguments.seconds:
                time.sleep(0.5)
                last = _status(here)
                lags.append(last.policy_lag_mean)
            seconds = time.monotonic() - began
            hourly = {way: 3600 * (proxy.carried[way] - carried[way]) / seconds for way in carried}
            cores = (_cpu(learner.process.pid) - cpu) / seconds
        finally:
            proxy.close()
    accepted = [sum(each.rollouts_accepted for each in status.actors) for status in (first, last)]
    return Measured(
        env_steps=(last.env_steps - first.env_steps) / seconds,
        rollouts=(accepted[1] - accepted[0]) / seconds,
        updates=(last.updates - first.updates) / seconds,
        lag=statistics.fmean(lags),
        up=hourly["up"],
        down=hourly["down"],
        learner_cpu=cores,
    )


def _status(here: Scene) -> RunStatus:
    while (status := here.status()) is None:
        time.sleep(0.05)
    return status


def _trained(here: Scene) -> int:
    """Return the number of actors that were trained on."""
    return sum(each.env_steps > 0 for each in _status(here).actors)


def _cpu(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--actors", type=int, default=12, help="(default: %(default)s)")
    options.add_argument(
        "--step-milliseconds", type=float, default=4.0, help="duration of a step (default: %(default)g)"
    )
    options.add_argument("--envs", type=int, default=4, help="environments of one actor (default: %(default)s)")
    options.add_argument("--rollout-length", type=int, default=16, help="rows of a rollout (default: %(default)s)")
    options.add_argument("--algorithm", default="impala", help="(default: %(default)s)")
    options.add_argument("--links", nargs="+", default=["auto", "wan"], help="cases to measure (default: auto wan)")
    options.add_argument("--seconds", type=float, default=60.0, help="duration of each case (default: %(default)g)")
    options.add_argument("--warm-up", type=float, default=10.0, help="seconds before each case (default: %(default)g)")
    parsed = options.parse_args()
    rows = []
    for link in parsed.links:
        found = measure(parsed, link)
        say(f"{link}: {found}")
        rows.append(
            (
                f"--link {link}",
                f"{found.env_steps:,.0f}",
                f"{found.rollouts:.1f}",
                f"{found.updates:.1f}",
                f"{found.lag:.1f}",
                f"{found.up / 1e9:.2f}",
                f"{found.down / 1e9:.2f}",
                f"{found.down / 3600 / max(found.rollouts, 1e-9) / 1e3:.1f}",
                f"{found.learner_cpu:.2f}",
            )
        )
    print(f"{machine()}; {parsed.actors} actors x {parsed.envs} environments, {parsed.step_milliseconds:g} ms a step\n")
    header = (
        "",
        "env_steps/s",
        "rollouts/s",
        "updates/s",
        "policy lag",
        "GB/h up",
        "GB/h down",
        "KB down a rollout",
        "cores",
    )
    print(table(header, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
