"""Measure Pong with one actor on a slow link, with and without compact snapshots.

    python -m benchmarks.slow_link --rounds 2

The slow link has 1 Mbit/s up, 4 Mbit/s down and 100 ms in each direction. Three cases run in turn, each with a learner
and an actor of its own: loopback; the slow link as the actor measures it; and the slow link with --link lan, so that
the actor receives every snapshot in full.
"""

import argparse
import contextlib
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields

from benchmarks.chaos.scene import ENDLESS, Scene, say, scene
from benchmarks.running import machine, table
from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.session.actor_config import ActorConfig, LinkChoice
from daedalus.actor.session.actor_service import ActorService
from daedalus.launch.process_lifecycle import stop_on_signals
from daedalus.learner.run.settings import read_preset, run_spec
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import RunStatus, Snapshot, SnapshotPart, SnapshotRequest
from daedalus.transport.interface import Transport
from daedalus.transport.zenoh_transport import connect

UP, DOWN, DELAY = 125e3, 500e3, 0.1  # bytes per second, and seconds in each direction
# The window of 1 in the preset is for loopback only: the actor waits for each answer.
_SETTINGS = ("environment.backend=ale", "collection.actors=1", "collection.window=2", "service.log_seconds=1")
_CASES: dict[str, tuple[bool, LinkChoice]] = {
    "loopback": (False, "auto"),
    "slow link": (True, "auto"),
    "slow link, --link lan": (True, "lan"),
}

_PLAYS = "plays with"
_UPDATES = run_spec(read_preset("pong")).training.updates_per_batch


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Results of one case, after the warm-up."""

    env_steps: float  # per second
    accepted: float
    rejected: float
    up: float  # bytes per hour, from the status
    down: float
    carried_up: float  # bytes per hour, counted by the link; 0 on loopback
    carried_down: float
    lag: float  # updates
    versions: float  # that the actor played with, per minute
    published: float  # per minute


class ReportingCollector(EnvironmentCollector):
    """Collector that prints the policy version of its weights."""

    def load(self, snapshot: Snapshot) -> None:
        """See Collector."""
        super().load(snapshot)
        print(f"{_PLAYS} {snapshot.policy_version}", flush=True)


def play(address: str, link: LinkChoice) -> int:
    """Run the process of the actor."""
    transport, stop = connect([address]), stop_on_signals()
    config = ActorConfig(name="far", incarnation=time.monotonic_ns(), link=link)
    try:
        ActorService(config, transport, stop, ReportingCollector()).run()
    finally:
        transport.close()
    return 0


@contextlib.contextmanager
def link_to(here: Scene, slow: bool) -> Iterator[tuple[str, dict[str, int]]]:
    """Yield the address for the actor and the bytes that the link carries."""
    if not slow:
        yield here.address, {"up": 0, "down": 0}
        return
    from faults import SlowProxy  # a module of the tests: benchmarks.chaos adds its folder to the path

    proxy = SlowProxy(here.address, up=UP, down=DOWN, delay=DELAY)
    try:
        yield proxy.address, proxy.carried
    finally:
        proxy.close()


def measure(slow: bool, link: LinkChoice, warm_up: float, duration: float) -> tuple[Measured, list[tuple[str, str]]]:
    """Measure one case; on loopback also the sizes of snapshots."""
    with scene() as here:
        settings = [word for setting in _SETTINGS for word in ("--set", setting)]
        here.start("learner", "pong", "--listen", here.address, "--run-dir", "run", *settings, *ENDLESS)
        here.wait("the learner", here.status)
        with link_to(here, slow) as (address, carried):
            actor = here.run([sys.executable, "-m", "benchmarks.slow_link", "--play", address, "--link", link])
            here.wait_for_training("far")
            time.sleep(warm_up)
            first, carried_before, lines = _status(here), dict(carried), len(actor.lines)
            began, statuses = time.monotonic(), []
            while time.monotonic() < began + duration:
                time.sleep(1.0)
                statuses.append(_status(here))
            seconds, played = time.monotonic() - began, actor.lines[lines:]
            hourly = {way: 3600 * (carried[way] - carried_before[way]) / seconds for way in carried}
            sizes = [] if slow else _sizes(here)  # while the learner still makes updates
        say("\n".join(f"  actor: {line}" for line in actor.lines if not line.startswith(_PLAYS)))
    before, after = first.actors[0], statuses[-1].actors[0]
    rejected = sum(after.rollouts_rejected.values()) - sum(before.rollouts_rejected.values())
    return Measured(
        env_steps=(after.env_steps - before.env_steps) / seconds,
        accepted=after.rollouts_accepted - before.rollouts_accepted,
        rejected=rejected,
        up=statistics.fmean(status.actors[0].bytes_up_per_hour for status in statuses),
        down=statistics.fmean(status.actors[0].bytes_down_per_hour for status in statuses),
        carried_up=hourly["up"],
        carried_down=hourly["down"],
        lag=statistics.fmean(status.policy_lag_mean for status in statuses),
        versions=60 * sum(line.startswith(_PLAYS) for line in played) / seconds,
        published=60 * (statuses[-1].updates - first.updates) / _UPDATES / seconds,
    ), sizes


def _status(here: Scene) -> RunStatus:
    while (status := here.status()) is None or not status.actors:
        time.sleep(0.05)
    return status


def _sizes(here: Scene) -> list[tuple[str, str]]:
    """Return the bytes of the newest snapshot, full and compact, and of later differences to it."""
    transport = connect([here.address])
    try:
        (answer,) = transport.query(keys.snapshots("run"), timeout=30.0)
        snapshot = decode(answer, Limits(max_bytes=len(answer)))
        assert isinstance(snapshot, Snapshot)
        held, compact = _fetched(transport, None)
        rows = [
            (f"float32, {sum(array.size for array in snapshot.weights.values()):,} weights", f"{len(answer):,}"),
            ("bfloat16", f"{compact:,}"),
        ]
        for batches in (1, 4):
            version, size = _fetched(transport, held)
            while version < held + batches * _UPDATES:
                version, size = _fetched(transport, held)
            rows.append((f"differences over {version - held} updates", f"{size:,}"))
    finally:
        transport.close()
    return rows


def _fetched(transport: Transport, held: int | None) -> tuple[int, int]:
    """Return the newest version and its bytes for an actor that holds another version."""
    size, part, version = 0, 0, None
    while True:
        request = SnapshotRequest(actor="sizes", held_version=held, policy_version=version, part=part)
        (answer,) = transport.query(keys.snapshots("run"), encode(request), timeout=30.0)
        message = decode(answer, Limits())
        assert isinstance(message, SnapshotPart)
        size, part, version = size + message.data.size, part + 1, message.policy_version
        if part == message.parts:
            return version, size


def _mean(rounds: list[Measured]) -> Measured:
    names = [field.name for field in fields(Measured)]
    return Measured(**{name: statistics.fmean(getattr(each, name) for each in rounds) for name in names})


def _column(found: Measured, alone: Measured) -> tuple[str, ...]:
    def megabytes(reported: float, carried: float) -> str:
        return f"{reported / 1e6:,.0f}" + (f" ({carried / 1e6:,.0f})" if carried else "")

    return (
        f"{found.env_steps:,.0f} ({found.env_steps / alone.env_steps:.0%})",
        f"{found.accepted:,g}",
        f"{found.rejected:,g}",
        f"{found.lag:.0f} ({found.lag / _UPDATES:.1f})",
        f"{found.versions:.0f} of {found.published:.0f}",
        megabytes(found.up, found.carried_up),
        megabytes(found.down, found.carried_down),
    )


_ROWS = (
    "env_steps/s (relative to loopback)",
    "rollouts accepted",
    "rollouts rejected as stale",
    "policy lag, updates (batches)",
    "policy versions per minute that the actor played with, of those published",
    "MB per hour up, from `status` (counted by the link)",
    "MB per hour down",
)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=1, help="rounds of all cases in turn (default: %(default)s)")
    options.add_argument("--minutes", type=float, default=1.0, help="duration of each case (default: %(default)g)")
    options.add_argument(
        "--warm-up",
        type=float,
        default=20.0,
        metavar="SECONDS",
        help="time before each measurement (default: %(default)g)",
    )
    options.add_argument("--play", metavar="ADDRESS", help=argparse.SUPPRESS)
    options.add_argument("--link", choices=("auto", "lan"), default="auto", help=argparse.SUPPRESS)
    parsed = options.parse_args()
    if parsed.play:
        return play(parsed.play, parsed.link)
    found: dict[str, list[Measured]] = {name: [] for name in _CASES}
    sizes = []
    for _ in range(parsed.rounds):
        for name, (slow, link) in _CASES.items():
            say(f"--- {name}")
            figures, more = measure(slow, link, parsed.warm_up, 60 * parsed.minutes)
            found[name].append(figures)
            sizes = more or sizes
            say(f"  {figures}")
    means = {name: _mean(rounds) for name, rounds in found.items()}
    columns = [_column(each, means["loopback"]) for each in means.values()]
    print(f"{machine()}; means of {parsed.rounds} x {parsed.minutes:g} minutes\n")
    print(table(("", *means), list(zip(_ROWS, *columns, strict=True))))
    print()
    print(table(("snapshot", "bytes"), sizes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
