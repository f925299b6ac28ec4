"""algorithms/returns.py against the sums of the papers, with every setting different from its neutral value."""

import pytest
import torch
from oracles import Stream, lambda_return, vtrace, vtrace_advantage
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.returns import lambda_targets, vtrace_corrected_targets
from daedalus.protocol.spec import TrainingSpec

SPEC = TrainingSpec(discount_factor=0.9, trace_lambda=0.8, rho_clip=1.25, trace_clip=0.75)
TERMINATED = [False, True, False, False, False, False]
TRUNCATED = [False, False, False, False, True, False]
VALID = [True, True, False, True, True, False]
ROWS = len(VALID)


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def column(values: list[bool]) -> Tensor:
    return torch.tensor(values)[:, None]


def batch_of(rewards: Tensor, behaviour_log_probs: Tensor) -> Batch:
    """Return one environment: an episode that terminates, one that a limit cuts, and the rows that only reset."""
    return Batch(
        observations={},
        initial_state=torch.zeros(1, 0),
        starts=column([False, False, False, True, False, False, True]),
        actions={},
        masks={},
        behaviour_log_probs=behaviour_log_probs,
        rewards=rewards,
        terminated=column(TERMINATED),
        truncated=column(TRUNCATED),
        valid=column(VALID).float(),
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
