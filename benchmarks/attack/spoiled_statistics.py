"""Attack: an authorised actor spoils what a run has learned about the size of observations and rewards.

    python -m benchmarks.attack.spoiled_statistics

CartPole with the default settings and two honest actors. Early in the run a third one sends one rollout with
observations of +-9e14, one with rewards of +-1e9, or 700 of the first kind, rejoining when it is quarantined; or, for
half of the run, values a thousand times too large, which no quarantine ends. The policy at the end of the run must have
95 % of the return that it has without an attack. `make attack` does all of it in one run; the command above does each
in a run of its own.

The newest policy plays new episodes with the actions that training samples. The return of training is no measure of it:
the newest 100 episodes began up to 50,000 env_steps ago, during the attack.
"""

import sys
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np

from benchmarks.attack._hostile_actor import HostileActor
from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import Scene, scene
from daedalus.launch.evaluation import evaluate

_ENV_STEPS = 100_000
_BEGIN, _END = 5_000, 50_000  # env_steps of the run, between which it is attacked
_RETURN = 475.0  # 95 % of 500, the largest of CartPole, which six runs without an attack had
_MESSAGES = 700


def spoiled_statistics() -> Verdict:
    """Attack one run in all ways, and return whether it has learned."""
    value = _attacked(everything)
    return Verdict(value >= _RETURN, f"return after all attacks {value:.0f}, at least {_RETURN:g}")


def _attacked(attack: Callable[[HostileActor, Scene], object]) -> float:
    with scene() as here:
        settings = ("--seed", 1, "--env-steps", _ENV_STEPS, "--set", "evaluation.final_episodes=1")
        run = here.start("train", "--env", "CartPole-v1", "--listen", here.address, "--run-dir", "run", *settings)
        here.wait("training", lambda: here.env_steps() > _BEGIN)
        with closing(HostileActor(here.address, "hostile")) as hostile:
            attack(hostile, here)
        here.wait("the end", lambda: run.process.poll() is not None)
        return evaluate(here.folder / "run", newest=True, actions="sampled", episodes=100).return_mean


def _signs(hostile: HostileActor) -> np.ndarray:
    return np.random.default_rng(1).choice([-1.0, 1.0], (hostile.rows + 1, 1, 4)).astype(np.float32)


def _frames(hostile: HostileActor, size: float) -> dict[str, Any]:
    return {"frames": {"observation": size * _signs(hostile)}}


def observations(hostile: HostileActor, here: Scene) -> None:
    """Send one rollout with observations of +-9e14."""
    hostile.send(**_frames(hostile, 9e14))


def rewards(hostile: HostileActor, here: Scene) -> None:
    """Send one rollout with rewards of +-1e9."""
    hostile.send(rewards=1e9 * _signs(hostile)[1:, :, 0])


def flood(hostile: HostileActor, here: Scene) -> None:
    """Send 700 rollouts with observations of +-9e14."""
    for _ in range(_MESSAGES):
        if here.env_steps() >= _ENV_STEPS:
            return
        if hostile.send(**_frames(hostile, 9e14)).verdict == "quarantined":
            hostile.join()


def broken_sensor(hostile: HostileActor, here: Scene) -> None:
    """Send rollouts with observations and rewards of +-1,000 for a while."""
    while here.env_steps() < _END:
        hostile.send(**_frames(hostile, 1e3), rewards=1e3 * _signs(hostile)[1:, :, 0])


def everything(hostile: HostileActor, here: Scene) -> None:
    """Do all of it, one after the other."""
    for attack in (observations, rewards, broken_sensor, flood):
        attack(hostile, here)


if __name__ == "__main__":
    returns = {attack.__name__: _attacked(attack) for attack in (observations, rewards, flood, broken_sensor)}
    print(f"return after each attack, at least {_RETURN:g}: {returns}")
    sys.exit(0 if min(returns.values()) >= _RETURN else 1)
