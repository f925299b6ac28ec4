"""The numpy samplers against the torch distributions, and against the frequencies of the softmax."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from daedalus.policy.acting.sampling import CategoricalSampler
from daedalus.policy.network.distributions import Categorical
from daedalus.protocol.spaces import DiscreteSpace

sampler = CategoricalSampler()
repeatable = settings(max_examples=100, deadline=None, derandomize=True)
numbers = st.floats(-10, 10, width=32) | st.sampled_from([0.0, 1e4, -1e4, 1e30, -1e30, 88.0, -88.0, -np.inf])
logits_of_any_size = arrays.arrays(
    np.float32, st.tuples(st.integers(1, 6), st.integers(1, 9)), elements=numbers, fill=st.nothing()
).filter(lambda logits: bool(np.isfinite(logits).any(axis=-1).all()))  # a policy may not rule out every action


class Uniforms(np.random.Generator):
    """A generator that always returns the same number."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self._value = value

    def random(self, size: int, dtype: type[np.float32]) -> np.ndarray:
        return np.full(size, self._value, dtype)


LARGEST_BELOW_1 = float(np.nextafter(np.float32(1), np.float32(0)))


def softmax(logits: np.ndarray) -> np.ndarray:
    """Compute the softmax in double precision: the oracle."""
    weights = np.exp(logits.astype(np.float64) - logits.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


def torch_log_probs(logits: np.ndarray, actions: np.ndarray) -> np.ndarray:
    distribution = Categorical(DiscreteSpace(count=logits.shape[1]))
    return distribution.log_prob_and_entropy(torch.from_numpy(logits), torch.from_numpy(actions))[0].numpy()


@repeatable
@given(logits=logits_of_any_size, seed=st.integers(0, 2**32))
def test_log_probs_of_samples_are_those_of_torch(logits: np.ndarray, seed: int) -> None:
    actions, log_probs = sampler.sample(logits, np.random.default_rng(seed))
    assert (actions.shape, actions.dtype) == ((len(logits),), np.int64)
    assert (log_probs.shape, log_probs.dtype) == ((len(logits),), np.float32)
    np.testing.assert_allclose(log_probs, torch_log_probs(logits, actions), rtol=1e-5, atol=1e-6)


@repeatable
@given(logits=logits_of_any_size)
def test_mode_is_the_most_probable_action_with_its_log_prob(logits: np.ndarray) -> None:
    actions, log_probs = sampler.mode(logits)
    np.testing.assert_array_equal(actions, logits.argmax(axis=-1))
    assert (actions.dtype, log_probs.dtype) == (np.int64, np.float32)
    np.testing.assert_allclose(log_probs, torch_log_probs(logits, actions), rtol=1e-5, atol=1e-6)


@repeatable
@given(logits=logits_of_any_size, uniform=st.sampled_from([0.0, LARGEST_BELOW_1, 0.5]))
def test_no_uniform_number_gives_an_action_of_probability_zero(logits: np.ndarray, uniform: float) -> None:
    actions, _ = sampler.sample(logits, Uniforms(uniform))
    assert (actions < logits.shape[1]).all()
    assert (softmax(logits)[np.arange(len(logits)), actions] > 0).all()


@pytest.mark.parametrize("actions", [1, 2, 3, 7, 1000, 65_536])
def test_largest_uniform_number_gives_the_last_action(actions: int) -> None:
    logits = np.random.default_rng(0).normal(size=(8, actions)).astype(np.float32)
    logits[:, -1] = 6.0
    chosen, _ = sampler.sample(logits, Uniforms(LARGEST_BELOW_1))
    assert (chosen == actions - 1).all()


def test_smallest_uniform_number_gives_the_first_possible_action() -> None:
    logits = np.array([[0.0, 0.0, 0.0], [-np.inf, 0.0, 0.0], [-np.inf, -np.inf, 0.0]], np.float32)
    np.testing.assert_array_equal(sampler.sample(logits, Uniforms(0.0))[0], [0, 1, 2])


def test_hand_worked_case() -> None:
    logits = np.log(np.array([[1, 2, 1], [6, 1, 1]], np.float32)) + np.float32(3)
    actions, log_probs = sampler.sample(logits, Uniforms(0.5))  # thresholds 2 of 1, 3, 4 and 4 of 6, 7, 8
    np.testing.assert_array_equal(actions, [1, 0])
    np.testing.assert_allclose(log_probs, np.log([0.5, 0.75]), rtol=1e-6)


@pytest.mark.parametrize(
    "row", [[0, 0, 0, 0, 0], [2, 1, 0, -1, -2], [-3, 0, 5, 0, 1], [1e4, 1e4, 1e4 - 1, 1e4 - 2, 1e4 - 2]]
)
def test_actions_have_the_frequencies_of_the_softmax(row: list[float]) -> None:
    samples = 40_000
    logits = np.tile(np.array(row, np.float32), (samples, 1))
    actions, _ = sampler.sample(logits, np.random.default_rng(7))
    expected = samples * softmax(logits[:1])[0]
    chi_square = ((np.bincount(actions, minlength=len(row)) - expected) ** 2 / expected).sum()
    assert chi_square < 18.47  # the 0.999 quantile for 4 degrees of freedom


def test_rows_are_sampled_independently() -> None:
    logits = np.zeros((40_000, 2), np.float32)
    actions, _ = sampler.sample(logits, np.random.default_rng(3))
    same = (actions[1:] == actions[:-1]).mean()
    assert abs(same - 0.5) < 0.01


@repeatable
@given(logits=logits_of_any_size.filter(lambda logits: bool(np.isfinite(logits).all())))
def test_entropy_matches_its_definition(logits: np.ndarray) -> None:
    probabilities = softmax(logits)
    log_probs = np.log(probabilities, where=probabilities > 0, out=np.zeros_like(probabilities))
    distribution = Categorical(DiscreteSpace(count=logits.shape[1]))
    actions = torch.zeros(len(logits), dtype=torch.int64)
    _, entropy = distribution.log_prob_and_entropy(torch.from_numpy(logits), actions)
    np.testing.assert_allclose(entropy.numpy(), -(probabilities * log_probs).sum(axis=-1), rtol=1e-4, atol=1e-5)
