"""Train from a loop that the caller owns: `python examples/own_loop.py tcp/127.0.0.1:7447`.

Start the learner in another terminal, on any machine:
    daedalus learner cartpole --actors 1 --set collection.rollout_length=64 --set training.batch_rollouts=4

CartPole stands for a robot here: the loop calls the policy, instead of the actor stepping the environment.
"""

import argparse
import logging

import gymnasium

from daedalus import Client


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("address", nargs="?", default="tcp/127.0.0.1:7447", help="default: %(default)s")
    options.add_argument("--name", help="name of this actor (default: made of the host name)")
    parsed = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")  # the client logs when it joins and leaves the run
    robot = gymnasium.make("CartPole-v1")
    with Client(
        parsed.address, observation_space=robot.observation_space, action_space=robot.action_space, name=parsed.name
    ) as client:
        episodes = 0
        while not client.is_over:
            observation, _ = robot.reset()
            terminated, truncated, total = False, False, 0.0
            while not (terminated or truncated):
                observation, reward, terminated, truncated, _ = robot.step(client.act(observation))
                client.reward(float(reward))
                total += float(reward)
            client.end_episode(terminated=terminated, observation=observation)
            episodes += 1
            if episodes % 50 == 0:
                print(f"{episodes} episodes, the last returned {total:g}", flush=True)


if __name__ == "__main__":
    main()
