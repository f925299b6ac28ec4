"""Returns and targets by hand and against the sums of the papers, and the weights of explored rows."""

import pytest
import torch
from building import SPACES, join, make_rollout
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import Stream, lambda_return, n_step_return, vtrace, vtrace_advantage
from torch import Tensor
from torch.testing import assert_close

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.returns import (
    actor_critic_targets,
    lambda_returns,
    lambda_targets,
    vtrace_corrected_targets,
    vtrace_targets,
)
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spec import PolicySpec, TrainingSpec

repeatable = settings(max_examples=100, deadline=None, derandomize=True)
NUMBER = st.floats(-10.0, 10.0, width=32)
UNIT = st.floats(0.0, 1.0, width=32)
CLIP = st.floats(0.125, 4.0, width=32)
ENDS = st.sampled_from(["no", "no", "no", "terminated", "truncated", "both"])


@st.composite
def streams(draw: st.DrawFn, rows: int) -> Stream:
    """Draw the rows of one environment under NEXT_STEP resets. Reset rows contain large numbers."""
    ends, valid = [], []
    resets = draw(st.booleans())  # the previous rollout may have ended with an episode
    for _ in range(rows):
        valid.append(not resets)
        ends.append("no" if resets else draw(ENDS))
        resets = ends[-1] != "no"
    return Stream(
        r=[draw(NUMBER) if ok else 1e4 for ok in valid],
        V=[draw(NUMBER) for _ in range(rows + 1)],
        log_ratios=[draw(st.floats(-3.0, 3.0, width=32)) if ok else 80.0 for ok in valid],
        terminated=[end in ("terminated", "both") for end in ends],
        truncated=[end in ("truncated", "both") for end in ends],
        valid=valid,
    )


ROLLOUTS = st.integers(1, 7).flatmap(lambda rows: st.lists(streams(rows), min_size=1, max_size=3))


class Columns:
    """Streams as the columns of [T, B] tensors, the arguments of the tested functions."""

    def __init__(self, columns: list[Stream], gamma: float) -> None:
        def stacked(name: str, dtype: torch.dtype = torch.float64) -> Tensor:
            return torch.tensor([getattr(column, name) for column in columns], dtype=dtype).T

        self.rewards, values = stacked("r"), stacked("V")
        self.values, self.next_values = values[:-1], values[1:]
        self.log_ratios = stacked("log_ratios")
        self.truncated, self.valid = stacked("truncated", torch.bool), stacked("valid", torch.bool)
        self.discounts = gamma * (~stacked("terminated", torch.bool)).double()
        self.of_returns = (self.rewards, self.discounts, self.next_values, self.truncated)
        self.of_targets = (self.rewards, self.discounts, self.values, self.next_values, self.truncated)


def assert_rows(result: Tensor, columns: list[Stream], expected) -> None:
    """Assert that every valid row of `result` [T, B] equals `expected(stream, t)`."""
    for number, column in enumerate(columns):
        for t in column.rows:
            assert result[t, number].item() == pytest.approx(expected(column, t), rel=1e-5, abs=1e-4)


# --------------------------------------------------------------------------------------------- oracles


@repeatable
@given(ROLLOUTS, UNIT)
def test_lambda_of_1_gives_n_step_returns_as_explicit_sums(columns: list[Stream], gamma: float) -> None:
    result = lambda_returns(*Columns(columns, gamma).of_returns, 1.0)
    assert_rows(result, columns, lambda x, t: n_step_return(x, gamma, t, len(x.r)))


@repeatable
@given(ROLLOUTS, UNIT, UNIT)
def test_lambda_returns_are_the_weighted_mixture_of_n_step_returns(
    columns: list[Stream], gamma: float, lam: float
) -> None:
    result = lambda_returns(*Columns(columns, gamma).of_returns, lam)
    assert_rows(result, columns, lambda x, t: lambda_return(x, gamma, lam, t))


@repeatable
@given(ROLLOUTS, UNIT, UNIT)
def test_actor_critic_advantages_are_returns_minus_values(columns: list[Stream], gamma: float, lam: float) -> None:
    data = Columns(columns, gamma)
    targets = actor_critic_targets(*data.of_targets, lam)
    assert_rows(targets.values, columns, lambda x, t: lambda_return(x, gamma, lam, t))
    assert_rows(targets.advantages, columns, lambda x, t: lambda_return(x, gamma, lam, t) - x.V[t])


@repeatable
@given(ROLLOUTS, UNIT, UNIT, CLIP, CLIP)
def test_vtrace_equals_the_sum_of_products_in_the_paper(
    columns: list[Stream], gamma: float, lam: float, rho_bar: float, c_bar: float
) -> None:
    data = Columns(columns, gamma)
    targets = vtrace_targets(data.log_ratios, *data.of_targets, lam, rho_bar, c_bar)
    assert_rows(targets.values, columns, lambda x, t: vtrace(x, gamma, lam, rho_bar, c_bar, t))
    assert_rows(targets.advantages, columns, lambda x, t: vtrace_advantage(x, gamma, lam, rho_bar, c_bar, t))


# ------------------------------------------------------------------------------------------ identities


@repeatable
@given(ROLLOUTS, UNIT)
def test_lambda_of_0_gives_one_step_returns(columns: list[Stream], gamma: float) -> None:
    data = Columns(columns, gamma)
    expected = data.rewards + data.discounts * data.next_values
    assert_close(lambda_returns(*data.of_returns, 0.0), expected)


@repeatable
@given(ROLLOUTS, UNIT, UNIT, st.floats(1.0, 4.0), st.floats(1.0, 4.0))
def test_vtrace_on_policy_is_the_lambda_return_and_its_advantage(
    columns: list[Stream], gamma: float, lam: float, rho_bar: float, c_bar: float
) -> None:
    data = Columns(columns, gamma)
    on_policy = torch.zeros_like(data.log_ratios)
    targets = vtrace_targets(on_policy, *data.of_targets, lam, rho_bar, c_bar)
    expected = actor_critic_targets(*data.of_targets, lam)
    assert_close(targets.values, expected.values, rtol=1e-5, atol=1e-4)
    assert_close(targets.advantages, expected.advantages, rtol=1e-5, atol=1e-4)


@repeatable
@given(ROLLOUTS, UNIT, UNIT, CLIP)
def test_vtrace_with_rho_clip_near_0_returns_the_values(
    columns: list[Stream], gamma: float, lam: float, c_bar: float
) -> None:
    data = Columns(columns, gamma)
    targets = vtrace_targets(data.log_ratios, *data.of_targets, lam, 1e-12, c_bar)
    assert torch.where(data.valid, targets.values - data.values, 0.0).abs().max() < 1e-6
    assert torch.where(data.valid, targets.weights, 0.0).abs().max() < 1e-6


@repeatable
@given(ROLLOUTS, UNIT, CLIP)
def test_vtrace_with_trace_clip_near_0_returns_one_step_targets(
    columns: list[Stream], gamma: float, rho_bar: float
) -> None:
    data = Columns(columns, gamma)
    targets = vtrace_targets(data.log_ratios, *data.of_targets, 1.0, rho_bar, 1e-12)
    rhos = data.log_ratios.exp().clamp(max=rho_bar)
    one_step = data.values + rhos * (data.rewards + data.discounts * data.next_values - data.values)
    assert_close(targets.values[data.valid], one_step[data.valid], rtol=1e-5, atol=1e-5)


@repeatable
@given(ROLLOUTS, UNIT, UNIT)
def test_vtrace_clips_ratios_above_both_clips(columns: list[Stream], gamma: float, lam: float) -> None:
    data = Columns(columns, gamma)
    high, higher = torch.full_like(data.log_ratios, 2.0), torch.full_like(data.log_ratios, 60.0)
    first = vtrace_targets(high, *data.of_targets, lam, 1.5, 0.75)
    second = vtrace_targets(higher, *data.of_targets, lam, 1.5, 0.75)
    assert torch.equal(first.values, second.values)
    assert torch.equal(first.advantages, second.advantages)


@repeatable
@given(ROLLOUTS, UNIT, UNIT, NUMBER)
def test_content_of_reset_rows_does_not_change_other_rows(
    columns: list[Stream], gamma: float, lam: float, garbage: float
) -> None:
    data = Columns(columns, gamma)

    def results() -> list[Tensor]:
        corrected = vtrace_targets(data.log_ratios, *data.of_targets, lam, 1.0, 1.0)
        plain = actor_critic_targets(*data.of_targets, lam)
        return [result[data.valid].clone() for result in (*corrected, *plain)]

    before = results()
    data.rewards[~data.valid] = garbage
    data.log_ratios[~data.valid] = garbage
    for ours, theirs in zip(before, results(), strict=True):
        assert torch.equal(ours, theirs)


# ---------------------------------------------------------------------------------------- worked by hand


def column(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float32).unsqueeze(1)


def test_n_step_returns_equal_a_hand_worked_example() -> None:
    # gamma = 1/2; no episode ends.
    #   G_2 = 4 + 1/2 * 30   = 19
    #   G_1 = 2 + 1/2 * 19   = 11.5
    #   G_0 = 1 + 1/2 * 11.5 = 6.75
    cut = torch.zeros(3, 1, dtype=torch.bool)
    result = lambda_returns(column(1, 2, 4), column(0.5, 0.5, 0.5), column(10, 20, 30), cut, 1.0)
    assert torch.equal(result, column(6.75, 11.5, 19))


def test_lambda_returns_equal_a_hand_worked_example() -> None:
    # gamma = lambda = 1/2; no episode ends.
    #   G_2 = 4 + 1/2 * 30                         = 19
    #   G_1 = 2 + 1/2 * (1/2 * 20 + 1/2 * 19)      = 11.75
    #   G_0 = 1 + 1/2 * (1/2 * 10 + 1/2 * 11.75)   = 6.4375
    cut = torch.zeros(3, 1, dtype=torch.bool)
    result = lambda_returns(column(1, 2, 4), column(0.5, 0.5, 0.5), column(10, 20, 30), cut, 0.5)
    assert torch.equal(result, column(6.4375, 11.75, 19))


def test_vtrace_equals_a_hand_worked_example() -> None:
    # gamma = 1/2, lambda = 1, rho-bar = 3/2, c-bar = 1; ratios 2 and 1/2; V = 4, 8, 16; r = 1, 2.
    #   rho = 3/2, 1/2      c_0 = 1
    #   delta_0 = 3/2 * (1 + 1/2 * 8  - 4) = 1.5     delta_1 = 1/2 * (2 + 1/2 * 16 - 8) = 1
    #   v_1 = 8 + 1 = 9                              v_0 = 4 + 1.5 + 1/2 * 1 * 1 = 6
    #   A_1 = 2 + 1/2 * 16 - 8 = 2                   A_0 = 1 + 1/2 * 9 - 4 = 1.5
    targets = vtrace_targets(
        column(2, 0.5).log(),
        column(1, 2),
        column(0.5, 0.5),
        column(4, 8),
        column(8, 16),
        torch.zeros(2, 1, dtype=torch.bool),
        1.0,
        1.5,
        1.0,
    )
    assert_close(targets.values, column(6, 9))
    assert_close(targets.advantages, column(1.5, 2))
    assert_close(targets.weights, column(1.5, 0.5))


def test_truncation_bootstraps_and_termination_does_not_within_one_rollout() -> None:
    # gamma = 1/2. Row 1 is truncated, row 2 is a reset row, row 4 terminates, row 5 is a reset row, row 6 continues.
    #   G_0 = 1 + 1/2 * 12 = 7      G_1 = 2 + 1/2 * 20 = 12, of V(s_2) = 20
    #   G_3 = 3 + 1/2 * 4  = 5      G_4 = 4, without V(s_5) = 50
    #   G_6 = 6 + 1/2 * 70 = 41
    no, yes = False, True
    rewards = column(1, 2, 1000, 3, 4, 1000, 6)
    discounts = column(0.5, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5)
    next_values = column(10, 20, 30, 40, 50, 60, 70)
    truncated = torch.tensor([no, yes, no, no, no, no, no]).unsqueeze(1)
    played = [0, 1, 3, 4, 6]
    expected = column(7, 12, 5, 4, 41)
    assert torch.equal(lambda_returns(rewards, discounts, next_values, truncated, 1.0)[played], expected)
    values = torch.cat([column(0), next_values[:-1]])
    on_policy = torch.zeros_like(rewards)
    targets = vtrace_targets(on_policy, rewards, discounts, values, next_values, truncated, 1.0, 1.0, 1.0)
    assert_close(targets.values[played], expected)
    assert_close(targets.advantages[played], expected - values[played])


SPEC = TrainingSpec(discount_factor=0.9, trace_lambda=0.8, rho_clip=1.25, trace_clip=0.75)
TERMINATED = [False, True, False, False, False, False]
TRUNCATED = [False, False, False, False, True, False]
VALID = [True, True, False, True, True, False]
ROWS = len(VALID)


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def flags(values: list[bool]) -> Tensor:
    return torch.tensor(values)[:, None]


def batch_of(rewards: Tensor, behaviour_log_probs: Tensor) -> Batch:
    """Return one environment: an episode that terminates, one that a limit cuts, and the rows that only reset."""
    return Batch(
        observations={},
        initial_state=torch.zeros(1, 0),
        starts=flags([False, False, False, True, False, False, True]),
        actions={},
        masks={},
        behaviour_log_probs=behaviour_log_probs,
        rewards=rewards,
        terminated=flags(TERMINATED),
        truncated=flags(TRUNCATED),
        valid=flags(VALID).float(),
    )


def test_targets_are_those_of_the_papers(random: torch.Generator) -> None:
    rewards, target, behaviour = (torch.randn(ROWS, 1, generator=random) for _ in range(3))
    values = torch.randn(ROWS + 1, 1, generator=random)
    batch = batch_of(rewards, behaviour)
    stream = Stream(
        r=rewards[:, 0].tolist(),
        V=values[:, 0].tolist(),
        log_ratios=(target - behaviour)[:, 0].tolist(),
        terminated=TERMINATED,
        truncated=TRUNCATED,
        valid=VALID,
    )
    assert max(stream.log_ratios) > 0.3 > -0.3 > min(stream.log_ratios)  # the clips bind in some rows only
    uncorrected = lambda_targets(SPEC, batch, target, values)
    corrected = vtrace_corrected_targets(SPEC, batch, target, values)
    for t in stream.rows:
        expected = lambda_return(stream, 0.9, 0.8, t)
        assert uncorrected.values[t, 0].item() == pytest.approx(expected, abs=1e-5)
        assert uncorrected.advantages[t, 0].item() == pytest.approx(expected - stream.V[t], abs=1e-5)
        settings = (0.9, 0.8, 1.25, 0.75, t)
        assert corrected.values[t, 0].item() == pytest.approx(vtrace(stream, *settings), abs=1e-5)
        assert corrected.advantages[t, 0].item() == pytest.approx(vtrace_advantage(stream, *settings), abs=1e-5)
    assert torch.equal(uncorrected.weights, torch.ones(ROWS, 1))
    assert torch.equal(corrected.weights, (target - behaviour).exp().clamp(max=1.25))


@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala"])
def test_rows_of_explored_actions_are_weighted_by_pi_over_mu(algorithm: str) -> None:
    """The gradient of the policy loss, by loops over rows; the actions of the batch are the actor's own."""
    torch.manual_seed(4)
    spec = TrainingSpec(algorithm=algorithm, exploration=(0.4,), trace_lambda=0.9, value_coefficient=0.0)
    network = ActorCritic(PolicySpec(hidden=(8,)), SPACES, training=spec)
    with torch.no_grad():
        network.policy_head.weight.mul_(200.0)
    rollout = make_rollout(seed=5)
    batch = join([rollout])
    with torch.no_grad():
        logits, _ = network(batch.observations, batch.initial_state, batch.starts)
    policy = torch.distributions.Categorical(logits=logits[:-1])
    actions = batch.actions["action"].squeeze(-1)
    behaviour = 0.6 * policy.log_prob(actions).exp() + 0.4 / 4
    batch.behaviour_log_probs.copy_(behaviour.log())
    computer = GradientComputer(spec, network, SPACES)
    list(computer.compute(batch, 0.0))
    first = computer.take_first_pass()
    assert first is not None
    weights = (policy.log_prob(actions).exp() / behaviour).clamp(max=1.0)
    assert weights.min() < 0.5
    again, _ = network(batch.observations, batch.initial_state, batch.starts)
    chosen = torch.distributions.Categorical(logits=again[:-1]).log_prob(actions)
    rows = batch.valid > 0.0
    loss = -(chosen * weights * first.advantages)[rows].mean()
    expected = torch.autograd.grad(loss, network.learned_parameters(), materialize_grads=True)
    flat = torch.cat([gradient.flatten() for gradient in expected])
    torch.testing.assert_close(computer.parameters.gradients, flat, rtol=1e-4, atol=1e-6)
