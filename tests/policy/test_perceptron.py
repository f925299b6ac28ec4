"""policy/network/perceptron.py against torch's own layers."""

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from daedalus.policy.network.custom_encoder import ObservationSpaces
from daedalus.policy.network.encoders import FlatEncoder
from daedalus.policy.network.perceptron import Perceptron
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.protocol.spec import PolicySpec


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("hidden", [(), (7,), (7, 3), (5, 6, 4)])
@pytest.mark.parametrize("input_gradient", [False, True])
def test_gradients_equal_those_of_the_layers(activation: str, hidden: tuple[int, ...], input_gradient: bool) -> None:
    torch.manual_seed(4)
    perceptron = Perceptron(5, hidden, "tanh" if activation == "tanh" else "relu")
    inputs = torch.randn(11, 5, requires_grad=input_gradient)
    weights = torch.randn(11, perceptron.features)

    def results(module: nn.Module) -> list[torch.Tensor]:
        outputs = module(inputs)
        wanted = [*perceptron.parameters(), *([inputs] if input_gradient else [])]
        return [outputs, *torch.autograd.grad((outputs * weights).sum(), wanted)] if wanted else [outputs]

    for ours, theirs in zip(results(perceptron), results(nn.Sequential(*perceptron)), strict=True):
        assert_close(ours, theirs)


def test_gradients_equal_finite_differences() -> None:
    perceptron = Perceptron(3, (4, 2), "tanh").double()
    assert torch.autograd.gradcheck(perceptron, torch.randn(5, 3, dtype=torch.float64, requires_grad=True))


def test_features_without_gradients_equal_those_with() -> None:
    perceptron, inputs = Perceptron(3, (8, 8), "tanh"), torch.randn(6, 3)
    with torch.no_grad():
        assert_close(perceptron(inputs), perceptron(inputs.clone().requires_grad_()))
    assert_close(perceptron(inputs).detach(), nn.Sequential(*perceptron)(inputs).detach())


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("hidden", [(7,), (8, 6)])
def test_choices_have_the_features_and_gradients_of_one_hot_inputs(hidden: tuple[int, ...], activation: str) -> None:
    """A column may be chosen by several rows. The reference: torch's own layers on the one-hot inputs."""
    spaces: ObservationSpaces = {"place": DiscreteSpace(counts=(5,)), "dice": DiscreteSpace(counts=(3, 2))}
    spec = PolicySpec.model_validate({"hidden": hidden, "activation": activation})
    encoder = FlatEncoder(spaces, spec)
    observations = {"place": torch.tensor([[4], [0], [4], [2]]), "dice": torch.tensor([[0, 1], [2, 0], [0, 0], [1, 1]])}
    one_hot = torch.tensor(
        [
            [0, 0, 0, 0, 1, 1, 0, 0, 0, 1],
            [1, 0, 0, 0, 0, 0, 0, 1, 1, 0],
            [0, 0, 0, 0, 1, 1, 0, 0, 1, 0],
            [0, 0, 1, 0, 0, 0, 1, 0, 0, 1],
        ],
        dtype=torch.float32,
    )
    parameters, outer = list(encoder.parameters()), torch.randn(4, hidden[-1])
    expected = torch.nn.Sequential.forward(encoder.layers, one_hot)
    features = encoder(observations)
    torch.testing.assert_close(features, expected)
    for given, wanted in zip(
        torch.autograd.grad(features, parameters, outer), torch.autograd.grad(expected, parameters, outer), strict=True
    ):
        torch.testing.assert_close(given, wanted)
    with torch.no_grad():
        torch.testing.assert_close(encoder(observations), expected)
