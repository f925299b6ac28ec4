"""Compare a plain A3C whose workers write into shared weights (Hogwild) with ours, on CartPole.

    python -m benchmarks.hogwild
    python -m benchmarks.hogwild --seeds 1 2 3 4 5 --workers 2 --no-daedalus

The plain A3C is that of Mnih et al. (2016), algorithm S3, as most implementations of it are: processes on one machine,
one environment each, parameters and RMSProp's statistics in shared memory, no lock. Solved means that the mean of the
last 100 training episodes is at least 475. The time starts with the command and includes the start of the processes.
"""

import argparse
import statistics
import time
from collections.abc import Sequence
from typing import NamedTuple

import gymnasium
import numpy as np
import torch
import torch.multiprocessing as multiprocessing
from torch import nn

from benchmarks.running import machine, table, train

TARGET, EPISODES, BUDGET = 475.0, 100, 3_000_000  # mean return; episodes in the mean; env_steps of all workers
ROLLOUT_LENGTH, DISCOUNT_FACTOR, REWARD_SCALE = 20, 0.99, 0.05
LEARNING_RATE, ENTROPY_BONUS, MAX_GRADIENT_NORM = 1e-3, 0.001, 0.5
DECAY, EPSILON = 0.99, 1e-5  # of RMSProp


class Network(nn.Module):
    """Policy and value of one observation or several."""

    def __init__(self) -> None:
        super().__init__()
        self.policy = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 2))
        self.value = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))

    def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return logits [..., 2] and values [...] of observations [..., 4]."""
        return self.policy(observations), self.value(observations).squeeze(-1)


class Shared:
    """What all workers write to without a lock, and the record of their episodes, which has one."""

    def __init__(self, seed: int) -> None:
        torch.manual_seed(seed)
        self.network = Network().share_memory()
        self.squares = [torch.zeros_like(weights).share_memory_() for weights in self.network.parameters()]
        self.returns = torch.zeros(EPISODES).share_memory_()
        self.counts = torch.zeros(2, dtype=torch.int64).share_memory_()  # episodes, env_steps
        self.solved = torch.zeros(1, dtype=torch.bool).share_memory_()
        self.lock = multiprocessing.get_context("spawn").Lock()

    @property
    def ended(self) -> bool:
        """Whether the task is solved or the budget is used up."""
        return bool(self.solved) or int(self.counts[1]) >= BUDGET

    def record(self, env_steps: int, episode_return: float | None) -> None:
        """Count the env_steps of a rollout, and its episode if it has ended."""
        with self.lock:
            self.counts[1] += env_steps
            if episode_return is None:
                return
            self.returns[self.counts[0] % EPISODES] = episode_return
            self.counts[0] += 1
            if self.counts[0] >= EPISODES and self.returns.mean() >= TARGET:
                self.solved[0] = True

    def apply(self, gradients: Sequence[torch.Tensor], learning_rate: float) -> None:
        """Make one step of RMSProp on the shared weights, while other workers may do the same."""
        with torch.no_grad():
            for weights, square, gradient in zip(self.network.parameters(), self.squares, gradients, strict=True):
                square.mul_(DECAY).addcmul_(gradient, gradient, value=1.0 - DECAY)
                weights.addcdiv_(gradient, square.sqrt().add_(EPSILON), value=-learning_rate)


def work(shared: Shared, seed: int) -> None:
    """Play one environment, and update the shared weights after each rollout."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    environment, own = gymnasium.make("CartPole-v1"), Network()
    observation, _ = environment.reset(seed=seed)
    episode_return = 0.0
    while not shared.ended:
        own.load_state_dict(shared.network.state_dict())
        observations, actions, rewards = [], [], []
        terminated = truncated = False
        while len(rewards) < ROLLOUT_LENGTH and not (terminated or truncated):
            observations.append(observation)
            with torch.no_grad():
                logits = own.policy(torch.from_numpy(observation))
            actions.append(int(torch.distributions.Categorical(logits=logits).sample()))
            observation, reward, terminated, truncated, _ = environment.step(actions[-1])
            rewards.append(REWARD_SCALE * float(reward))
            episode_return += float(reward)
        loss = _loss(own, np.stack([*observations, observation]), actions, rewards, terminated)
        gradients = torch.autograd.grad(loss, list(own.parameters()))
        norm = float(torch.stack([gradient.norm() for gradient in gradients]).norm())
        scale = min(1.0, MAX_GRADIENT_NORM / max(norm, 1e-9))
        share_left = 1.0 - int(shared.counts[1]) / BUDGET
        shared.apply([gradient * scale for gradient in gradients], LEARNING_RATE * max(share_left, 0.0))
        shared.record(len(rewards), episode_return if terminated or truncated else None)
        if terminated or truncated:
            observation, _ = environment.reset()
            episode_return = 0.0
    environment.close()


def _loss(
    network: Network, observations: np.ndarray, actions: Sequence[int], rewards: Sequence[float], terminated: bool
) -> torch.Tensor:
    """Return the loss of a rollout: policy gradient with n-step advantages, value error, entropy bonus.

    Args:
      network: the worker's copy of the weights.
      observations: [T+1, 4]; the last one bootstraps, unless the episode terminated.
      actions, rewards: [T].
      terminated: whether the last action ended the episode for good.
    """
    logits, values = network(torch.from_numpy(observations))
    distribution = torch.distributions.Categorical(logits=logits[:-1])
    following = 0.0 if terminated else float(values[-1].detach())
    targets = torch.zeros(len(rewards))
    for step in reversed(range(len(rewards))):
        following = rewards[step] + DISCOUNT_FACTOR * following
        targets[step] = following
    advantages = targets - values[:-1]
    log_probs = distribution.log_prob(torch.tensor(actions))
    policy_loss = -(log_probs * advantages.detach()).mean()
    return policy_loss + 0.5 * advantages.square().mean() - ENTROPY_BONUS * distribution.entropy().mean()


class Run(NamedTuple):
    """Result of one training."""

    seconds: float | None  # to solved; None if it was not
    env_steps: int
    env_steps_per_second: float


def hogwild(seed: int, workers: int) -> Run:
    """Train with shared weights."""
    began, shared = time.monotonic(), Shared(seed)
    context = multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=work, args=(shared, 1000 * seed + index), daemon=True) for index in range(workers)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    seconds, env_steps = time.monotonic() - began, int(shared.counts[1])
    return Run(seconds if bool(shared.solved) else None, env_steps, env_steps / seconds)


def daedalus(seed: int, workers: int, *options: str) -> Run:
    """Train with `daedalus train cartpole`."""
    summary = train("cartpole", "--seed", seed, "--actors", workers, *options)
    return Run(summary["seconds_to_target"], summary["env_steps"], summary["env_steps_per_second"])


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    options.add_argument("--workers", type=int, default=2)
    options.add_argument("--no-daedalus", action="store_true", help="only the plain A3C")
    parsed = options.parse_args()
    gradients = ("--algorithm", "a3c", "--set", "collection.upload=gradients")
    variants = {"shared weights (1 environment each)": hogwild}
    if not parsed.no_daedalus:
        variants |= {
            "daedalus a3c, gradients": lambda seed, workers: daedalus(seed, workers, *gradients),
            "daedalus a3c, rollouts": lambda seed, workers: daedalus(seed, workers, "--algorithm", "a3c"),
            "daedalus impala": lambda seed, workers: daedalus(seed, workers),
        }
    rows = []
    for name, variant in variants.items():
        runs = [variant(seed, parsed.workers) for seed in parsed.seeds]
        seconds = sorted(run.seconds or float("inf") for run in runs)
        solved = sum(run.seconds is not None for run in runs)
        env_steps = statistics.median(run.env_steps for run in runs)
        rate = statistics.median(run.env_steps_per_second for run in runs)
        median, worst = f"{statistics.median(seconds):.1f}", f"{seconds[-1]:.1f}"
        rows.append((name, f"{solved} of {len(runs)}", median, worst, f"{env_steps:,.0f}", f"{rate:,.0f}"))
        print(rows[-1], flush=True)
    print(machine())
    print(table(("", "solved", "seconds, median", "worst", "env_steps, median", "env_steps/s"), rows))


if __name__ == "__main__":
    main()
