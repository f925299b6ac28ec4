"""Our layers compute the same as torch's."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from daedalus.policy.network.layers import BytesConv2d, PReLU, orthogonal


@pytest.mark.parametrize("slope", [0.25, -0.5, 0.0, 1.5])
@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("shape", [(3, 5, 4, 6), (1, 1, 1, 1), (2, 8, 16, 16)])
def test_prelu_matches_torch(slope: float, memory_format: torch.memory_format, shape: tuple[int, ...]) -> None:
    torch.manual_seed(3)
    ours, theirs = PReLU(), nn.PReLU()
    results = []
    inputs, outer = torch.randn(shape), torch.randn(shape).contiguous(memory_format=memory_format)
    inputs.flatten()[0] = 0.0  # torch treats zero as negative
    for layer in (ours, theirs):
        parameter = next(layer.parameters())
        nn.init.constant_(parameter, slope)
        given = inputs.contiguous(memory_format=memory_format).clone().requires_grad_()
        outputs = layer(given)
        outputs.backward(outer)
        results.append((outputs.detach(), given.grad, parameter.grad))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-5)


def test_gradients_of_prelu_match_its_definition() -> None:
    layer = PReLU().double()
    inputs = torch.randn(3, 2, 4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda given, _: layer(given), (inputs, layer.slope))


def test_slope_of_prelu_has_a_gradient_in_bfloat16() -> None:
    torch.manual_seed(3)
    layer, inputs, outer = PReLU(), torch.randn(64, 32, 8, 8), torch.randn(64, 32, 8, 8)
    layer(inputs.bfloat16().contiguous(memory_format=torch.channels_last)).backward(outer.bfloat16())
    expected = (outer * inputs.clamp(max=0.0)).sum()
    assert layer.slope.grad is not None
    assert layer.slope.grad.dtype == torch.float32
    torch.testing.assert_close(layer.slope.grad, expected.reshape(1), atol=0.5, rtol=0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_convolution_of_bytes_scales_them_to_the_unit_interval(dtype: torch.dtype) -> None:
    ours, plain = BytesConv2d(3, 8, 3), nn.Conv2d(3, 8, 3)
    plain.load_state_dict(ours.state_dict())
    images = torch.randint(0, 256, (2, 3, 9, 9)).float()
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        outputs = ours(images.to(dtype))
    assert outputs.dtype == dtype
    tolerance = 1e-5 if dtype == torch.float32 else 0.02
    torch.testing.assert_close(outputs.float(), plain(images / 255.0), atol=tolerance, rtol=tolerance)


def test_orthogonal_layers_scale_lengths_by_the_gain() -> None:
    layer = orthogonal(nn.Linear(8, 8), 2.0)
    inputs = torch.randn(5, 8)
    torch.testing.assert_close(functional.linear(inputs, layer.weight).norm(dim=1), 2.0 * inputs.norm(dim=1))
    assert (layer.bias == 0).all()
