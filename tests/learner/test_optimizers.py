"""learner/training/optimizers.py against torch's optimisers and against the formula of the paper."""

import copy
import math

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from daedalus.algorithms.forward import FlatParameters
from daedalus.learner.training.optimizers import Adam, RmsProp

MADE, SKIPPED = torch.zeros(()), torch.ones(())


def network() -> nn.Sequential:
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(4, 5), nn.Tanh(), nn.Linear(5, 2))


def gradients(steps: int, size: int) -> list[torch.Tensor]:
    """Return gradients of very different sizes, with zeros at random places."""
    random = torch.Generator().manual_seed(9)
    scales = 10.0 ** torch.linspace(-6.0, 2.0, size)
    return [
        torch.randn(size, generator=random) * scales * (torch.rand(size, generator=random) > 0.2) for _ in range(steps)
    ]


@pytest.mark.parametrize("epsilon", [1e-8, 1e-5, 1e-2])
def test_adam_equals_torch_adam(epsilon: float) -> None:
    size = 40
    ours = torch.linspace(-1.0, 1.0, size)
    theirs = nn.Parameter(ours.clone())
    adam, reference = Adam(torch.zeros(size), epsilon), torch.optim.Adam([theirs], eps=epsilon)
    for step, gradient in enumerate(gradients(200, size)):
        rate = 1e-2 * (1.0 - step / 200)
        adam.step(ours, gradient, torch.tensor(rate), MADE)
        reference.param_groups[0]["lr"] = rate
        theirs.grad = gradient.clone()
        reference.step()
        assert_close(ours, theirs.detach(), rtol=1e-5, atol=1e-6)


def test_rmsprop_adds_epsilon_inside_the_root() -> None:
    size, epsilon, decay, rate = 6, 1e-1, 0.9, 0.01
    ours = torch.linspace(-1.0, 1.0, size)
    theta, g = ours.tolist(), [0.0] * size
    rmsprop = RmsProp(torch.zeros(size), epsilon, decay)
    for gradient in gradients(50, size):
        rmsprop.step(ours, gradient, torch.tensor(rate), MADE)
        for i, d in enumerate(gradient.tolist()):
            g[i] = decay * g[i] + (1.0 - decay) * d * d
            theta[i] -= rate * d / math.sqrt(g[i] + epsilon)
        assert ours.tolist() == pytest.approx(theta, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("optimizer", [Adam(torch.ones(6), 1e-5), RmsProp(torch.ones(6), 1e-5, 0.9)])
def test_a_skipped_step_changes_nothing(optimizer: Adam | RmsProp) -> None:
    values = torch.ones(6)
    optimizer.step(values, torch.ones(6), torch.tensor(0.1), MADE)
    before = [each.clone() for each in (values, *optimizer.statistics.values())]
    optimizer.step(values, torch.full((6,), math.nan), torch.tensor(0.1), SKIPPED)
    for after, expected in zip((values, *optimizer.statistics.values()), before, strict=True):
        assert torch.equal(after, expected)


def test_flat_parameters_keep_the_initial_values() -> None:
    module, same = network(), network()
    FlatParameters(module.parameters())
    for ours, theirs in zip(module.parameters(), same.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_change_of_the_flat_vector_changes_the_module() -> None:
    module, observations = network(), torch.ones(3, 4)
    flat = FlatParameters(module.parameters())
    before = module(observations)
    flat.values.zero_()
    assert torch.equal(module(observations), torch.zeros_like(before))
    flat.values[-2:] = torch.tensor([7.0, 8.0])  # the last bias
    assert torch.equal(module(observations), torch.tensor([7.0, 8.0]).expand(3, 2))


def test_backward_fills_the_flat_gradients_repeatedly() -> None:
    module = network()
    reference = copy.deepcopy(module)
    flat = FlatParameters(module.parameters())
    for scale in (1.0, -3.0):
        flat.gradients.copy_(flat.differentiated((scale * module(torch.ones(3, 4))).square().sum()))
        reference.zero_grad()
        (scale * reference(torch.ones(3, 4))).square().sum().backward()
        expected = [parameter.grad.flatten() for parameter in reference.parameters() if parameter.grad is not None]
        assert_close(flat.gradients, torch.cat(expected))


@pytest.mark.parametrize("max_norm", [0.5, 1e6])
def test_gradient_clipping_equals_torch_clipping(max_norm: float) -> None:
    module = network()
    reference = copy.deepcopy(module)
    flat = FlatParameters(module.parameters())
    reference(torch.ones(3, 4)).square().sum().mul(10.0).backward()
    flat.gradients.copy_(flat.differentiated(module(torch.ones(3, 4)).square().sum().mul(10.0)))
    norm = nn.utils.clip_grad_norm_(reference.parameters(), max_norm)
    assert flat.clip_gradients(max_norm) == pytest.approx(norm.item())
    theirs = [parameter.grad.flatten() for parameter in reference.parameters() if parameter.grad is not None]
    assert_close(flat.gradients, torch.cat(theirs))


def test_gradient_of_a_parameter_that_the_loss_does_not_use_is_0() -> None:
    module = network()
    flat = FlatParameters(module.parameters())
    flat.gradients.fill_(3.0)
    flat.gradients.copy_(flat.differentiated(next(iter(module.parameters())).sum()))
    used = next(iter(module.parameters())).numel()
    assert flat.gradients[:used].eq(1.0).all()
    assert flat.gradients[used:].eq(0.0).all()


@pytest.mark.parametrize("bad", [math.inf, math.nan])
def test_clipping_leaves_gradients_that_are_not_finite(bad: float) -> None:
    flat = FlatParameters(network().parameters())
    flat.gradients[3] = bad
    assert not math.isfinite(flat.clip_gradients(0.5))
