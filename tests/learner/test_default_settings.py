"""learner/run/default_settings.py: which settings an environment gets by its spaces."""

from typing import Any

import pytest

from daedalus.learner.run.default_settings import default_settings, kind_of
from daedalus.learner.run.settings import choose_algorithm, run_spec
from daedalus.policy.acting.program import export_program
from daedalus.policy.component_inputs import normalized_components
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spaces import ActionSpace, ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec

VECTOR = ArraySpace(shape=(17,), dtype="float32")
CHOICES, JOINTS = DiscreteSpace(counts=(4,)), ContinuousSpace(low=(-1.0,), high=(1.0,))


def spaces(action: ActionSpace, *observations: ArraySpace | DiscreteSpace) -> Spaces:
    return Spaces(observations={str(index): space for index, space in enumerate(observations)}, actions={"a": action})


def image(*shape: int) -> ArraySpace:
    return ArraySpace(shape=shape, dtype="uint8")


@pytest.mark.parametrize(
    ("where", "kind"),
    [
        (spaces(CHOICES, VECTOR), "vectors_discrete"),
        (spaces(CHOICES, DiscreteSpace(counts=(500,))), "vectors_discrete"),
        (spaces(CHOICES, image(7, 7, 3)), "vectors_discrete"),
        (spaces(JOINTS, VECTOR), "vectors_continuous"),
        (spaces(JOINTS, VECTOR, image(96, 96, 3)), "images"),
        (spaces(CHOICES, image(128, 96)), "images"),
        (spaces(CHOICES, image(210, 160, 3)), "large_images"),
        (spaces(CHOICES, image(3, 210, 160)), "large_images"),
    ],
)
def test_kind_follows_the_spaces(where: Spaces, kind: str) -> None:
    assert kind_of(where) == kind


def test_a_discrete_and_a_continuous_component_make_a_continuous_action() -> None:
    where = Spaces(observations={"o": VECTOR}, actions={"a": CHOICES, "b": JOINTS})
    assert kind_of(where) == "vectors_continuous"


@pytest.mark.parametrize("algorithm", [None, *ALGORITHMS])
@pytest.mark.parametrize(
    "where", [None, spaces(CHOICES, VECTOR), spaces(JOINTS, VECTOR), spaces(CHOICES, image(96, 96, 3))]
)
def test_default_settings_are_valid_for_each_algorithm(where: Spaces | None, algorithm: str | None) -> None:
    settings: dict[str, Any] = default_settings(where)
    settings.setdefault("environment", {})["id"] = "Any-v0"
    settings.pop("with_memory")
    choose_algorithm(settings, algorithm)
    spec = run_spec(settings)
    assert spec.training.normalize_rewards or spec.algorithm.replay
    assert spec.training.target_return is None


@pytest.mark.parametrize(
    ("shape", "grey"),
    [
        ((210, 160, 3), True),
        ((3, 210, 160), True),
        ((210, 160), False),
        ((210, 160, 1), False),
        ((210, 160, 5), False),
    ],
)
def test_only_images_with_colours_are_made_grey(shape: tuple[int, ...], grey: bool) -> None:
    environment = default_settings(spaces(CHOICES, image(*shape)))["environment"]
    assert environment.get("grey", False) is grey
    assert environment["resize"] == [84, 84]


@pytest.mark.parametrize(("arms", "numbers", "std"), [(1, 1, 1.0), (1, 2, 1.0), (1, 3, 0.82), (1, 8, 0.5), (2, 4, 0.5)])
def test_noise_of_all_numbers_of_an_action_together_is_bounded(arms: int, numbers: int, std: float) -> None:
    arm = ContinuousSpace(low=(None,) * numbers, high=(None,) * numbers)
    actions: dict[str, ActionSpace] = {f"arm_{index}": arm for index in range(arms)}
    where = Spaces(observations={"o": VECTOR}, actions={**actions, "gripper": CHOICES})
    assert default_settings(where)["policy"]["initial_std"] == std


@pytest.mark.parametrize("observation", [VECTOR, image(96, 96, 3), image(210, 160, 3)])
def test_continuous_actions_get_no_entropy_bonus(observation: ArraySpace) -> None:
    training = default_settings(spaces(JOINTS, observation))["training"]
    assert (training["entropy_bonus"], training.get("entropy_bonus_final")) == (0.0, None)
    assert default_settings(spaces(CHOICES, observation))["training"]["entropy_bonus"] > 0


def policy_of(where: Spaces) -> PolicySpec:
    return PolicySpec.model_validate(default_settings(where)["policy"])


@pytest.mark.parametrize("size", [96, 210])
def test_numbers_beside_an_image_are_normalised(size: int) -> None:
    where = spaces(JOINTS, image(size, size, 3), VECTOR)
    assert normalized_components(policy_of(where), where.observations) == {"1": VECTOR}


def test_images_alone_have_the_program_of_a_policy_that_normalises_nothing() -> None:
    where = spaces(CHOICES, image(20, 20))
    policies = policy_of(where), policy_of(where).model_copy(update={"normalize_observations": False})
    networks = [ActorCritic(policy, where) for policy in policies]
    names = [list(dict(network.named_parameters())) for network in networks]
    assert names[0] == names[1]
    assert export_program(networks[0], where) == export_program(networks[1], where)


@pytest.mark.parametrize(
    ("where", "rows", "environments"),
    [
        (spaces(CHOICES, ArraySpace(shape=(64, 64), dtype="float32")), 128, 8),  # 16 MiB
        (spaces(CHOICES, ArraySpace(shape=(128, 128), dtype="float32")), 64, 8),
        (spaces(JOINTS, ArraySpace(shape=(1024, 1024), dtype="float32")), 8, 1),  # 4 MiB each
        (spaces(JOINTS, ArraySpace(shape=(512, 512), dtype="float32")), 16, 2),
        (spaces(CHOICES, image(128, 128, 3)), 64, 8),
        (spaces(CHOICES, image(1000, 1000, 3)), 64, 8),  # made small
        (spaces(CHOICES, image(210, 160, 3), ArraySpace(shape=(200, 200), dtype="float32")), 32, 8),
        (spaces(CHOICES, ArraySpace(shape=(4000, 4000), dtype="float32")), 1, 1),
    ],
)
def test_a_message_can_carry_a_rollout(where: Spaces, rows: int, environments: int) -> None:
    settings = default_settings(where)
    assert settings["collection"]["rollout_length"] == rows
    assert settings["collection"]["envs_per_actor"] == environments
    memory = settings["with_memory"]["collection"]
    assert memory["rollout_length"] * memory["envs_per_actor"] <= 2 * rows * environments
    for each in settings["for_algorithm"].values():
        assert each["collection"]["rollout_length"] == min(16, rows)


@pytest.mark.parametrize(
    ("where", "seats", "rows", "copies"),
    [
        (spaces(CHOICES, VECTOR), 2, 128, 8),
        (spaces(CHOICES, VECTOR), 4, 128, 4),
        (spaces(JOINTS, VECTOR), 20, 128, 1),
        (spaces(JOINTS, image(457, 120, 3)), 20, 64, 1),  # pistonball
        (spaces(CHOICES, ArraySpace(shape=(512, 512), dtype="float32")), 20, 2, 1),
    ],
)
def test_rollouts_of_many_seats_are_no_larger(where: Spaces, seats: int, rows: int, copies: int) -> None:
    settings = default_settings(where, seats=seats)
    collection, with_memory = settings["collection"], settings["with_memory"]["training"]
    assert (collection["rollout_length"], collection["envs_per_actor"]) == (rows, copies)
    assert not {"curiosity", "entropy_bonus"} & set(with_memory)  # which were measured with one agent
    assert settings["training"].get("mean_first_value", False) == (seats > 2)


def test_maps_are_convolved_where_actions_are_choices() -> None:
    board = ArraySpace(shape=(10, 10, 4), dtype="float32")
    settings = default_settings(spaces(CHOICES, board), maps=["observation"])
    assert settings["policy"]["encoder"] == "grid"
    assert (settings["training"]["passes"], settings["training"]["learning_rate_final"]) == (4, 0.0)
    for where, maps in ((spaces(CHOICES, board), []), (spaces(JOINTS, board), ["observation"])):
        settings = default_settings(where, maps=maps)
        assert "encoder" not in settings["policy"]
        assert settings["training"]["passes"] == 10


def test_components_to_leave_out_become_a_setting() -> None:
    assert default_settings(spaces(CHOICES, VECTOR), ["mission"])["environment"]["leave_out"] == ["mission"]
    assert "environment" not in default_settings(spaces(CHOICES, VECTOR))


@pytest.mark.parametrize(
    ("observations", "codes", "kind", "surrogate"),
    [
        ((CHOICES, image(7, 7, 3)), {"1": (11, 6, 4)}, "vectors_discrete", "spo"),
        ((image(19, 19, 3),), {"0": (11, 6, 4)}, "vectors_discrete", "spo"),
        ((image(7, 7, 3), image(96, 96, 3)), {"0": (11, 6, 4)}, "images", None),
        ((image(7, 7, 3),), {}, "vectors_discrete", None),
    ],
)
def test_codes_are_no_images_and_are_set_and_learned_with_spo(
    observations: tuple[Any, ...], codes: dict[str, tuple[int, ...]], kind: str, surrogate: str | None
) -> None:
    where = spaces(CHOICES, *observations)
    settings = default_settings(where, codes=codes)
    assert PolicySpec.model_validate(settings["policy"]).codes == codes
    assert settings["training"].get("surrogate") == surrogate
    assert kind_of(where, codes) == kind
