"""Nested spaces as maps of components, and back: what the policy sees, and what the environment receives."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces as gym
from hypothesis import given, settings
from hypothesis import strategies as st

from daedalus.actor.environments.components import ActionComponents, batch_of_one, observation_components
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.transforms import Transforms
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace
from daedalus.protocol.spec import EnvironmentSpec

SPEC = EnvironmentSpec(id="Any-v0")
OBSERVATION = gym.Dict(
    {
        "arm": gym.Dict({"camera": gym.Box(0, 255, (20, 30, 3), np.uint8), "joints": gym.Box(-1, 1, (3,), np.float64)}),
        "inventory": gym.Tuple((gym.Discrete(3, start=-1), gym.MultiBinary(2))),
    }
)
ACTION = gym.Dict(
    {
        "grip": gym.Discrete(3, start=1),
        "move": gym.Tuple(
            (
                gym.Box(np.array([-2, 0], np.float32), np.array([2, np.inf], np.float32)),
                gym.MultiDiscrete(np.array([[2, 3]])),
            )
        ),
    }
)


def test_components_are_named_by_the_keys_and_indices_that_lead_to_them() -> None:
    spaces = Transforms(SPEC, OBSERVATION, ACTION).spaces
    assert spaces.observations == {
        "arm.camera": ArraySpace(shape=(20, 30, 3), dtype="uint8"),
        "arm.joints": ArraySpace(shape=(3,), dtype="float32"),
        "inventory.0": DiscreteSpace(counts=(3,)),
        "inventory.1": ArraySpace(shape=(2,), dtype="float32"),
    }
    assert spaces.actions == {
        "grip": DiscreteSpace(counts=(3,)),
        "move.0": ContinuousSpace(low=(-2.0, 0.0), high=(2.0, None)),
        "move.1": DiscreteSpace(counts=(2, 3)),
    }


@pytest.mark.parametrize(
    ("key", "name"),
    [("walker/joints pos", "walker_joints_pos"), ("", "_"), ("arm " * 20 + "left", "arm_" * 15 + "left")],
)
def test_any_key_makes_a_name(key: str, name: str) -> None:
    assert set(Transforms(SPEC, gym.Dict({key: gym.Box(0, 1)}), gym.Discrete(2)).spaces.observations) == {name}
    long = gym.Dict({"robot" * 10: gym.Dict({key: gym.Box(0, 1)})})
    assert set(Transforms(SPEC, long, gym.Discrete(2)).spaces.observations) == {f"{'robot' * 10}.{name}"[-64:]}


def test_keys_that_would_make_the_same_name_are_numbered() -> None:
    """Keys of letters outside ASCII are all underscores, and long keys are cut."""
    first, second = "a" * 70, "b" + "a" * 69
    parts = {"位置": 1, "速度": 2, "___2": 3, first: 4, second: 5}
    space = gym.Dict({key: gym.Box(0, 1, (size,)) for key, size in parts.items()})
    transforms = Transforms(SPEC, space, gym.Dict({"a b": gym.Discrete(2), "a_b": gym.Discrete(3)}))
    shapes = {name: array.shape[0] for name, array in transforms.spaces.observations.items()}
    assert shapes == {"___2": 3, "a" * 64: 4, "a" * 62 + "_2": 5, "__": 1, "___3": 2}
    value = {key: np.full(size, 0.5, np.float32) for key, size in parts.items()}
    frames = transforms.observe_one(value, None).frames
    assert {name: len(frame[0]) for name, frame in frames.items()} == shapes
    assert list(transforms.spaces.actions) == ["a_b", "a_b_2"]
    assert transforms.env_action({"a_b": np.array([[1]]), "a_b_2": np.array([[2]])}) == {"a b": 1, "a_b": 2}


def test_spaces_that_are_not_composite_have_one_component() -> None:
    spaces = Transforms(SPEC, gym.Discrete(5), gym.MultiBinary((2, 2))).spaces
    assert spaces.observations == {"observation": DiscreteSpace(counts=(5,))}
    assert spaces.actions == {"action": DiscreteSpace(counts=(2, 2, 2, 2))}


def test_observation_is_split_and_discrete_values_count_from_zero() -> None:
    transforms = Transforms(SPEC, OBSERVATION, ACTION)
    camera = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
    given_value = {
        "arm": {"camera": camera, "joints": np.array([0.5, -0.25, 1.0])},
        "inventory": (np.int64(1), np.array([0, 1], np.int8)),
    }
    frames = transforms.observe_one(given_value, None).frames
    np.testing.assert_array_equal(frames["arm.camera"], camera[None])
    assert frames["arm.joints"].dtype == np.float32
    assert {name: frames[name].tolist() for name in ("arm.joints", "inventory.0", "inventory.1")} == {
        "arm.joints": [[0.5, -0.25, 1.0]],
        "inventory.0": [[2]],
        "inventory.1": [[0.0, 1.0]],
    }


def test_action_has_the_form_of_its_space_and_its_bounds() -> None:
    """By hand: -1 to 1 is -2 to 2; an action with one bound is clipped, not scaled."""
    values = {
        "grip": np.array([[2]]),
        "move.0": np.array([[0.5, -3.0]], np.float32),
        "move.1": np.array([[1, 2]]),
    }
    action = Transforms(SPEC, OBSERVATION, ACTION).env_action(values)
    assert action["grip"] == 3
    assert action["move"][0].tolist() == [1.0, 0.0]
    assert action["move"][1].tolist() == [[1, 2]]
    assert ACTION.contains({**action, "grip": np.int64(action["grip"])})


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64])
def test_choice_has_the_dtype_of_its_space(dtype: type) -> None:
    """An environment may check `action_space.contains(action)`, which is false for another dtype."""
    space = gym.Discrete(3, start=4, dtype=dtype)
    actions = ActionComponents(space).env_actions({"action": np.array([[0], [2]])})
    assert actions.tolist() == [4, 6]
    assert all(space.contains(action) for action in actions)


def test_number_with_equal_bounds_is_always_that_number() -> None:
    components = ActionComponents(gym.Box(np.array([-1, 0.3], np.float32), np.array([1, 0.3], np.float32)))
    assert components.spaces == {
        "action": ContinuousSpace(low=(-1.0, float(np.float32(0.3))), high=(1.0, float(np.float32(0.3))))
    }
    actions = components.env_actions({"action": np.array([[0.5, -3.0], [-0.5, 0.7]], np.float32)})
    assert actions.tolist() == [[0.5, np.float32(0.3)], [-0.5, np.float32(0.3)]]


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_whole_numbers_without_a_bound_are_not_scaled_and_stay_in_their_space(dtype: type) -> None:
    """gymnasium writes the largest integer for infinity; float64 rounds that of int64 up to one that overflows."""
    space = gym.Box(0, np.inf, (2,), dtype)
    components = ActionComponents(space)
    assert components.spaces == {"action": ContinuousSpace(low=(0.0, 0.0), high=(None, None))}
    actions = components.env_actions({"action": np.array([[1.2, 1.0], [-3.0, 1e20]], np.float32)})
    assert actions[:, 0].tolist() == [1, 0]
    assert all(action in space for action in actions)
    assert actions[1, 1] > 2**30


leaf_spaces = st.one_of(
    st.integers(1, 5).flatmap(lambda n: st.integers(-3, 3).map(lambda start: gym.Discrete(n, start=start))),
    st.lists(st.integers(1, 4), min_size=1, max_size=3).map(gym.MultiDiscrete),
    st.integers(1, 4).map(gym.MultiBinary),
    st.sampled_from([(1,), (3,), (2, 2)]).flatmap(
        lambda shape: st.sampled_from(
            [gym.Box(-2.0, 5.0, shape), gym.Box(-np.inf, np.inf, shape), gym.Box(-9, 9, shape, np.int64)]
        )
    ),
)
nested_spaces = st.recursive(
    leaf_spaces,
    lambda parts: (
        st.lists(parts, min_size=1, max_size=3).map(lambda found: gym.Tuple(tuple(found)))
        | st.dictionaries(st.sampled_from(["a", "b.c", "d e", "f"]), parts, min_size=1, max_size=3).map(gym.Dict)
    ),
    max_leaves=5,
)


@settings(max_examples=150)
@given(space=nested_spaces, seed=st.integers(0, 2**31))
def test_every_nested_space_is_played(space: gymnasium.Space, seed: int) -> None:
    """Values of observations fit their components, and actions of all components belong to the nested space."""
    space.seed(seed)
    random = np.random.default_rng(seed)
    transforms = Transforms(SPEC, space, space)
    frames = transforms.observe_one(space.sample(), None).frames
    for name, component in transforms.spaces.observations.items():
        assert frames[name].shape == (1, *component.shape)
        if isinstance(component, DiscreteSpace):
            assert (frames[name] >= 0).all()
            assert (frames[name] < component.counts).all()
    values = {
        name: random.integers(0, part.counts, (1, part.size))
        if isinstance(part, DiscreteSpace)
        else random.normal(0, 2, (1, part.size)).astype(np.float32)
        for name, part in transforms.spaces.actions.items()
    }
    assert space.contains(as_contained(space, transforms.env_action(values)))


def as_contained(space: gymnasium.Space, value: Any) -> Any:
    """Return a value with numpy's scalars where `contains` insists on them."""
    if isinstance(space, gym.Dict):
        return {name: as_contained(part, value[name]) for name, part in space.spaces.items()}
    if isinstance(space, gym.Tuple):
        return tuple(as_contained(part, value[index]) for index, part in enumerate(space.spaces))
    return np.int64(value) if isinstance(space, gym.Discrete) else value


@settings(max_examples=50)
@given(space=nested_spaces, seed=st.integers(0, 2**31))
def test_a_vector_environment_accepts_the_actions(space: gymnasium.Space, seed: int) -> None:
    """gymnasium splits batched actions among its environments."""
    random = np.random.default_rng(seed)
    actions = ActionComponents(space)
    values = {
        name: random.integers(0, part.counts, (3, part.size))
        if isinstance(part, DiscreteSpace)
        else random.normal(0, 2, (3, part.size)).astype(np.float32)
        for name, part in actions.spaces.items()
    }
    batched = gymnasium.vector.utils.batch_space(space, 3)
    split = list(gymnasium.vector.utils.iterate(batched, actions.env_actions(values)))
    assert len(split) == 3
    assert all(space.contains(as_contained(space, each)) for each in split)


# ----------------------------------------------------------------------------------------------- refusals

VARIED = gym.Box(np.zeros((30, 9), np.float32), np.float32(np.eye(30, 9) + 1))  # its text has many lines


@pytest.mark.parametrize(
    ("observation", "action", "reason"),
    [
        (gym.Text(3), gym.Discrete(2), r"observation space Text.* is not supported: use Box, Discrete"),
        (gym.Dict({"a": gym.Graph(gym.Box(0, 1), None)}), gym.Discrete(2), r"\(component 'a'\) is not supported"),
        (gym.Box(0, 1), gym.Tuple((gym.Text(3),)), r"action space Text.*\(component '0'\) is not supported"),
        (gym.Box(0, 1, (1, 1, 1, 1, 1)), gym.Discrete(2), "is not supported"),
        (gym.Box(0, 1, (0,)), gym.Discrete(2), "is not supported"),
        (gym.Dict({}), gym.Discrete(2), "is empty"),
        (gym.Box(0, 1), gym.Discrete(70_000), "70,000 choices of one variable: use at most 65,536"),
        (gym.Box(0, 1), gym.MultiDiscrete([40_000, 40_000]), "80,000 choices together"),
        (gym.Box(0, 1), gym.Tuple((VARIED,) * 40), "at most 8,192"),
        (
            gym.Dict({str(n): gym.Box(0, 1) for n in range(65)}),
            gym.Discrete(2),
            r"the observation has 65 comp.*at most 64, or make one array of them: --wrap g.*:FlattenObs",
        ),
        (
            gym.Box(0, 1),
            gym.Dict({str(n): gym.Discrete(2) for n in range(65)}),
            "the action has 65 components: use at most 64$",
        ),
    ],
)
def test_unsupported_space_is_refused_in_one_line(observation: Any, action: Any, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=reason) as caught:
        Transforms(SPEC, observation, action)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ({"a": np.zeros(2)}, r"the observation lacks 'b': its space has a, b"),
        ({"a": np.zeros(3), "b": (np.int64(0),)}, r"the observation\['a'\] has shape \(3,\), but its space has shape"),
        ({"a": np.array([np.nan, 0]), "b": (np.int64(0),)}, r"the observation\['a'\] has a value that is not finite"),
        ({"a": np.zeros(2), "b": ()}, r"the observation\['b'\] must be a tuple of 1 components"),
        ({"a": np.zeros(2), "b": (np.int64(2),)}, r"the observation\['b'\]\[0\] is 2, which is outside Discrete\(2\)"),
        (np.zeros(2), r"the observation lacks 'a'"),
    ],
)
def test_value_that_does_not_fit_is_refused_with_its_component(value: Any, reason: str) -> None:
    space = gym.Dict({"a": gym.Box(-1, 1, (2,)), "b": gym.Tuple((gym.Discrete(2),))})
    with pytest.raises(ValueError, match=reason):
        batch_of_one(space, value)


@pytest.mark.parametrize(
    ("space", "value", "reason"),
    [
        (gym.Box(0, 255, (2,), np.uint8), [0.0, 0.5], r"has the value 0.5, but its space has dtype uint8: pass it as"),
        (gym.Box(0, 255, (2,), np.uint8), np.array([3, 300]), "has the value 300, but its space has dtype uint8"),
        (gym.Discrete(3), 1.7, "has the value 1.7, but its space has dtype int64"),
        (gym.Discrete(3), "1", "has dtype <U1: it must have numbers, of dtype int64"),
        (gym.Box(0, 1, (2,)), np.array([None, 0.5]), "has dtype object: it must have numbers, of dtype float32"),
        (gym.Box(-np.inf, np.inf, (1,), np.float64), [1e300], "has a value that is not finite"),
    ],
)
def test_value_is_refused_that_its_space_would_change(space: gymnasium.Space, value: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        batch_of_one(space, value)


def test_numbers_of_another_dtype_with_the_same_values_are_taken() -> None:
    taken = batch_of_one(gym.Box(0, 255, (2,), np.uint8), [3.0, 255.0])
    assert taken.dtype == np.uint8
    assert taken.tolist() == [[3, 255]]
    assert batch_of_one(gym.Discrete(3), True).tolist() == [1]


def test_discrete_observation_outside_its_space_is_refused() -> None:
    (component,) = observation_components(gym.Discrete(3))
    with pytest.raises(
        EnvironmentSetupError, match=r"an observation outside its space: \[\[0\] \[3\]\] for Discrete\(3\)"
    ):
        component.values(np.array([0, 3]))


def test_binary_observation_that_is_neither_0_nor_1_is_refused_as_from_a_client() -> None:
    (component,) = observation_components(gym.MultiBinary(2))
    assert component.values(np.array([[0, 1]], np.int8)).tolist() == [[0.0, 1.0]]
    for other in (2, -1):
        with pytest.raises(EnvironmentSetupError, match=r"an observation outside its space: .* for MultiBinary\(2\)"):
            component.values(np.array([[0, other]], np.int8))
        with pytest.raises(ValueError, match="which is outside MultiBinary"):
            batch_of_one(gym.MultiBinary(2), np.array([0, other], np.int8))


@pytest.mark.parametrize(
    ("observation", "action", "reason"),
    [
        (gym.Discrete(100_000), gym.Discrete(2), "100,000 choices of one variable: use at most 65,536"),
        (gym.Discrete(2), gym.Discrete(100_000), "100,000 choices of one variable: use at most 65,536"),
        (gym.Box(-1, 1, (0,)), gym.Discrete(2), "use an array with at most 4 axes that is not empty"),
        (gym.Discrete(2), gym.Box(-1, 1, (0,)), "use an array of numbers that is not empty"),
    ],
)
def test_space_that_is_not_supported_is_refused_with_the_limit(
    observation: gymnasium.Space, action: gymnasium.Space, reason: str
) -> None:
    with pytest.raises(EnvironmentSetupError, match=reason):
        Transforms(SPEC, observation, action)


# ------------------------------------------------------------------------------------------------- leave_out


PARTS = gym.Dict(
    {"goal": gym.Tuple((gym.Text(9), gym.Discrete(3))), "empty": gym.Box(-1, 1, (0,)), "arm": gym.Box(-1, 1, (2,))}
)


def test_components_that_are_left_out_are_not_read() -> None:
    spec = EnvironmentSpec(id="Any-v0", leave_out=("goal.0", "empty"))
    transforms = Transforms(spec, PARTS, gym.Discrete(2))
    assert list(transforms.spaces.observations) == ["arm", "goal.1"]
    for observation in (
        {"goal": ("left", np.int64(2)), "empty": np.zeros(0), "arm": np.ones(2)},
        {"goal": (None, np.int64(2)), "arm": np.ones(2)},
    ):
        frames = transforms.observe_one(observation, None).frames
        assert {name: values.tolist() for name, values in frames.items()} == {"arm": [[1.0, 1.0]], "goal.1": [[2]]}


@pytest.mark.parametrize(
    ("leave_out", "reason"),
    [
        ((), r"component 'arm5'\) is not supported: .*with at most 4 axes.*\"environment.leave_out=\['arm5'\]\""),
        (("arm5", "word"), r"leave_out names 'word', but the components of the observation are arm5, text"),
        (("arm5", "text"), "leave_out names every component of the observation: keep one"),
        (("arm5",), r"component 'text'\) is not supported: use Box, .*\"environment.leave_out=\['text'\]\""),
    ],
)
def test_component_that_is_not_supported_can_be_left_out(leave_out: tuple[str, ...], reason: str) -> None:
    space = gym.Dict({"arm5": gym.Box(-1, 1, (2, 1, 1, 1, 1)), "text": gym.Text(9)})
    with pytest.raises(EnvironmentSetupError, match=reason):
        Transforms(EnvironmentSpec(id="Any-v0", leave_out=leave_out), space, gym.Discrete(2))


# --------------------------------------------------------------------------------------------- frame stacks


def depths(frame_stack: Any, **spaces: gymnasium.Space) -> dict[str, int]:
    spec = EnvironmentSpec(id="Any-v0", frame_stack=frame_stack)
    found = Transforms(spec, gym.Dict(spaces), gym.Discrete(2)).spaces
    return {name: space.frames for name, space in found.observations.items()}


def test_frame_stack_is_of_images_or_else_of_arrays_or_of_the_named_ones() -> None:
    image, numbers, choice = gym.Box(0, 255, (20, 20), np.uint8), gym.Box(0, 1, (3,)), gym.Discrete(4)
    assert depths(3, a=image, b=numbers, c=choice) == {"a": 3, "b": 1, "c": 1}
    assert depths(3, b=numbers, c=choice) == {"b": 3, "c": 1}
    assert depths({"b": 5}, a=image, b=numbers) == {"a": 1, "b": 5}
    with pytest.raises(EnvironmentSetupError, match="frame_stack names 'c', but the arrays of the observation are b"):
        depths({"c": 2}, b=numbers, c=choice)
    with pytest.raises(EnvironmentSetupError, match="the observation has no array to stack"):
        depths(2, c=choice)


def test_pixel_transforms_apply_to_all_images_and_to_nothing_else() -> None:
    image, numbers = gym.Box(0, 255, (20, 20, 3), np.uint8), gym.Box(0, 1, (3,))
    spec = EnvironmentSpec(id="Any-v0", grey=True, resize=(10, 16))
    transforms = Transforms(spec, gym.Dict({"a": image, "b": numbers, "c": image}), gym.Discrete(2))
    assert {name: space.shape for name, space in transforms.spaces.observations.items()} == {
        "a": (10, 16),
        "b": (3,),
        "c": (10, 16),
    }
    seen = {"a": np.full((20, 20, 3), 9), "b": np.array([0.5, 0.5, 0.5]), "c": np.full((20, 20, 3), 200)}
    frames = transforms.observe_one(seen, None).frames
    assert (frames["a"] == 9).all()
    assert (frames["c"] == 200).all()
    with pytest.raises(EnvironmentSetupError, match="need an image, but the observation has none"):
        Transforms(spec, gym.Dict({"b": numbers, "d": numbers}), gym.Discrete(2))
