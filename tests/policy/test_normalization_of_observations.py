"""policy/network/observation_normalizer.py: statistics as parameters that every kind of snapshot carries exactly."""

import numpy as np
import pytest
import torch

from daedalus.policy.component_inputs import normalized_components
from daedalus.policy.network.observation_normalizer import ObservationNormalizer
from daedalus.protocol.compact import bfloat16, float32
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace
from daedalus.protocol.spec import PolicySpec


@pytest.fixture
def normalizer() -> ObservationNormalizer:
    return ObservationNormalizer({"o": ArraySpace(shape=(3,), dtype="float32")})


def test_observations_are_shifted_scaled_and_clipped(normalizer: ObservationNormalizer) -> None:
    normalizer.set_statistics("o", torch.tensor([1.0, -2.0, 0.0]), torch.tensor([4.0, 0.25, 1.0]))
    seen = normalizer({"o": torch.tensor([[3.0, -1.0, 50.0]])})["o"]
    torch.testing.assert_close(seen, torch.tensor([[1.0, 2.0, 10.0]]))


def test_small_units_are_normalised_and_constants_are_not(normalizer: ObservationNormalizer) -> None:
    """A hundredth of a millimetre in metres, and a number that never changes."""
    deviation = torch.tensor([1e-5, 1e-4, 0.0], dtype=torch.float64)
    normalizer.set_statistics("o", torch.tensor([0.0, 0.1, 1234.5]), deviation.square())
    seen = normalizer({"o": torch.tensor([[1e-5, 0.1 - 2e-4, 1234.5]])})["o"]
    torch.testing.assert_close(seen, torch.tensor([[1.0, -2.0, 0.0]]), rtol=0.01, atol=1e-6)


def test_compact_snapshot_changes_no_statistic(normalizer: ObservationNormalizer) -> None:
    """A mean of 1,000 beside a deviation of 0.01: bfloat16 alone would move it by up to 4, which is 400 deviations."""
    mean, deviation = torch.tensor([1000.123, -7.7777, 3e-5]), torch.tensor([0.01, 3.3, 1.0])
    normalizer.set_statistics("o", mean, deviation.square())
    weights = {name: values.detach().numpy() for name, values in normalizer.named_parameters()}
    compact = float32(bfloat16(weights))
    assert weights.keys() == compact.keys()
    for name in weights:
        np.testing.assert_array_equal(weights[name], compact[name], err_msg=name)
    kept, variance = normalizer.statistics("o")
    torch.testing.assert_close(kept, mean, rtol=2**-23, atol=1e-12)
    torch.testing.assert_close(variance.sqrt(), deviation, rtol=2**-8, atol=1e-6)


def test_statistics_are_set_without_reading_the_parameters(normalizer: ObservationNormalizer) -> None:
    """Parameters on a GPU cannot be combined with statistics on the CPU; those on "meta" cannot be read either."""
    normalizer.to("meta")
    # Reading them would raise an exception.
    normalizer.set_statistics("o", torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))


BYTES = ArraySpace(shape=(7, 7, 3), dtype="uint8")
NUMBERS = ArraySpace(shape=(3,), dtype="float32")
IMAGE = ArraySpace(shape=(16, 16, 3), dtype="uint8")


@pytest.mark.parametrize(
    ("encoder", "spaces", "normalized"),
    [
        ("auto", {"bytes": BYTES}, {"bytes"}),
        ("mlp", {"bytes": BYTES, "image": IMAGE}, {"bytes", "image"}),
        ("auto", {"bytes": BYTES, "image": IMAGE, "numbers": NUMBERS}, {"bytes", "numbers"}),
        ("impala", {"bytes": BYTES}, set()),  # its first convolution scales bytes itself
        ("impala", {"numbers": NUMBERS}, {"numbers"}),
        ("impala", {"bytes": BYTES, "image": IMAGE}, {"bytes"}),  # the multilayer perceptron reads them
        ("auto", {"coded": BYTES, "bytes": BYTES}, {"coded", "bytes"}),  # as one-hot numbers
        ("grid", {"map": BYTES, "bytes": ArraySpace(shape=(4,), dtype="uint8")}, {"bytes"}),
        ("module:Own", {"bytes": BYTES}, set()),
        ("module:Own", {"bytes": BYTES, "numbers": NUMBERS, "choice": DiscreteSpace(counts=(3,))}, {"numbers"}),
    ],
)
def test_bytes_are_normalised_for_the_multilayer_perceptron_only(
    encoder: str, spaces: dict[str, ArraySpace | DiscreteSpace], normalized: set[str]
) -> None:
    codes = {"coded": (5,)} if "coded" in spaces else {}
    policy = PolicySpec(encoder=encoder, codes=codes, normalize_observations=True)
    assert set(normalized_components(policy, spaces)) == normalized
    assert not normalized_components(PolicySpec(encoder=encoder), spaces)
