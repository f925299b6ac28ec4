"""Train PPO or SAC of stable-baselines3 with all its defaults in one process, and print the result as JSON.

    pip install -e ".[benchmark]"
    python -m benchmarks.peer --env LunarLander-v3 --env-steps 500000 --seed 11
    python -m benchmarks.peer --env HalfCheetah-v5 --env-steps 100000 --seed 11 --algorithm sac --until 1000

PPO has 8 environments, SAC has one.

Agents of a PettingZoo game that ends for all at once share one policy (parameter sharing): each is an environment of
its own, and env_steps count steps of the game. Observations of pictures are shrunk to 84 x 84 grey pixels.

It has MultiInputPolicy for Dict observations, CnnPolicy for images, else MlpPolicy. It refuses texts in observations
and images as small as those of MiniGrid: there it gets the numbers as one array. The score is the mean return of the
last 100 training episodes. With --until, training ends as soon as the mean of the last 5 is so high.
"""

import argparse
import importlib
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import cv2  # pyright: ignore[reportMissingImports]
import gymnasium
import numpy as np
from stable_baselines3 import PPO, SAC  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv  # pyright: ignore[reportMissingImports]

_ENVIRONMENTS, _EPISODES = {"ppo": 8, "sac": 1}, 100
_NEWEST = 5  # episodes whose mean --until waits for
_SMALLEST_IMAGE = 36  # pixels of the shorter side that its CnnPolicy takes


class Returns(BaseCallback):
    """Collects the returns of all episodes, and ends training once the newest are as high as `until`."""

    def __init__(self, until: float) -> None:
        super().__init__()
        self.returns: list[float] = []
        self._until = until

    def _on_step(self) -> bool:
        self.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return len(self.returns) < _NEWEST or statistics.fmean(self.returns[-_NEWEST:]) < self._until


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


class SharedPolicy(DummyVecEnv):
    """All agents of some copies of a game, as environments of their own."""

    def __init__(self, make: Callable[[], Any], copies: int, seed: int) -> None:
        games = [make() for _ in range(copies)]
        agents = games[0].possible_agents
        space = games[0].observation_space(agents[0])
        self._pictures = len(space.shape) == 3
        if self._pictures:
            space = gymnasium.spaces.Box(0, 255, (84, 84, 1), np.uint8)
        VecEnv.__init__(self, copies * len(agents), space, games[0].action_space(agents[0]))
        self._games, self._agents, self._seed = games, agents, seed
        self._returns = np.zeros(self.num_envs)

    def _seen(self, observations: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        seen = [observations[agent] for agent in self._agents]
        if not self._pictures:
            return seen
        size, area = (84, 84), cv2.INTER_AREA
        return [
            cv2.resize(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), size, interpolation=area)[..., None] for each in seen
        ]

    def reset(self) -> np.ndarray:
        """Begin an episode in each copy."""
        return np.stack(
            [
                seen
                for copy, game in enumerate(self._games)
                for seen in self._seen(game.reset(seed=self._seed + copy)[0])
            ]
        )

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Make a step in each copy; a copy that ends begins its next episode."""
        seen, rewards, dones, infos = [], [], [], []
        rows = self.actions.reshape(len(self._games), len(self._agents), *self.actions.shape[1:])
        for game, actions in zip(self._games, rows, strict=True):
            observations, reward, ended, cut, _ = game.step(dict(zip(self._agents, actions, strict=True)))
            now, done = self._seen(observations), not game.agents
            rewards += [reward[agent] for agent in self._agents]
            dones += [done] * len(self._agents)
            infos += [
                {"terminal_observation": last, "TimeLimit.truncated": cut[agent] and not ended[agent]} if done else {}
                for agent, last in zip(self._agents, now, strict=True)
            ]
            seen += self._seen(game.reset()[0]) if done else now
        self._returns += rewards
        for index in np.flatnonzero(dones):
            infos[index]["episode"] = {"r": self._returns[index], "l": 0, "t": 0}
            self._returns[index] = 0
        return np.stack(seen), np.array(rewards, np.float32), np.array(dones), infos


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--env", required=True)
    options.add_argument("--env-steps", type=int, required=True)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--algorithm", choices=tuple(_ENVIRONMENTS), default="ppo")
    options.add_argument(
        "--until", type=float, default=math.inf, help="mean return of the last 5 episodes; default: none"
    )
    options.add_argument("--kwargs", type=json.loads, default={}, help="of gymnasium.make, as JSON")
    parsed = options.parse_args()
    module, _, name = parsed.env.rpartition(":")
    if module or name.startswith("ALE/"):
        importlib.import_module(module or "ale_py")  # registers its environments
    agents, copies = 1, _ENVIRONMENTS[parsed.algorithm]
    if name.startswith(("pettingzoo.", "mpe2.")):
        game = importlib.import_module(name)
        environments = SharedPolicy(lambda: game.parallel_env(**parsed.kwargs), copies, parsed.seed)
        agents = environments.num_envs // copies
    else:
        environments = make_vec_env(
            name, n_envs=copies, seed=parsed.seed, env_kwargs=parsed.kwargs, wrapper_class=accepted
        )
    trainer = PPO if parsed.algorithm == "ppo" else SAC
    model = trainer(policy_for(environments.observation_space), environments, seed=parsed.seed, device="cpu")
    returns = Returns(parsed.until)
    began = time.monotonic()
    model.learn(agents * parsed.env_steps, callback=returns)
    seconds = time.monotonic() - began
    score = statistics.fmean(returns.returns[-_EPISODES * agents :]) if returns.returns else None
    print(json.dumps({"score": score, "seconds": seconds, "env_steps": model.num_timesteps // agents}))


if __name__ == "__main__":
    main()
