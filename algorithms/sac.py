"""Soft actor-critic: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", algorithm 1, with the
critics of Kuznetsov et al. (2020), "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional
Quantile Critics" (TQC). For a choice in place of continuous actions: Christodoulou (2019), "Soft Actor-Critic for
Discrete Action Settings".

The critics stay in the learner: the program and the snapshots of the actors are the policy alone.
"""

import copy
import functools
import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

from daedalus.algorithms.algorithm import Algorithm, Forward
from daedalus.algorithms.forward import FlatParameters
from daedalus.algorithms.recording import OperationRecorder
from daedalus.algorithms.replay_buffer import Transitions
from daedalus.policy.network.actor_critic import ActorCritic, full_precision
from daedalus.policy.network.encoders import build_encoder, image_encoders
from daedalus.policy.network.layers import Components, map_components
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec

QUANTILES = 25  # of each critic of continuous actions, as published
_FEATURES = 50  # of each image
DROPPED = 4  # the largest of those of both target critics


class TwinCritics(nn.Module):
    """Two critics with layers of their own, computed at once, and one encoder of images.

    Continuous actions are inputs, and the outputs are quantiles of the return. For a choice, the outputs are the values
    Q_1(s, a) and Q_2(s, a) of all its actions. The convolutions of images are the critics': the policy has a copy of
    them.

    Attributes:
      choices: A, the number of actions of the choice; 0 if the actions are continuous.
    """

    def __init__(self, spec: PolicySpec, spaces: Spaces, modules: UserModules) -> None:
        """Construct both. The layers have the sizes of `policy.hidden`; see `build_encoder` for the exceptions."""
        super().__init__()
        # Without layers of its own, an encoder of vectors puts all components side by side.
        without_layers = spec.model_copy(update={"hidden": ()})
        self.encoder = build_encoder(without_layers, spaces.observations, modules, _few_features)
        choice = spaces.only_choice
        self.choices = 0 if choice is None else choice.choices
        actions = 0 if choice is not None else sum(space.size for space in spaces.actions.values())
        sizes = [self.encoder.features + actions, *spec.hidden, self.choices or QUANTILES]
        pairs = list(itertools.pairwise(sizes))
        # As torch initialises linear layers; [2, inputs, outputs] and [2, 1, outputs].
        self.weights = nn.ParameterList([_uniform(inputs, (2, inputs, outputs)) for inputs, outputs in pairs])
        self.biases = nn.ParameterList([_uniform(inputs, (2, 1, outputs)) for inputs, outputs in pairs])
        self._activate = torch.relu if spec.activation == "relu" else torch.tanh

    def convolve(self, prepared: Components) -> Components:
        """Return observations, with each image shifted at random and replaced by the outputs of its convolutions."""
        encoders = image_encoders(self.encoder)
        return prepared | {name: encoder.convolve(prepared[name], shifted=True) for name, encoder in encoders.items()}

    def forward(self, prepared: Components, actions: Tensor) -> Tensor:
        """Return quantiles [2, B, Q] of the returns after actions [B, D] in observations, or the values [2, B] of
        chosen actions [B, 1]. The observations are each [B, *stacked_shape] or convolved."""
        if self.choices:
            return self.of_choices(prepared).gather(-1, actions.long().expand(2, *actions.shape)).squeeze(-1)
        return self._outputs(torch.cat([self.encoder(prepared).float(), actions], -1))

    def of_choices(self, prepared: Components) -> Tensor:
        """Return both values of all A actions of a choice [2, B, A] in observations, which are as in `forward`."""
        return self._outputs(self.encoder(prepared).float())

    def _outputs(self, features: Tensor) -> Tensor:
        """Return the outputs [2, B, F'] of all layers, of [B, F]; of the last in full precision, as in ActorCritic."""
        hidden = features.expand(2, *features.shape)
        *layers, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for inner_weight, inner_bias in layers:
            hidden = self._activate(torch.baddbmm(inner_bias, hidden, inner_weight))
        with full_precision(hidden):
            return torch.baddbmm(bias, hidden.float(), weight)

    def rounded(self) -> "TwinCritics":
        """Return a copy in bfloat16, but for the last layer, which both share."""
        copied = copy.deepcopy(self).bfloat16()
        copied.weights[-1], copied.biases[-1] = self.weights[-1], self.biases[-1]
        return copied


def _few_features(inputs: int) -> tuple[nn.Module, int]:
    """Return what follows the convolutions of the critics: so few outputs that actions count beside them.

    As in the appendix of Kostrikov et al. (2021), "Image Augmentation Is All You Need".
    """
    return nn.Sequential(nn.Linear(inputs, _FEATURES), nn.LayerNorm(_FEATURES), nn.Tanh()), _FEATURES


def _uniform(inputs: int, shape: tuple[int, ...]) -> nn.Parameter:
    bound = 1.0 / math.sqrt(inputs)
    return nn.Parameter(torch.empty(shape).uniform_(-bound, bound))


# Of the largest entropy of a choice, log A: the target. Christodoulou has 0.98. With as much, few policies that solve a
# task have the target, and the temperature rises without end: with 0.89 on CartPole (docs/results.md).
ENTROPY_SHARE = 0.7


class Sac(Algorithm):
    """Twin critics with target critics, a policy, and a temperature alpha that keeps the entropy of the policy.

    The value of a policy is V(s) = E[Q(s, a) - alpha log pi(a | s)], a ~ pi(s). With a transition of m rewards R and
    discounts d (replay_buffer.py), both critics regress on R + d V-(s'), where V- has the target critics; the policy
    ascends V(s); and log alpha descends log alpha (E[-log pi(a | s)] - H), where H is the target of the entropy. All
    three gradients are those at the parameters before the update.

    Continuous actions are squashed Gaussian: each expectation is one reparameterised sample, and H = -D, of the actions
    scaled to [-1, 1]. Q is the mean of all quantiles of both critics. The critics regress on the quantiles of both
    target critics without the largest of them, so that values are not too high (section 3 of TQC).

    For a choice of A actions an expectation is the sum over all of them, Q is the smaller of both values, and H a share
    of log A.
    """

    record = ALGORITHMS["sac"]

    def build(self, critics: TwinCritics, network: ActorCritic, *, target_rate: float, is_mixed: bool) -> None:
        """Begin with these critics, and a temperature of 1, before the first update.

        Args:
          critics: on the device of the network.
          network: the policy.
          target_rate: share of the way that the target critics move to the critics at each update.
          is_mixed: whether forward passes compute in bfloat16.
        """
        self._network, self._critics = network, critics
        self._target_critics = copy.deepcopy(critics).requires_grad_(False)
        self._flat = FlatParameters(critics.parameters())
        device = self._flat.values.device
        self._targets = FlatParameters(self._target_critics.parameters()).values
        self._convolutions = [
            (part.convolutions, of_critics.convolutions, of_targets.convolutions)
            for part, of_critics, of_targets in zip(
                *(image_encoders(each.encoder).values() for each in (network, critics, self._target_critics)),
                strict=True,
            )
        ]
        self.take_convolutions()
        self._log_temperature = torch.zeros(1, device=device)
        choices, count = critics.choices, self.distribution.normal_count  # A or 0, D or 0
        self._target_entropy = ENTROPY_SHARE * math.log(choices) if choices else -float(count)
        self._target_rate, self._is_mixed = target_rate, is_mixed
        self._recorders = OperationRecorder(), OperationRecorder()
        self._records = device.type == "cpu" and not network.convolutional and not network.has_user_modules
        self._thread = ThreadPoolExecutor(1, "policy-gradient")  # beside that of the critics, if both are recorded
        self._encoder = network.encoder
        self._rounded: dict[nn.Parameter, nn.Parameter] = {}  # what computes in bfloat16, by what it is rounded from
        if is_mixed and self._records:
            # Copies that are rounded once for each update: autocast rounds at each use, and in both directions.
            modules = (critics, self._target_critics, network.encoder)
            copies = (critics.rounded(), self._target_critics.rounded(), copy.deepcopy(network.encoder).bfloat16())
            for module, copied in zip(modules, copies, strict=True):
                pairs = zip(module.parameters(), copied.parameters(), strict=True)
                self._rounded |= {one: other for one, other in pairs if one is not other}
            self._critics, self._target_critics, self._encoder = copies
        self._policy_parameters = [self._rounded.get(each, each) for each in network.learned_parameters()]
        self._critic_parameters = [self._rounded.get(each, each) for each in critics.parameters()]
        # What optimisers change, besides the policy.
        self.learned = {"critics": self._flat.values, "log_temperature": self._log_temperature}
        self.statistics = {**self.learned, "target_critics": self._targets}

    def take_convolutions(self) -> None:
        """Give the critics and their targets the convolutions of the policy."""
        for of_policy, *others in self._convolutions:
            for each in others:
                _copy(of_policy, each)

    @property
    def temperature(self) -> float:
        """Alpha, the weight of the entropy of the policy."""
        return math.exp(float(self._log_temperature))

    def gradients(self, transitions: Transitions) -> tuple[dict[str, Tensor], list[Tensor]]:
        """Return the gradients of one update, by the names in `learned` and "policy", and its loss terms (Terms)."""
        now, then, *others = transitions
        shape = 2 * len(transitions.rewards), self.distribution.normal_count
        noise = torch.randn(shape, device=transitions.rewards.device)
        noise, next_noise = noise.chunk(2)
        for values, rounded in self._rounded.items():
            rounded.data.copy_(values)
        if self._records:
            results = self._recorded(now, then, [*others, next_noise], noise)
        else:
            with self._precision():
                seen = self._critics.convolve(self._network.prepare(now))
            actions, rewards, discounts = others
            prepared = self._network.prepare(then)
            of_critics = self._of_critics(seen, prepared, actions, rewards, discounts, next_noise)
            # The policy does not change the convolutions.
            results = (of_critics, self._of_policy(map_components(seen, Tensor.detach), noise))
        (critics, value_loss), (policy, temperature, policy_loss, entropy) = results
        terms = [policy_loss, value_loss, entropy, entropy.new_zeros(())]
        return {"policy": policy, "critics": critics, "log_temperature": temperature}, terms

    def _recorded(
        self, now: Components, then: Components, others: Sequence[Tensor], noise: Tensor
    ) -> list[tuple[Tensor, ...]]:
        """Return the results of `_of_critics` and `_of_policy`: by recordings, which two threads repeat at once."""
        names, size = tuple(now), len(now)

        def seen(values: Sequence[Tensor]) -> Components:
            return self._network.prepare(dict(zip(names, values, strict=True)))

        def of_critics(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
            return self._of_critics(seen(tensors[:size]), seen(tensors[size : 2 * size]), *tensors[2 * size :])

        def of_policy(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
            return self._of_policy(seen(tensors[:size]), tensors[size])

        calls = [
            functools.partial(recorder.call, names, function, tensors)
            for recorder, function, tensors in (
                (self._recorders[0], of_critics, [*now.values(), *then.values(), *others]),
                (self._recorders[1], of_policy, [*now.values(), noise]),
            )
        ]
        if not all(recorder.has_recordings for recorder in self._recorders):
            return [call() for call in calls]
        beside = self._thread.submit(calls[1])
        return [calls[0](), beside.result()]

    def _of_critics(
        self, now: Components, then: Components, actions: Tensor, rewards: Tensor, discounts: Tensor, noise: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the gradient of the critics, and half the squared errors of their values (means of quantiles)."""
        with self._precision():
            with torch.no_grad():
                by_targets = self._target_critics.convolve(then)
                following, _ = self._values(self._target_critics, by_targets, self._critics.convolve(then), noise)
                if not self._critics.choices:
                    pooled = following.transpose(0, 1).flatten(1)
                    kept = pooled.topk(2 * QUANTILES - DROPPED, largest=False, sorted=False)
                    following = kept.values.T  # [M, B]
                targets = rewards + discounts * following
            values = self._critics(now, actions)
            if self._critics.choices:
                loss = value_loss = 0.5 * (values - targets).square().mean(-1).sum()
            else:
                loss = quantile_loss(values, targets.T)
                value_loss = 0.5 * (values.mean(-1) - targets.mean(0)).square().mean(-1).sum()
        return _differentiated(loss, self._critic_parameters), value_loss.detach()

    def _of_policy(self, now: Components, noise: Tensor) -> tuple[Tensor, ...]:
        """Return the gradients of the policy and of the temperature, the loss and the entropy of the policy."""
        with self._precision():
            values, entropies = self._values(self._critics, now, now, noise)
            loss = -values.mean()
        gradient = _differentiated(loss, self._policy_parameters)
        entropy = entropies.detach().mean()
        return gradient, (entropy - self._target_entropy).reshape(1), loss.detach(), entropy

    def _values(
        self, critics: TwinCritics, seen: Components, prepared: Components, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the values V(s) by some critics, and the entropies of the policy [B].

        The values are [B] of a choice; of continuous actions [2, B, Q], one for each quantile in place of Q(s, a).

        Args:
          critics: the critics or their targets.
          seen: observations, with images convolved by `critics`.
          prepared: the same, with images convolved for the policy.
          noise: [B, D], of the samples of continuous actions.
        """
        features = self._encoder(prepared).float()
        if critics.choices:
            with full_precision(features):
                log_probs = self._network.policy_head(features).log_softmax(-1)  # [B, A]: its outputs are the logits
            first, second = critics.of_choices(seen).unbind()
            values = (log_probs.exp() * torch.minimum(first, second)).sum(-1)
            entropies = -(log_probs.exp() * log_probs).sum(-1)
            bonus = self._log_temperature.exp() * entropies
        else:
            with full_precision(features):
                actions, log_probs = self.distribution.sample_and_log_prob(self._network.policy_head(features), noise)
            values, entropies = critics(seen, actions), -log_probs
            bonus = (self._log_temperature.exp() * entropies)[:, None]
        return values + bonus, entropies

    def _precision(self) -> AbstractContextManager[object]:
        device = self._log_temperature.device.type
        return torch.autocast(device, torch.bfloat16) if self._is_mixed else nullcontext()

    def after_update(self, policy_version: int, forward: Forward) -> None:
        """See Algorithm: move the target critics by `target_rate` of the way to the critics."""
        self._targets.lerp_(self._flat.values, self._target_rate)
        for of_policy, of_critics, _ in self._convolutions:
            _copy(of_critics, of_policy)


def quantile_loss(values: Tensor, targets: Tensor) -> Tensor:
    """Return a number with the gradient of TQC's loss of quantiles [2, B, Q], for targets [B, M].

    The loss is the mean over rows, quantiles and targets of |tau - 1(target < quantile)| h(target - quantile): tau
    is the level of the quantile, h the loss of Huber with threshold 1. Those of both critics are added.
    """
    _, rows, quantiles = values.shape
    with torch.no_grad():
        clipped = (targets[:, None] - values[..., None]).clamp(-1.0, 1.0)  # [2, B, Q, M]
        levels = (torch.arange(quantiles, device=values.device) + 0.5) / quantiles
        # A positive error counts `levels` times, a negative one 1 - `levels` times.
        slopes = -(0.5 * clipped.mean(-1) + (levels - 0.5) * clipped.abs().mean(-1)) / (rows * quantiles)
    return (slopes * values).sum()


def _differentiated(loss: Tensor, parameters: Sequence[Tensor]) -> Tensor:
    """Return the gradients [P] of a loss, 0 for a parameter that it does not depend on."""
    gradients = torch.autograd.grad(loss, parameters, materialize_grads=True)
    return torch.cat([gradient.flatten() for gradient in gradients]).float()


def _copy(source: nn.Module, target: nn.Module) -> None:
    with torch.no_grad():
        for parameter, values in zip(target.parameters(), source.parameters(), strict=True):
            parameter.copy_(values)
