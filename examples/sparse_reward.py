"""Learn a task whose reward random actions hardly ever reach: `python examples/sparse_reward.py`.

It needs MiniGrid: pip install "daedalus-rl[minigrid]".

In six small rooms, the agent must open every door on the way to the goal, which is the only reward. With the default
settings every return stays 0. training.curiosity adds a reward for each observation that is new in its episode, so that
the agent learns to open doors, until it comes to the goal. The reward falls to 0 over the budget.
"""

import argparse

import daedalus


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--curiosity", type=float, default=1.0, help="weight; 0: none (default: %(default)s)")
    options.add_argument("--env-steps", type=int, default=400_000, help="budget (default: %(default)s)")
    options.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    parsed = options.parse_args()
    settings = {"training.curiosity": parsed.curiosity, "training.target_return": 0.65}
    result = daedalus.train(
        env="MiniGrid-MultiRoom-N4-S5-v0", seed=parsed.seed, env_steps=parsed.env_steps, settings=settings
    )
    print(f"{'solved' if result.solved else 'not solved'}: {result.directory}")


if __name__ == "__main__":
    main()
