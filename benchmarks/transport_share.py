"""Measure the share of codec and transport in the CPU time of learner and actors, on CartPole.

    python -m benchmarks.transport_share --env-steps 8000000

The total includes the start of the processes and imports. benchmarks/profiled.py describes what is counted.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.running import machine, table


def free_address() -> str:
    """Return a loopback address that no process listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--env-steps", type=int, default=8_000_000)
    options.add_argument("--preset", default="cartpole")
    options.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parsed = options.parse_args()
    address = free_address()
    script = str(Path(__file__).with_name("profiled.py"))
    with tempfile.TemporaryDirectory() as folder:
        learner = ["daedalus.cli.commands.learner", parsed.preset, "--env-steps", parsed.env_steps, "--listen", address]
        learner += ["--run-dir", f"{folder}/run", "--set", "training.stop_when_solved=false"]
        learner += [word for setting in parsed.set for word in ("--set", setting)]
        actor = ["daedalus.cli.commands.actor", "--connect", address, "--log-level", "warning", "--name"]
        actors = [[*actor, f"actor-{index}"] for index in range(2)]
        processes = []
        for index, words in enumerate([learner, *actors]):
            environment = {**os.environ, "PROFILE": f"{folder}/{index}.json", "OMP_NUM_THREADS": "1"}
            command = [sys.executable, "-P", script, *(str(word) for word in words)]
            processes.append(subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL))
        statuses = [process.wait() for process in processes]
        if any(statuses):
            raise SystemExit("a process failed")
        reports = [json.loads(Path(f"{folder}/{index}.json").read_text()) for index in range(3)]
    rows, share = [], 0.0
    total = sum(report["total"] for report in reports)
    for name, report in zip(("learner", "actor-0", "actor-1"), reports, strict=True):
        part = report["codec"] + report["transport"]
        share += part / total
        cells = (f"{report[kind]:.2f}" for kind in ("total", "codec", "transport"))
        rows.append((name, *cells, f"{100 * part / report['total']:.1f} %"))
    print(machine())
    print(table(("process", "CPU s", "codec", "transport", "share"), rows))
    print(f"together {100 * share:.1f} % of {total:.1f} CPU seconds")


if __name__ == "__main__":
    main()
