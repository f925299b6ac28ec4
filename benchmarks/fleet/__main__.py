"""Measure the cost of a run by the number of its actors, with one learner and simulated actors.

    python -m benchmarks.fleet --actors 1 10 100 1000 --plot docs/fleet.png

A simulated actor has a session, presence and acknowledgements of its own, but no environments: it sends one recorded
rollout of CartPole, 16 rows of 16 environments, repeatedly. First all actors together send --rate rollouts per second,
a rate that the learner can train on. The cost and the latencies then depend on the number of actors only. Then all
actors send as fast as they get answers.

    python -m benchmarks.fleet --actors 14 --pixels --device cuda
    python -m benchmarks.fleet --actors 8 --pixels --hosts 2
    python -m benchmarks.fleet --actors 32 --pixels --no-gradients --per-process 16 --rollout-length 64

With --pixels, the frames are like those of Pong, and the learner trains the Nature network with `impala`, one pass over
batches of --batch rollouts. Only the maximum is measured: env_steps/s from the network to the gradient, beside what the
learner does alone with rollouts that are decoded. With --hosts the actors are in network namespaces, as on other hosts;
that needs root. With --no-gradients the learner joins batches only: the table says what CPU time each stage of a
rollout takes, and how many cores of the learner 250,000 rows a second would need.
"""

import argparse
import contextlib
import itertools
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hosts import Network, NoHostsError
from processes import Running

from benchmarks.chaos.scene import ENDLESS, Scene, resident_mib, say, scene
from benchmarks.fleet.noting_learner import STAGES
from benchmarks.fleet.swarm import ENVIRONMENTS
from benchmarks.running import COMMAND, cpu_seconds, machine, table
from daedalus.learner.run.settings import SettingsError

_PER_PROCESS = 250
_HEADER = (
    "actors",
    "rollouts/s",
    "ack ms, p50 and p99",
    "snapshot ms, p50 and p99",
    "ms to the last actor",
    "missed",
    "CPU s per 1,000 rollouts: learner",
    "router",
    "MiB: learner",
    "router",
    "maximum, rollouts/s",
)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--actors", type=int, nargs="+", default=[1, 10, 100, 1000])
    options.add_argument(
        "--rate", type=float, default=100.0, help="rollouts per second of all actors (default: %(default)g)"
    )
    options.add_argument(
        "--seconds", type=float, default=20.0, help="duration of each measurement (default: %(default)g)"
    )
    options.add_argument("--pixels", action="store_true", help="measure the maximum with frames like those of Pong")
    options.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of the learner, with --pixels")
    options.add_argument("--no-gradients", action="store_true", help="with --pixels, join batches only")
    options.add_argument("--hosts", type=int, default=0, help="with --pixels, network namespaces of actors")
    options.add_argument("--batch", type=int, default=16, help="rollouts of a batch, with --pixels")
    options.add_argument("--rollout-length", type=int, default=16, help="with --pixels (default: %(default)d)")
    options.add_argument("--per-process", type=int, default=1, help="actors of a process, with --pixels")
    options.add_argument("--plot", type=Path, help="picture of the results to write")
    parsed = options.parse_args()
    of_pixels = ("device", "no_gradients", "hosts", "batch", "rollout_length", "per_process")
    useless = ("rate", "plot") if parsed.pixels else of_pixels
    given = [f"--{name.replace('_', '-')}" for name in useless if getattr(parsed, name) != options.get_default(name)]
    if given:
        options.error(f"{', '.join(given)}: no effect {'with' if parsed.pixels else 'without'} --pixels")
    if parsed.pixels:
        print(_pixels_table(parsed))
        return 0
    rows = []
    for count in parsed.actors:
        with scene() as here:
            rows.append(_measured(here, count, parsed.rate, parsed.seconds))
        say(f"{count} actors: {rows[-1]}")
    print(f"{machine()}; {parsed.rate:g} rollouts/s, {parsed.seconds:g} s each\n")
    print(table(_HEADER, [_cells(row) for row in rows]))
    if parsed.plot:
        _plot(rows, parsed.plot)
    return 0


def _pixels_table(parsed: argparse.Namespace) -> str:
    from benchmarks.gpu import learner_alone

    fleet = PixelsFleet(
        device=parsed.device,
        batch=parsed.batch,
        seconds=parsed.seconds,
        per_process=parsed.per_process,
        rows=parsed.rollout_length,
        hosts=parsed.hosts,
        gradients=not parsed.no_gradients,
    )
    try:
        if fleet.gradients:
            fleet = replace(fleet, limit=learner_alone(parsed.device, fleet.rows, fleet.batch, parsed.seconds / 4))
        made = [fleet.measured(count) for count in parsed.actors]
    except (SettingsError, NoHostsError) as error:
        raise SystemExit(str(error)) from None
    header = PIXELS_HEADER if fleet.gradients else PIXELS_HEADER + STAGES_HEADER
    return f"{machine()}; {parsed.seconds:g} s each\n\n{table(header, made)}"


class Swarm:
    """Simulated actors in several processes."""

    def __init__(
        self,
        address: str,
        count: int,
        rate: float,
        seconds: float,
        *kind: str,
        per_process: int = _PER_PROCESS,
        places: Sequence[Sequence[str]] = ((),),
    ) -> None:
        """Start the processes. `places`: beginnings of command lines, each of which runs a command in another place."""
        each = [len(part) for part in np.array_split(np.arange(count), -(-count // per_process))]
        self._processes = []
        for place, first, size in zip(itertools.cycle(places), np.cumsum([0, *each[:-1]]), each, strict=False):
            words = [address, first, size, rate / count, seconds, *kind]
            self._processes.append(
                subprocess.Popen(
                    [*place, sys.executable, "-m", "benchmarks.fleet.swarm", *map(str, words)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )

    def await_ready(self) -> None:
        """Wait until all actors have joined and the learner has a policy."""
        for process in self._processes:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"

    def go(self) -> None:
        """Let the actors send."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()

    def results(self) -> list[dict]:
        """Wait for the results of all processes and return them."""
        found = []
        for process in self._processes:
            assert process.stdout is not None
            found.append(json.loads(process.stdout.readline()))
            process.wait(60.0)
        return found

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            process.kill()
            process.wait()


def _measured(here: Scene, count: int, rate: float, seconds: float) -> dict[str, float]:
    """Measure a number of actors, first at a given rate, then at the maximum rate."""
    router = here.router()
    notes = here.folder / "published"
    settings = ("--set", "collection.envs_per_actor=16", "--set", "collection.rollout_length=16", *ENDLESS)
    words = ["cartpole", "--connect", here.address, "--run-dir", here.folder / "fleet", "--actors", 4, *settings]
    learner = here.run(
        [sys.executable, "-m", "benchmarks.fleet.noting_learner", str(notes), *map(str, words)], Path.cwd()
    )
    learner.expect("actors join with")
    pids = {"learner": learner.process.pid, "router": router.process.pid}
    row: dict[str, float] = {"actors": count}
    for pace in (rate, 1e6):
        swarm = Swarm(here.address, count, pace, seconds)
        try:
            swarm.await_ready()
            began, before = time.monotonic(), {name: cpu_seconds(pid) for name, pid in pids.items()}
            swarm.go()
            results = swarm.results()
            took = time.monotonic() - began
        finally:
            swarm.close()
        accepted = sum(result["verdicts"].get("accepted", 0) for result in results)
        if pace != rate:
            row["most"] = accepted / took
            continue
        row["rate"] = accepted / seconds
        for name, pid in pids.items():
            row[f"{name}_cpu"] = 1000 * (cpu_seconds(pid) - before[name]) / max(accepted, 1)
            row[f"{name}_mib"] = resident_mib(pid)
        latencies = [latency for result in results for latency in result["latencies"]]
        row["ack_50"], row["ack_99"] = (1000 * np.quantile(latencies, (0.5, 0.99))).tolist()
        row |= _snapshots(notes, [came for result in results for came in result["came"]], began, seconds)
    return row


PIXELS_HEADER = (
    "actors",
    "rows of a batch",
    "env_steps/s",
    "of the learner alone",
    "ack ms, p50 and p99",
    "policy lag",
    "CPU: learner",
    "router",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelsFleet:
    """Simulated actors with pixels that send as fast as they get answers, and their learner."""

    device: str
    batch: int  # rollouts
    seconds: float
    per_process: int = 1  # actors
    rows: int = 16  # of a rollout
    hosts: int = 0  # network namespaces of actors; 0: they use the loopback
    gradients: bool = True  # False: batches are only joined
    limit: float | None = None  # rows/s of the learner alone

    def measured(self, count: int) -> tuple[str, ...]:
        """Return a row of PIXELS_HEADER for `count` actors and, without gradients, of STAGES_HEADER."""
        with scene() as here, self._network(here) as (router, at_learner, at_actors, places):
            notes = here.folder / "stages"
            learner = self._learner(here, notes, "--connect", at_learner, "--actors", count)
            learner.expect("actors join with")
            kind = {"per_process": self.per_process, "places": places}
            swarm = Swarm(at_actors, count, 1e6, self.seconds, "pixels", **kind)
            try:
                swarm.await_ready()
                pids = (learner.process.pid, router.process.pid)
                before = [cpu_seconds(pid) for pid in pids]
                swarm.go()
                time.sleep(0.3 * self.seconds)  # the recording of a GPU's graph is not measured
                began, first, stages = time.monotonic(), here.status(), _last_line(notes)
                time.sleep(0.65 * self.seconds)
                last, took = here.status(), time.monotonic() - began
                stages = _per_rollout(ENVIRONMENTS * self.rows, stages, _last_line(notes))
                spent = [(cpu_seconds(pid) - old) / self.seconds for pid, old in zip(pids, before, strict=True)]
                results = swarm.results()
            finally:
                swarm.close()
        assert first is not None
        assert last is not None
        latencies = [latency for result in results for latency in result["latencies"]]
        acks = " and ".join(f"{1000 * value:.1f}" for value in np.quantile(latencies, (0.5, 0.99)))
        rate = (last.env_steps - first.env_steps) / took
        share = "-" if self.limit is None else f"{rate / self.limit:.0%}"
        lag = "?" if last.policy_lag_mean is None else f"{last.policy_lag_mean:.1f}"
        shares = [f"{each:.0%}" for each in spent]
        batch = f"{ENVIRONMENTS * self.rows * self.batch:,}"
        return str(count), batch, f"{rate:,.0f}", share, acks, lag, *shares, *stages

    def _learner(self, here: Scene, notes: Path, *more: object) -> Running:
        settings = {
            "policy.encoder": "nature",
            "training.algorithm": "impala",
            "training.batch_rollouts": self.batch,
            "training.passes": 1,
            "training.minibatches": 1,
            "training.device": self.device,
            "collection.envs_per_actor": ENVIRONMENTS,
            "collection.rollout_length": self.rows,
            "service.queue_megabytes": 256,
        }
        words = ["pong", *more, "--run-dir", here.folder / "fleet", *ENDLESS]
        words += [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
        if self.gradients:
            return here.start("learner", *words)
        module = [sys.executable, "-m", "benchmarks.fleet.noting_learner", "--no-gradients", notes]
        return here.run([*map(str, module), *map(str, words)], Path.cwd())

    @contextlib.contextmanager
    def _network(self, here: Scene) -> Iterator[tuple[Running, str, str, Sequence[Sequence[str]]]]:
        """Start a router; yield it, its addresses for the learner and for actors, and the places of actors."""
        if not self.hosts:
            yield here.router(), here.address, here.address, ((),)
            return
        network = Network(here.folder)
        try:
            central, *others = [network.host(f"host{number}") for number in range(self.hosts + 1)]
            # A Unix socket reaches from one namespace into another.
            here.address, at_actors = f"unixsock-stream/{here.folder / 'router'}", f"tcp/{central.address}:7447"
            words = ("--listen", here.address, "--listen", at_actors, "--insecure")
            router = here.run(network.words(central.name, *COMMAND, "router", *words))
            router.expect("listening")
            yield router, here.address, at_actors, [network.words(host.name) for host in others]
        finally:
            network.close()


STAGES_HEADER = (
    *(f"{name}, us" for name in ("zenoh", *dict.fromkeys(name for name, _, _ in STAGES), "other", "all")),
    "rows/s of a core",
    "cores for 250k rows/s",
)


def _last_line(notes: Path) -> dict[str, float]:
    """Return what a learner without gradients noted last; empty for another learner."""
    return json.loads(notes.read_text().splitlines()[-1]) if notes.exists() else {}


def _per_rollout(rows: int, before: dict[str, float], after: dict[str, float]) -> tuple[str, ...]:
    """Return the cells of STAGES_HEADER: CPU microseconds of each stage of a rollout, of all, and what follows."""
    if not after:
        return ()
    spent = {name: after[name] - before.get(name, 0.0) for name in after}
    rollouts, everything = spent.pop("rollouts"), spent.pop("all")
    spent |= {"other": everything - sum(spent.values()), "all": everything}
    cells = [f"{1e6 * spent.get(name.removesuffix(', us'), 0.0) / rollouts:.0f}" for name in STAGES_HEADER[:-2]]
    rate = rows * rollouts / everything
    return *cells, f"{rate:,.0f}", f"{250_000 / rate:.2f}"


def _snapshots(notes: Path, came: Sequence[Sequence[tuple[int, float]]], began: float, seconds: float) -> dict:
    """Return the delays of the snapshots that were published while the actors sent."""
    published = {}
    for line in notes.read_text().splitlines():
        version, at = line.split()
        if began < float(at) < began + seconds:
            published[int(version)] = float(at)
    delays: dict[int, list[float]] = {version: [] for version in published}
    for actor in came:
        for version, at in actor:
            if version in delays:
                delays[version].append(at - published[version])
    every = [delay for each in delays.values() for delay in each]
    last = [max(each) for each in delays.values() if each]
    return {
        "snapshot_50": 1000 * float(np.quantile(every, 0.5)),
        "snapshot_99": 1000 * float(np.quantile(every, 0.99)),
        "last_50": 1000 * float(np.median(last)),
        "missed": 1 - len(every) / (len(delays) * len(came)),
    }


def _cells(row: dict[str, float]) -> tuple[str, ...]:
    return (
        f"{row['actors']:,.0f}",
        f"{row['rate']:.0f}",
        f"{row['ack_50']:.1f} and {row['ack_99']:.1f}",
        f"{row['snapshot_50']:.1f} and {row['snapshot_99']:.1f}",
        f"{row['last_50']:.1f}",
        f"{row['missed']:.1%}",
        f"{row['learner_cpu']:.2f}",
        f"{row['router_cpu']:.2f}",
        f"{row['learner_mib']:.0f}",
        f"{row['router_mib']:.0f}",
        f"{row['most']:,.0f}",
    )


def _plot(rows: Sequence[dict[str, float]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(12, 3.5), layout="constrained")
    counts = [row["actors"] for row in rows]
    for axis, title, names in (
        (axes[0], "milliseconds", ("ack_50", "ack_99", "snapshot_50", "snapshot_99")),
        (axes[1], "CPU seconds per 1,000 rollouts", ("learner_cpu", "router_cpu")),
        (axes[2], "MiB", ("learner_mib", "router_mib")),
    ):
        for name in names:
            axis.plot(counts, [row[name] for row in rows], marker="o", label=name.replace("_", " "))
        axis.set(xscale="log", xlabel="actors", title=title)
        axis.legend()
    axes[0].set(yscale="log")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
