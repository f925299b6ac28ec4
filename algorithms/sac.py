"""Soft actor-critic: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", algorithm 1, with the
critics of Bhatt et al. (2024), "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample
Efficiency and Simplicity". For a choice in place of continuous actions: Christodoulou (2019), "Soft Actor-Critic for
Discrete Action Settings".

The critics stay in the learner: the program and the snapshots of the actors are the policy alone.
"""

import functools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn

from daedalus.algorithms.algorithm import Algorithm, Forward
from daedalus.algorithms.forward import FlatParameters, flat_gradient, forward_precision
from daedalus.algorithms.recording import OperationRecorder
from daedalus.algorithms.replay_buffer import Transitions
from daedalus.policy.network.actor_critic import ActorCritic, full_precision
from daedalus.policy.network.encoders import build_encoder, image_encoders
from daedalus.policy.network.layers import Components, map_components
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec

_FEATURES = 50  # of each image
_DECAY = 0.99  # of the running moments, at each update
_EPSILON = 1e-3  # added to variances, as published
POLICY_PERIOD = 3  # updates of the critics for one of the policy and the temperature, as published
FIRST_DECAY = 0.5  # of Adam, as published: with 0.9 HalfCheetah learns more slowly than with target critics


class TwinCritics(nn.Module):
    """Two critics Q_1(s, a) and Q_2(s, a) with layers of their own, computed at once, and one encoder of images.

    Continuous actions are inputs. For a choice, the outputs are the values of all its actions. The convolutions of
    images are the critics': the policy has a copy of them.

    The inputs of each layer are normalised over a batch: by the moments of the batch, where the critics learn, and else
    by running moments.

    Attributes:
      choices: A, the number of actions of the choice; 0 if the actions are continuous.
      moments: [2, 2, N] of the inputs of all layers side by side: running mean and variance for each critic.
    """

    moments: Tensor

    def __init__(self, spec: PolicySpec, spaces: Spaces, modules: UserModules) -> None:
        """Construct both. The layers have the sizes of `policy.hidden`; see `build_encoder` for the exceptions."""
        super().__init__()
        # Without layers of its own, an encoder of vectors puts all components side by side.
        without_layers = spec.model_copy(update={"hidden": ()})
        self.encoder = build_encoder(without_layers, spaces.observations, modules, _few_features)
        choice = spaces.only_choice
        self.choices = 0 if choice is None else choice.choices
        actions = 0 if choice is not None else sum(space.size for space in spaces.actions.values())
        self._widths = [self.encoder.features + actions, *spec.hidden]
        pairs = list(zip(self._widths, [*spec.hidden, self.choices or 1], strict=True))
        # As torch initialises linear layers; [2, inputs, outputs] and [2, 1, outputs].
        self.weights = nn.ParameterList([_uniform(inputs, (2, inputs, outputs)) for inputs, outputs in pairs])
        self.biases = nn.ParameterList([_uniform(inputs, (2, 1, outputs)) for inputs, outputs in pairs])
        # Of the normalised inputs of each layer: [2, inputs, 1] and [2, 1, inputs].
        self.factors = nn.ParameterList([nn.Parameter(torch.ones(2, inputs, 1)) for inputs in self._widths])
        self.offsets = nn.ParameterList([nn.Parameter(torch.zeros(2, 1, inputs)) for inputs in self._widths])
        moments = torch.stack([torch.zeros(2, sum(self._widths)), torch.ones(2, sum(self._widths))])
        self.register_buffer("moments", moments)
        self._activate = torch.relu if spec.activation == "relu" else torch.tanh

    def convolve(self, prepared: Components) -> Components:
        """Return observations, with each image shifted at random and replaced by the outputs of its convolutions."""
        encoders = image_encoders(self.encoder)
        return prepared | {name: encoder.convolve(prepared[name], shifted=True) for name, encoder in encoders.items()}

    def inputs(self, prepared: Components, actions: Tensor) -> Tensor:
        """Return the inputs [B, N_1] of the first layers, of observations, each [B, *stacked_shape] or convolved.

        `actions`: [B, D]; those of a choice are no inputs.
        """
        features = self.encoder(prepared).float()
        return features if self.choices else torch.cat([features, actions], -1)

    def forward(self, inputs: Tensor, moments: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the values [2, B, A], A = 1 for continuous actions, and moments as in `moments`.

        Args:
          inputs: a result of `inputs`.
          moments: to normalise by; None: by those of the batch, which are returned.
        """
        hidden = inputs.expand(2, *inputs.shape)
        used, last = [], len(self.weights) - 1
        given = [None] * len(self._widths) if moments is None else moments.split(self._widths, -1)
        layers = zip(self.weights, self.biases, self.factors, self.offsets, given, strict=True)
        for number, (weight, bias, factor, offset, known) in enumerate(layers):
            used.append(_moments(hidden) if known is None else known)
            mean, variance = used[-1].unbind()
            # The normalisation of the inputs is a change of weight and bias, which are smaller than a batch of inputs.
            with full_precision(hidden):
                scale = factor * (variance + _EPSILON).rsqrt()[..., None]  # [2, N_k, 1]
                bias = torch.baddbmm(bias, offset - mean[:, None] * scale.mT, weight)
                weight = scale * weight
                if number == last:  # in full precision, as in ActorCritic
                    hidden = torch.baddbmm(bias, hidden.float(), weight)
            if number < last:
                hidden = self._activate(torch.baddbmm(bias, hidden, weight))
        return hidden, torch.cat(used, -1)


class _Moments(torch.autograd.Function):
    """Mean and variance over B rows [2, 2, N] of values [2, B, N]: its gradient takes two operations on all values."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        """Return the moments."""
        with full_precision(values):
            exact = values.float()
            # A product takes a fourth of the time of a sum over the rows.
            share = exact.new_full((1, 1, exact.shape[1]), 1.0 / exact.shape[1]).expand(2, -1, -1)
            mean = share @ exact  # [2, 1, N]
            variance = share @ (exact - mean).square()
        ctx.save_for_backward(values, mean)
        return torch.stack([mean, variance]).squeeze(2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        """Return the gradient of the values: (g_mean + 2 g_variance (value - mean)) / B."""
        values, mean = ctx.saved_tensors
        of_mean, of_variance = (gradients[0][..., None, :] / values.shape[1]).unbind()
        slope = 2.0 * of_variance
        return torch.addcmul((of_mean - slope * mean).to(values.dtype), values, slope.to(values.dtype))


def _moments(values: Tensor) -> Tensor:
    return _Moments.apply(values)  # pyright: ignore[reportReturnType]


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
    """Twin critics, a policy, and a temperature alpha that keeps the entropy of the policy.

    The value of a policy is V(s) = E[min_i Q_i(s, a) - alpha log pi(a | s)], a ~ pi(s). With a transition of m rewards
    R and discounts d (replay_buffer.py), both critics regress on R + d V(s'), which is constant; the policy ascends
    V(s); and log alpha descends log alpha (E[-log pi(a | s)] - H), where H is the target of the entropy. All three
    gradients are those at the parameters before the update.

    There are no target critics: the values of (s, a) and of (s', a') are computed as one batch, by whose moments all
    inputs of layers are normalised (section 3 of CrossQ). The policy ascends values that are normalised by running
    moments.

    Continuous actions are squashed Gaussian: each expectation is one reparameterised sample, and H = -D, of the actions
    scaled to [-1, 1]. For a choice of A actions an expectation is the sum over all of them, and H a share of log A.
    """

    record = ALGORITHMS["sac"]

    def build(self, critics: TwinCritics, network: ActorCritic, *, is_mixed: bool) -> None:
        """Begin with these critics, and a temperature of 1, before the first update.

        Args:
          critics: on the device of the network.
          network: the policy.
          is_mixed: whether forward passes compute in bfloat16.
        """
        self._network, self._critics, self._is_mixed = network, critics, is_mixed
        self._flat = FlatParameters(critics.parameters())
        device = self._flat.values.device
        self._convolutions = [
            (of_policy.convolutions, of_critics.convolutions)
            for of_policy, of_critics in zip(
                *(image_encoders(each.encoder).values() for each in (network, critics)), strict=True
            )
        ]
        self.take_convolutions()
        self._log_temperature = torch.zeros(1, device=device)
        choices, count = critics.choices, self.distribution.normal_count  # A or 0, D or 0
        self._target_entropy = ENTROPY_SHARE * math.log(choices) if choices else -float(count)
        self._batch_moments = critics.moments.clone()  # of the newest minibatch
        self._recorders = OperationRecorder(), OperationRecorder()
        self._records = device.type == "cpu" and not network.convolutional and not network.has_user_modules
        self._thread = ThreadPoolExecutor(1, "policy-gradient")  # beside that of the critics, if both are recorded
        # What optimisers change, besides the policy.
        self.learned = {"critics": self._flat.values, "log_temperature": self._log_temperature}
        self.statistics = {**self.learned, "moments": critics.moments}

    def take_convolutions(self) -> None:
        """Give the critics the convolutions of the policy."""
        for of_policy, of_critics in self._convolutions:
            _copy(of_policy, of_critics)

    @property
    def temperature(self) -> float:
        """Alpha, the weight of the entropy of the policy."""
        return math.exp(float(self._log_temperature))

    def gradients(self, transitions: Transitions, *, of_policy: bool = True) -> tuple[dict[str, Tensor], list[Tensor]]:
        """Return the gradients of one update, by the names in `learned` and "policy", and its loss terms (Terms).

        With `of_policy` False, return that of the critics alone, and no terms.
        """
        now, then, *others = transitions
        shape = 2 * len(transitions.rewards), self.distribution.normal_count
        noise = torch.randn(shape, device=transitions.rewards.device)
        noise, next_noise = noise.chunk(2)
        if self._records:
            results = self._recorded(now, then, [*others, next_noise], noise if of_policy else None)
        else:
            with self._precision():
                seen = self._critics.convolve(self._network.prepare(now))
            actions, rewards, discounts = others
            results = [self._of_critics(seen, self._network.prepare(then), actions, rewards, discounts, next_noise)]
            if of_policy:  # it does not change the convolutions
                results.append(self._of_policy(map_components(seen, Tensor.detach), noise))
        critics, value_loss, self._batch_moments = results[0]
        if not of_policy:
            return {"critics": critics}, []
        policy, temperature, policy_loss, entropy = results[1]
        terms = [policy_loss, value_loss, entropy, entropy.new_zeros(())]
        return {"policy": policy, "critics": critics, "log_temperature": temperature}, terms

    def _recorded(
        self, now: Components, then: Components, others: Sequence[Tensor], noise: Tensor | None
    ) -> list[tuple[Tensor, ...]]:
        """Return the results of `_of_critics`, and with noise those of `_of_policy`: by recordings, on two threads."""
        names, size = tuple(now), len(now)

        def seen(values: Sequence[Tensor]) -> Components:
            return self._network.prepare(dict(zip(names, values, strict=True)))

        def of_critics(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
            return self._of_critics(seen(tensors[:size]), seen(tensors[size : 2 * size]), *tensors[2 * size :])

        def of_policy(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
            return self._of_policy(seen(tensors[:size]), tensors[size])

        first, second = self._recorders
        inputs = [*now.values(), *then.values(), *others]
        if noise is None:
            return [first.call(names, of_critics, inputs)]
        call = functools.partial(second.call, names, of_policy, [*now.values(), noise])
        if not (first.has_recordings and second.has_recordings):
            return [first.call(names, of_critics, inputs), call()]
        beside = self._thread.submit(call)
        return [first.call(names, of_critics, inputs), beside.result()]

    def _of_critics(
        self, now: Components, then: Components, actions: Tensor, rewards: Tensor, discounts: Tensor, noise: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the gradient of the critics, their loss, and the moments of the minibatch."""
        critics = self._critics
        with self._precision():
            with torch.no_grad():
                then = critics.convolve(then)
                next_actions, log_probs = self._played(then, noise)
            outputs, moments = critics(torch.cat([critics.inputs(now, actions), critics.inputs(then, next_actions)]))
            values, next_values = outputs.chunk(2, 1)  # [2, B, A]
            with torch.no_grad():
                following, _ = self._values(next_values, log_probs)
                targets = rewards + discounts * following
            values = values.gather(-1, actions.long().expand(2, -1, -1)) if critics.choices else values
            loss = 0.5 * (values.squeeze(-1) - targets).square().mean(-1).sum()
        return self._flat.differentiated(loss), loss.detach(), moments.detach()

    def _of_policy(self, now: Components, noise: Tensor) -> tuple[Tensor, ...]:
        """Return the gradients of the policy and of the temperature, the loss and the entropy of the policy."""
        critics = self._critics
        with self._precision():
            actions, log_probs = self._played(now, noise)
            outputs, _ = critics(critics.inputs(now, actions), critics.moments)
            values, entropies = self._values(outputs, log_probs)
            loss = -values.mean()
        gradient = flat_gradient(loss, self._network.learned_parameters())
        entropy = entropies.detach().mean()
        return gradient, (entropy - self._target_entropy).reshape(1), loss.detach(), entropy

    def _played(self, seen: Components, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions of the policy [B, D] and their log-probabilities [B]; [B, 0] and those of all choices [B, A].

        Args:
          seen: observations, with images convolved.
          noise: [B, D], of the samples of continuous actions.
        """
        features = self._network.encoder(seen).float()
        with full_precision(features):
            parameters = self._network.policy_head(features)  # of a choice, the logits
            if self._critics.choices:
                return noise, parameters.log_softmax(-1)
            return self.distribution.sample_and_log_prob(parameters, noise)

    def _values(self, outputs: Tensor, log_probs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values V(s) and the entropies of the policy, each [B], of outputs of the critics [2, B, A]."""
        smaller = torch.minimum(*outputs.unbind())
        if self._critics.choices:
            entropies = -(log_probs.exp() * log_probs).sum(-1)
            values = (log_probs.exp() * smaller).sum(-1)
        else:
            values, entropies = smaller.squeeze(-1), -log_probs
        return values + self._log_temperature.exp() * entropies, entropies

    def _precision(self) -> AbstractContextManager[object]:
        return forward_precision(self._log_temperature.device.type, is_mixed=self._is_mixed)

    def after_update(self, policy_version: int, forward: Forward) -> None:
        """See Algorithm: move the running moments of the critics towards those of the minibatch."""
        self._critics.moments.lerp_(self._batch_moments, 1.0 - _DECAY)
        for of_policy, of_critics in self._convolutions:
            _copy(of_critics, of_policy)


def _copy(source: nn.Module, target: nn.Module) -> None:
    with torch.no_grad():
        for parameter, values in zip(target.parameters(), source.parameters(), strict=True):
            parameter.copy_(values)
