"""Client with nested spaces and masks: what its rollouts hold, and the errors of calls that do not fit the spaces."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from nested_environment import NestedEnvironment
from scripted_learner import Policy, ScriptedLearner, acknowledge

from daedalus.actor import Client
from daedalus.actor import client as client_module
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.transforms import Transforms
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

ROWS = 4
SPEC = RunSpec.model_validate({"environment": {"id": "Nested-v0"}, "collection": {"rollout_length": ROWS, "window": 1}})
MASK = {"0": np.array([1, 1, 0, 1], np.int8)}
Space = gymnasium.Space
Connect = Callable[..., tuple[Client, ScriptedLearner]]


@pytest.fixture
def connect(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> Iterator[Connect]:
    """Function that returns a client and its learner, which has a policy for the client's spaces."""
    monkeypatch.setattr(client_module, "connect_with_retry", lambda *_: MemoryTransport(network))
    opened: list[Any] = []

    def connect_one(
        mask: Any = None,
        observation_space: Space = NestedEnvironment.observation_space,
        action_space: Space = NestedEnvironment.action_space,
    ) -> tuple[Client, ScriptedLearner]:
        batch = None if mask is None else {name: values[None] for name, values in mask.items()}
        spaces = Transforms(SPEC.environment, observation_space, action_space, batch).spaces
        learner = ScriptedLearner(network, SPEC, policy=Policy.of(PolicySpec(hidden=(8,)), spaces))
        learner.publish(0)
        opened.append(learner.transport)
        client = Client("tcp/a:1", observation_space=observation_space, action_space=action_space, action_mask=mask)
        opened.append(client)
        return client, learner

    yield connect_one
    for one in reversed(opened):
        one.close()


def received(learner: ScriptedLearner) -> Rollout:
    rollout, request = learner.receive()
    acknowledge(request, "accepted")
    return rollout


def observe(rollout: Rollout, row: int) -> dict[str, Any]:
    """Return the nested observation of a row."""
    frames = {name: values[row, 0] for name, values in rollout.frames.items()}
    sensors = {"level": frames["sensors.level"], "code": frames["sensors.code"][0] + 2}
    return {"camera": {"image": frames["camera.image"]}, "sensors": sensors}


def assert_equal_observations(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        if isinstance(value, dict):
            assert_equal_observations(value, theirs[name])
        else:
            np.testing.assert_array_equal(value, theirs[name])


def test_rollouts_hold_the_components_of_what_the_loop_saw_and_did(connect: Connect) -> None:
    """Two episodes of 6 and 8 rows: the row after an episode only resets."""
    robot = NestedEnvironment(masked=True)
    observation, info = robot.reset(seed=3)
    client, learner = connect(info["action_mask"])
    played: list[tuple[dict, dict, Any, float]] = []  # observation, mask, action and reward; the action of a reset row
    while len(played) < 3 * ROWS:
        action = client.act(observation, info["action_mask"])
        assert robot.action_space.contains(action)
        seen, mask = copy.deepcopy(observation), copy.deepcopy(info["action_mask"])
        following, reward, *_, following_info = robot.step(action)  # raises for an illegal action
        client.reward(reward)
        played.append((seen, mask, action, reward))
        observation["camera"]["image"][:] = info["action_mask"]["0"][:] = 0  # the loop may reuse its arrays
        if len(played) == 6:
            client.end_episode(terminated=False, observation=following)
            played.append((following, {"0": np.ones(4)}, None, 0.0))
            following, following_info = robot.reset()
        observation, info = following, following_info
    client.act(observation, info["action_mask"])
    for start in range(0, 3 * ROWS, ROWS):
        rollout = received(learner)
        for row, (seen, mask, action, reward) in enumerate(played[start : start + ROWS]):
            assert_equal_observations(observe(rollout, row), seen)
            assert rollout.rewards[row, 0] == np.float32(reward)
            assert rollout.valid[row, 0] == (action is not None)
            assert rollout.truncated[row, 0] == (start + row == 5)
            if action is None:
                assert rollout.masks["0"][row, 0].any()
                continue
            np.testing.assert_array_equal(rollout.masks["0"][row, 0], mask["0"])
            place, height, bits = (rollout.actions[name][row, 0] for name in ("0", "1", "2"))
            assert mask["0"][place[0]]
            np.testing.assert_array_equal(place, [action[0]])
            np.testing.assert_allclose(np.clip(height, -1.0, 1.0) + 1.0, action[1], atol=1e-6)  # from 0 to 2
            np.testing.assert_array_equal(bits, action[2])


def test_masks_narrow_the_choices_to_the_legal_ones(connect: Connect) -> None:
    client, _ = connect(MASK)
    observation, _ = NestedEnvironment().reset(seed=1)
    for legal in (0, 3, 1, 2) * 3:
        place, *_ = client.act(observation, {"0": np.arange(4) == legal})
        assert place == legal


@pytest.mark.parametrize(
    ("example", "given", "message"),
    [
        (MASK, None, "constructed with an action_mask: pass one to every act()"),
        (None, MASK, "constructed without an action_mask: construct it with an example of one"),
        (MASK, {"0": np.zeros(4)}, "the action_mask of '0' forbids every choice of variable 0"),
        (MASK, {"0": np.ones(3)}, "the action_mask of '0' has shape (3,), but the action has 4 choices"),
        (MASK, {"1": np.ones(4)}, "the action_mask names '1', which is no discrete component of the action"),
        (MASK, {}, "the action_mask has no entry for '0'"),
        (
            MASK,
            np.ones(4),
            "the action_mask has shape (4,), but the discrete components of the action have 4 + 4 choices",
        ),
    ],
)
def test_a_mask_that_does_not_fit_is_refused_and_changes_nothing(
    connect: Connect, example: Any, given: Any, message: str
) -> None:
    client, learner = connect(example)
    observation, _ = NestedEnvironment().reset(seed=1)
    for _ in range(ROWS):
        client.act(observation, example)
        with pytest.raises(ValueError) as error:  # noqa: PT011 - the message is compared below
            client.act(observation, given)
        assert message in str(error.value)
        client.reward(1.0)
    client.act(observation, example)
    assert received(learner).rewards[:, 0].tolist() == [1.0] * ROWS


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("camera", {}, "the observation['camera'] lacks 'image': its space has image"),
        ("sensors", {"level": np.zeros(1)}, "the observation['sensors'] lacks 'code'"),
        ("sensors", {"level": np.zeros(2), "code": 2}, "the observation['sensors']['level'] has shape (2,), but its"),
        ("sensors", {"level": np.zeros(1), "code": 1}, "the observation['sensors']['code'] is 1, which is outside"),
        ("sensors", {"level": np.full(1, np.nan), "code": 2}, "['level'] has a value that is not finite"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused_with_its_part(
    connect: Connect, part: str, value: Any, message: str
) -> None:
    client, _ = connect()
    observation, _ = NestedEnvironment().reset(seed=1)
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the message is compared below
        client.act({**observation, part: value})
    assert message in str(error.value)
    client.act(observation)


def test_an_example_mask_that_does_not_fit_the_action_ends_the_constructor(connect: Connect) -> None:
    connect(MASK)
    with pytest.raises(EnvironmentSetupError, match=r"the action_mask of '0' has shape \(5,\), but the action has 4"):
        Client(
            "tcp/a:1",
            observation_space=NestedEnvironment.observation_space,
            action_space=NestedEnvironment.action_space,
            action_mask={"0": np.ones(5)},
        )


def test_a_mask_in_the_observation_needs_no_other(connect: Connect) -> None:
    """PettingZoo's convention: the policy does not observe the component `action_mask`."""
    observation_space = gymnasium.spaces.Dict(
        {"seen": gymnasium.spaces.Box(-1, 1, (2,)), "action_mask": gymnasium.spaces.Box(0, 1, (3,), np.int8)}
    )
    client, learner = connect(None, observation_space, gymnasium.spaces.Discrete(3, start=5))
    for legal in (0, 2, 1, 0, 2):
        mask = (np.arange(3) == legal).astype(np.int8)
        assert client.act({"seen": np.zeros(2, np.float32), "action_mask": mask}) == 5 + legal
    rollout = received(learner)
    assert rollout.frames.keys() == {"seen"}
    assert rollout.masks["action"][:, 0].argmax(1).tolist() == [0, 2, 1, 0]
    assert rollout.actions["action"][:, 0, 0].tolist() == [0, 2, 1, 0]
