"""One-hot codes and maps: against a slow oracle, and what no code is refused with."""

from typing import Any

import numpy as np
import pytest
import torch
from plain import NAME, plain_spaces

from daedalus.policy.acting.noise import neutral_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.layers import OneHotCodes
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, unfit_code
from daedalus.protocol.spec import PolicySpec

COUNTS = (4, 1, 3)
GRID = ArraySpace(shape=(5, 6, 3), dtype="uint8")


def one_hot(cells: np.ndarray, counts: tuple[int, ...]) -> np.ndarray:
    """The oracle: one cell after the other, a place of the last axis after the other."""
    planes = np.zeros((*cells.shape[:-1], sum(counts)), np.float32)
    for index in np.ndindex(*cells.shape):
        *cell, place = index
        planes[(*cell, sum(counts[:place]) + int(cells[index]))] = 1.0
    return planes


def cells(random: np.random.Generator, *shape: int) -> np.ndarray:
    return random.integers(0, COUNTS, (*shape, 3)).astype(np.uint8)


@pytest.mark.parametrize("leading", [(2,), (3, 2), (2, 4, 5)])
def test_codes_become_one_hot(leading: tuple[int, ...]) -> None:
    given = {"map": torch.from_numpy(cells(np.random.default_rng(0), *leading)), "other": torch.ones(1)}
    encoded = OneHotCodes({"map": COUNTS})(given)
    assert encoded["map"].dtype == torch.float32
    np.testing.assert_array_equal(encoded["map"].numpy(), one_hot(given["map"].numpy(), COUNTS))
    assert encoded["other"] is given["other"]


def test_the_grid_encoder_convolves_planes() -> None:
    """The oracle: every filter at every place, by hand."""
    spec = PolicySpec(encoder="grid", codes={NAME: COUNTS}, hidden=(), normalize_observations=True)
    network = ActorCritic(spec, plain_spaces(GRID, 2))
    seen = cells(np.random.default_rng(1), 2, 5, 6)
    weights = {name: values.detach().numpy() for name, values in network.named_parameters()}
    filters, biases = (weights[f"encoder.grids.0.convolution.{part}"] for part in ("weight", "bias"))
    planes, expected = one_hot(seen, COUNTS), np.zeros((2, 16, 3, 4))
    for row, number, y, x in np.ndindex(*expected.shape):
        window = planes[row, y : y + 3, x : x + 3].transpose(2, 0, 1)
        expected[row, number, y, x] = max((window * filters[number]).sum() + biases[number], 0.0)
    features = network.encoder(network.prepare({NAME: torch.from_numpy(seen)}))
    np.testing.assert_allclose(features.detach().numpy(), expected.reshape(2, -1), atol=1e-5)


def test_codes_are_normalised_as_one_hot_numbers() -> None:
    network = ActorCritic(PolicySpec(codes={NAME: COUNTS}, normalize_observations=True), plain_spaces(GRID, 2))
    seen = cells(np.random.default_rng(4), 3, 5, 6)
    planes = one_hot(seen, COUNTS)
    shares, variance = planes.mean(0), np.linspace(0.001, 0.25, planes[0].size).reshape(planes[0].shape)
    network.normalizer.set_statistics(NAME, torch.from_numpy(shares), torch.from_numpy(variance))
    expected = ((planes - shares) / np.sqrt(variance)).clip(-10.0, 10.0)
    prepared = network.prepare({NAME: torch.from_numpy(seen)})[NAME].numpy()
    np.testing.assert_allclose(prepared, expected, rtol=2**-7, atol=1e-5)  # of bfloat16
    assert np.abs(prepared).max() == 10.0


@pytest.mark.parametrize(
    "policy", [{}, {"encoder": "grid"}, {"activation": "relu"}, {"memory": "gru"}, {"normalize_observations": True}]
)
def test_a_policy_has_no_probability_for_what_is_no_code(policy: dict[str, Any]) -> None:
    """In the program, too, which an actor, an evaluation, or nobody of ours may run. Other rows are not spoilt."""
    spaces = plain_spaces(GRID, 4)
    network = ActorCritic(PolicySpec.model_validate({"codes": {NAME: COUNTS}, **policy}), spaces)
    runtime = OnnxRuntime(export_program(network, spaces))
    runtime.load({name: values.detach().numpy() for name, values in network.named_parameters()})
    seen = cells(np.random.default_rng(2), 3, 5, 6)
    seen[1, 2, 3, 2] = COUNTS[2]
    state = np.zeros((3, runtime.state_size), np.float32)
    choice = runtime.act({NAME: seen}, state, neutral_noise(runtime.noise_size, 3), {})
    assert np.isnan(choice.log_probs).tolist() == [False, True, False]


@pytest.mark.parametrize("leading", [(), (2, 3)])
def test_the_first_value_that_is_no_code_is_named(leading: tuple[int, ...]) -> None:
    seen = cells(np.random.default_rng(3), *leading, 5, 6)
    assert unfit_code(seen, COUNTS) == ""
    seen[..., 4, 5, 1] = 7
    assert "the value 7 in place 1 of its last axis, but policy.codes has 1 codes there" in unfit_code(seen, COUNTS)
    assert unfit_code(np.full((2, 2), 255, np.uint8), (256,)) == ""


@pytest.mark.parametrize(
    ("policy", "space", "reason"),
    [
        ({"codes": {"grid": (3,)}}, GRID, "policy.codes names 'grid', but the components of the observation are obs"),
        ({"codes": {NAME: (3, 3)}}, GRID, "has 2 numbers, but the last axis of a uint8 array of shape (5, 6, 3) has 3"),
        ({"codes": {NAME: (3,)}}, ArraySpace(shape=(3,), dtype="float32"), "is for an array of bytes, not for float32"),
        ({"codes": {NAME: (3,)}}, DiscreteSpace(counts=(3,)), "is for an array of bytes, not for 3 choices"),
        ({"codes": {NAME: (3,)}, "encoder": "impala"}, GRID, "the encoder 'impala' takes no codes"),
        ({"encoder": "grid"}, ArraySpace(shape=(5, 6), dtype="uint8"), "the observations have no array of three axes"),
    ],
)
def test_settings_that_do_not_fit_the_observations_are_refused(policy: dict[str, Any], space: Any, reason: str) -> None:
    with pytest.raises(NetworkError) as error:
        ActorCritic(PolicySpec.model_validate(policy), plain_spaces(space, 2))
    assert reason in str(error.value)
