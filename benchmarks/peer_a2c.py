"""Peer for comparison: A2C of stable-baselines3 on CartPole-v1 (its defaults, eight environments) or Pong.

Prints env_steps/s.

pip install "daedalus-rl[benchmark]"
python benchmarks/peer_a2c.py --env-steps 100000
python benchmarks/peer_a2c.py --pong --env-steps 10000
"""

import argparse
import time

# The extra `benchmark` installs it.
from stable_baselines3 import A2C  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.env_util import make_atari_env, make_vec_env  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecFrameStack  # pyright: ignore[reportMissingImports]


def cartpole() -> A2C:
    """Return a model with the defaults: eight environments, five steps per update."""
    return A2C("MlpPolicy", make_vec_env("CartPole-v1", n_envs=8), device="cpu", seed=1)


def pong() -> A2C:
    """Return a model for 84 x 84 grey frames, skip 4, stack 4, Nature CNN; 256 rows per update, 16 environments."""
    import ale_py  # pyright: ignore[reportMissingImports]
    import gymnasium

    gymnasium.register_envs(ale_py)
    environments = make_atari_env("PongNoFrameskip-v4", n_envs=16, seed=1)
    return A2C("CnnPolicy", VecFrameStack(environments, n_stack=4), n_steps=16, device="cpu", seed=1)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--env-steps", type=int, default=100_000)
    options.add_argument("--pong", action="store_true")
    parsed = options.parse_args()
    model = pong() if parsed.pong else cartpole()
    model.learn(2_000)  # warm-up, not measured
    began = time.monotonic()
    model.learn(parsed.env_steps)
    print(parsed.env_steps / (time.monotonic() - began))


if __name__ == "__main__":
    main()
