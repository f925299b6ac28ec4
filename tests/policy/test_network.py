"""The network gives the same results step by step and unrolled, for one row and many, in every image layout."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plain import NAME, array_space, choices, vector_spaces
from policies import POLICIES, Policy, make_policy, observations, spaces
from torch import Tensor, nn
from torch.nn import functional
from torch.testing import assert_close

from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.custom_encoder import ObservationSpaces
from daedalus.policy.network.encoders import Encoder, FlatEncoder, build_encoder
from daedalus.policy.network.layers import BytesConv2d, PReLU, orthogonal
from daedalus.policy.network.perceptron import Perceptron
from daedalus.policy.network.recurrent_memory import Gru
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace
from daedalus.protocol.spec import PolicySpec

ENCODERS = ("small", "nature", "impala", "article")


@pytest.fixture(scope="module", params=POLICIES)
def policy(request: pytest.FixtureRequest) -> Policy:
    policy = make_policy(*POLICIES[request.param])
    policy.load(policy.weights())
    return policy


@pytest.fixture(scope="module")
def recurrent() -> Policy:
    policy = make_policy({"hidden": (8,), "memory": "gru", "memory_units": 12}, spaces((3,), "float32"))
    policy.load(policy.weights())
    return policy


def step_by_step(network: ActorCritic, seen: Tensor, state: Tensor, starts: Tensor) -> Tensor:
    """Compute row after row as an actor does, with the memory reset at episode starts: the oracle."""
    rows = []
    for row in range(len(seen)):
        for environment in range(len(state)):
            if starts[row, environment]:
                state[environment] = 0.0
        logits, state = network.step({NAME: seen[row]}, state)
        rows.append(logits)
    return torch.stack(rows)


def check_unroll(policy: Policy, starts: np.ndarray, seed: int) -> None:
    rows, environments = starts.shape
    seen = torch.from_numpy(observations(array_space(policy.spaces), (rows, environments), seed))
    state = torch.from_numpy(policy.states(environments, seed))
    begins = torch.from_numpy(starts)
    with torch.no_grad():
        logits, values = policy.network({NAME: seen}, state.clone(), begins)
        expected = step_by_step(policy.network, seen, state.clone(), begins)
    assert logits.shape == (rows, environments, choices(policy.spaces))
    assert values.shape == (rows, environments)
    torch.testing.assert_close(logits, expected, atol=2e-5, rtol=1e-4)


def test_forward_matches_acting_row_by_row(policy: Policy) -> None:
    starts = np.zeros((5, 3), np.bool_)
    starts[2, 0] = starts[3, 1] = starts[0, 2] = True
    check_unroll(policy, starts, 0)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    starts=st.integers(1, 6).flatmap(
        lambda rows: st.lists(st.lists(st.booleans(), min_size=rows, max_size=rows), min_size=1, max_size=4)
    ),
    seed=st.integers(0, 1000),
)
def test_episodes_may_start_anywhere(recurrent: Policy, starts: list[list[bool]], seed: int) -> None:
    check_unroll(recurrent, np.array(starts, np.bool_).T, seed)


def test_memory_is_reset_only_at_episode_starts(recurrent: Policy) -> None:
    seen = torch.from_numpy(observations(array_space(recurrent.spaces), (4, 1)))
    starts = torch.tensor([[False], [False], [True], [False]])
    states = [torch.zeros(1, 12), torch.ones(1, 12)]
    with torch.no_grad():
        one, other = (recurrent.network({NAME: seen}, state, starts)[0] for state in states)
    torch.testing.assert_close(one[2:], other[2:])
    assert (one[:2] - other[:2]).abs().amax(-1).min() > 1e-4


def test_gradients_flow_through_the_memory_of_all_rows(recurrent: Policy) -> None:
    seen = torch.from_numpy(observations(array_space(recurrent.spaces), (4, 2))).requires_grad_()
    logits, _ = recurrent.network({NAME: seen}, torch.zeros(2, 12), torch.zeros(4, 2, dtype=torch.bool))
    logits[3, 0].square().sum().backward()
    assert seen.grad is not None
    assert (seen.grad[:, 0].abs().sum(-1) > 0).all()
    assert (seen.grad[:, 1] == 0).all()


def test_gru_matches_torch() -> None:
    ours, theirs = Gru(7, 5), nn.GRUCell(7, 5)
    with torch.no_grad():
        for parameter in ours.parameters():
            parameter.normal_()
        theirs.weight_ih.copy_(ours.input.weight)
        theirs.bias_ih.copy_(ours.input.bias)
        theirs.weight_hh.copy_(ours.hidden.weight)
        theirs.bias_hh.copy_(ours.hidden.bias)
        features, state = torch.randn(9, 7), torch.randn(9, 5)
        torch.testing.assert_close(ours.step(features, state)[0], theirs(features, state), atol=1e-6, rtol=1e-5)


def test_one_row_and_many_rows_give_the_same(policy: Policy) -> None:
    seen, states = torch.from_numpy(policy.observations(6)), torch.from_numpy(policy.states(6))
    with torch.no_grad():
        together, _ = policy.network.step({NAME: seen}, states)
        alone = [policy.network.step({NAME: seen[row : row + 1]}, states[row : row + 1])[0] for row in range(6)]
    torch.testing.assert_close(together, torch.cat(alone), atol=2e-5, rtol=1e-4)


def test_heads_are_float32_under_autocast(policy: Policy) -> None:
    seen = torch.from_numpy(observations(array_space(policy.spaces), (3, 4)))
    state, starts = torch.from_numpy(policy.states(4)), torch.zeros(3, 4, dtype=torch.bool)
    logits, values = policy.network({NAME: seen}, state, starts)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough_logits, rough_values = policy.network({NAME: seen}, state, starts)
        _, next_state = policy.network.step({NAME: seen[0]}, state)
    assert (rough_logits.dtype, rough_values.dtype, next_state.dtype) == (torch.float32,) * 3
    assert (logits - rough_logits).abs().max() < 0.05 * max(1.0, float(logits.detach().abs().max()))
    assert (values - rough_values).abs().max() < 0.05 * max(1.0, float(values.detach().abs().max()))
    (rough_logits.sum() + rough_values.sum()).backward()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in policy.network.parameters())


def test_new_policies_are_nearly_uniform() -> None:
    for spec, where in POLICIES.values():
        network = ActorCritic(PolicySpec.model_validate(spec), where)
        seen = torch.from_numpy(observations(array_space(where), (1, 8)))
        state, starts = torch.zeros(8, network.state_size), torch.zeros(1, 8, dtype=torch.bool)
        logits, values = network({NAME: seen}, state, starts)
        assert logits.detach().abs().max() < 0.2
        assert torch.isfinite(values).all()


def test_convolutional_is_true_for_image_encoders(policy: Policy) -> None:
    assert policy.network.convolutional == (policy.spec.encoder not in ("auto", "mlp"))


# ------------------------------------------------------------------------------------------- encoders


def encoder_of(name: str, shape: tuple[int, ...], dtype: str = "uint8", frames: int = 1) -> nn.Module:
    torch.manual_seed(0)  # the same weights for equal shapes
    space = ArraySpace.model_validate({"shape": shape, "dtype": dtype, "frames": frames})
    return _Plain(build_encoder(PolicySpec(encoder=name), {NAME: space})).requires_grad_(False)


class _Plain(nn.Module):
    """An encoder of one component that takes a tensor in place of a map."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder, self.features = encoder, encoder.features

    def named_parameters(self, *arguments: Any, **options: Any) -> Any:
        return self.encoder.named_parameters(*arguments, **options)

    def forward(self, observations: Tensor) -> Tensor:
        return self.encoder({NAME: observations})


@pytest.mark.parametrize(
    ("name", "shape", "features"),
    [("small", (84, 84), 256), ("nature", (84, 84), 512), ("impala", (84, 84), 256), ("article", (96, 96), 1152)],
)
def test_sizes_of_published_networks(name: str, shape: tuple[int, ...], features: int) -> None:
    encoder = encoder_of(name, shape, frames=4)
    parameters = {name: p.numel() for name, p in encoder.named_parameters()}
    assert encoder.features == features
    assert encoder(torch.zeros((2, 4, *shape), dtype=torch.uint8)).shape == (2, features)
    counts = {
        # Weights and biases, layer by layer.
        "small": (4 * 64 * 16 + 16) + (16 * 16 * 32 + 32) + (2592 * 256 + 256),
        "nature": (4 * 64 * 32 + 32) + (32 * 16 * 64 + 64) + (64 * 9 * 64 + 64) + (3136 * 512 + 512),
        "impala": (4 * 9 * 16 + 16) + 4 * (16 * 9 * 16 + 16) + (16 * 9 * 32 + 32) + 4 * (32 * 9 * 32 + 32)
        + (32 * 9 * 32 + 32) + 4 * (32 * 9 * 32 + 32) + (3872 * 256 + 256),
        "article": (4 * 16 * 32 + 32 + 1) + 3 * (32 * 9 * 32 + 32 + 1) + 2 * 1152,
    }  # fmt: skip
    assert sum(parameters.values()) == counts[name]


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_all_layouts_give_the_same_features(name: str, dtype: str) -> None:
    height, width, frames, colours = 40, 44, 2, 3
    pictures = observations(
        ArraySpace.model_validate({"shape": (frames * colours, height, width), "dtype": dtype}), (2,)
    )
    split = pictures.reshape(2, frames, colours, height, width)
    layouts = [
        (encoder_of(name, (frames * colours, height, width), dtype), pictures),
        (encoder_of(name, (height, width), dtype, frames * colours), pictures),
        (encoder_of(name, (height, width, colours), dtype, frames), split.transpose(0, 1, 3, 4, 2)),
    ]
    first, *others = [encoder(torch.from_numpy(np.ascontiguousarray(seen))) for encoder, seen in layouts]
    assert first.std() > 1e-3
    for other in others:
        torch.testing.assert_close(other, first, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ENCODERS)
def test_layouts_of_one_frame(name: str) -> None:
    grey = observations(ArraySpace(shape=(40, 44), dtype="uint8"), (2,))
    colours = np.stack([grey, grey // 2, grey // 3], -1)
    first, deeper = (encoder_of(name, shape) for shape in ((40, 44), (40, 44, 1)))
    torch.testing.assert_close(first(torch.from_numpy(grey)), deeper(torch.from_numpy(grey[..., None])))
    first, deeper = (encoder_of(name, shape) for shape in ((3, 40, 44), (40, 44, 3)))
    channels_first = torch.from_numpy(np.ascontiguousarray(colours.transpose(0, 3, 1, 2)))
    torch.testing.assert_close(first(channels_first), deeper(torch.from_numpy(colours)), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ENCODERS)
def test_convolutions_of_one_grey_frame_have_channels_last(name: str) -> None:
    made: list[Any] = []
    whole = build_encoder(PolicySpec(encoder=name), {NAME: ArraySpace(shape=(40, 44), dtype="uint8")})
    for module in whole.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(lambda _module, _inputs, output: made.append(output))
    whole({NAME: torch.zeros(2, 40, 44, dtype=torch.uint8)})
    assert made
    assert all(each.is_contiguous(memory_format=torch.channels_last) for each in made)


def test_colours_are_on_the_shorter_of_the_outer_axes() -> None:
    pictures = observations(ArraySpace(shape=(5, 40, 44), dtype="uint8"), (2,))
    first, last = (encoder_of("nature", shape) for shape in ((5, 40, 44), (40, 44, 5)))
    seen = torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 2, 3, 1)))
    torch.testing.assert_close(last(seen), first(torch.from_numpy(pictures)), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ["small", "nature", "impala"])
def test_bytes_are_scaled_to_the_unit_interval(name: str) -> None:
    seen = torch.from_numpy(observations(ArraySpace(shape=(40, 44), dtype="uint8"), (2,)))
    ours, plain = encoder_of(name, (40, 44), "uint8"), encoder_of(name, (40, 44), "float32")
    torch.testing.assert_close(ours(seen), plain(seen / 255.0), atol=1e-5, rtol=1e-4)


def test_article_encoder_ignores_brightness() -> None:
    seen = torch.from_numpy(observations(ArraySpace(shape=(4, 48, 48), dtype="float32"), (2,)))
    encoder = encoder_of("article", (4, 48, 48), "float32")
    torch.testing.assert_close(encoder(seen), encoder(3.0 * seen + 5.0), atol=1e-4, rtol=1e-3)
    black = encoder_of("article", (48, 48), "uint8")(torch.zeros((1, 48, 48), dtype=torch.uint8))
    assert torch.isfinite(black).all()


def test_article_encoder_normalises_each_image() -> None:
    seen = torch.from_numpy(observations(ArraySpace(shape=(4, 32, 32), dtype="float32"), (3,)))
    encoder = encoder_of("article", (4, 32, 32), "float32")
    centred = seen - seen.mean((1, 2, 3), keepdim=True)
    images = centred / centred.square().mean((1, 2, 3), keepdim=True).add(1e-5).sqrt()
    weights = dict(encoder.named_parameters())
    for layer in range(4):
        weight, bias = (weights[f"convolutions.{2 * layer}.{kind}"] for kind in ("weight", "bias"))
        images = functional.conv2d(images, weight, bias, stride=2, padding=1)
        images = functional.prelu(images, weights[f"convolutions.{2 * layer + 1}.slope"])
    expected = functional.layer_norm(
        images.flatten(1), (images[0].numel(),), weights["head.weight"], weights["head.bias"]
    )
    torch.testing.assert_close(encoder(seen), expected, atol=1e-5, rtol=1e-4)


def test_mlp_without_layers_flattens_stacks() -> None:
    encoder = FlatEncoder({NAME: ArraySpace(shape=(3,), dtype="float32", frames=2)}, PolicySpec(hidden=()))
    assert encoder.features == 6
    seen = torch.arange(12.0).reshape(2, 2, 3)
    torch.testing.assert_close(encoder({NAME: seen}), seen.reshape(2, 6))


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize(("shape", "frames"), [((4,), 1), ((4,), 4), ((2, 3, 4, 5), 1)])
def test_observations_that_are_not_images_are_rejected(name: str, shape: tuple[int, ...], frames: int) -> None:
    with pytest.raises(NetworkError, match=rf"'{name}' takes images.*{shape[0]}.*policy\.encoder"):
        encoder_of(name, shape, frames=frames)


@pytest.mark.parametrize(("name", "shape"), [("nature", (20, 20)), ("nature", (84, 35)), ("article", (1, 96))])
def test_too_small_image_is_rejected(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(NetworkError, match=rf"'{name}' needs images larger than a uint8 array of shape \({shape[0]}, "):
        encoder_of(name, shape, frames=4)


def test_smallest_accepted_images() -> None:
    assert encoder_of("nature", (36, 36)).features == 512
    assert encoder_of("impala", (1, 1)).features == 256
    assert encoder_of("article", (2, 2)).features == 32


@pytest.mark.parametrize("mixed", [False, True])
def test_values_near_100_that_differ_by_a_tenth_stay_distinct(mixed: bool) -> None:
    """A head that ran in bfloat16 would keep 8 bits: steps of 0.5 between 64 and 128."""
    spaces = vector_spaces(1, 2)
    network = ActorCritic(PolicySpec(hidden=()), spaces)
    assert network.value_head is not None
    with torch.no_grad():
        for head in (network.policy_head, network.value_head):
            head.weight.fill_(1.0)
    seen = (100.0 + torch.arange(10) / 10).reshape(1, 10, 1)
    state, starts = torch.zeros(10, 0), torch.zeros(1, 10, dtype=torch.bool)
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=mixed):
        logits, values = network({NAME: seen}, state, starts)
    assert torch.equal(values[0], seen[0, :, 0])
    assert torch.equal(logits[0, :, 0], seen[0, :, 0])


@pytest.mark.parametrize(
    ("shape", "dtype", "encoder"),
    [
        ((4,), "float32", "mlp"),
        ((128,), "uint8", "mlp"),
        ((7, 7, 3), "uint8", "mlp"),
        ((84, 84), "float32", "mlp"),
        ((84, 84), "uint8", "nature"),
        ((210, 160, 3), "uint8", "nature"),
        ((3, 36, 64), "uint8", "nature"),
        ((35, 84), "uint8", "impala"),
        ((16, 16, 3), "uint8", "impala"),
    ],
)
def test_encoder_is_chosen_by_the_space(shape: tuple[int, ...], dtype: str, encoder: str) -> None:
    with torch.device("meta"):  # only the shapes matter, and to initialise the largest network takes a second
        chosen, named = encoder_of("auto", shape, dtype), encoder_of(encoder, shape, dtype)
    assert {name: value.shape for name, value in chosen.state_dict().items()} == {
        name: value.shape for name, value in named.state_dict().items()
    }


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
    for found, wanted in zip(
        torch.autograd.grad(features, parameters, outer), torch.autograd.grad(expected, parameters, outer), strict=True
    ):
        torch.testing.assert_close(found, wanted)
    with torch.no_grad():
        torch.testing.assert_close(encoder(observations), expected)


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
