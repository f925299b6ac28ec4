"""Each distribution against torch's own, against the frequencies of its samples, and exported against torch."""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch import distributions as reference

from daedalus.policy.acting.noise import draw_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.distributions import (
    Categorical,
    Distribution,
    Gaussian,
    GaussianMixture,
    Kumaraswamy,
    SquashedGaussian,
    without_illegal,
)
from daedalus.policy.user_modules import NetworkError, UserModules
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec

SAMPLES = 20_000
KOLMOGOROV = 1.95 / math.sqrt(SAMPLES)  # the 0.999 quantile of the statistic for so many samples
repeatable = settings(max_examples=60, deadline=None, derandomize=True)
BOX = ContinuousSpace(low=(-1.0, 0.0, -3.0), high=(1.0, 2.0, 3.0))

FAMILIES: dict[str, Callable[[], Distribution]] = {
    "gaussian": lambda: Gaussian(BOX, initial_std=0.6, state_dependent=False),
    "gaussian, state": lambda: Gaussian(BOX, initial_std=0.6, state_dependent=True),
    "squashed": lambda: SquashedGaussian(BOX, initial_std=0.6, state_dependent=False),
    "squashed, state": lambda: SquashedGaussian(BOX, initial_std=0.6, state_dependent=True),
    "mixture": lambda: GaussianMixture(BOX, initial_std=0.4, components=3),
    "mixture of one": lambda: GaussianMixture(BOX, initial_std=0.4, components=1),
    "kumaraswamy": lambda: Kumaraswamy(BOX),
}


@pytest.fixture(params=FAMILIES)
def family(request: pytest.FixtureRequest) -> Distribution:
    return FAMILIES[request.param]().requires_grad_(False)


def parameters_of(family: Distribution, rows: int, seed: int = 1) -> Tensor:
    """Return parameters of one distribution, repeated for every row."""
    return torch.randn(family.parameter_count, generator=torch.Generator().manual_seed(seed)).expand(rows, -1)


def sampled(family: Distribution, parameters: Tensor, seed: int = 2) -> Tensor:
    random, rows = np.random.default_rng(seed), len(parameters)
    uniform = torch.from_numpy(random.random((rows, family.uniform_count), np.float32))
    normal = torch.from_numpy(random.standard_normal((rows, family.normal_count), np.float32))
    return family.sample(parameters, uniform, normal)


# ------------------------------------------------------------------------------------------ continuous


def test_samples_follow_the_density(family: Distribution) -> None:
    """The distribution function, integrated from the density, at the samples must be uniform (Kolmogorov-Smirnov)."""
    parameters = parameters_of(family, SAMPLES)
    actions = sampled(family, parameters)
    assert (actions.shape, actions.dtype) == ((SAMPLES, 3), torch.float32)
    for dimension in range(3):
        values = actions[:, dimension].sort().values.double()
        low, high = (values[0] - 3, values[-1] + 3) if family.normal_count else (-1.0, 1.0)
        low, high = (max(low, -1.0), min(high, 1.0)) if isinstance(family, SquashedGaussian) else (low, high)
        grid = torch.linspace(float(low), float(high), 40_001, dtype=torch.float64)
        middle = actions.median(0).values.repeat(len(grid), 1)
        at = middle.clone()
        at[:, dimension] = grid.float()
        joint = family.log_prob(parameters_of(family, len(grid)), at).double()
        density = (joint - joint.max()).exp()  # of this dimension, up to a factor
        cumulative = torch.cumulative_trapezoid(density, grid)
        expected = torch.from_numpy(np.interp(values.numpy(), grid[1:].numpy(), (cumulative / cumulative[-1]).numpy()))
        ranks = torch.arange(1, SAMPLES + 1) / SAMPLES
        assert (ranks - expected).abs().max() < KOLMOGOROV + 2e-3  # of it 2e-3 for the grid


def test_density_integrates_to_one(family: Distribution) -> None:
    grid = torch.linspace(-8, 8, 400_001) if family.normal_count else torch.linspace(-1, 1, 400_001)
    if isinstance(family, SquashedGaussian):
        grid = torch.linspace(-1 + 1e-6, 1 - 1e-6, 400_001)
    one = type(BOX)(low=(-1.0,), high=(1.0,))
    single = {
        Gaussian: lambda: Gaussian(one, initial_std=0.6, state_dependent=False),
        SquashedGaussian: lambda: SquashedGaussian(one, initial_std=0.6, state_dependent=False),
        GaussianMixture: lambda: GaussianMixture(one, initial_std=0.4, components=3),
        Kumaraswamy: lambda: Kumaraswamy(one),
    }[type(family)]().requires_grad_(False)
    log_probs = single.log_prob(parameters_of(single, len(grid)), grid.unsqueeze(-1))
    assert torch.trapezoid(log_probs.exp(), grid) == pytest.approx(1.0, abs=2e-3)


def test_entropy_is_the_mean_of_minus_the_log_probability(family: Distribution) -> None:
    parameters = parameters_of(family, 100_000)
    log_probs = family.log_prob(parameters, sampled(family, parameters))
    error = float(log_probs.std()) / math.sqrt(len(log_probs))
    assert float(family.entropy(parameters[:1])) == pytest.approx(-float(log_probs.mean()), abs=5 * error + 2e-3)


def test_entropy_and_log_probability_have_finite_gradients(family: Distribution) -> None:
    family.requires_grad_()
    for scale in (1.0, 30.0):
        parameters = (scale * parameters_of(family, 8)).clone().requires_grad_()
        actions = sampled(family, parameters).detach()
        log_probs, entropy = family.log_prob_and_entropy(parameters, actions)
        (log_probs.sum() + entropy.sum()).backward()
        assert torch.isfinite(log_probs).all()
        assert parameters.grad is not None
        assert torch.isfinite(parameters.grad).all()
        assert all(own.grad is None or torch.isfinite(own.grad).all() for own in family.parameters())


def test_extreme_noise_gives_finite_log_probabilities(family: Distribution) -> None:
    parameters = parameters_of(family, 2)
    largest = float(np.nextafter(np.float32(1), np.float32(0)))
    uniform = torch.tensor([[0.0], [largest]]).expand(2, family.uniform_count)
    normal = torch.tensor([[-6.0], [6.0]]).expand(2, family.normal_count)
    if family.normal_count and family.uniform_count:
        uniform = uniform.clamp(1e-6)  # all zero would leave no component to choose
    actions = family.sample(parameters, uniform, normal)
    assert torch.isfinite(actions).all()
    assert torch.isfinite(family.log_prob(parameters, actions)).all()
    if not isinstance(family, GaussianMixture) and type(family) is not Gaussian:
        assert actions.abs().max() <= 1.0


def test_gaussian_is_that_of_torch() -> None:
    family = FAMILIES["gaussian, state"]().requires_grad_(False)
    parameters, actions = torch.randn(50, 6), torch.randn(50, 3)
    mean, relative = parameters.split(3, -1)
    expected = reference.Normal(mean, (math.log(0.6) + relative).clamp(-5, 2).exp())
    torch.testing.assert_close(family.log_prob(parameters, actions), expected.log_prob(actions).sum(-1))
    torch.testing.assert_close(family.entropy(parameters), expected.entropy().sum(-1))
    normal = torch.randn(50, 3)
    torch.testing.assert_close(family.sample(parameters, torch.zeros(50, 0), normal), mean + expected.stddev * normal)


def test_squashed_gaussian_is_that_of_torch() -> None:
    torch.manual_seed(1)  # a sample near the bound has few digits left
    family = FAMILIES["squashed"]().requires_grad_(False)
    mean = torch.randn(50, 3)
    plain = reference.Normal(mean, torch.full((3,), 0.6))
    expected = reference.TransformedDistribution(plain, [reference.TanhTransform()])
    actions = family.sample(mean, torch.zeros(50, 0), torch.randn(50, 3))
    torch.testing.assert_close(family.log_prob(mean, actions), expected.log_prob(actions).sum(-1), atol=2e-4, rtol=1e-4)


@pytest.mark.parametrize("std", [0.05, 0.3])
@pytest.mark.parametrize("mean", [3.0, 7.25, 14.5, 1e4, -14.5])
def test_recorded_density_of_a_squashed_gaussian_is_that_of_its_samples(mean: float, std: float) -> None:
    """Beyond +-7.25 all samples are the same number in float32; the density of the tanh's argument is in float64."""
    family = SquashedGaussian(ContinuousSpace(low=(-1.0,), high=(1.0,)), initial_std=std, state_dependent=False)
    parameters, none = torch.full((2000, 1), mean), torch.zeros(2000, 0)
    normal = torch.randn(2000, 1, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        recorded = family.log_prob(parameters, family.sample(parameters, none, normal)).double()
        greedy = float(family.sample(parameters[:1], none[:1], torch.zeros(1, 1)))
    beyond = max(abs(mean) - 4, 0)
    limited = math.copysign(min(abs(mean), 4) + beyond / (1 + beyond / 2), mean)
    argument = limited + std * normal[:, 0].double()
    slope = 2 * (math.log(2) - argument - torch.nn.functional.softplus(-2 * argument))  # log(1 - tanh^2)
    expected = reference.Normal(torch.tensor(limited).double(), std).log_prob(argument) - slope
    assert (recorded - expected).abs().max() < 0.2
    assert greedy == pytest.approx(math.tanh(mean), abs=1e-4)  # policies that were trained without the limit


def test_mixture_is_that_of_torch() -> None:
    family = GaussianMixture(BOX, initial_std=0.4, components=3).requires_grad_(False)
    parameters, actions = torch.randn(50, 18), torch.randn(50, 3)
    logits, means = parameters.unflatten(-1, (2, 3, 3)).unbind(1)
    components = reference.Normal(means + torch.tensor([-0.5, 0.0, 0.5]), torch.full((3, 3), 0.4))
    expected = reference.MixtureSameFamily(reference.Categorical(logits=logits), components)
    torch.testing.assert_close(family.log_prob(parameters, actions), expected.log_prob(actions).sum(-1))


def test_kumaraswamy_is_that_of_torch() -> None:
    family = Kumaraswamy(BOX)
    parameters = torch.randn(50, 6)
    a, b = (1 + torch.nn.functional.softplus(parameters)).split(3, -1)
    expected = reference.Kumaraswamy(a, b)
    x = torch.rand(50, 3) * 0.98 + 0.01
    expected_log_prob = (expected.log_prob(x) - math.log(2)).sum(-1)
    torch.testing.assert_close(family.log_prob(parameters, 2 * x - 1), expected_log_prob, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(family.entropy(parameters), (expected.entropy() + math.log(2)).sum(-1))


@pytest.mark.parametrize("scale", [0.0, 1.0, 10.0, 400.0])
def test_neutral_noise_gives_the_mean_of_kumaraswamy(scale: float) -> None:
    family = Kumaraswamy(BOX)
    parameters = scale * torch.randn(50, 6)
    a, b = (1 + torch.nn.functional.softplus(parameters)).clamp(max=1000.0).double().split(3, -1)
    neutral = family.sample(parameters, torch.full((50, 3), 0.5), torch.zeros(50, 0))
    torch.testing.assert_close(0.5 * (neutral + 1.0), reference.Kumaraswamy(a, b).mean.float(), atol=1e-3, rtol=1e-2)


def test_mean_of_a_skewed_kumaraswamy_is_not_its_median() -> None:
    """With a = 1 and b = 3 the density is 3 (1 - x)^2: the mean is 1/4, the median 1 - 0.5^(1/3) = 0.2063."""
    one = ContinuousSpace(low=(0.0,), high=(1.0,))
    parameters = torch.tensor([[-30.0, math.log(math.e**2 - 1.0)]])  # softplus of them is 0 and 2
    neutral = Kumaraswamy(one).sample(parameters, torch.full((1, 1), 0.5), torch.zeros(1, 0))
    assert 0.5 * (float(neutral) + 1.0) == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize("name", ["gaussian", "gaussian, state", "squashed", "mixture"])
@pytest.mark.parametrize(("outside", "sign"), [(-6.0, -1.0), (2.5, 1.0)])
def test_standard_deviation_comes_back_from_beyond_its_limits(name: str, outside: float, sign: float) -> None:
    """A loss that pulls it inside moves it; one that pushes it further outside does not."""
    family = FAMILIES[name]()
    assert isinstance(family, Gaussian | GaussianMixture)
    with torch.no_grad():
        family.log_std.fill_(outside)
    optimizer = torch.optim.SGD(family.parameters(), lr=0.05)
    parameters = torch.zeros(4, family.parameter_count)
    actions = torch.zeros(4, BOX.size)

    def step(inwards: float) -> None:
        loss = inwards * sign * -family.log_prob(parameters, actions).mean()  # the most probable: the least deviation
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    step(inwards=-1.0)
    np.testing.assert_array_equal(family.log_std.detach(), np.full(family.log_std.shape, outside, np.float32))
    for _ in range(200):
        step(inwards=1.0)
        if ((family.log_std > -5.0) & (family.log_std < 2.0)).any():
            return
    pytest.fail(f"log_std is still {family.log_std}")


@pytest.mark.parametrize(("action", "inwards"), [(0.0, 0), (0.999, 1)])
def test_shapes_of_kumaraswamy_come_back_from_beyond_their_limit(action: float, inwards: int) -> None:
    """The density of the first action grows with a smaller a and a larger b; that of the second with the opposite."""
    family = Kumaraswamy(ContinuousSpace(low=(-1.0,), high=(1.0,)))
    shapes = torch.full((1, 2), 1100.0, requires_grad=True)  # the limit is 1,000
    optimizer = torch.optim.SGD([shapes], lr=100.0)
    for _ in range(3):
        optimizer.zero_grad()
        (-family.log_prob(shapes, torch.full((1, 1), action))).sum().backward()
        optimizer.step()
    assert shapes[0, inwards] < 1000.0
    assert shapes[0, 1 - inwards] == 1100.0


def test_neutral_noise_gives_the_mean_of_the_most_probable_component() -> None:
    family = GaussianMixture(ContinuousSpace(low=(None,), high=(None,)), initial_std=0.4, components=2)
    parameters = torch.tensor([[0.0, 2.0, 1.0, 3.0]])  # logits 0 and 2, means 1 and 3
    neutral = family.sample(parameters, torch.full((1, 2), 0.5), torch.zeros(1, 1))
    torch.testing.assert_close(neutral, torch.tensor([[3.5]]))


# ------------------------------------------------------------------------------------------ categorical


@st.composite
def discrete(draw: st.DrawFn) -> tuple[tuple[int, ...], Tensor]:
    counts = tuple(draw(st.lists(st.integers(1, 6), min_size=1, max_size=4)))
    numbers = st.floats(-10, 10, width=32) | st.sampled_from([0.0, 50.0, -50.0])
    rows = draw(st.integers(1, 4))
    logits = [[draw(numbers) for _ in range(sum(counts))] for _ in range(rows)]
    return counts, torch.tensor(logits)


@repeatable
@given(content=discrete(), seed=st.integers(0, 2**32))
def test_categorical_is_the_sum_of_torchs(content: tuple[tuple[int, ...], Tensor], seed: int) -> None:
    counts, logits = content
    family = Categorical(DiscreteSpace(counts=counts))
    actions = sampled(family, logits, seed)
    assert (actions.shape, actions.dtype) == ((len(logits), len(counts)), torch.int64)
    parts = [reference.Categorical(logits=part) for part in logits.split(list(counts), -1)]
    expected = sum(part.log_prob(actions[:, index]) for index, part in enumerate(parts))
    log_probs, entropy = family.log_prob_and_entropy(logits, actions)
    torch.testing.assert_close(log_probs, expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(family.log_prob(logits, actions), log_probs)
    torch.testing.assert_close(entropy, sum(part.entropy() for part in parts), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(family.entropy(logits), entropy)
    assert torch.isfinite(log_probs).all()  # no noise gives an action of probability 0


@pytest.mark.parametrize("counts", [(5,), (3, 2), (2, 4, 3)])
def test_choices_have_the_frequencies_of_the_softmax(counts: tuple[int, ...]) -> None:
    family = Categorical(DiscreteSpace(counts=counts))
    logits = torch.linspace(-2, 2, sum(counts)).expand(SAMPLES, -1)
    actions = sampled(family, logits)
    for variable, part in enumerate(logits[0].split(list(counts))):
        expected = SAMPLES * part.softmax(-1)
        seen = torch.bincount(actions[:, variable], minlength=len(part))
        assert ((seen - expected).square() / expected).sum() < 20.5  # above the 0.999 quantile for 4 degrees of freedom


def test_neutral_noise_gives_the_most_probable_choice() -> None:
    family = Categorical(DiscreteSpace(counts=(3, 2)))
    logits = torch.tensor([[0.0, 2.0, 1.0, 5.0, 4.0], [3.0, 2.0, 1.0, -5.0, 4.0]])
    chosen = family.sample(logits, torch.full((2, 5), 0.5), torch.zeros(2, 0))
    assert chosen.tolist() == [[1, 0], [0, 1]]


@pytest.mark.parametrize("legal", [0.0, -1e12])  # a policy that diverges still takes legal actions
def test_illegal_choices_have_probability_zero_and_entropy_stays_finite(legal: float) -> None:
    family = Categorical(DiscreteSpace(counts=(4,)))
    mask = torch.tensor([True, False, True, False]).expand(SAMPLES, -1)
    logits = without_illegal(torch.tensor([legal, 9.0, legal, 9.0]).expand(SAMPLES, -1), mask)
    logits.requires_grad_()
    actions = sampled(family, logits)
    assert set(actions.flatten().tolist()) == ({0, 2} if legal == 0.0 else {0})  # noise is lost beside 1e12
    log_probs, entropy = family.log_prob_and_entropy(logits, actions)
    torch.testing.assert_close(log_probs, torch.full((SAMPLES,), -math.log(2)))
    torch.testing.assert_close(entropy, torch.full((SAMPLES,), math.log(2)))
    entropy.sum().backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()


# ------------------------------------------------------------------------------------------------ joint

MIXED = Spaces(
    observations={"observation": ArraySpace(shape=(2,), dtype="float32")},
    actions={"grip": DiscreteSpace(counts=(3,), masked=True), "arm": ContinuousSpace(low=(-1.0,) * 2, high=(1.0,) * 2)},
)


def test_log_probability_and_entropy_of_a_composite_are_sums_over_its_components() -> None:
    network = ActorCritic(PolicySpec(), MIXED).requires_grad_(False)
    joint = network.distribution
    grip, arm = joint.components
    assert isinstance(grip, Categorical)
    assert isinstance(arm, Gaussian)
    parameters, mask = torch.randn(7, 5), torch.tensor([True, True, False]).expand(7, -1)
    actions = joint.sample(parameters, torch.rand(7, 3), torch.randn(7, 2), {"grip": mask})
    assert (actions["grip"] < 2).all()
    log_probs, entropy = joint.log_prob_and_entropy(parameters, actions, {"grip": mask})
    legal = without_illegal(parameters[:, :3], mask)
    expected = grip.log_prob(legal, actions["grip"]) + arm.log_prob(parameters[:, 3:], actions["arm"])
    torch.testing.assert_close(log_probs, expected)
    torch.testing.assert_close(entropy, grip.entropy(legal) + arm.entropy(parameters[:, 3:]))
    torch.testing.assert_close(joint.log_prob(parameters, actions, {"grip": mask}), log_probs)


@pytest.mark.parametrize("name", ["squashed_gaussian", "kumaraswamy"])
def test_bounded_distribution_refuses_unbounded_actions(name: str) -> None:
    spaces = MIXED.model_copy(update={"actions": {"arm": ContinuousSpace(low=(-1.0, None), high=(1.0, 1.0))}})
    with pytest.raises(
        NetworkError, match=rf"policy.distribution={name} needs bounded actions, but 'arm' is .*gaussian"
    ):
        ActorCritic(PolicySpec(distribution=name), spaces)


# ------------------------------------------------------------------------------------------ of the user's own

OWN = """
import torch
from daedalus.policy.network.distributions import Distribution


class Own(Distribution):
    def __init__(self, space):
        super().__init__()
        self.parameter_count = self.normal_count = space.size

    def sample(self, parameters, uniform, normal):
        return {sample}

    def log_prob(self, parameters, actions):
        return {log_prob}

    def entropy(self, parameters):
        return {entropy}
"""
GOOD = {
    "sample": "parameters + normal",
    "log_prob": "-((actions - parameters) ** 2).sum(-1) / 2",
    "entropy": "torch.zeros_like(parameters[..., 0])",
}


def own_distribution(folder: Path, monkeypatch: pytest.MonkeyPatch, **parts: str) -> ActorCritic:
    """Return a network with a distribution of the user's own, some of whose functions are others than GOOD's."""
    (folder / "mine_distribution.py").write_text(OWN.format(**GOOD | parts))
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "mine_distribution", raising=False)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    modules = UserModules(frozenset({"mine_distribution"}))
    spaces = Spaces(observations={"seen": ArraySpace(shape=(4,), dtype="float32")}, actions={"arm": BOX})
    return ActorCritic(PolicySpec(distribution="mine_distribution:Own"), spaces, modules)


def test_own_distribution_is_the_policys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert type(own_distribution(tmp_path, monkeypatch).distribution.components[0]).__name__ == "Own"


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"sample": "(parameters + normal)[:, :1]"}, r"sample returns \(2, 1\) for two rows: it must be .* \(2, 3\)"),
        (
            {"log_prob": "-((actions - parameters) ** 2)"},
            r"log_prob returns \(2, 3\) for two rows: it must be .* \(2,\)",
        ),
        ({"entropy": "torch.tensor(1.0)"}, r"entropy returns \(\) for two rows"),
        ({"entropy": "1.0"}, "entropy returns float for two rows"),
        ({"log_prob": "(parameters / 0).sum(-1)"}, "log_prob of parameters that are all 0 is not finite: nan"),
        ({"sample": "parameters.missing"}, "AttributeError: 'Tensor' object has no attribute 'missing'"),
    ],
)
def test_fault_of_an_own_distribution_is_one_line(
    parts: dict[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise it would be a traceback of the learner, or an error of every actor."""
    with pytest.raises(NetworkError, match=f"^policy.distribution=mine_distribution:Own.*{message}") as caught:
        own_distribution(tmp_path, monkeypatch, **parts)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["gaussian", "squashed_gaussian", "gaussian_mixture", "kumaraswamy"])
def test_extreme_parameters_have_the_same_log_probability_for_actor_and_learner(name: str) -> None:
    """Of the same stored actions: the ratio of both policies must be 1 before an update."""
    spaces = Spaces(observations={"observation": ArraySpace(shape=(1,), dtype="float32")}, actions={"action": BOX})
    network = ActorCritic(PolicySpec(hidden=(), distribution=name), spaces)  # pyright: ignore[reportArgumentType]
    runtime, rows = OnnxRuntime(export_program(network, spaces)), 64
    observations = {"observation": np.zeros((rows, 1), np.float32)}
    for scale in (1.0, 8.0, 60.0, 1e4):
        head = scale * torch.randn(network.policy_head.bias.shape, generator=torch.Generator().manual_seed(3))
        network.policy_head.bias.data.copy_(head)
        runtime.load({key: value.detach().numpy() for key, value in network.named_parameters()})
        noise = draw_noise(runtime.noise_size, rows, np.random.default_rng(1))
        choice = runtime.act(observations, np.zeros((rows, 0), np.float32), noise, {})
        with torch.no_grad():
            learned = network.distribution.log_prob(
                head.expand(rows, -1), {"action": torch.from_numpy(choice.actions["action"])}, {}
            )
        assert np.isfinite(choice.log_probs).all()
        np.testing.assert_allclose(choice.log_probs, learned, rtol=1e-4, atol=2e-2)
