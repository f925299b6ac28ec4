"""The player whose loop is somebody else's, against the collector that steps the same environment itself."""

import copy
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import pytest
from processes import LIMIT, until

from daedalus.actor.collecting.client_collector import _HELD_ROLLOUTS, ClientPlayer
from daedalus.actor.collecting.environment_collector import Collector
from daedalus.actor.environments.make import make_environments
from daedalus.actor.session.learner_queries import ActorError
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spec import RunSpec

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)
ROWS = 5


def run_spec(**environment: Any) -> RunSpec:
    settings = {"id": "counting_environment:Counting-v0", **environment}
    return RunSpec.model_validate({"environment": settings, "collection": {"rollout_length": ROWS}})


class Played:
    """A policy with a memory for an environment, and weights of several versions."""

    def __init__(self, spec: RunSpec) -> None:
        self.spec = spec
        environments = make_environments(spec.environment, 1)
        self.spaces = environments.spaces
        environments.close()
        policy = spec.policy.model_copy(update={"memory": "gru", "memory_units": 4, "hidden": (8,)})
        self.network = ActorCritic(policy, self.spaces)
        self.model = export_program(self.network, self.spaces.observation)

    def runtime(self) -> OnnxRuntime:
        return OnnxRuntime(self.model)

    def snapshot(self, version: int) -> Snapshot:
        weights = {
            name: parameter.detach().numpy() * np.float32(1 + 0.1 * version)
            for name, parameter in self.network.named_parameters()
        }
        return Snapshot(learner_epoch=1, policy_version=version, program="", weights=weights)


def take(player: ClientPlayer, newest: Snapshot) -> Rollout:
    """A rollout that is full already."""
    assert player._full
    return player.collect(IDENTITY, lambda ready, seconds: ready(), lambda: newest)


@dataclass
class Robot:
    """An environment, and what it shows now."""

    environment: gymnasium.Env
    observation: np.ndarray


def drive(player: ClientPlayer, robot: Robot, steps: int) -> None:
    """As a user would: in a loop of its own. It goes on where the last call ended."""
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = robot.environment.step(player.act(robot.observation))
        player.reward(float(reward) / 2)
        player.reward(float(reward) / 2)
        if terminated or truncated:
            player.end_episode(observation, terminated=terminated)
            observation, _ = robot.environment.reset()
        robot.observation = observation


def begun(played: Played) -> tuple[ClientPlayer, Robot]:
    environment = gymnasium.make(played.spec.environment.id).unwrapped
    player = ClientPlayer(environment.observation_space, environment.action_space)
    assert player.prepare(played.spec) == (played.spaces, 1)
    player.begin(played.runtime(), played.spec, 3)
    player.load(played.snapshot(0))
    return player, Robot(environment, environment.reset(seed=1)[0])


@pytest.mark.parametrize(
    "environment",
    [{}, {"frame_stack": 3}, {"reward_scale": 0.25, "reward_clip": 1.0}, {"bootstrap_terminations": True}],
    ids=["plain", "stacked", "scaled", "bootstrap_terminations"],
)
def test_its_rollouts_are_those_of_the_collector(environment: dict[str, Any]) -> None:
    played = Played(run_spec(**environment))
    player, own = begun(played)
    environments = make_environments(played.spec.environment, 1)
    collector = Collector(environments, played.runtime(), played.spec.environment, rollout_length=ROWS, seed=3)
    # Both sample from one source each: what the collector's makes of the seed is given to the player's.
    _, action_seed = np.random.SeedSequence(3).generate_state(2)
    player.begin(played.runtime(), played.spec, int(action_seed))
    player.load(played.snapshot(0))
    found: list[Rollout] = []
    for version in range(8):
        collector.load(played.snapshot(version).weights)
        expected = copy.deepcopy(collector.collect(IDENTITY, version))
        while not player._full:
            drive(player, own, 1)
            if player._version == version:
                player.load(played.snapshot(version + 1))  # while it fills: for the next
        found.append(take(player, played.snapshot(version + 1)))
        for name in Rollout.__dataclass_fields__:
            left, right = getattr(found[-1], name), getattr(expected, name)
            assert np.array_equal(left, right), (version, name, left, right)
    assert sum(len(rollout.episode_returns) for rollout in found) > 5
    environments.close()


def test_rollouts_that_nobody_takes_give_way_to_newer_ones() -> None:
    player, own = begun(Played(run_spec()))
    drive(player, own, 200)
    assert len(player._full) == _HELD_ROLLOUTS
    assert player.dropped > 0


def test_another_learners_policy_is_played_from_the_next_step_on() -> None:
    played = Played(run_spec())
    player, own = begun(played)
    drive(player, own, 3)
    player.begin(played.runtime(), played.spec, 4)
    drive(player, own, 40)  # its weights have not come: the former policy acts, and nothing is kept of that
    assert not player._full
    player.load(played.snapshot(7))
    drive(player, own, 2 * ROWS)
    assert take(player, played.snapshot(7)).policy_version == 7


def test_who_waits_for_a_rollout_sees_newer_weights_meanwhile() -> None:
    played = Played(run_spec())
    player, own = begun(played)

    def newest() -> Snapshot:
        return played.snapshot(1)

    def wait(ready: Callable[[], bool], seconds: float) -> bool:
        time.sleep(0.01)
        return ready()

    found: list[Rollout] = []
    thread = threading.Thread(target=lambda: found.append(player.collect(IDENTITY, wait, newest)), daemon=True)
    thread.start()
    until(lambda: player._weights is not None and player._weights.policy_version == 1)
    drive(player, own, ROWS + 1)
    thread.join(LIMIT)
    assert found[0].policy_version == 1


def test_mistakes_are_told_and_change_nothing() -> None:
    player, own = begun(Played(run_spec()))
    with pytest.raises(ValueError, match="before any action"):
        player.reward(1.0)
    with pytest.raises(ValueError, match="without any action"):
        player.end_episode(None, terminated=True)
    player.act(own.observation)
    with pytest.raises(ValueError, match="must be finite"):
        player.reward(float("nan"))
    with pytest.raises(ValueError, match="give its last observation"):
        player.end_episode(None, terminated=False)
    with pytest.raises(ValueError, match="the observation has shape"):
        player.act(np.zeros(99, np.float32))
    player.reward(1.0)
    player.end_episode(None, terminated=True)
    drive(player, own, ROWS)
    rollout = take(player, Played(run_spec()).snapshot(0))
    assert rollout.terminated[0, 0]
    assert rollout.episode_returns[0] == 1.0


def test_a_run_that_waits_for_each_update_is_refused() -> None:
    spec = run_spec().model_copy(update={"training": run_spec().training.model_copy(update={"algorithm": "a2c"})})
    environment = gymnasium.make(spec.environment.id)
    with pytest.raises(ActorError, match="a client cannot: use another algorithm"):
        ClientPlayer(environment.observation_space, environment.action_space).prepare(spec)
