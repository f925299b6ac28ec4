"""Measure who should compute the gradient: the learner's CPU time and the bytes it receives, by network and actors.

    python -m benchmarks.study.gradient_cost --file build/gradient_cost.csv
    python -m benchmarks.study.gradient_cost --file build/gradient_cost.csv --networks nature --actors 1 4
    python -m benchmarks.study.gradient_cost --file build/gradient_cost.csv --table

`a3c`, once with `collection.upload=rollouts` and once with `gradients`: a learner with its router and N actors on this
machine, one thread each, in rollouts of 20 rows of 16 environments. The first rollouts are left out. CPU seconds are
those of the learner's process, so they hold on a busy machine, too. Bytes are those of the uploads. Each measurement
adds a line to the file; the same command again makes only those that are missing.
"""

import argparse
import itertools
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file

from benchmarks.chaos.scene import ENDLESS, FailedError, Scene, scene
from benchmarks.recorded_runs import RecordedRuns
from benchmarks.running import COMMAND, cpu_seconds, machine, table

_IDENTITY, _RESULTS = ("network", "actors", "upload"), ("cpu_seconds", "bytes", "env_steps", "parameters")
_UPLOADS = ("rollouts", "gradients")
_WARM_UP_ROLLOUTS = 20
_ROWS, _ENVIRONMENTS = 20, 16
_LIMIT = 600.0  # seconds, for actors that compute gradients on a busy machine
_MODULE = "benchmarks.study.catch"
_COMMON = f"""
collection.rollout_length = {_ROWS}
collection.envs_per_actor = {_ENVIRONMENTS}
training.algorithm = "a3c"
"""
_NETWORKS = {
    "mlp": 'environment.id = "CartPole-v1"',
    "small": f'environment.id = "{_MODULE}:Catch-v0"\npolicy.encoder = "small"',
    "nature": """
        policy.encoder = "nature"
        [environment]
        id = "Pong-v5"
        backend = "envpool"
        action_repeat = 4
        grey = true
        resize = [84, 84]
        frame_stack = 4
    """,
}


def measure(here: Scene, network: str, actors: int, upload: str, seconds: float) -> dict[str, Any]:
    """Run a learner with actors; return what the learner needed over some seconds."""
    settings, directory = here.folder / "settings.toml", here.folder / "run"
    settings.write_text(f'{_COMMON}collection.upload = "{upload}"\n{_NETWORKS[network]}\n')
    common = ("--allow-module", _MODULE)
    words = [settings, *common, "--actors", actors, "--listen", here.address, "--run-dir", directory, *ENDLESS]
    learner = here.run([*COMMAND, "learner", *map(str, words)], Path.cwd())
    learner.expect("actors join with")
    for number in range(actors):
        words = (*common, "--connect", here.address, "--name", f"actor-{number}")
        here.run([*COMMAND, "actor", *words], Path.cwd())
    least = _WARM_UP_ROLLOUTS * _ROWS * _ENVIRONMENTS
    _await_env_steps(here, least)
    cpu_before, steps_before = cpu_seconds(learner.process.pid), here.env_steps()
    time.sleep(seconds)
    _await_env_steps(here, steps_before + least)
    used, env_steps = cpu_seconds(learner.process.pid) - cpu_before, here.env_steps() - steps_before
    learner.process.terminate()
    learner.process.wait(30.0)
    summary = json.loads((directory / "summary.json").read_text())
    return {
        "cpu_seconds": f"{1000 * used / env_steps:.4g}",
        "bytes": f"{1000 * summary['rollout_bytes_per_env_step']:.0f}",
        "env_steps": env_steps,
        "parameters": sum(each.size for each in load_file(next(directory.glob("checkpoints/*/parameters*"))).values()),
    }


def _await_env_steps(here: Scene, env_steps: int) -> None:
    """Wait until so many env_steps are trained on. Asks rarely: the learner's answers count as its CPU time."""
    end = time.monotonic() + _LIMIT
    while here.env_steps() < env_steps:
        if time.monotonic() > end:
            raise FailedError(f"the learner has not trained on {env_steps} env_steps within {_LIMIT:g} s")
        time.sleep(1.0)


def results(lines: Sequence[Mapping[str, str]]) -> str:
    """Return the table of what was measured with both uploads."""
    found = {tuple(line[name] for name in _IDENTITY): line for line in lines}
    rows = []
    for network, actors in dict.fromkeys((line["network"], line["actors"]) for line in lines):
        pair = [found[network, actors, upload] for upload in _UPLOADS if (network, actors, upload) in found]
        if len(pair) < len(_UPLOADS):
            continue
        row = [network, f"{int(pair[0]['parameters']):,}", actors]
        for name, form in (("cpu_seconds", "{:.3f}"), ("bytes", "{:,.0f}")):
            sent, computed = (float(line[name]) for line in pair)
            row += [form.format(sent), form.format(computed), f"{computed / sent:.2f}"]
        rows.append(row)
    header = ("network", "parameters", "actors")
    for name in ("CPU s", "bytes"):
        header += (f"{name}: rollouts", "gradients", "ratio")
    return table(header, rows) + "\n\nCPU seconds and bytes of the learner for 1,000 env_steps."


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--file", type=Path, required=True, help="CSV file of the measurements")
    options.add_argument("--networks", nargs="+", choices=_NETWORKS, default=list(_NETWORKS))
    options.add_argument("--actors", nargs="+", type=int, default=[1, 4, 16])
    options.add_argument("--seconds", type=float, default=15.0, help="of a measurement, at least")
    options.add_argument("--table", action="store_true", help="only print the table of what is in the file")
    parsed = options.parse_args()
    runs = RecordedRuns(parsed.file, _IDENTITY, _RESULTS)
    wanted = [
        {"network": network, "actors": actors, "upload": upload}
        for network, actors, upload in itertools.product(parsed.networks, parsed.actors, _UPLOADS)
    ]
    for run in [] if parsed.table else runs.missing(wanted):
        with scene() as here:
            line = {**run, **measure(here, **run, seconds=parsed.seconds)}
        runs.add(line)
        print(", ".join(str(value) for value in line.values()), flush=True)
    print(machine())
    print(results(runs.read()))


if __name__ == "__main__":
    main()
