"""Train from one loop with several agents: `python examples/several_agents.py tcp/127.0.0.1:7447`.

Start the learner in another terminal, on any machine:
    daedalus learner cartpole --actors 1 --set collection.rollout_length=64 --set training.batch_rollouts=4

Copies of CartPole stand for a simulator with many robots, or a game with many players. All agents share one connection
and one policy; each has episodes of its own, which begin and end whenever they do.
"""

import argparse
import logging

import gymnasium

from daedalus import Client


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("address", nargs="?", default="tcp/127.0.0.1:7447", help="default: %(default)s")
    options.add_argument("--agents", type=int, default=4, help="number of agents (default: %(default)s)")
    options.add_argument("--name", help="name of this actor (default: made of the host name)")
    parsed = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")  # the client logs when it joins and leaves the run
    robots = [gymnasium.make("CartPole-v1") for _ in range(parsed.agents)]
    observations = [robot.reset()[0] for robot in robots]
    episodes = 0
    with Client(
        parsed.address,
        observation_space=robots[0].observation_space,
        action_space=robots[0].action_space,
        name=parsed.name,
        agents=parsed.agents,
    ) as client:
        while not client.is_over:
            for index, (robot, agent) in enumerate(zip(robots, client.agents, strict=True)):
                observation, reward, terminated, truncated, _ = robot.step(agent.act(observations[index]))
                agent.reward(float(reward))
                if terminated or truncated:
                    agent.end_episode(terminated=terminated, observation=observation)
                    observation, _ = robot.reset()
                    episodes += 1
                    if episodes % 200 == 0:
                        print(f"{episodes} episodes", flush=True)
                observations[index] = observation


if __name__ == "__main__":
    main()
