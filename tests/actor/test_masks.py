"""Masks of illegal actions, by each convention that environments have."""

from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from collectors import collect, started_collector
from gymnasium import spaces as gym
from gymnasium.envs.registration import EnvSpec
from plain import PlainPolicy

from daedalus.actor.checking.checker import gymnasium_notes
from daedalus.actor.checking.play import check_environment
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.info import mask_of_one
from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.evaluation.episodes import play_episodes
from daedalus.policy.acting.noise import Noise
from daedalus.policy.acting.runtime import Choice
from daedalus.policy.user_modules import NO_MODULES
from daedalus.protocol.spaces import DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec

SPEC = EnvironmentSpec(id="Any-v0")


class Narrowing(gymnasium.Env):
    """Episodes of three steps. After step t only choice t is legal; the convention is an argument."""

    observation_space = gym.Box(0, 9, (1,), np.float32)
    action_space = gym.Discrete(3)

    def __init__(self, convention: str) -> None:
        self._convention = convention
        self._step = 0
        if convention == "observation":
            self.observation_space = gym.Dict(
                {"seen": gym.Box(0, 9, (1,)), "action_mask": gym.Box(0, 1, (3,), np.int8)}
            )
        if convention == "method":
            self.action_masks = self.mask

    def mask(self) -> np.ndarray:
        return np.arange(3) == self._step % 3

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self._step = 0
        return self._shown()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        assert self.mask()[action] or self._convention.endswith("in reset"), "an illegal action was taken"
        self._step += 1
        seen, info = self._shown()
        return seen, 1.0, self._step == 3, False, info

    def _shown(self) -> tuple[Any, dict]:
        seen = np.array([self._step], np.float32)
        if self._convention in ("none in reset", "null in reset") and self._step == 0:
            return seen, {} if self._convention == "none in reset" else {"action_mask": None}
        if self._convention.endswith("in reset"):
            return seen, {"action_mask": self.mask().astype(np.int8)}
        if self._convention == "observation":
            return {"seen": seen, "action_mask": self.mask().astype(np.int8)}, {}
        return seen, {"action_mask": self.mask().astype(np.int8)} if self._convention == "info" else {}


class Uneven(Narrowing):
    """Episodes of different lengths, after which no choice is legal."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        self._length = 1 + (seed or 0) % 5
        return super().reset(seed=seed)

    def mask(self) -> np.ndarray:
        return super().mask() & (self._step < self._length)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        seen, reward, _, _, info = super().step(action)
        return seen, reward, self._step == self._length, False, info

    def _shown(self) -> tuple[Any, dict]:
        seen, info = super()._shown()
        return seen, {"action_mask": list(self.mask())} if self._convention == "list" else info


class Pedals(Narrowing):
    """Narrowing with continuous actions; an action table makes choices of them."""

    action_space = gym.Box(-1.0, 1.0, (1,))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        return super().step(int(action[0]) + 1)


class Unforbidden(Narrowing):
    """Narrowing that takes also the actions which its mask forbids."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        return super().step(self.mask().argmax())


class InPairs(Narrowing):
    """Narrowing whose mask changes after two steps."""

    def mask(self) -> np.ndarray:
        return np.arange(3) == self._step // 2 % 3


@pytest.fixture(autouse=True)
def _registered() -> Any:
    gymnasium.register("Narrowing-v0", lambda **kwargs: Narrowing(**kwargs))
    gymnasium.register("Uneven-v0", lambda **kwargs: Uneven(**kwargs))
    gymnasium.register("Pedals-v0", lambda **kwargs: Pedals(**kwargs))
    yield
    for name in ("Narrowing-v0", "Uneven-v0", "Pedals-v0"):
        del gymnasium.registry[name]


@pytest.mark.parametrize("convention", ["info", "method", "observation"])
def test_masks_accompany_their_observations(convention: str) -> None:
    spec = EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": convention})
    with closing(make_environments(spec, 2)) as environments:
        assert environments.spaces.actions == {"action": DiscreteSpace(counts=(3,), masked=True)}
        assert list(environments.spaces.observations) == ["seen" if convention == "observation" else "observation"]
        observed = environments.reset(1)
        legal = []
        for _ in range(8):  # two episodes, each with the row that only resets
            legal.append(np.flatnonzero(observed.masks["action"][0]).tolist())
            observed, *_ = environments.step({"action": observed.masks["action"].argmax(1)[:, None]})
        assert legal == [[0], [1], [2], [0], [0], [1], [2], [0]]


def test_map_of_masks_arrives_with_every_step() -> None:
    with closing(
        make_environments(EnvironmentSpec(id="nested_environment:NestedMasked-v0"), 2, modules=TEST_MODULES)
    ) as environments:
        sizes = environments.spaces.masks
        assert sizes
        observed = environments.reset(1)
        for _ in range(5):
            assert {name: mask.shape for name, mask in observed.masks.items()} == {
                name: (2, size) for name, size in sizes.items()
            }
            legal = {name: mask.argmax(1)[:, None] for name, mask in observed.masks.items()}
            observed, *_ = environments.step(first_actions(environments.spaces) | legal)


def first_actions(spaces: Spaces) -> dict[str, np.ndarray]:
    """Return the first choice, or 0, of every component for two environments."""
    return {
        name: np.zeros((2, space.size), np.int64 if isinstance(space, DiscreteSpace) else np.float32)
        for name, space in spaces.actions.items()
    }


class LegalPolicy(PlainPolicy):
    """A policy that takes the first legal choice."""

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        actions = masks["action"].argmax(1)[:, None]
        return Choice({"action": actions}, np.zeros(len(actions), np.float32), state)


def test_rollout_holds_the_mask_of_each_row() -> None:
    """Two episodes, each with the row that only resets, whose mask has no meaning."""
    spec = EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": "info"})
    with closing(started_collector(spec, LegalPolicy(), count=2, rollout_length=6)) as collector:
        for legal in ([0, 1, 2, 0, 0, 1], [2, 0, 0, 1, 2, 0]):
            masks = collect(collector).masks["action"]
            assert masks.dtype == np.bool_
            for environment in range(2):
                assert masks[:, environment].tolist() == np.eye(3, dtype=np.bool_)[legal].tolist()


@pytest.mark.parametrize("convention", ["info", "method", "observation"])
def test_the_check_plays_legal_actions(convention: str) -> None:
    """Narrowing fails for any other action."""
    spec = EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": convention})
    report = check_environment(spec, NO_MODULES, seconds=60.0, env_steps=20)
    assert (report.problems, report.env_steps) == ((), 20)


def test_the_check_plays_legal_actions_of_several_components() -> None:
    spec = EnvironmentSpec(id="nested_environment:NestedMasked-v0")
    report = check_environment(spec, TEST_MODULES, seconds=60.0, env_steps=100)
    assert (report.problems, report.env_steps) == ((), 100)
    assert max(report.returns) < 6.0  # tests/end_to_end/test_nested_spaces.py expects more of a policy that has learned


def test_the_check_reports_a_mask_without_any_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Narrowing, "mask", lambda self: np.zeros(3, np.bool_))
    spec = EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": "info"})
    (problem,) = check_environment(spec, NO_MODULES, seconds=60.0, env_steps=20).problems
    assert problem.startswith(
        "environment Narrowing-v0: the action_mask of 'action' forbids every choice of variable 0"
    )


def test_environments_without_masks_have_none() -> None:
    environments = make_environments(EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": "none"}), 1)
    assert environments.spaces.masks == {}
    assert environments.reset(1).masks == {}


def test_none_in_place_of_a_mask_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Narrowing, "_shown", lambda self: (np.zeros(1, np.float32), {"action_mask": None}))
    environments = make_environments(EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": "info"}), 2)
    environments.reset(1)
    assert environments.step(first_actions(environments.spaces))[0].masks == {}


@pytest.mark.parametrize("convention", ["none in reset", "null in reset"])
@pytest.mark.parametrize("one_episode", [False, True])
def test_masks_that_come_only_with_steps_are_refused(convention: str, one_episode: bool) -> None:
    """Only the first reset shows whether there are masks: these would be ignored, and illegal actions be played."""
    spec = EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": convention})
    environments = make_environments(spec, 2, one_episode=one_episode)
    environments.reset(1)
    with pytest.raises(EnvironmentSetupError, match="info has an action_mask after a step, but reset gave none: give"):
        environments.step(first_actions(environments.spaces))


@pytest.mark.parametrize("convention", ["none in reset", "null in reset"])
def test_the_check_reports_masks_that_come_only_with_steps(convention: str) -> None:
    spec = EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": convention})
    (problem,) = check_environment(spec, NO_MODULES, seconds=60.0, env_steps=20).problems
    assert problem == (
        "environment Narrowing-v0: info has an action_mask after a step, but reset gave none: give it in reset too"
    )


@pytest.mark.parametrize(("key", "name"), [("b", "b"), ("_b", "_b"), ("左", "_"), ("_a", "_a")])
def test_masks_of_several_components_are_a_map(key: str, name: str) -> None:
    """A vector environment has gymnasium's flags beside the masks; a map of `a` and `_a` comes from an observation."""
    action = gym.Dict({"a": gym.Discrete(2), key: gym.MultiDiscrete([2, 3]), "c": gym.Box(-1, 1)})
    example = {name: np.ones((1, 5), np.int8)}
    example |= {"a": np.ones((1, 2), np.int8)} if name == "_a" else {f"_{name}": np.ones(1, np.bool_)}
    transforms = Transforms(SPEC, gym.Box(0, 1), action, example)
    assert transforms.spaces.masks == {each: len(mask[0]) for each, mask in example.items() if mask.ndim == 2}
    mask = {name: np.array([0, 1, 1, 0, 0])} | ({"a": np.ones(2)} if name == "_a" else {})
    observed = transforms.observe_one(np.zeros(1), mask)
    assert observed.masks[name].tolist() == [[False, True, True, False, False]]


MASKED = {"a": gym.Discrete(2), "arm": gym.Dict(grip=gym.MultiDiscrete([2, 3])), "c": gym.Box(-1, 1)}


@pytest.mark.parametrize(
    ("space", "mask", "expected"),
    [
        (gym.MultiBinary(7), [1, 0, 0, 1, 1, 0, 1], {"a": [True, False], "arm.grip": [False, True, True, False, True]}),
        (
            gym.Dict(a=gym.MultiBinary(2), arm=gym.Dict(grip=gym.Box(0, 1, (5,), np.int8))),
            {"a": [0, 1], "arm": {"grip": [1, 0, 0, 0, 1]}},
            {"a": [False, True], "arm.grip": [True, False, False, False, True]},
        ),
        (gym.Dict(a=gym.MultiBinary(2)), {"a": [0, 1]}, {"a": [False, True]}),
    ],
    ids=["one array", "a map", "a map of some"],
)
def test_masks_in_the_observation_cover_several_components(
    space: gymnasium.Space, mask: Any, expected: dict[str, list[bool]]
) -> None:
    observations = gym.Dict(seen=gym.Box(0, 1), action_mask=space)
    transforms = Transforms(SPEC, observations, gym.Dict(MASKED))
    assert list(transforms.spaces.observations) == ["seen"]
    assert transforms.spaces.masks == {name: len(flags) for name, flags in expected.items()}
    assert not transforms.needs_mask

    def arrays(part: Any) -> Any:
        return (
            {key: arrays(value) for key, value in part.items()} if isinstance(part, dict) else np.array(part, np.int8)
        )

    observed = transforms.observe_one({"seen": np.zeros(1), "action_mask": arrays(mask)}, None)
    assert {name: flags[0].tolist() for name, flags in observed.masks.items()} == expected


@pytest.mark.parametrize(
    ("space", "name"),
    [
        (gym.MultiBinary(6), "action_mask"),
        (gym.MultiDiscrete([2] * 7), "action_mask"),
        (gym.Dict(a=gym.MultiBinary(3)), "action_mask.a"),
        (gym.Dict(b=gym.MultiBinary(2)), "action_mask.b"),
        (gym.Dict(c=gym.MultiBinary(1)), "action_mask.c"),
    ],
)
def test_mask_in_the_observation_that_fits_no_action_is_refused(space: gymnasium.Space, name: str) -> None:
    """It would be observed like anything else, and illegal actions be played."""
    observations = gym.Dict(seen=gym.Box(0, 1), action_mask=space)
    with pytest.raises(EnvironmentSetupError, match=rf"observation component '{name}' has shape .* 'a', 'arm.grip': "):
        Transforms(SPEC, observations, gym.Dict(MASKED))
    kept = SPEC.model_copy(update={"leave_out": (name,)})
    assert list(Transforms(kept, observations, gym.Dict(MASKED)).spaces.observations) == ["seen"]
    assert len(Transforms(SPEC, observations, gym.Box(-1, 1)).spaces.observations) == 2, "no action has choices"


def observe(mask: Any, needed: bool = True, example: Any = None, action: gymnasium.Space | None = None) -> np.ndarray:
    """Return the mask of one observation of an environment with masks."""
    space = action or gym.MultiDiscrete([2, 3])
    transforms = Transforms(SPEC, gym.Box(0, 1), space, np.ones((1, 5)) if example is None else example)
    return transforms.observe_one(np.zeros(1), mask, needed).masks["action"]


def test_forbidding_every_choice_is_refused_unless_no_action_is_taken() -> None:
    with pytest.raises(ValueError, match="'action' forbids every choice of variable 1 in environment 0: one must be"):
        observe(np.array([1, 0, 0, 0, 0]))
    assert observe(np.array([1, 0, 0, 0, 0]), needed=False).tolist() == [[True, False, True, True, True]]


@pytest.mark.parametrize(
    ("mask", "reason"),
    [
        (None, "no 'action_mask' any more"),
        (np.ones(4), r"of 'action' has shape \(4,\), but the action has 5 choices"),
        (np.array(["x"] * 5), "has shape"),
        ({"gripper": np.ones(5)}, "names 'gripper', which is no discrete component"),
        ({}, "has no entry for 'action' any more"),
        (
            np.array([0.0, -np.inf, 0.0, 0.0, 0.0]),
            "of 'action' has the value -inf: write 1 for each legal choice, 0 for",
        ),
        (np.array([1.0, np.nan, 0.0, 0.0, 0.0]), "has the value nan"),
    ],
)
def test_mask_that_does_not_fit_is_refused(mask: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        observe(mask)


def test_mask_of_a_component_that_had_none_at_first_is_refused() -> None:
    transforms = Transforms(SPEC, gym.Box(0, 1), BOTH, {"0": np.ones((1, 2))})
    with pytest.raises(ValueError, match="has an entry for '1' after a step, but reset gave none: give it in reset"):
        transforms.observe_one(np.zeros(1), {"0": np.ones(2), "1": np.ones(3)})


BOTH = gym.Tuple((gym.Discrete(2), gym.Discrete(3)))


@pytest.mark.parametrize(
    "mask", [np.array([1, 0, 0, 1, 1]), [1, 0, 0, 1, 1], ([1, 0], np.array([0, 1, 1])), ((1, 0), [0, 1, 1], None)]
)
def test_one_mask_covers_the_choices_of_all_components(mask: Any) -> None:
    """Also lists and tuples, as `sample(mask)` of gymnasium's spaces takes them."""
    transforms = Transforms(SPEC, gym.Box(0, 1), BOTH, mask_of_one(mask))
    masks = transforms.observe_one(np.zeros(1), mask).masks
    assert {name: part.tolist() for name, part in masks.items()} == {"0": [[True, False]], "1": [[False, True, True]]}


def test_one_mask_of_another_size_is_refused() -> None:
    with pytest.raises(EnvironmentSetupError, match=r"has shape \(4,\), but .* have 2 \+ 3 choices: give a map"):
        Transforms(SPEC, gym.Box(0, 1), BOTH, np.ones((1, 4)))
    both = np.empty(2, np.object_)
    both[:] = [[1, 0], None]  # gymnasium's batch where one environment gives no mask
    with pytest.raises(EnvironmentSetupError, match="differs in size between environments: give it in every step"):
        Transforms(SPEC, gym.Box(0, 1), gym.Discrete(2), both)


@pytest.mark.parametrize("make", [list, tuple])
def test_masks_of_an_environment_may_be_lists(monkeypatch: pytest.MonkeyPatch, make: Any) -> None:
    masked = Narrowing.mask
    monkeypatch.setattr(
        Narrowing, "_shown", lambda self: (np.zeros(1, np.float32), {"action_mask": make(masked(self))})
    )
    environments = make_environments(EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": "list"}), 2)
    observed = environments.reset(1)
    for _ in range(4):
        observed, *_ = environments.step({"action": observed.masks["action"].argmax(1)[:, None]})
    assert observed.masks["action"].tolist() == [[True, False, False]] * 2
    environments.close()


@pytest.mark.parametrize("convention", ["info", "method", "observation", "list"])
def test_environments_that_have_ended_need_no_legal_choice_in_an_evaluation(convention: str) -> None:
    spec = EnvironmentSpec(id="Uneven-v0", kwargs={"convention": convention})
    with closing(make_environments(spec, 8, one_episode=True)) as environments:
        evaluation = play_episodes(LegalPolicy(), environments, 20, seed=1, sampled=False)
    assert set(evaluation.lengths.tolist()) == {1, 2, 3, 4, 5}
    assert evaluation.returns.tolist() == evaluation.lengths.tolist()


def narrowing_notes(convention: str) -> tuple[str, ...]:
    return gymnasium_notes(EnvironmentSpec(id="Narrowing-v0", kwargs={"convention": convention}), NO_MODULES)


@pytest.mark.parametrize("convention", ["info", "method", "observation"])
def test_gymnasiums_checker_plays_legal_actions(convention: str) -> None:
    """Only choice 0 is legal at first, and the checker would sample another."""
    assert not [note for note in narrowing_notes(convention) if "Error" in note]
    (note,) = [note for note in narrowing_notes("none") if "Error" in note]
    assert "an illegal action was taken" in note


def test_choices_of_an_action_table_may_have_masks() -> None:
    table = ((-1.0,), (0.0,), (1.0,))
    spec = EnvironmentSpec(id="Pedals-v0", kwargs={"convention": "info"}, action_table=table)
    report = check_environment(spec, NO_MODULES, seconds=60.0, env_steps=20)
    assert (report.problems, report.env_steps) == ((), 20)
    with closing(make_environments(spec, 2)) as environments:
        assert environments.reset(1).masks["action"].tolist() == [[True, False, False]] * 2


@pytest.mark.parametrize("convention", ["info", "method", "observation", "table"])
def test_a_repeated_action_ends_where_the_mask_forbids_it(convention: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kind, table = InPairs, None
    if convention == "table":
        kind, table = type("PairsOfPedals", (Pedals, InPairs), {}), ((-1.0,), (0.0,), (1.0,))
        convention = "info"
    monkeypatch.setitem(gymnasium.registry, "InPairs-v0", EnvSpec("InPairs-v0", lambda **kwargs: kind(**kwargs)))
    spec = EnvironmentSpec(id="InPairs-v0", kwargs={"convention": convention}, action_repeat=4, action_table=table)
    with closing(make_environments(spec, 2)) as environments:
        observed, played = environments.reset(1), []
        for _ in range(4):  # an episode of three steps, the row that only resets, and the next episode
            choices = observed.masks["action"].argmax(1)
            observed, rewards, *_ = environments.step({"action": choices[:, None]})
            played.append((int(choices[0]), rewards.tolist()))
        assert played == [(0, [2.0, 2.0]), (1, [1.0, 1.0]), (1, [0.0, 0.0]), (0, [2.0, 2.0])]
    assert check_environment(spec, NO_MODULES, seconds=60.0, env_steps=20).problems == ()


def test_a_repeated_action_ignores_a_mask_that_the_policy_does_not_see(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gymnasium.registry, "Free-v0", EnvSpec("Free-v0", lambda **kwargs: Unforbidden(**kwargs)))
    kwargs: dict[str, Any] = {"convention": "observation"}
    spec = EnvironmentSpec(id="Free-v0", kwargs=kwargs, action_repeat=4, leave_out=("action_mask",))
    with closing(make_environments(spec, 1)) as environments:
        environments.reset(1)
        assert environments.step({"action": np.zeros((1, 1), np.int64)})[1] == [3.0]
