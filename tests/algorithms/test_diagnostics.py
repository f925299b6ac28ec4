"""algorithms/diagnostics.py against exact sums over small distributions."""

import math

import pytest
import torch
from torch import Tensor

from daedalus.algorithms.diagnostics import FirstPass, behaviour_kl, diagnostics, effective_sample_share

BEHAVIOUR, TARGET = (0.5, 0.25, 0.25), (0.2, 0.3, 0.5)
ACTIONS = [0, 0, 1, 2]  # as often as the behaviour policy chooses them


LOG_RATIOS = torch.tensor([math.log(TARGET[a] / BEHAVIOUR[a]) for a in ACTIONS])
VALID = torch.tensor([[1.0], [1.0], [1.0], [1.0], [0.0]])


def test_estimate_over_all_actions_in_proportion_is_the_exact_divergence_and_never_negative() -> None:
    exact = sum(mu * math.log(mu / pi) for mu, pi in zip(BEHAVIOUR, TARGET, strict=True))
    assert behaviour_kl(LOG_RATIOS).item() == pytest.approx(exact, rel=1e-5)
    for log_ratio in (-3.0, -0.1, 0.1, 3.0):
        assert behaviour_kl(torch.tensor([log_ratio])).item() > 0.0
    assert behaviour_kl(torch.zeros(50)).item() == 0.0


def test_effective_share_is_the_square_of_the_sum_over_the_sum_of_squares() -> None:
    ratios = [TARGET[a] / BEHAVIOUR[a] for a in ACTIONS]
    expected = sum(ratios) ** 2 / (4 * sum(ratio**2 for ratio in ratios))
    assert effective_sample_share(LOG_RATIOS).item() == pytest.approx(expected, rel=1e-5)
    assert effective_sample_share(torch.zeros(6)).item() == pytest.approx(1.0)
    one = torch.tensor([500.0, 0.0, -3.0, 1.0])  # e^500 overflows float32
    assert effective_sample_share(one).item() == pytest.approx(1 / 4)


def first_pass(errors: Tensor) -> FirstPass:
    """The first pass of four valid rows and of one that only resets, whose numbers have no meaning."""
    behaviour, values = torch.full((5, 1), -1.5), torch.full((5, 1), 3.0)
    log_ratios = torch.cat([LOG_RATIOS, torch.tensor([1e30])]).unsqueeze(1)
    return FirstPass(behaviour + log_ratios, behaviour, values, values + errors, errors, VALID)


def test_diagnostics_of_a_batch() -> None:
    measured = diagnostics(first_pass(torch.tensor([[0.0], [1.0], [2.0], [3.0], [99.0]])), rho_clip=1.0)
    assert measured["rho_mean"] == pytest.approx(1.0, rel=1e-5)  # its expectation under the behaviour policy
    assert measured["rho_clipped_fraction"] == 0.5  # of 0.4, 0.4, 1.2 and 2
    # Linear between the four valid errors, the reset row excepted.
    assert measured["value_error_p05"] == pytest.approx(0.15)
    assert measured["value_error_p50"] == pytest.approx(1.5)
    assert measured["value_error_p95"] == pytest.approx(2.85)
    assert measured["behaviour_kl"] == pytest.approx(behaviour_kl(LOG_RATIOS).item(), rel=1e-5)
    assert measured["rho_effective_share"] == pytest.approx(effective_sample_share(LOG_RATIOS).item())
    assert "rho_clipped_fraction" not in diagnostics(first_pass(torch.zeros(5, 1)), rho_clip=None)
    no_rows = first_pass(torch.zeros(5, 1))._replace(valid=torch.zeros(5, 1))
    assert diagnostics(no_rows, rho_clip=1.0) == {}
