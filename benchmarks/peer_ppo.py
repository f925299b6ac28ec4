"""Train PPO of stable-baselines3 with all its defaults and 8 environments in one process, and print the result as JSON.

    pip install -e ".[benchmark]"
    python -m benchmarks.peer_ppo --env LunarLander-v3 --env-steps 500000 --seed 11

It has MultiInputPolicy for Dict observations, CnnPolicy for images, else MlpPolicy. It refuses texts in observations
and images as small as those of MiniGrid: there it gets the numbers as one array. The score is the mean return of the
last 100 training episodes.
"""

import argparse
import importlib
import json
import statistics
import time

import gymnasium
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore[reportMissingImports]

_ENVIRONMENTS, _EPISODES = 8, 100
_SMALLEST_IMAGE = 36  # pixels of the shorter side that its CnnPolicy takes


class Returns(BaseCallback):
    """Collects the returns of all episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        self.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return True


def policy_for(space: gymnasium.Space) -> str:
    """Return the name of the policy for observations of a space."""
    if isinstance(space, gymnasium.spaces.Dict):
        return "MultiInputPolicy"
    shape = space.shape or ()
    return "CnnPolicy" if len(shape) == 3 and min(shape[:2]) >= _SMALLEST_IMAGE else "MlpPolicy"


def accepted(environment: gymnasium.Env) -> gymnasium.Env:
    """Return the environment with observations that the peer accepts: a Dict with texts becomes one flat array."""
    space = environment.observation_space
    if not isinstance(space, gymnasium.spaces.Dict):
        return environment
    kept = [name for name, component in space.items() if component.shape is not None]
    if len(kept) == len(space):
        return environment
    return gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FilterObservation(environment, kept))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--env", required=True)
    options.add_argument("--env-steps", type=int, required=True)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--kwargs", type=json.loads, default={}, help="of gymnasium.make, as JSON")
    parsed = options.parse_args()
    module, _, name = parsed.env.rpartition(":")
    if module or name.startswith("ALE/"):
        importlib.import_module(module or "ale_py")  # registers its environments
    environments = make_vec_env(
        name, n_envs=_ENVIRONMENTS, seed=parsed.seed, env_kwargs=parsed.kwargs, wrapper_class=accepted
    )
    model = PPO(policy_for(environments.observation_space), environments, seed=parsed.seed, device="cpu")
    returns = Returns()
    began = time.monotonic()
    model.learn(parsed.env_steps, callback=returns)
    seconds = time.monotonic() - began
    score = statistics.fmean(returns.returns[-_EPISODES:]) if returns.returns else None
    print(json.dumps({"score": score, "seconds": seconds, "env_steps": model.num_timesteps}))


if __name__ == "__main__":
    main()
