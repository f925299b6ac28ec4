"""Measure env_steps/s on CartPole with learning, of Daedalus and of A2C of stable-baselines3, and the memory.

    python -m benchmarks.throughput --rounds 3

Both run in turn, each alone on the machine. The ratio is computed per round.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.running import COMMAND, machine, table


def resident_megabytes(pid: int) -> float:
    """Return the peak resident memory of a process, in MB."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0]) / 1024


def children(pid: int) -> dict[int, str]:
    """Return the ids of the child processes of a process, with the module that each runs."""
    found = {}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        found[int(child)] = words[words.index(b"-m") + 1].decode() if b"-m" in words else "?"
    return found


def ours(env_steps: int) -> tuple[float, float, float]:
    """Measure env_steps/s, and the peak memory of the learner and of the larger actor."""
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        arguments = ["train", "cartpole", "--env-steps", str(env_steps), "--run-dir", str(directory)]
        process = subprocess.Popen(
            [*COMMAND, *arguments, "--set", "training.stop_when_solved=false"], stdout=subprocess.DEVNULL
        )
        memory = {"learner": 0.0, "actor": 0.0}
        while process.poll() is None:
            time.sleep(0.5)
            for child, module in children(process.pid).items() if process.poll() is None else ():
                role = module.rpartition(".")[2]
                if role in memory:
                    memory[role] = max(memory[role], resident_megabytes(child))
        if process.returncode != 0:
            raise SystemExit("daedalus train failed")
        rate = json.loads((directory / "summary.json").read_text())["env_steps_per_second"]
    return rate, memory["learner"], memory["actor"]


def peer(env_steps: int) -> float:
    """Measure env_steps/s of A2C of stable-baselines3."""
    script = os.path.join(os.path.dirname(__file__), "peer_a2c.py")
    command = [sys.executable, script, "--env-steps", str(env_steps)]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1])


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--env-steps", type=int, default=8_000_000)
    options.add_argument("--peer-env-steps", type=int, default=100_000)
    parsed = options.parse_args()
    rows, rates, ratios = [], [], []
    for index in range(parsed.rounds):
        rate, learner, actor = ours(parsed.env_steps)
        other = peer(parsed.peer_env_steps)
        rates.append(rate)
        ratios.append(rate / other)
        rows.append(
            (index + 1, f"{rate:,.0f}", f"{other:,.0f}", f"{rate / other:.1f}", f"{learner:.0f}", f"{actor:.0f}")
        )
    print(machine())
    header = ("round", "env_steps/s", "stable-baselines3 A2C", "ratio", "learner, peak MB", "actor, peak MB")
    print(table(header, rows))
    print(f"median {statistics.median(rates):,.0f} env_steps/s, {statistics.median(ratios):.1f} x the peer")


if __name__ == "__main__":
    main()
