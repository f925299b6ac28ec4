"""policy/network/exploration.py: the behaviour policy of an actor, in torch and in the exported program."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from daedalus.actor.collecting.rollout_writer import RolloutWriter
from daedalus.policy.acting.noise import Noise, draw_noise, neutral_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import Choice, OnnxRuntime, PolicyRuntime
from daedalus.policy.acting.torch_runtime import TorchRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.distributions import Categorical
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, ObservationSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, TrainingSpec

ROWS = 400
OBSERVED: dict[str, ObservationSpace] = {"seen": ArraySpace(shape=(3,), dtype="float32")}
CHOICES = Spaces(observations=OBSERVED, actions={"action": DiscreteSpace(counts=(4,), masked=True)})
BOUNDED = Spaces(observations=OBSERVED, actions={"arm": ContinuousSpace(low=(-1.0, 0.0), high=(1.0, 7.0))})
MIXED = Spaces(
    observations=OBSERVED,
    actions={
        "legs": DiscreteSpace(counts=(2, 3), masked=True),
        "arm": ContinuousSpace(low=(-1.0,), high=(2.0,)),
        "hand": DiscreteSpace(counts=(3,)),
    },
)
SPACES = {"choices": CHOICES, "bounded": BOUNDED, "mixed": MIXED}
EXPLORING = TrainingSpec(exploration=(0.3,))


class Acting:
    """A network whose policy is far from uniform, with both of its runtimes, and inputs for ROWS rows."""

    def __init__(self, spaces: Spaces, training: TrainingSpec = EXPLORING, annealing: float = 0.0, **spec: Any) -> None:
        torch.manual_seed(1)
        random = np.random.default_rng(2)
        policy = PolicySpec(hidden=(8,), **spec)
        self.spaces, self.network = spaces, ActorCritic(policy, spaces, training=training)
        with torch.no_grad():
            self.network.policy_head.weight.mul_(300.0)
        if self.network.exploration is not None:
            self.network.exploration.set_annealing(annealing)
        self.observations = {"seen": random.standard_normal((ROWS, 3), np.float32)}
        self.masks = {name: random.random((ROWS, size)) < 0.5 for name, size in spaces.masks.items()}
        for mask in self.masks.values():
            mask[:, [0, 2]] = True  # of each variable in these spaces at least one choice
        weights = {name: parameter.detach().numpy() for name, parameter in self.network.named_parameters()}
        self.runtimes: list[PolicyRuntime] = [
            OnnxRuntime(export_program(self.network, spaces)),
            TorchRuntime(policy, spaces, training),
        ]
        for runtime in self.runtimes:
            runtime.load(weights)
        self.noise = draw_noise(self.runtimes[0].noise_size, ROWS, random)

    def act(self, epsilon: float | None, noise: Noise | None = None) -> Choice:
        """Return the choices of the program, which are those of torch."""
        given = None if epsilon is None else np.full((ROWS, 1), epsilon, np.float32)
        state = np.zeros((ROWS, 0), np.float32)
        ours, theirs = (
            runtime.act(self.observations, state, noise or self.noise, self.masks, given) for runtime in self.runtimes
        )
        for name, values in ours.actions.items():
            np.testing.assert_allclose(values, theirs.actions[name], atol=1e-5)
        np.testing.assert_allclose(ours.log_probs, theirs.log_probs, atol=1e-4)
        return ours

    def parameters(self) -> Tensor:
        with torch.no_grad():
            tensors = {name: torch.from_numpy(values) for name, values in self.observations.items()}
            return self.network.step(tensors, torch.zeros(ROWS, 0))[0]

    def log_policy(self, choice: Choice) -> np.ndarray:
        """Return log pi of the chosen actions."""
        masks = {name: torch.from_numpy(mask) for name, mask in self.masks.items()}
        actions = {name: torch.from_numpy(values) for name, values in choice.actions.items()}
        with torch.no_grad():
            return self.network.distribution.log_prob(self.parameters(), actions, masks).numpy()

    def log_uniform(self) -> np.ndarray:
        """Return log u of any legal action, by counting."""
        total = np.zeros(ROWS)
        for name, space in self.spaces.actions.items():
            if isinstance(space, ContinuousSpace):
                total -= space.size * np.log(2.0 * (1.0 - 1e-4))
                continue
            first = 0
            for count in space.counts:
                legal = self.masks[name][:, first : first + count].sum(1) if name in self.masks else count
                total -= np.log(legal)
                first += count
        return total

    def legal(self, choice: Choice) -> bool:
        for name, mask in self.masks.items():
            first = 0
            for variable, count in enumerate(self.spaces.actions[name].counts):  # type: ignore[union-attr]
                if not mask[np.arange(ROWS), first + choice.actions[name][:, variable]].all():
                    return False
                first += count
        return True


@pytest.mark.parametrize("epsilon", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("spaces", SPACES)
def test_log_probability_is_that_of_the_mixture(spaces: str, epsilon: float) -> None:
    acting = Acting(SPACES[spaces])
    choice = acting.act(epsilon)
    uniform = epsilon * np.exp(acting.log_uniform())
    inside = np.ones(ROWS, np.bool_)
    for name, space in acting.spaces.actions.items():
        if isinstance(space, ContinuousSpace):
            inside &= (np.abs(choice.actions[name]) <= 1.0 - 1e-4).all(1)
    assert acting.legal(choice)
    expected = np.log((1.0 - epsilon) * np.exp(acting.log_policy(choice)) + uniform * inside)
    np.testing.assert_allclose(choice.log_probs, expected, atol=2e-4)


@pytest.mark.parametrize("spaces", SPACES)
def test_without_epsilon_the_program_acts_as_the_policy_whatever_the_annealing(spaces: str) -> None:
    """So do evaluations, which give none: neither greedy nor sampled ones explore."""
    exploring = Acting(SPACES[spaces], annealing=1.0)
    plain = Acting(SPACES[spaces], TrainingSpec())
    assert (exploring.runtimes[0].explores, plain.runtimes[0].explores) == (True, False)
    own = plain.runtimes[0].noise_size.uniform
    noise = Noise(uniform=exploring.noise.uniform[:, :own], normal=exploring.noise.normal)
    for given, theirs in ((exploring.noise, noise), (neutral(exploring), neutral(plain))):
        for epsilon in (None, 0.0):
            ours, policy = exploring.act(epsilon, given), plain.act(None, theirs)
            for name, values in ours.actions.items():
                np.testing.assert_array_equal(values, policy.actions[name])
            np.testing.assert_array_equal(ours.log_probs, policy.log_probs)


def neutral(acting: Acting) -> Noise:
    return neutral_noise(acting.runtimes[0].noise_size, ROWS)


def test_actions_are_random_as_often_as_epsilon_says_and_legal_ones_equally_often() -> None:
    acting = Acting(CHOICES, TrainingSpec(algorithm="n_step_q"))
    acting.masks = {"action": np.tile([True, False, True, True], (ROWS, 1))}
    acting.observations = {"seen": np.tile(acting.observations["seen"][:1], (ROWS, 1))}
    greedy = int(acting.act(0.0).actions["action"][0, 0])
    counts, random = np.zeros(4), np.random.default_rng(7)
    size = acting.runtimes[0].noise_size
    choices = [acting.act(0.3, draw_noise(size, ROWS, random)) for _ in range(25)]
    for choice in choices:
        counts += np.bincount(choice.actions["action"][:, 0], minlength=4)
    expected = np.array([0.1, 0.0, 0.1, 0.1]) + 0.7 * np.eye(4)[greedy]
    np.testing.assert_allclose(counts / counts.sum(), expected, atol=0.015)
    probabilities = np.exp(choices[0].log_probs)
    np.testing.assert_allclose(probabilities, expected[choices[0].actions["action"][:, 0]], rtol=1e-4)


@pytest.mark.parametrize("algorithm", ["one_step_q", "n_step_q"])
def test_greedy_actions_have_the_largest_value_among_the_legal(algorithm: str) -> None:
    acting = Acting(CHOICES, TrainingSpec(algorithm=algorithm))
    values = np.where(acting.masks["action"], acting.parameters().numpy(), -np.inf)
    choice = acting.act(0.0, neutral(acting))
    np.testing.assert_array_equal(choice.actions["action"][:, 0], values.argmax(1))
    assert (choice.log_probs == 0.0).all()


def test_epsilon_falls_from_one_to_that_of_the_actor() -> None:
    for annealing, expected in ((1.0, 1.0), (0.5, 0.55), (0.0, 0.1)):
        acting = Acting(CHOICES, TrainingSpec(algorithm="n_step_q"), annealing=annealing)
        assert acting.network.exploration is not None
        assert float(acting.network.exploration.epsilon(torch.tensor([[0.1]]))) == pytest.approx(expected)
    spec = TrainingSpec(algorithm="n_step_q", env_steps=1000)
    assert [spec.exploration_annealing(progress, 7) for progress in (0.0, 0.05, 0.1, 1.0)] == [1.0, 0.5, 0.0, 0.0]
    spec = TrainingSpec(algorithm="a3c", env_steps=1000, exploration=(0.1,))
    assert spec.exploration_annealing(0.0, 0) == 0.0
    spec = TrainingSpec(algorithm="a3c", env_steps=1000, exploration=(0.1,), exploration_env_steps=500)
    assert [spec.exploration_annealing(0.9, env_steps) for env_steps in (0, 250, 500, 900)] == [1.0, 0.5, 0.0, 0.0]


def test_one_legal_choice_is_taken_whatever_the_noise() -> None:
    """A uniform number of 0 made the only legal choice less probable than an illegal one."""
    mask = torch.tensor([[False, True, False]])
    logits = torch.zeros(1, 3).masked_fill(~mask, -1e30)
    space = DiscreteSpace(counts=(3,), masked=True)
    assert Categorical(space).sample(logits, torch.zeros(1, 3), torch.zeros(1, 0)).item() == 1


def test_actions_without_bounds_are_refused() -> None:
    spaces = BOUNDED.model_copy(update={"actions": {"arm": ContinuousSpace(low=(None,), high=(1.0,))}})
    with pytest.raises(NetworkError, match="'arm' is 1 continuous from -inf to 1 and has no bounds to choose within"):
        ActorCritic(PolicySpec(), spaces, training=EXPLORING)


def test_an_actor_that_is_to_explore_refuses_a_program_that_cannot() -> None:
    runtime = Acting(CHOICES, TrainingSpec()).runtimes[0]

    def writer(epsilon: float) -> RolloutWriter:
        random, spec = np.random.default_rng(1), EnvironmentSpec(id="A")
        return RolloutWriter(CHOICES, 2, runtime, spec, rollout_length=3, random=random, epsilon=epsilon)

    writer(0.0)
    with pytest.raises(PolicyError, match=r"explore with epsilon 0\.1, but its program has no input 'epsilon'"):
        writer(0.1)
