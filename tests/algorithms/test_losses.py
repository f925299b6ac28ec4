"""algorithms/losses.py against sums over single elements."""

import math
from typing import get_args

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from daedalus.algorithms.losses import (
    explained_variance,
    mean,
    normalized,
    policy_factors,
    policy_gradient_loss,
    shares_of,
    surrogate_policy_loss,
    value_loss,
    variance,
)
from daedalus.algorithms.returns import Targets
from daedalus.policy.network.distributions import Categorical
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.protocol.spec import LossSpec, Surrogate

ROWS, COLUMNS = 5, 3
CELLS = [(t, b) for t in range(ROWS) for b in range(COLUMNS)]
SURROGATES: tuple[Surrogate, ...] = get_args(Surrogate)


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(5)


@pytest.fixture
def valid(random: torch.Generator) -> Tensor:
    mask = (torch.rand(ROWS, COLUMNS, generator=random) > 0.4).float()
    assert 0 < mask.sum() < mask.numel()
    return mask


def normal(random: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*(shape or (ROWS, COLUMNS)), generator=random) * 2.0


def mean_of(terms: dict[tuple[int, int], float], valid: Tensor) -> float:
    kept = [terms[cell] for cell in CELLS if valid[cell] == 1.0]
    return math.fsum(kept) / len(kept)


def test_mean_is_the_mean_over_the_valid_rows(random: torch.Generator, valid: Tensor) -> None:
    values = normal(random)
    expected = mean_of({cell: values[cell].item() for cell in CELLS}, valid)
    assert mean(values, shares_of(valid)).item() == pytest.approx(expected, rel=1e-5)


def test_mean_of_one_valid_row_is_its_value_and_of_none_0() -> None:
    assert mean(torch.tensor([[3.0, 5.0]]), shares_of(torch.tensor([[1.0, 0.0]]))).item() == 3.0
    assert mean(torch.ones(2, 2), shares_of(torch.zeros(2, 2))).item() == 0.0


def test_policy_gradient_loss_is_minus_the_mean_log_prob_times_advantage(
    random: torch.Generator, valid: Tensor
) -> None:
    log_probs, advantages = normal(random), normal(random)
    expected = -mean_of({cell: log_probs[cell].item() * advantages[cell].item() for cell in CELLS}, valid)
    assert policy_gradient_loss(log_probs, advantages, shares_of(valid)).item() == pytest.approx(expected, rel=1e-5)


def test_policy_gradient_is_the_softmax_gradient(random: torch.Generator, valid: Tensor) -> None:
    # d/dlogits_k of - log pi(a) A is A (pi_k - [k = a]), a share of it for each valid row.
    logits = normal(random, ROWS, COLUMNS, 4).requires_grad_()
    actions = torch.randint(0, 4, (ROWS, COLUMNS), generator=random)
    advantages = normal(random)
    log_probs, _ = Categorical(DiscreteSpace(counts=(4,))).log_prob_and_entropy(logits, actions.unsqueeze(-1))
    policy_gradient_loss(log_probs, advantages, shares_of(valid)).backward()
    chosen = torch.nn.functional.one_hot(actions, 4)
    expected = (logits.detach().softmax(-1) - chosen) * (advantages * valid / valid.sum()).unsqueeze(-1)
    assert logits.grad is not None
    assert_close(logits.grad, expected)


@pytest.mark.parametrize("surrogate", SURROGATES)
@pytest.mark.parametrize("clip_range", [0.1, 0.5, 2.0])
def test_surrogate_policy_loss_equals_the_equation_of_the_paper(
    random: torch.Generator, valid: Tensor, clip_range: float, surrogate: Surrogate
) -> None:
    log_ratios, advantages = normal(random) / 2.0, normal(random)

    def gain(cell: tuple[int, int]) -> float:
        ratio, advantage = math.exp(log_ratios[cell].item()), advantages[cell].item()
        if surrogate == "spo":
            return ratio * advantage - abs(advantage) * (ratio - 1.0) ** 2 / (2.0 * clip_range)
        clipped = min(max(ratio, 1.0 - clip_range), 1.0 + clip_range)
        return min(ratio * advantage, clipped * advantage)

    expected = -mean_of({cell: gain(cell) for cell in CELLS}, valid)
    loss, clipped_share = surrogate_policy_loss(log_ratios, advantages, shares_of(valid), clip_range, surrogate)
    left = {cell: float(abs(math.exp(log_ratios[cell].item()) - 1.0) > clip_range) for cell in CELLS}
    assert clipped_share.item() == pytest.approx(mean_of(left, valid))
    assert loss.item() == pytest.approx(expected, rel=1e-5)


def test_clipped_policy_loss_equals_a_hand_worked_example() -> None:
    # Ratios 1.5, 1.5, 0.5, 0.5, 1.1, 1 with a range of 0.2; the last row is not valid.
    log_ratios = torch.tensor([[1.5, 1.5, 0.5, 0.5, 1.1, 1.0]]).log().requires_grad_()
    advantages = torch.tensor([[2.0, -2.0, 2.0, -2.0, 3.0, 100.0]])
    valid = torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0, 0.0]])
    loss, clipped_share = surrogate_policy_loss(log_ratios, advantages, shares_of(valid), 0.2, "clip")
    # min(3, 2.4) + min(-3, -2.4) + min(1, 1.6) + min(-1, -1.6) + min(3.3, 3.3), over five rows
    assert loss.item() == pytest.approx(-(2.4 - 3.0 + 1.0 - 1.6 + 3.3) / 5.0)
    loss.backward()
    # The gradient is 0 where the ratio left the range in the direction of the advantage, and not 0 in the other.
    expected = torch.tensor([[0.0, 3.0, -1.0, 0.0, -3.3, 0.0]]) / 5.0
    assert log_ratios.grad is not None
    assert_close(log_ratios.grad, expected)
    assert clipped_share.item() == pytest.approx(4 / 5)


@pytest.mark.parametrize("clip_range", [0.1, 0.3])
def test_gradient_of_spo_is_that_of_torch(random: torch.Generator, valid: Tensor, clip_range: float) -> None:
    log_ratios, advantages = normal(random), normal(random)
    gradients = []
    for ours in (False, True):
        values = log_ratios.clone().requires_grad_()
        if ours:
            surrogate_policy_loss(values, advantages, shares_of(valid), clip_range, "spo")[0].backward()
        else:
            ratios = values.exp()
            penalties = advantages.abs() * (ratios - 1.0).square() / (2.0 * clip_range)
            (-(ratios * advantages - penalties) * shares_of(valid)).sum().backward()
        gradients.append(values.grad)
    assert_close(gradients[0], gradients[1])


def test_spo_equals_a_hand_worked_example() -> None:
    # Ratios 1.2, 0.8, 1.5 and 0.5 with a range of 0.2.
    log_ratios = torch.tensor([[1.2, 0.8, 1.5, 0.5]]).log().requires_grad_()
    advantages = torch.tensor([[2.0, -2.0, 2.0, 2.0]])
    loss, outside = surrogate_policy_loss(log_ratios, advantages, torch.full((1, 4), 0.25), 0.19, "spo")
    assert outside.item() == 1.0
    loss, outside = surrogate_policy_loss(log_ratios, advantages, torch.full((1, 4), 0.25), 0.2, "spo")
    # 2.4 - 0.2, -1.6 - 0.2, 3 - 1.25, 1 - 1.25
    assert loss.item() == pytest.approx(-(2.2 - 1.8 + 1.75 - 0.25) / 4.0)
    loss.backward()
    assert log_ratios.grad is not None
    # 0 where the change is that of the range in the direction of the advantage; beyond it, it points back.
    assert_close(log_ratios.grad, -torch.tensor([[0.0, 0.0, 1.5 * (2.0 - 5.0), 0.5 * (2.0 + 5.0)]]) / 4.0)


@pytest.mark.parametrize("surrogate", SURROGATES)
def test_gradient_of_a_surrogate_equals_the_policy_gradient_at_a_ratio_of_1(
    random: torch.Generator, valid: Tensor, surrogate: Surrogate
) -> None:
    advantages, before = normal(random), normal(random)
    gradients = []
    for clipped in (False, True):
        log_probs = before.clone().requires_grad_()
        if clipped:
            surrogate_policy_loss(log_probs - before, advantages, shares_of(valid), 0.2, surrogate)[0].backward()
        else:
            policy_gradient_loss(log_probs, advantages, shares_of(valid)).backward()
        gradients.append(log_probs.grad)
    assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize("surrogate", SURROGATES)
@pytest.mark.parametrize("log_ratio", [1e3, 1e30])
def test_huge_ratio_does_not_overflow_the_clipped_loss(log_ratio: float, surrogate: Surrogate) -> None:
    log_ratios = torch.tensor([[log_ratio, 0.1], [log_ratio, -0.1]], requires_grad=True)
    advantages = torch.tensor([[1.0, 1.0], [-1.0, 1.0]])
    loss, _ = surrogate_policy_loss(log_ratios, advantages, torch.full((2, 2), 0.25), 0.2, surrogate)
    (gradient,) = torch.autograd.grad(loss, log_ratios)
    assert loss.isfinite()
    assert gradient.isfinite().all()
    assert gradient[:, 1].all()


@pytest.mark.parametrize("clip_range", [0.3, 0.0])
def test_ratios_of_1_are_not_clipped(valid: Tensor, clip_range: float) -> None:
    zeros = torch.zeros(ROWS, COLUMNS)
    assert surrogate_policy_loss(zeros, zeros, shares_of(valid), clip_range, "clip")[1].item() == 0.0


def test_advantages_and_targets_are_constants(random: torch.Generator, valid: Tensor) -> None:
    values = normal(random).requires_grad_()
    log_probs = normal(random).requires_grad_()
    policy_gradient_loss(log_probs, normal(random) - values, shares_of(valid)).backward()
    assert values.grad is None
    for surrogate in SURROGATES:
        surrogate_policy_loss(log_probs, normal(random) - values, shares_of(valid), 0.2, surrogate)[0].backward()
        assert values.grad is None
    for kind in ("mse", "huber"):
        targets = normal(random).requires_grad_()
        value_loss(values, targets, shares_of(valid), kind).backward()
        assert targets.grad is None
        assert values.grad is not None


def test_mse_is_the_mean_squared_error_without_a_half(random: torch.Generator, valid: Tensor) -> None:
    values, targets = normal(random), normal(random)
    expected = mean_of({cell: (values[cell].item() - targets[cell].item()) ** 2 for cell in CELLS}, valid)
    assert value_loss(values, targets, shares_of(valid), "mse").item() == pytest.approx(expected, rel=1e-5)


def test_huber_is_quadratic_within_1_and_linear_beyond(random: torch.Generator, valid: Tensor) -> None:
    def huber(error: float) -> float:
        return 0.5 * error * error if abs(error) <= 1.0 else abs(error) - 0.5

    values, targets = normal(random), normal(random)
    terms = {cell: huber(values[cell].item() - targets[cell].item()) for cell in CELLS}
    assert value_loss(values, targets, shares_of(valid), "huber").item() == pytest.approx(
        mean_of(terms, valid), rel=1e-5
    )


def test_normalized_has_mean_0_and_deviation_1_over_the_valid_rows(random: torch.Generator, valid: Tensor) -> None:
    kept = normalized(normal(random) * 9.0 + 4.0, valid)[valid == 1.0]
    assert kept.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert kept.std(correction=0).item() == pytest.approx(1.0, rel=1e-5)


def test_policy_factors_are_weighted_after_the_advantages_are_normalised(
    random: torch.Generator, valid: Tensor
) -> None:
    advantages, weights = normal(random), normal(random).abs()
    targets = Targets(values=normal(random), advantages=advantages, weights=weights)
    assert torch.equal(policy_factors(LossSpec(), targets, valid), weights * advantages)
    spec = LossSpec(normalize_advantages=True)
    assert torch.equal(policy_factors(spec, targets, valid), weights * normalized(advantages, valid))


def test_normalized_of_equal_advantages_is_0() -> None:
    assert torch.equal(normalized(torch.full((2, 2), 3.0), torch.ones(2, 2)), torch.zeros(2, 2))
    assert normalized(torch.tensor([[3.0, 5.0]]), torch.tensor([[1.0, 0.0]]))[0, 0].item() == 0.0  # one valid row


@pytest.mark.parametrize("value", [0.1, 0.3, -1.1, 7.7, 1e6])
@pytest.mark.parametrize("number", [2048, 2047, 1999, 3])
def test_normalized_of_equal_advantages_is_about_0_where_their_mean_is_rounded(value: float, number: int) -> None:
    assert normalized(torch.full((number, 1), value), torch.ones(number, 1)).abs().max() < 0.01


def test_normalized_keeps_differences_that_are_small_beside_the_mean() -> None:
    advantages = torch.tensor([[1000.0, 1001.0, 999.0]])
    assert_close(normalized(advantages, torch.ones(1, 3)), torch.tensor([[0.0, 1.5**0.5, -(1.5**0.5)]]))


def test_normalized_does_not_amplify_differences_that_are_only_rounding() -> None:
    tiny = torch.tensor([[1e-9, -1e-9]])
    positive, negative = normalized(tiny, torch.ones(1, 2))[0].tolist()
    assert 0.0 < positive < 0.2
    assert negative == -positive


def test_explained_variance_is_1_for_a_perfect_critic_0_for_a_mean_and_negative_for_worse(
    random: torch.Generator, valid: Tensor
) -> None:
    targets = normal(random)
    assert explained_variance(targets, targets, shares_of(valid)).item() == pytest.approx(1.0)
    assert explained_variance(targets + 7.0, targets, shares_of(valid)).item() == pytest.approx(1.0, abs=1e-5)
    assert explained_variance(torch.full_like(targets, 2.0), targets, shares_of(valid)).item() == pytest.approx(
        0.0, abs=1e-5
    )
    assert explained_variance(-targets, targets, shares_of(valid)).item() == pytest.approx(-3.0, rel=1e-4)


@pytest.mark.parametrize("target", [0.0, 1.0, -0.3, 1e6])
def test_explained_variance_of_equal_targets_is_unknown(random: torch.Generator, valid: Tensor, target: float) -> None:
    assert explained_variance(normal(random), torch.full_like(valid, target), shares_of(valid)).isnan()
    assert explained_variance(normal(random), normal(random), torch.zeros_like(valid)).isnan()  # of no rows


def test_explained_variance_equals_its_definition_over_the_valid_rows(random: torch.Generator, valid: Tensor) -> None:
    values, targets = normal(random), normal(random)
    kept = valid == 1.0
    residual = (targets - values)[kept]
    expected = 1.0 - residual.var(correction=0) / targets[kept].var(correction=0)
    for scale in (1.0, 0.01, 1e-6):  # it does not depend on the unit of the rewards
        assert_close(explained_variance(scale * values, scale * targets, shares_of(valid)), expected)
    assert_close(variance(values, shares_of(valid)), values[kept].var(correction=0))


def test_content_of_invalid_rows_does_not_change_losses_or_gradients(random: torch.Generator, valid: Tensor) -> None:
    first, second = normal(random), normal(random)
    garbage = torch.where(valid == 1.0, 0.0, 1e6)

    def outcome(shift: Tensor) -> list[Tensor]:
        ours = (first + shift).requires_grad_()
        theirs = second - 3.0 * shift
        losses = [
            policy_gradient_loss(ours, theirs, shares_of(valid)),
            policy_gradient_loss(ours, normalized(theirs, valid), shares_of(valid)),
            *(surrogate_policy_loss(ours * valid, theirs, shares_of(valid), 0.2, each)[0] for each in SURROGATES),
            value_loss(ours, theirs, shares_of(valid), "mse"),
            value_loss(ours, theirs, shares_of(valid), "huber"),
            explained_variance(ours, theirs, shares_of(valid)),
        ]
        gradients = torch.autograd.grad(losses, ours, [torch.ones(())] * len(losses))
        assert torch.equal(gradients[0] * (1.0 - valid), torch.zeros_like(valid))
        return [*(loss.detach() for loss in losses), *gradients]

    for clean, dirty in zip(outcome(torch.zeros(())), outcome(garbage), strict=True):
        assert torch.equal(clean, dirty)
