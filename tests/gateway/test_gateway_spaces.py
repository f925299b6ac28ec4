"""Clients with composite spaces and masks: what the policy sees and what the rollouts hold, compared with a Client."""

import json
import math
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gateways import JsonClient, RunningGateway
from gymnasium import spaces as gym
from scripted_learner import SPACES, Policy, ScriptedLearner

from daedalus.actor.environments.transforms import Transforms
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.client_spaces import ClientSpaces
from daedalus.protocol.messages import Join
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.memory import MemoryNetwork

STATED: dict[str, Any] = {
    "observations": {
        "camera.image": {"kind": "array", "shape": [2, 3], "dtype": "uint8"},
        "sensors.level": {"kind": "array", "shape": [2], "dtype": "float32"},
        "sensors.code": {"kind": "discrete", "counts": [3, 2]},
        "mode": {"kind": "discrete", "counts": [4]},
    },
    "actions": {
        "gear": {"kind": "discrete", "counts": [4], "masked": True},
        "lights": {"kind": "discrete", "counts": [2, 2]},
        "arm.push": {"kind": "continuous", "low": [-2.0, 0.0], "high": [2.0, 10.0]},
        "arm.free": {"kind": "continuous", "low": [None], "high": [None]},
    },
}
OBSERVATION = {
    "camera.image": [[1, 2, 3], [4, 5, 255]],
    "sensors.level": [0.5, -1.5],
    "sensors.code": [2, 1],
    "mode": 3,
}
MASK = {"gear": [True, False, False, True]}
SAME = (
    gym.Dict(
        camera=gym.Dict(image=gym.Box(0, 255, (2, 3), np.uint8)),
        sensors=gym.Dict(level=gym.Box(-np.inf, np.inf, (2,), np.float32), code=gym.MultiDiscrete([3, 2])),
        mode=gym.Discrete(4),
    ),
    gym.Dict(
        gear=gym.Discrete(4),
        lights=gym.MultiDiscrete([2, 2]),
        arm=gym.Dict(
            push=gym.Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32)),
            free=gym.Box(-np.inf, np.inf, (1,), np.float32),
        ),
    ),
)


def run_spec(**environment: Any) -> RunSpec:
    return RunSpec.model_validate({"environment": {"id": "Any-v0", **environment}, "collection": {"rollout_length": 4}})


def spaces_of(spec: RunSpec, observations: gymnasium.Space, actions: gymnasium.Space, mask: Any) -> Transforms:
    batch = None if mask is None else {name: np.array(flags)[None] for name, flags in mask.items()}
    return Transforms(spec.environment, observations, actions, batch)


@pytest.fixture
def play(network: MemoryNetwork, gateway: RunningGateway) -> Iterator[Callable[..., tuple[list[Any], Rollout]]]:
    """Function that plays one rollout as a client; return the actions and the rollout."""
    opened: list[Any] = []

    def play_one(spec: RunSpec, transforms: Transforms, stated: dict[str, Any], **act: Any) -> tuple[list, Rollout]:
        policy = Policy.of(PolicySpec(hidden=(8,), memory="gru", memory_units=4), transforms.spaces)
        learner = ScriptedLearner(network, spec, policy=policy)
        opened.append(learner.transport)
        learner.publish(0)
        client = JsonClient(gateway.port)
        opened.append(client)
        welcome = client.hello("c", stated)
        assert welcome["type"] == "welcome", welcome
        actions = []
        for _ in range(5):
            answer = client.act(**act)
            assert answer["type"] == "action", answer
            actions.append(answer["action"])
        return actions, learner.receive()[0]

    yield play_one
    for one in reversed(opened):
        one.close()


def test_composite_spaces_with_masks_and_memory(play: Callable[..., tuple[list[Any], Rollout]]) -> None:
    spec = run_spec()
    transforms = spaces_of(spec, *SAME, MASK)
    actions, rollout = play(spec, transforms, STATED, observation=OBSERVATION, action_mask=MASK)
    for action in actions:
        assert action.keys() == STATED["actions"].keys()
        assert action["gear"] in (0, 3)
        assert len(action["lights"]) == 2
        assert set(action["lights"]) <= {0, 1}
        assert -2.0 <= action["arm.push"][0] <= 2.0
        assert 0.0 <= action["arm.push"][1] <= 10.0
        assert len(action["arm.free"]) == 1
    for name, value in OBSERVATION.items():
        np.testing.assert_array_equal(rollout.frames[name][0, 0].reshape(-1), np.array(value).reshape(-1))
    assert rollout.masks["gear"].all(axis=(0, 1)).tolist() == MASK["gear"]
    assert rollout.actions["gear"][:, 0, 0].tolist() == [action["gear"] for action in actions[:4]]
    pushed = -2.0 + (np.clip(rollout.actions["arm.push"][0, 0, 0], -1, 1) + 1.0) * 2.0
    assert actions[0]["arm.push"][0] == pytest.approx(pushed, abs=1e-5)
    assert rollout.initial_state.shape == (1, 4)


def test_transforms_of_the_run_apply_to_clients(play: Callable[..., tuple[list[Any], Rollout]]) -> None:
    """Stacked frames, and a table of discrete actions over a continuous space."""
    spec = run_spec(frame_stack=3, action_table=[[-1.0], [0.5], [1.0]])
    observations, action = gym.Box(-np.inf, np.inf, (2,), np.float32), gym.Box(-1, 1, (1,), np.float32)
    stated = {
        "observations": {"observation": {"kind": "array", "shape": [2], "dtype": "float32"}},
        "actions": {"action": {"kind": "continuous", "low": [-1.0], "high": [1.0]}},
    }
    actions, rollout = play(spec, spaces_of(spec, observations, action, None), stated, observation=[1.0, 2.0])
    assert {value for (value,) in actions} <= {-1.0, 0.5, 1.0}
    assert rollout.frames["observation"].shape == (3 + 4, 1, 2)


def test_spaces_of_a_client_equal_those_of_an_environment() -> None:
    spec = run_spec()
    client = ClientSpaces(STATED["observations"], STATED["actions"])
    mask = {name: flags[None] for name, flags in (client.example_mask or {}).items()}
    ours = Transforms(spec.environment, client.observation_space, client.action_space, mask)
    assert ours.spaces == spaces_of(spec, *SAME, MASK).spaces


PLAIN = {"kind": "array", "shape": [1], "dtype": "float32"}
CHOICE = {"kind": "discrete", "counts": [2]}


def test_only_an_observation_or_action_of_that_name_is_no_map() -> None:
    """A client whose actions were named `observation` had bare actions, which could not be sent to it."""
    bare = ClientSpaces({"observation": PLAIN}, {"action": CHOICE})
    assert (bare.observation([0.5]), bare.action(np.int64(1))) == (np.array([0.5], np.float32), 1)
    swapped = ClientSpaces({"action": PLAIN}, {"observation": CHOICE})
    assert swapped.observation_space == gym.Dict(action=gym.Box(-np.inf, np.inf, (1,), np.float32))
    assert swapped.action_space == gym.Dict(observation=gym.Discrete(2))
    assert swapped.action_space != bare.action_space
    assert swapped.observation({"action": [0.5]}) == {"action": np.array([0.5], np.float32)}
    assert swapped.action({"observation": np.int64(1)}) == {"observation": 1}
    own = Transforms(run_spec().environment, swapped.observation_space, swapped.action_space, None)
    assert own.spaces == swapped.stated


@pytest.mark.parametrize(
    ("observations", "actions", "text"),
    [
        ({}, {"action": CHOICE}, "observations"),
        ("x", {"action": CHOICE}, "observations"),
        ({"observation": PLAIN}, {"action": {"kind": "discrete", "counts": [10**9]}}, "actions"),
        ({"observation": {**PLAIN, "shape": [1 << 20, 1 << 20]}}, {"action": CHOICE}, "bytes: use at most"),
        ({"observation": {**PLAIN, "dtype": "float64"}}, {"action": CHOICE}, "dtype"),
        ({"observation": {**PLAIN, "frames": 4}}, {"action": CHOICE}, "frames must be 1"),
        ({"a": PLAIN, "a.b": PLAIN}, {"action": CHOICE}, "like names"),
        ({"a.b": PLAIN, "a": PLAIN}, {"action": CHOICE}, "the name of others"),
        ({"observation": PLAIN}, {"action": {"kind": "continuous", "low": [1.0], "high": [0.0]}}, "lower bound"),
        ({"observation": {**CHOICE, "masked": True}}, {"action": CHOICE}, "masked is for actions"),
        ({"<b>": PLAIN}, {"action": CHOICE}, "observations"),
    ],
)
def test_wrong_spaces_are_named(observations: Any, actions: Any, text: str) -> None:
    with pytest.raises(ClientError, match=text) as fault:
        ClientSpaces(observations, actions)
    assert fault.value.code == "misfit"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({**OBSERVATION, "mode": 4}, "mode of the observation is outside its space"),
        ({**OBSERVATION, "mode": 1.5}, "mode of the observation is not an array of integers"),
        ({**OBSERVATION, "camera.image": [[0] * 3, [0, 0, 256]]}, "not from 0 to 255"),
        ({**OBSERVATION, "camera.image": [[0] * 3, [0, 0, -1]]}, "not from 0 to 255"),
        ({**OBSERVATION, "camera.image": b"12345"}, "has 5 bytes"),
        ({**OBSERVATION, "mode": -1}, "mode of the observation is outside its space"),
        ({**OBSERVATION, "mode": 10**400}, "mode of the observation is outside its space"),
        ({**OBSERVATION, "mode": "1"}, "mode of the observation is not an array of integers"),
        ({**OBSERVATION, "camera.image": [[0.0] * 3] * 2}, "not an array of integers"),
        ({**OBSERVATION, "camera.image": [[0, 0], [0], [0, 0, 0]]}, "not an array of integers"),
        ({**OBSERVATION, "camera.image": [[0] * 3, b"123"]}, "not an array of integers"),
        ({**OBSERVATION, "camera.image": [[0] * 3]}, "has 3 values, but its space is"),
        ({**OBSERVATION, "sensors.level": ["1.5", "2"]}, "not an array of numbers"),
        ({**OBSERVATION, "sensors.level": [1.5, b"2"]}, "not an array of numbers"),
        ({**OBSERVATION, "sensors.level": [1.5, None]}, "not an array of numbers"),
        ({**OBSERVATION, "sensors.level": {"0": 1, "1": 2}}, "not an array of numbers"),
        ({**OBSERVATION, "sensors.level": []}, "has 0 values, but its space is"),
        ({**OBSERVATION, "sensors.level": [[], []]}, "has 0 values, but its space is"),
        ({**OBSERVATION, "sensors.level": [10**400, 0]}, "beyond"),
        ({**OBSERVATION, "sensors.level": [1e16, 0]}, "beyond"),
        ({**OBSERVATION, "sensors.level": [1e300, 0]}, "beyond"),
        ({**OBSERVATION, "sensors.level": [float("nan"), 0]}, "not finite"),
        ({**OBSERVATION, "sensors.level": [-(2**63), 0]}, "beyond"),
        ({**OBSERVATION, "camera.image": [[1, 2], [3, 4], [5, 6]]}, r"has the shape \(3, 2\), but its space is"),
        ({**OBSERVATION, "more": 1}, "must be a map with"),
        ([1, 2], "must be a map with"),
    ],
)
def test_wrong_observations_are_named(value: Any, text: str) -> None:
    spaces = ClientSpaces(STATED["observations"], STATED["actions"])
    with pytest.raises(ClientError, match=text):
        spaces.observation(value)


@pytest.mark.parametrize(
    "image", [[1, 2, 3, 4, 5, 255], [[[1, 2, 3]], [[4, 5, 255]]], [[[[1]], [[2]], [[3]], [[4]], [[5]], [[255]]]]]
)
def test_observation_may_be_flat_or_nested_row_by_row(image: Any) -> None:
    spaces = ClientSpaces(STATED["observations"], STATED["actions"])
    observed = spaces.observation({**OBSERVATION, "camera.image": image, "mode": [[True]]})
    assert observed["camera"]["image"].tolist() == [[1, 2, 3], [4, 5, 255]]
    assert observed["mode"] == 1


@pytest.mark.parametrize("is_override", [False, True])
def test_long_text_among_numbers_takes_no_memory(is_override: bool) -> None:
    """numpy.asarray would allocate the size of the longest text for each element."""
    size = 2000
    value = ["x" * size, *[0] * (size - 1)]
    observations = {"observation": {"kind": "array", "shape": [size], "dtype": "float32"}}
    actions = {"action": {"kind": "continuous", "low": [-1.0] * size, "high": [1.0] * size}}
    spaces = ClientSpaces(observations, actions)
    tracemalloc.start()
    try:
        with pytest.raises(ClientError, match="numbers"):
            (spaces.checked_action if is_override else spaces.observation)(value)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize(
    ("mask", "text"),
    [
        (None, "act lacks the action_mask"),
        ({"gear": [1, 0]}, "a list of 4 flags"),
        ({"gear": [0, 0, 0, 0]}, "forbids every choice"),
        ({"lights": [1, 1, 1, 1]}, "must be a map with gear"),
        ({"gear": [2.5, 0, 0, 0]}, "a list of 4 flags"),
        ({"gear": [3, 1, 0, 2]}, "has the value [23]: write true or 1 for each legal choice"),
    ],
)
def test_wrong_masks_are_named(mask: Any, text: str) -> None:
    with pytest.raises(ClientError, match=text):
        ClientSpaces(STATED["observations"], STATED["actions"]).action_mask(mask)


@pytest.mark.parametrize(("dtype", "shape"), [("float32", [4096, 4096]), ("uint8", [4096, 4096, 3])])
def test_spaces_that_no_learner_has_accepted_take_no_memory(dtype: str, shape: list[int]) -> None:
    observations = {"observation": {"kind": "array", "shape": shape, "dtype": dtype}}
    environment = run_spec().environment
    tracemalloc.start()
    try:
        spaces = ClientSpaces(observations, {"action": {"kind": "discrete", "counts": [2]}})
        transforms = Transforms(environment, spaces.observation_space, spaces.action_space)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert transforms.spaces.observations == spaces.stated.observations
    assert peak < 1 << 20


def test_largest_legal_message_fits_the_limit() -> None:
    spaces = ClientSpaces(STATED["observations"], STATED["actions"])
    worst = {**OBSERVATION, "sensors.level": [-1.2345678901234567e-300] * 2, "camera.image": [[255] * 3] * 2}
    message = json.dumps({"type": "act", "observation": worst, "action_mask": {"gear": [False] * 4}}, indent=4)
    assert len(message) <= spaces.max_message_bytes < 10_000


PUSH = {"kind": "continuous", "low": [-0.7], "high": [0.1]}  # which float32 does not have


@pytest.mark.parametrize(
    ("action", "value", "learned"),
    [(CHOICE, 1, 1), (CHOICE, [1], 1), (PUSH, 0.1, 1.0), (PUSH, [[-0.7]], -1.0), (PUSH, [float(np.float32(0.1))], 1.0)],
)
def test_override_is_an_action_that_can_be_learned_from(action: Any, value: Any, learned: float) -> None:
    spaces = ClientSpaces({"observation": PLAIN}, {"action": action})
    transforms = Transforms(run_spec().environment, spaces.observation_space, spaces.action_space)
    played = transforms.policy_action(spaces.checked_action(value))
    assert played["action"] == np.array([[learned]], np.float32)


def test_actions_are_within_the_bounds_that_the_client_states() -> None:
    """0.7 is lower in float32, and 1.1 higher."""
    stated = {"kind": "continuous", "low": [0.7, None], "high": [1.1, None]}
    spaces = ClientSpaces({"observation": PLAIN}, {"action": stated})
    assert spaces.action(np.array([0.7, 5.0], np.float32)) == [0.7, 5.0]
    assert spaces.action(np.array([1.1, -5.0], np.float32)) == [1.1, -5.0]


@pytest.mark.parametrize(
    ("action", "value", "text"),
    [
        (CHOICE, True, "must have 1 integers"),
        (CHOICE, 1.0, "must have 1 integers"),
        (CHOICE, [0, 1], "must have 1 integers"),
        (CHOICE, -1, "outside its space"),
        (CHOICE, {"action": 99}, "action of the override is outside its space"),
        (CHOICE, {"more": 1}, "the override must be a map with action"),
        (CHOICE, 10**400, "must have 1 integers"),
        (CHOICE, "1", "must have 1 integers"),
        (CHOICE, [True], "must have 1 integers"),
        (CHOICE, [[1], [1, 2]], "must have 1 integers"),
        ({"kind": "continuous", "low": [-1.0, None], "high": [1.0, None]}, [0.5], "must have 2 numbers"),
        ({"kind": "continuous", "low": [-1.0, None], "high": [1.0, None]}, [0.5, "1"], "must have 2 numbers"),
        ({"kind": "continuous", "low": [-1.0, None], "high": [1.0, None]}, [0.5, 10**400], "must have 2 numbers"),
        ({"kind": "continuous", "low": [-1.0, None], "high": [1.0, None]}, [1.5, 0], "outside its space"),
        ({"kind": "continuous", "low": [-1.0, None], "high": [1.0, None]}, [0.5, math.inf], "outside its space"),
    ],
)
def test_wrong_override_is_named(action: Any, value: Any, text: str) -> None:
    with pytest.raises(ClientError, match=text):
        ClientSpaces({"observation": PLAIN}, {"action": action}).checked_action(value)


@pytest.mark.parametrize("shape", [[16, 1_300_000, 3], [4, 16_000_000], [9000, 16]])
def test_image_that_is_too_large_for_the_transforms_is_refused_at_once(shape: list[int]) -> None:
    stated = {"observation": {"kind": "array", "shape": shape, "dtype": "uint8"}}
    spaces = ClientSpaces(stated, {"action": {"kind": "discrete", "counts": [2]}})
    actor = ClientActor(Join(actor="a", incarnation=1), spaces, None)  # type: ignore[arg-type] - it sends nothing
    tracemalloc.start()
    try:
        with pytest.raises(ClientError, match=r"observation is an image .* at most 8,192 pixels a side"):
            actor.prepare(run_spec(resize=(84, 84)).for_actors())
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_images_of_a_camera_are_not_too_large() -> None:
    stated = {
        "camera": {"kind": "array", "shape": [1080, 1920, 3], "dtype": "uint8"},
        "bytes": {"kind": "array", "shape": [9000, 4], "dtype": "uint8"},  # no image: it is not transformed
        "unseen": {"kind": "array", "shape": [4320, 7680], "dtype": "uint8"},
    }
    spaces = ClientSpaces(stated, {"action": {"kind": "discrete", "counts": [2]}})
    actor = ClientActor(Join(actor="a", incarnation=1), spaces, None)  # type: ignore[arg-type] - it sends nothing
    join, _ = actor.prepare(run_spec(crop=(0, 0, 4, 4), grey=True, resize=(84, 84), leave_out=("unseen",)).for_actors())
    assert join.spaces is not None
    assert {name: space.shape for name, space in join.spaces.observations.items()} == {
        "camera": (84, 84),
        "bytes": (9000, 4),
    }


SPEC = RunSpec.model_validate(
    {
        "environment": {"id": "CartPole-v1"},
        "collection": {"rollout_length": 48},
        "training": {"algorithm": "n_step_q"},
    }
)
EPSILONS = {"careful": 0.0, "curious": 0.5}


def test_each_client_explores_with_its_own_epsilon(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, SPEC, policy=Policy.of(PolicySpec(), SPACES, SPEC.training))
    learner.epsilons = EPSILONS
    learner.publish(0)
    gateway = RunningGateway(network)
    clients = {name: JsonClient(gateway.port) for name in EPSILONS}
    try:
        for name, client in clients.items():
            client.hello(name)
        for step in range(49):
            for client in clients.values():
                client.send("act", observation=[math.sin(step), 0.0, 0.1, 0.0])
            for client in clients.values():
                assert client.receive()["action"] in (0, 1)
        rollouts = {rollout.identity.actor: rollout for rollout, _ in (learner.receive(), learner.receive())}
    finally:
        for client in clients.values():
            client.close()
        gateway.close()
        learner.transport.close()
    assert (rollouts["careful"].behaviour_log_probs == 0.0).all()
    is_random = np.isclose(rollouts["curious"].behaviour_log_probs, math.log(0.25), atol=1e-5)
    is_greedy = np.isclose(rollouts["curious"].behaviour_log_probs, math.log(0.75), atol=1e-5)
    assert (is_random | is_greedy).all()
    assert 0 < is_random.mean() < 0.6


def test_numbers_of_a_client_that_float32_rounds_are_a_warning(
    play: Callable[..., tuple[list[Any], Rollout]], caplog: pytest.LogCaptureFixture
) -> None:
    spec = run_spec()
    transforms = spaces_of(spec, *SAME, MASK)
    observation = {**OBSERVATION, "sensors.level": [0.5, 1764449001]}
    play(spec, transforms, STATED, observation=observation, action_mask=MASK)
    (warning,) = (record.getMessage() for record in caplog.records if "float32" in record.getMessage())
    assert warning.startswith("client c: observation component 'sensors.level' has the value 1,764,449,001, which beco")
