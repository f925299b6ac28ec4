"""The exported program against torch, for spaces, distributions and masks that hypothesis chooses."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from daedalus.policy.acting.noise import Noise, draw_noise, neutral_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import Choice, OnnxRuntime
from daedalus.policy.acting.torch_runtime import TorchRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec

ROWS = 5

arrays = st.builds(
    ArraySpace,
    shape=st.sampled_from([(1,), (3,), (2, 3), (6, 5, 2), (20, 18)]),
    dtype=st.sampled_from(["float32", "uint8"]),
    frames=st.sampled_from([1, 2]),
)
counts = st.lists(st.integers(1, 4), min_size=1, max_size=3).map(tuple)
observation_spaces = arrays | st.builds(DiscreteSpace, counts=counts)
bounds = st.sampled_from([(-2.0, 3.0), (None, None), (0.0, None)])
continuous_spaces = st.lists(bounds, min_size=1, max_size=3).map(
    lambda pairs: ContinuousSpace(low=tuple(low for low, _ in pairs), high=tuple(high for _, high in pairs))
)
action_spaces = continuous_spaces | st.builds(DiscreteSpace, counts=counts, masked=st.booleans())
names = st.sampled_from(["a", "b.0", "c-d"])
all_spaces = st.builds(
    Spaces,
    observations=st.dictionaries(names, observation_spaces, min_size=1, max_size=3),
    actions=st.dictionaries(names, action_spaces, min_size=1, max_size=3),
)
policies = st.builds(
    PolicySpec,
    hidden=st.just((8,)),
    normalize_observations=st.booleans(),
    memory=st.sampled_from(["none", "gru"]),
    memory_units=st.just(4),
    distribution=st.sampled_from(["gaussian", "gaussian_mixture"]),
    state_dependent_std=st.booleans(),
)


def observe(spaces: Spaces, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return random observations, as frame stacks have them."""
    seen: dict[str, np.ndarray] = {}
    for name, space in spaces.observations.items():
        shape = (ROWS, *space.stacked_shape)
        if isinstance(space, DiscreteSpace):
            seen[name] = random.integers(0, space.counts, shape).astype(space.dtype)
        elif space.dtype == "uint8":
            seen[name] = random.integers(0, 256, shape, np.uint8)
        else:
            seen[name] = random.normal(0, 3, shape).astype(np.float32)
    return seen


def masks_of(spaces: Spaces, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return random masks with a legal choice of every variable."""
    masks = {}
    for name, space in spaces.actions.items():
        if isinstance(space, DiscreteSpace) and space.masked:
            parts = [random.random((ROWS, count)) < 0.5 for count in space.counts]
            for part in parts:
                part[np.arange(ROWS), random.integers(0, part.shape[1], ROWS)] = True
            masks[name] = np.concatenate(parts, 1)
    return masks


def built(
    spec: PolicySpec, spaces: Spaces, training: TrainingSpec | None = None
) -> tuple[ActorCritic, dict[str, np.ndarray]]:
    """Return a network and its weights, also the biases and the statistics of its normaliser random."""
    network = ActorCritic(spec, spaces, training=training)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "normalizer" in name:
                parameter.copy_(torch.randn_like(parameter).abs())
            elif parameter.ndim == 1 or name == "policy_head.weight":  # zeros and small numbers at first
                parameter.add_(0.3 * torch.randn_like(parameter))
    return network, {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}


@settings(max_examples=12, phases=(Phase.generate,))  # shrinking would export a program for each step
@given(
    spaces=all_spaces,
    spec=policies,
    seed=st.integers(0, 2**20),
    greedy=st.booleans(),
    explores=st.booleans(),
    coded=st.booleans(),
)
def test_program_acts_as_torch_does(
    spaces: Spaces, spec: PolicySpec, seed: int, greedy: bool, explores: bool, coded: bool
) -> None:
    arrays = {name: space for name, space in spaces.observations.items() if isinstance(space, ArraySpace)}
    if coded:
        codes = {name: (256,) for name, space in arrays.items() if space.dtype == "uint8"}
        maps = any(len(space.shape) == 3 for space in arrays.values())
        spec = spec.model_copy(update={"codes": codes, "encoder": "grid" if maps else "mlp"})
    torch.manual_seed(seed)
    random = np.random.default_rng(seed)
    bounded = all(isinstance(space, DiscreteSpace) or space.bounded for space in spaces.actions.values())
    training = TrainingSpec(exploration=(0.5,)) if explores and bounded else TrainingSpec()
    network, weights = built(spec, spaces, training)
    runtime = OnnxRuntime(export_program(network, spaces))
    plain = TorchRuntime(spec, spaces, training)
    assert runtime.explores == plain.explores == training.explores
    epsilon = np.full((ROWS, 1), 0.5, np.float32)
    assert runtime.state_size == plain.state_size
    seen, masks = observe(spaces, random), masks_of(spaces, random)
    state = random.normal(0, 0.5, (ROWS, runtime.state_size)).astype(np.float32)
    size = plain.noise_size
    noise = neutral_noise(size, ROWS) if greedy else draw_noise(size, ROWS, random)
    choices = []
    for one in (runtime, plain):
        one.load(weights)
        choices.append(one.act(seen, state, noise, masks, epsilon))
    assert_same(spaces, *choices)
    assert_legal(spaces, masks, choices[0])
    if training.explores:
        return
    # Both round the means differently, which counts in deviations, and these may be e^-5: 0.003 was seen in one of some
    # 2,000 examples.
    np.testing.assert_allclose(choices[0].log_probs, learned(network, seen, state, masks, choices[0]), atol=2e-2)


def assert_same(spaces: Spaces, one: Choice, other: Choice) -> None:
    np.testing.assert_allclose(one.state, other.state, atol=1e-4)
    assert list(one.actions) == list(spaces.actions)
    for name, space in spaces.actions.items():
        kind = np.int64 if isinstance(space, DiscreteSpace) else np.float32
        assert (one.actions[name].dtype, one.actions[name].shape) == (kind, (ROWS, space.size))
        np.testing.assert_allclose(one.actions[name], other.actions[name], atol=1e-3)
    np.testing.assert_allclose(one.log_probs, other.log_probs, atol=2e-3)


def assert_legal(spaces: Spaces, masks: dict[str, np.ndarray], choice: Choice) -> None:
    for name, mask in masks.items():
        first = 0
        for variable, count in enumerate(spaces.actions[name].counts):  # type: ignore[union-attr] - masked are discrete
            chosen = choice.actions[name][:, variable]
            assert mask[np.arange(ROWS), first + chosen].all()
            first += count


def learned(network: ActorCritic, seen: Any, state: np.ndarray, masks: Any, choice: Choice) -> np.ndarray:
    """Return the log-probabilities of the chosen actions as the learner computes them, from whole batches."""
    observations = {name: torch.from_numpy(values)[None] for name, values in seen.items()}
    with torch.no_grad():
        parameters, _ = network(observations, torch.from_numpy(state), torch.zeros(1, ROWS, dtype=torch.bool))
        actions = {name: torch.from_numpy(values)[None] for name, values in choice.actions.items()}
        legal = {name: torch.from_numpy(mask)[None] for name, mask in masks.items()}
        return network.distribution.log_prob(parameters, actions, legal)[0].numpy()


@pytest.mark.parametrize("distribution", ["squashed_gaussian", "kumaraswamy"])
def test_bounded_distributions_stay_within_their_bounds_in_the_program(distribution: str) -> None:
    spaces = Spaces(
        observations={"a": ArraySpace(shape=(3,), dtype="float32")},
        actions={"b": ContinuousSpace(low=(-1.0, 0.0), high=(1.0, 7.0))},
    )
    network, weights = built(PolicySpec(hidden=(8,), distribution=distribution), spaces)
    runtime = OnnxRuntime(export_program(network, spaces))
    runtime.load(weights)
    random = np.random.default_rng(1)
    seen = {"a": random.normal(0, 3, (ROWS, 3)).astype(np.float32)}
    drawn = [draw_noise(runtime.noise_size, ROWS, random) for _ in range(50)]
    uniform, normal = runtime.noise_size
    largest = np.full((ROWS, uniform), 1 - 2**-24, np.float32), np.full((ROWS, normal), 8.0, np.float32)
    for noise in [*drawn, Noise(uniform=largest[0], normal=largest[1])]:
        choice = runtime.act(seen, np.zeros((ROWS, 0), np.float32), noise, {})
        assert np.abs(choice.actions["b"]).max() <= 1.0
        assert np.isfinite(choice.log_probs).all()


@pytest.mark.parametrize("counts", [(2,) * 4096, (3, 2) * 350, (65_536,), (64,) * 1024])
def test_program_of_the_largest_discrete_observations_acts_as_torch_does(counts: tuple[int, ...]) -> None:
    spaces = Spaces(
        observations={"a": DiscreteSpace(counts=counts), "b": ArraySpace(shape=(3,), dtype="float32")},
        actions={"c": DiscreteSpace(counts=(4,))},
    )
    spec = PolicySpec(hidden=(8,))
    network, weights = built(spec, spaces)
    random = np.random.default_rng(1)
    seen, choices = observe(spaces, random), []
    runtimes = OnnxRuntime(export_program(network, spaces)), TorchRuntime(spec, spaces)
    noise = draw_noise(runtimes[0].noise_size, ROWS, random)
    for runtime in runtimes:
        runtime.load(weights)
        choices.append(runtime.act(seen, np.zeros((ROWS, 0), np.float32), noise, {}))
    assert_same(spaces, *choices)
