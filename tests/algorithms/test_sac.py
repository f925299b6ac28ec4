"""algorithms/sac.py against a slow oracle in plain torch, a case by hand, and torch.distributions."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch import distributions as reference
from torch.nn import functional

from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.recording import EARLIER_CALLS
from daedalus.algorithms.replay_buffer import Transitions
from daedalus.algorithms.sac import ENTROPY_SHARE, Sac, TwinCritics
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.convolutional import ImageEncoder, ImageLayout
from daedalus.policy.network.distributions import SquashedGaussian
from daedalus.policy.network.encoders import image_encoders
from daedalus.policy.user_modules import NO_MODULES, NetworkError
from daedalus.protocol.spaces import ActionSpace, ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec

ARM = ContinuousSpace(low=(-1.0, 0.0), high=(1.0, 2.0))
LEG = ContinuousSpace(low=(-1.0,), high=(1.0,))
POLICY = PolicySpec(hidden=(5, 4), activation="relu", distribution="squashed_gaussian", state_dependent_std=True)
ROWS, NUMBERS = 6, 3


def spaces_of(**actions: ActionSpace) -> Spaces:
    return Spaces(observations={"o": ArraySpace(shape=(NUMBERS,), dtype="float32")}, actions=actions)


SPACES = spaces_of(arm=ARM, leg=LEG)


CHOICE = spaces_of(choice=DiscreteSpace(counts=(4,)))


class Built:
    """Sac, and the parts that the learner joins it with."""

    def __init__(self, seed: int = 1, *, spaces: Spaces = SPACES, is_mixed: bool = False, **training: Any) -> None:
        torch.manual_seed(seed)
        self.spaces = spaces
        spec = TrainingSpec.model_validate({"algorithm": "sac", **training})
        self.network = ActorCritic(POLICY, spaces, training=spec)
        self.network.policy_head.weight.data.normal_(std=0.3)
        computer = GradientComputer(spec, self.network, spaces)
        assert isinstance(computer.algorithm, Sac)
        self.sac = computer.algorithm
        self.critics = TwinCritics(POLICY, spaces, NO_MODULES)
        self.sac.build(self.critics, self.network, is_mixed=is_mixed)
        for parameter in (*self.critics.factors, *self.critics.offsets):
            parameter.data.add_(torch.randn_like(parameter) * 0.3)
        mean, variance = self.sac.statistics["moments"].unbind()
        mean.normal_(std=0.3)
        variance.uniform_(0.5, 2.0)
        self.sac.learned["log_temperature"].fill_(math.log(0.3))


def transitions(seed: int = 3, spaces: Spaces = SPACES) -> Transitions:
    torch.manual_seed(seed)
    actions = torch.randint(4, (ROWS, 1)).float() if spaces is CHOICE else torch.rand(ROWS, 3) * 2.0 - 1.0
    return Transitions(
        observations={"o": torch.randn(ROWS, NUMBERS)},
        next_observations={"o": torch.randn(ROWS, NUMBERS)},
        actions=actions,
        rewards=torch.randn(ROWS),
        discounts=torch.tensor([0.9, 0.0] * (ROWS // 2)),
    )


def normalised(inputs: Tensor, moments: tuple[Tensor, Tensor]) -> Tensor:
    mean, variance = moments
    return (inputs - mean) / (variance + 1e-3).sqrt()


def by_batch(rows: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Mean and variance of the inputs of a layer over the rows of a minibatch."""
    mean = sum(rows, torch.zeros(())) / len(rows)
    return mean, sum(((row - mean) ** 2 for row in rows), torch.zeros(())) / len(rows)


def values(critics: TwinCritics, which: int, rows: list[Tensor], running: Tensor | None = None) -> list[Tensor]:
    """The outputs of a critic for rows of inputs, layer by layer; normalised by the rows, or by running moments."""
    first = 0
    for index, (weight, bias) in enumerate(zip(critics.weights, critics.biases, strict=True)):
        if index:
            rows = [row.clamp(min=0.0) for row in rows]
        last = first + len(rows[0])
        known = by_batch(rows) if running is None else (running[0, which, first:last], running[1, which, first:last])
        factor, offset = critics.factors[index][which, :, 0], critics.offsets[index][which, 0]
        rows = [(factor * normalised(row, known) + offset) @ weight[which] + bias[which, 0] for row in rows]
        first = last
    return rows


def chosen(network: ActorCritic, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """a ~ pi(s) and log pi(a | s), by torch.distributions."""
    parameters = network.policy_head(network.encoder({"o": observation[None]}))[0]
    arm, leg = parameters.split([4, 2])
    first, second = (part for part in network.distribution.components if isinstance(part, SquashedGaussian))
    mean = torch.cat([arm[:2], leg[:1]])
    assert mean.abs().max() < 4.0  # the means are as the head computes them
    deviation = torch.cat([first.log_std + arm[2:], second.log_std + leg[1:]]).clamp(-5.0, 2.0).exp()
    squashed = reference.TransformedDistribution(
        reference.Normal(mean, deviation), reference.TanhTransform(cache_size=1)
    )
    action = torch.tanh(mean + deviation * noise)
    return action, squashed.log_prob(action).sum()


def check(built: Built, gradients: dict[str, Tensor], terms: list[Tensor], losses: list[Tensor], target: float) -> None:
    """Compare gradients and terms with the losses of the critics and of the policy, and with the entropy."""
    value_loss, policy_loss, entropy = losses
    for name, loss, parameters in (
        ("critics", value_loss, list(built.critics.parameters())),
        ("policy", policy_loss, built.network.learned_parameters()),
    ):
        expected = torch.cat([each.flatten() for each in torch.autograd.grad(loss, parameters)])
        torch.testing.assert_close(gradients[name], expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients["log_temperature"], (entropy - target).reshape(1), rtol=1e-4, atol=1e-5)
    for found, loss in zip(terms, (policy_loss, value_loss, entropy), strict=False):
        torch.testing.assert_close(found, loss.detach(), rtol=1e-4, atol=1e-5)


def test_gradients_are_those_of_the_papers_losses() -> None:
    """Both observations of all transitions are one batch of the critics, and the targets are constants."""
    built, batch, alpha = Built(), transitions(), 0.3
    torch.manual_seed(5)
    noise = torch.randn(2 * ROWS, 3)
    torch.manual_seed(5)
    gradients, terms = built.sac.gradients(batch)
    now, then, moments = batch.observations["o"], batch.next_observations["o"], built.sac.statistics["moments"]
    following = [chosen(built.network, then[row], noise[ROWS + row]) for row in range(ROWS)]
    own = [chosen(built.network, now[row], noise[row]) for row in range(ROWS)]
    played = [torch.cat([now[row], batch.actions[row]]) for row in range(ROWS)]
    next_played = [torch.cat([then[row], following[row][0].detach()]) for row in range(ROWS)]
    of_batch = [values(built.critics, which, played + next_played) for which in range(2)]
    own_played = [torch.cat([now[row], own[row][0]]) for row in range(ROWS)]
    of_policy = [values(built.critics, which, own_played, moments) for which in range(2)]
    value_loss, policy_loss, entropy = torch.zeros(()), torch.zeros(()), torch.zeros(())
    for row in range(ROWS):
        smaller = min(float(each[ROWS + row].detach()) for each in of_batch)
        y = batch.rewards[row] + batch.discounts[row] * (smaller - alpha * float(following[row][1].detach()))
        for each in of_batch:
            value_loss = value_loss + 0.5 * ((each[row] - y) ** 2).sum() / ROWS
        log_prob = own[row][1]
        policy_loss = policy_loss + (alpha * log_prob - torch.minimum(*(each[row] for each in of_policy)).sum()) / ROWS
        entropy = entropy - log_prob.detach() / ROWS
    check(built, gradients, terms, [value_loss, policy_loss, entropy], -3.0)


def test_gradients_of_a_choice_are_those_of_the_papers_losses() -> None:
    """Christodoulou (2019), equations 4, 10 and 12: each expectation over the actions is a sum."""
    built, batch, alpha = Built(spaces=CHOICE), transitions(spaces=CHOICE), 0.3
    gradients, terms = built.sac.gradients(batch)
    now, then, moments = batch.observations["o"], batch.next_observations["o"], built.sac.statistics["moments"]
    of_batch = [values(built.critics, which, [*now, *then]) for which in range(2)]
    of_policy = [values(built.critics, which, [*now], moments) for which in range(2)]
    value_loss, policy_loss, entropy = torch.zeros(()), torch.zeros(()), torch.zeros(())
    for row in range(ROWS):
        of_now, of_then = (
            built.network.policy_head(built.network.encoder({"o": each[row][None]}))[0] for each in (now, then)
        )
        y = batch.rewards[row]
        for action in range(4):
            probability = (of_then[action] - of_then.logsumexp(0)).exp().detach()
            smaller = min(float(each[ROWS + row][action].detach()) for each in of_batch)
            y = y + batch.discounts[row] * probability * (smaller - alpha * probability.log())
            log_prob = of_now[action] - of_now.logsumexp(0)
            smaller = min(float(each[row][action].detach()) for each in of_policy)
            policy_loss = policy_loss + log_prob.exp() * (alpha * log_prob - smaller) / ROWS
            entropy = entropy - (log_prob.exp() * log_prob).detach() / ROWS
        for each in of_batch:
            value_loss = value_loss + 0.5 * (each[row][int(batch.actions[row, 0])] - y) ** 2 / ROWS
    check(built, gradients, terms, [value_loss, policy_loss, entropy], ENTROPY_SHARE * math.log(4.0))


def only_biases(built: Built, biases: list[list[float]]) -> None:
    """Let policy and critics compute 0, but for the last biases of the critics."""
    for parameter in (*built.network.parameters(), *built.critics.parameters()):
        parameter.data.zero_()
    built.critics.biases[-1].data.copy_(torch.tensor(biases)[:, None])


def test_target_of_a_choice_by_hand() -> None:
    """Uniform policy of four actions, Q = (1, 2, 3, 4) and 2.5: y = r + d (mean of (1, 2, 2.5, 2.5) + alpha log 4)."""
    built = Built(spaces=CHOICE)
    only_biases(built, [[1.0, 2.0, 3.0, 4.0], [2.5] * 4])
    batch = transitions(spaces=CHOICE)._replace(rewards=torch.full((ROWS,), 0.5), discounts=torch.full((ROWS,), 0.9))
    _, (_, value_loss, entropy, _) = built.sac.gradients(batch)
    y = 0.5 + 0.9 * (2.0 + 0.3 * math.log(4.0))
    errors = (torch.tensor([1.0, 2.0, 3.0, 4.0])[batch.actions[:, 0].long()] - y) ** 2 + (2.5 - y) ** 2
    assert float(value_loss) == pytest.approx(float(0.5 * errors.mean()), rel=1e-5)
    assert float(entropy) == pytest.approx(math.log(4.0))


@pytest.mark.parametrize(("logit", "rises"), [(0.0, False), (9.0, True)])
def test_temperature_of_a_choice_rises_where_the_policy_is_nearly_certain(logit: float, rises: bool) -> None:
    built = Built(spaces=CHOICE)
    built.network.policy_head.weight.data.zero_()
    built.network.policy_head.bias.data[0] = logit
    gradients, _ = built.sac.gradients(transitions(spaces=CHOICE))
    assert (float(gradients["log_temperature"]) < 0.0) is rises  # the optimiser descends


def test_policy_and_temperature_are_left_out_of_an_update_of_the_critics_alone() -> None:
    found = []
    for of_policy in (True, False):
        built = Built()
        torch.manual_seed(5)
        found.append(built.sac.gradients(transitions(), of_policy=of_policy)[0])
    assert found[1].keys() == {"critics"}
    torch.testing.assert_close(found[0]["critics"], found[1]["critics"])


def test_target_by_hand() -> None:
    """Policy N(0, 1) before tanh, critics 2 and 5: y is r + d (2 - alpha log pi(a' | s'))."""
    built = Built()
    only_biases(built, [[2.0], [5.0]])
    batch = transitions()._replace(rewards=torch.full((ROWS,), 0.5), discounts=torch.full((ROWS,), 0.9))
    torch.manual_seed(5)
    u = torch.randn(2 * ROWS, 3)[ROWS:].double()
    torch.manual_seed(5)
    _, (_, value_loss, *_) = built.sac.gradients(batch)
    log_prob = (-0.5 * u**2 - 0.5 * math.log(2.0 * math.pi) - torch.log(1.0 - torch.tanh(u) ** 2)).sum(-1)
    y = 0.5 + 0.9 * (2.0 - 0.3 * log_prob)
    assert float(value_loss) == pytest.approx(float((0.5 * ((2.0 - y) ** 2 + (5.0 - y) ** 2)).mean()), rel=1e-4)


def test_inputs_of_layers_are_normalised_by_hand() -> None:
    """One layer, inputs 1 and 3 (mean 2, variance 1), factor 2, offset 1, weight 3, bias 0.5."""
    spaces = Spaces(
        observations={"o": ArraySpace(shape=(1,), dtype="float32")}, actions={"c": DiscreteSpace(counts=(2,))}
    )
    critics = TwinCritics(POLICY.model_copy(update={"hidden": ()}), spaces, NO_MODULES)
    for parameters, number in (
        (critics.weights, 3.0),
        (critics.biases, 0.5),
        (critics.factors, 2.0),
        (critics.offsets, 1.0),
    ):
        parameters[0].data.fill_(number)
    outputs, moments = critics(torch.tensor([[1.0], [3.0]]))
    deviation = math.sqrt(1.0 + 1e-3)
    torch.testing.assert_close(
        outputs[0, :, 0], torch.tensor([3.0 * (1.0 - 2.0 / deviation), 3.0 * (1.0 + 2.0 / deviation)]) + 0.5
    )
    torch.testing.assert_close(moments, torch.tensor([2.0, 1.0])[:, None, None].expand(2, 2, 1))
    outputs, used = critics(torch.tensor([[1.0]]), critics.moments)
    torch.testing.assert_close(used, critics.moments)
    torch.testing.assert_close(outputs[0, 0, 0], torch.tensor(3.0 * (2.0 / deviation + 1.0) + 0.5))


@pytest.mark.parametrize("spaces", [SPACES, CHOICE])
def test_recorded_updates_have_the_gradients_of_the_others(spaces: Spaces) -> None:
    built = Built(spaces=spaces)
    for _ in range(EARLIER_CALLS + 1):
        built.sac.gradients(transitions(8, spaces))
    batch = transitions(9, spaces)
    torch.manual_seed(7)
    found, _ = built.sac.gradients(batch)
    other = Built(spaces=spaces)
    torch.manual_seed(7)
    expected, _ = other.sac.gradients(batch)
    for name, gradient in found.items():
        torch.testing.assert_close(gradient, expected[name])


@pytest.mark.parametrize("spaces", [SPACES, CHOICE])
def test_bfloat16_rounds_the_parameters_of_the_moment(spaces: Spaces) -> None:
    exact, rounded = Built(spaces=spaces), Built(spaces=spaces, is_mixed=True)
    for built in (exact, rounded):  # after the copies were made
        torch.manual_seed(11)
        built.sac.statistics["critics"].add_(torch.randn_like(built.sac.statistics["critics"]))
        for parameter in built.network.encoder.parameters():
            parameter.data.add_(torch.randn_like(parameter))
    for _ in range(EARLIER_CALLS + 2):
        found = []
        for built in (exact, rounded):
            torch.manual_seed(5)
            found.append(built.sac.gradients(transitions(spaces=spaces))[0])
        for name, expected in found[0].items():
            assert found[1][name].dtype == torch.float32
            assert 0.0 < float((found[1][name] - expected).norm() / expected.norm()) < 0.05, name


def test_running_moments_follow_those_of_the_minibatches_that_were_learned_from() -> None:
    built, batch = Built(), transitions()
    moments = built.sac.statistics["moments"]
    before = moments.clone()
    torch.manual_seed(5)
    noise = torch.randn(2 * ROWS, 3)[ROWS:]
    torch.manual_seed(5)
    built.sac.gradients(batch)
    torch.testing.assert_close(moments, before, msg="a gradient that is not finite changes nothing")
    built.sac.after_update(1, GradientComputer(built.sac.spec, built.network, SPACES).forward)
    following = [chosen(built.network, batch.next_observations["o"][row], noise[row])[0] for row in range(ROWS)]
    rows = [*torch.cat([batch.observations["o"], batch.actions], -1)]
    rows += [*torch.cat([batch.next_observations["o"], torch.stack(following)], -1)]
    for number, (found, expected) in enumerate(zip(moments, by_batch(rows), strict=True)):
        size = NUMBERS + 3
        torch.testing.assert_close(found[0, :size], 0.99 * before[number, 0, :size] + 0.01 * expected)


@pytest.mark.parametrize("mean", [0.0, 1.5, -3.9])
def test_sampled_density_is_that_of_torch_also_beyond_the_last_digit(mean: float) -> None:
    family = SquashedGaussian(LEG, initial_std=1.0, state_dependent=True).double().requires_grad_(False)
    noise = torch.linspace(-6.0, 6.0, 25, dtype=torch.float64)[:, None]
    parameters = torch.tensor([mean, math.log(0.7)], dtype=torch.float64).expand(25, 2)
    actions, log_probs = family.sample_and_log_prob(parameters, noise)
    u = mean + 0.7 * noise
    normal = reference.Normal(torch.tensor(mean, dtype=torch.float64), 0.7)
    expected = normal.log_prob(u) - reference.TanhTransform().log_abs_det_jacobian(u, u.tanh())
    torch.testing.assert_close(log_probs, expected.sum(-1))
    torch.testing.assert_close(actions, u.tanh())


@pytest.mark.parametrize(
    ("actions", "named"),
    [
        ({"a": DiscreteSpace(counts=(4,), masked=True)}, "4 choices, masked"),
        ({"a": DiscreteSpace(counts=(2, 3))}, "choices of 2 x 3"),
        ({"a": DiscreteSpace(counts=(4,)), "b": DiscreteSpace(counts=(2,))}, "a: 4 choices, b: 2 choices"),
        ({"arm": ARM, "hand": DiscreteSpace(counts=(2,))}, "hand"),
        ({"a": ContinuousSpace(low=(None,), high=(1.0,))}, "-inf"),
    ],
)
def test_other_actions_are_refused_in_one_line(actions: dict[str, ActionSpace], named: str) -> None:
    with pytest.raises(NetworkError, match=r"^training\.algorithm=sac needs continuous actions with bounds") as refusal:
        ActorCritic(POLICY, spaces_of(**actions), training=TrainingSpec(algorithm="sac"))
    assert named in str(refusal.value)
    assert "use appo" in str(refusal.value)


PIXELS = ArraySpace(shape=(42, 42), dtype="uint8", frames=2)


@pytest.mark.parametrize("action", [LEG, DiscreteSpace(counts=(3,))])
def test_convolutions_are_those_of_the_critics(action: ActionSpace) -> None:
    spaces = Spaces(observations={"pixels": PIXELS}, actions={"a": action})
    spec = TrainingSpec(algorithm="sac")
    network = ActorCritic(POLICY, spaces, training=spec)
    computer, critics = GradientComputer(spec, network, spaces), TwinCritics(POLICY, spaces, NO_MODULES)
    sac = computer.algorithm
    assert isinstance(sac, Sac)
    sac.build(critics, network, is_mixed=False)
    ours, theirs = (image_encoders(each.encoder)["pixels"].convolutions for each in (network, critics))

    def same() -> bool:
        return all(torch.equal(one, other) for one, other in zip(ours.parameters(), theirs.parameters(), strict=True))

    assert same(), "the critics begin with those of the policy, which may come from another run"
    now, then = ({"pixels": torch.randint(0, 255, (4, 2, 42, 42), dtype=torch.uint8)} for _ in range(2))
    batch = Transitions(now, then, torch.zeros(4, 1), torch.zeros(4), torch.ones(4))
    network.policy_head.weight.data.normal_()
    gradients, _ = sac.gradients(batch)
    learned = {name: each.numel() for name, each in network.named_parameters() if each.requires_grad}
    changed = {
        name
        for name, part in zip(learned, gradients["policy"].split([*learned.values()]), strict=True)
        if part.abs().max() > 0.0
    }
    assert changed == {name for name in learned if "convolutions" not in name}

    def seeded() -> dict[str, Tensor]:
        torch.manual_seed(7)
        return sac.gradients(batch)[0]

    before, _ = seeded(), critics.moments[1].mul_(2.0)
    after = seeded()
    assert torch.equal(before["critics"], after["critics"]), "the critics learn with the moments of the minibatch"
    assert not torch.equal(before["policy"], after["policy"]), "and the policy with running moments"
    sac.learned["critics"].sub_(gradients["critics"])
    assert not same()
    sac.after_update(1, computer.forward)
    assert same()


def test_images_are_shifted_with_their_borders_repeated() -> None:
    encoder = ImageEncoder(
        ImageLayout("small", PIXELS), nn.Sequential(nn.Identity()), lambda size: (nn.Identity(), size)
    )
    images = torch.randint(0, 255, (20, 2, 42, 42), dtype=torch.uint8)
    torch.manual_seed(1)
    shifted = encoder.convolve(images, shifted=True).reshape(images.shape)
    assert torch.equal(encoder.convolve(images).reshape(images.shape), images.float())
    padded, found = functional.pad(images.float(), (2, 2, 2, 2), mode="replicate"), set()
    for image, wide in zip(shifted, padded, strict=True):
        places = [(y, x) for y in range(5) for x in range(5) if torch.equal(image, wide[:, y : y + 42, x : x + 42])]
        assert len(places) == 1
        found.add(places[0])
    assert {0, 4} <= {y for y, _ in found}
    assert {0, 4} <= {x for _, x in found}
