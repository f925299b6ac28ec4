"""Peer for comparison: asynchronous APPO of Sample Factory on Pong, with its own Atari environment.

Prints env_steps/s.

Its requirements conflict with those of this project, so it needs a virtual environment of its own. ale-py 0.10 includes
the games and works with the gymnasium version of Sample Factory:

    python -m venv PLACE
    PLACE/bin/pip install torch sample-factory==2.1.1 ale-py==0.10.2
    PLACE/bin/python -m benchmarks.peer_appo --env-steps 10000
"""

import argparse
import tempfile
import time

# Not installed with this project. Importing ale_py registers its games.
import ale_py  # noqa: F401  # pyright: ignore[reportMissingImports]
from sample_factory.algo.runners.runner import AlgoObserver, Runner  # pyright: ignore[reportMissingImports]
from sample_factory.train import make_runner  # pyright: ignore[reportMissingImports]
from sf_examples.atari.train_atari import (  # pyright: ignore[reportMissingImports]
    parse_atari_args,
    register_atari_components,
)

_WARM_STEPS = 4_000

# 84 x 84 grey, skip 4, stack 4, Nature CNN; 256 rows per update, one pass, 16 environments in two workers.
SETTINGS = {
    "env": "atari_pong",
    "async_rl": True,
    "device": "cpu",
    "num_workers": 2,
    "num_envs_per_worker": 8,
    "worker_num_splits": 2,
    "rollout": 16,
    "batch_size": 256,
    "num_epochs": 1,
    "num_batches_per_epoch": 1,
    "summaries_use_frameskip": False,
    "decorrelate_envs_on_one_worker": False,
    "experiment": "pong",
    "restart_behavior": "overwrite",
    "with_wandb": False,
    "save_every_sec": 10_000,
}


class Watch(AlgoObserver):
    """Observer that records the number of steps after each update."""

    def __init__(self) -> None:
        self.points: list[tuple[float, int]] = []

    def on_training_step(self, runner: Runner, training_iteration_since_resume: int) -> None:
        """Record the time and the steps, after each update."""
        self.points.append((time.monotonic(), sum(runner.env_steps.values())))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--env-steps", type=int, default=20_000)
    parsed = options.parse_args()
    register_atari_components()
    watch = Watch()
    with tempfile.TemporaryDirectory() as folder:
        settings = SETTINGS | {"train_dir": folder, "train_for_env_steps": _WARM_STEPS + parsed.env_steps}
        config = parse_atari_args([f"--{name}={value}" for name, value in settings.items()])
        _, runner = make_runner(config)
        runner.register_observer(watch)
        runner.init()
        runner.run()
    warm = next(point for point in watch.points if point[1] >= _WARM_STEPS)
    last = watch.points[-1]
    print((last[1] - warm[1]) / (last[0] - warm[0]))


if __name__ == "__main__":
    main()
