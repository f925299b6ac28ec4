"""Tests of a client with several agents: separate rows, memory and rollouts; in a2c, one rollout of all agents."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from test_client_collector import IDENTITY, ROWS, Played, Robot, run_spec, synchronous, take

from daedalus.actor.collecting.client_collector import ClientAgent, ClientCollector
from daedalus.learner.serving.rollout_judge import episode_violation
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout

AGENTS = 3
ENDS = ((3, -2, 1), (7,), (-4, 2))  # lengths of the episodes of each agent: see Counting


def begun(played: Played) -> tuple[ClientCollector, list[Robot]]:
    environments = [gymnasium.make(played.spec.environment.id, ends=ends).unwrapped for ends in ENDS]
    spaces = environments[0].observation_space, environments[0].action_space
    client = ClientCollector(*spaces, None, agents=AGENTS)
    assert client.prepare(played.spec.for_actors()) == (
        played.spaces,
        AGENTS if played.spec.algorithm.synchronous else 1,
    )
    client.begin(played.runtime(), played.spec.for_actors(), 3)
    client.load(played.snapshot(0))
    return client, [Robot(environment, environment.reset(seed=1)[0]) for environment in environments]


def step(agent: ClientAgent, robot: Robot) -> None:
    observation, reward, terminated, truncated, _ = robot.environment.step(agent.act(robot.observation))
    agent.reward(float(reward))
    if terminated or truncated:
        agent.end_episode(observation=observation, terminated=terminated)
        observation, _ = robot.environment.reset()
    robot.observation = observation


def taken(client: ClientCollector) -> list[Rollout]:
    return [take(client) for _ in iter(client.has_rollout, False)]


def of_agent(rollout: Rollout) -> int:
    """Return the number of the agent that made a rollout, which the lengths of its episodes show."""
    lengths = rollout.episode_lengths.tolist()
    return 1 if 7 in lengths or not lengths else 2 if 4 in lengths else 0


def assert_same(found: Rollout, expected: Rollout) -> None:
    for name in Rollout.__dataclass_fields__:
        np.testing.assert_equal(getattr(found, name), getattr(expected, name), name)


def test_agents_of_a_loop_do_not_disturb_each_other() -> None:
    """The rollouts are equal whether the agents act in turn or one after the other, and each is of one agent."""
    played = Played(run_spec())
    client, robots = begun(played)
    for _ in range(4 * ROWS + 1):
        for agent, robot in zip(client.agents, robots, strict=True):
            step(agent, robot)
    in_turn = taken(client)
    client, robots = begun(played)
    for agent, robot in zip(client.agents, robots, strict=True):
        for _ in range(4 * ROWS + 1):
            step(agent, robot)
    after_each_other = taken(client)
    assert len(in_turn) == len(after_each_other) >= 3 * AGENTS
    order = [index for index in range(AGENTS) for rollout in after_each_other if of_agent(rollout) == index]
    assert set(order) == set(range(AGENTS))
    for rollout in after_each_other:
        assert episode_violation(rollout) == ""
        assert any(_equal(rollout, other) for other in in_turn), "no agent made this rollout when they acted in turn"


def _equal(left: Rollout, right: Rollout) -> bool:
    try:
        assert_same(left, right)
    except AssertionError:
        return False
    return True


def test_agents_sample_different_actions() -> None:
    played = Played(run_spec())
    client, robots = begun(played)
    actions: list[list[int]] = [[int(agent.act(robots[0].observation)) for agent in client.agents] for _ in range(40)]
    columns = set(zip(*actions, strict=True))
    assert len(columns) == AGENTS


def test_synchronous_run_receives_the_rollouts_of_all_agents_as_one() -> None:
    played = synchronous(Played(run_spec()))
    client, robots = begun(played)
    assert client.collect(IDENTITY) is None  # the service asks for a rollout
    for _ in range(2):
        for agent, robot in zip(client.agents[:-1], robots[:-1], strict=True):
            for _ in range(2 * ROWS):
                step(agent, robot)
        assert client.collect(IDENTITY) is None, "the last agent has not acted yet"
    for _ in range(ROWS + 3):
        step(client.agents[-1], robots[-1])
    rollout = take(client)
    assert (rollout.rows, rollout.environments) == (ROWS, AGENTS)
    assert episode_violation(rollout) == ""
    (frames,) = rollout.frames.values()
    assert frames[0, :, 1].tolist() == [0.0] * AGENTS  # the first step of every agent
    lengths = [length for ends in ENDS for length in _finished(ends)]
    assert sorted(rollout.episode_lengths.tolist()) == sorted(lengths)
    client.load(played.snapshot(1))
    assert client.collect(IDENTITY) is None
    for _ in range(2 * ROWS):
        for agent, robot in zip(client.agents, robots, strict=True):
            step(agent, robot)
    second = take(client)
    assert (second.policy_version, second.environments, client.dropped) == (1, AGENTS, 0)
    assert second.initial_state.any(axis=1).all(), "each memory went on between the rollouts"


def _finished(ends: tuple[int, ...]) -> list[int]:
    """Return the lengths of the episodes that end within the first rollout, whose resets are rows too."""
    lengths, rows = [], 0
    for end in ends * ROWS:
        rows += abs(end)
        if rows > ROWS:
            return lengths
        lengths.append(abs(end))
        rows += 1
    return lengths


def test_synchronous_rollout_is_of_one_policy_version() -> None:
    """A learner may go on without this client. The client then drops the rows of the older policy."""
    played = synchronous(Played(run_spec()))
    client, robots = begun(played)
    assert client.collect(IDENTITY) is None
    for _ in range(2 * ROWS):
        step(client.agents[0], robots[0])
    client.load(played.snapshot(1))
    for _ in range(2 * ROWS):
        for agent, robot in zip(client.agents, robots, strict=True):
            step(agent, robot)
    rollout = take(client)
    assert (rollout.policy_version, rollout.environments, client.dropped) == (1, AGENTS, 1)


def test_overridden_rows_of_one_agent_are_marked_in_its_column() -> None:
    played = synchronous(Played(run_spec()))
    client, robots = begun(played)
    assert client.collect(IDENTITY) is None
    for row in range(2 * ROWS):
        for agent, robot in zip(client.agents, robots, strict=True):
            agent.act(robot.observation, override=1 if agent is client.agents[1] and row == 2 else None)
    overridden = take(client).overridden
    assert overridden is not None
    assert np.argwhere(overridden).tolist() == [[2, 1]]
    assert [agent.overridden_actions for agent in client.agents] == [0, 1, 0]


@pytest.mark.parametrize("settings", [{}, {"frame_stack": 3}])
def test_one_agent_of_a_synchronous_run_is_an_actor_with_one_environment(settings: dict[str, Any]) -> None:
    played = synchronous(Played(run_spec(**settings)))
    client, robots = begun(played)
    alone = ClientCollector(robots[0].environment.observation_space, robots[0].environment.action_space, None)
    assert alone.prepare(played.spec.for_actors()) == (played.spaces, 1)
    alone.begin(played.runtime(), played.spec.for_actors(), 3)
    alone.load(played.snapshot(0))
    for each in (client, alone):
        assert each.collect(IDENTITY) is None
    for _ in range(2 * ROWS):
        for agent, robot in zip(client.agents, robots, strict=True):
            step(agent, robot)
    robots = begun(played)[1]
    for _ in range(2 * ROWS):
        step(alone.agents[0], robots[0])
    together, single = take(client), take(alone)
    np.testing.assert_array_equal(together.rewards[:, :1], single.rewards)
    for name, frames in single.frames.items():
        np.testing.assert_array_equal(together.frames[name][:, :1], frames)


def hosting(algorithm: str, *, turns: bool) -> ClientCollector:
    """Return a client with two seats in each of two matches."""
    settings = {"id": "engine", "backend": "pettingzoo", "agent_ids": True}
    spec = RunSpec.model_validate(
        {"training": {"algorithm": algorithm}, "environment": settings, "collection": {"rollout_length": ROWS}}
    )
    spaces = Box(-9.0, 9.0, (1,), np.float32), Discrete(2)
    client = ClientCollector(*spaces, None, agents=4, seats=("left", "right"), turns=turns)
    joined, environments = client.prepare(spec.for_actors())
    assert joined.observations["agent"] == DiscreteSpace(counts=(2,))
    assert environments == (4 if algorithm == "a2c" else 1)
    network = ActorCritic(spec.policy, joined)
    client.begin(OnnxRuntime(export_program(network, joined)), spec.for_actors(), 3)
    weights = {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}
    client.load(Snapshot(learner_epoch=1, policy_version=0, program="", weights=weights))
    assert client.collect(IDENTITY) is None  # the agents may begin
    return client


def act_all(client: ClientCollector) -> None:
    """Let each agent observe its number."""
    for number, agent in enumerate(client.agents):
        agent.act(np.full(1, number, np.float32))


@pytest.mark.parametrize("algorithm", ["impala", "a2c"])
@pytest.mark.parametrize("turns", [True, False], ids=["in turns", "together"])
def test_steps_of_hosted_matches_count_once(turns: bool, algorithm: str) -> None:
    """Rows name the agent, and those of one step are one env_step."""
    client = hosting(algorithm, turns=turns)
    for _ in range(ROWS + 1):
        act_all(client)
    rollouts = taken(client)
    assert [rollout.environments for rollout in rollouts] == ([4] if algorithm == "a2c" else [1] * 4)
    for rollout in rollouts:
        numbers = rollout.frames["observation"][:-1, :, 0]
        assert (rollout.frames["agent"][:-1, :, 0] == numbers % 2).all()
    assert sum(rollout.agent_steps for rollout in rollouts) == 4 * ROWS
    assert sum(rollout.env_steps for rollout in rollouts) == (4 if turns else 2) * ROWS


def test_each_agent_has_its_share_of_the_rollouts_that_are_taken() -> None:
    """The agents fill their rollouts together, faster than the service takes them."""
    client = hosting("impala", turns=True)
    seen: list[int] = []
    while len(seen) < 40:
        for _ in range(ROWS):
            act_all(client)
        if client.dropped:
            seen.append(int(take(client).frames["observation"][0, 0, 0]))
    assert {seen.count(agent) for agent in range(4)} == {10}
