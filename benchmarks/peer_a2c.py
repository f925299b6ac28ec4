"""The peer: stable-baselines3's A2C on CartPole-v1, its own defaults, eight environments. Prints env_steps/s.

pip install "daedalus-rl[benchmark]"
python benchmarks/peer_a2c.py --env-steps 100000
"""

import argparse
import time

from stable_baselines3 import A2C  # pyright: ignore[reportMissingImports] - an extra, for this file only
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore[reportMissingImports]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--env-steps", type=int, default=100_000)
    parsed = options.parse_args()
    model = A2C("MlpPolicy", make_vec_env("CartPole-v1", n_envs=8), device="cpu", seed=1)
    model.learn(2_000)  # what is made once is not counted
    began = time.monotonic()
    model.learn(parsed.env_steps)
    print(parsed.env_steps / (time.monotonic() - began))


if __name__ == "__main__":
    main()
