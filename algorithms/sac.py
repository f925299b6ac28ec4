"""Soft actor-critic: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", algorithm 1.

The critics stay in the learner: the program and the snapshots of the actors are the policy alone.
"""

import copy
import itertools
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

from daedalus.algorithms.algorithm import Algorithm, Forward
from daedalus.algorithms.forward import FlatParameters
from daedalus.algorithms.recording import OperationRecorder
from daedalus.algorithms.replay_buffer import Transitions
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.encoders import build_encoder, image_encoders
from daedalus.policy.network.layers import Components, map_components
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec


class TwinCritics(nn.Module):
    """Two critics Q_1(s, a) and Q_2(s, a) with layers of their own, computed at once, and one encoder of images.

    The convolutions of images are the critics': the policy has a copy of them.
    """

    def __init__(self, spec: PolicySpec, spaces: Spaces, modules: UserModules) -> None:
        """Construct both. The layers have the sizes of `policy.hidden`; see `build_encoder` for the exceptions."""
        super().__init__()
        # Without layers of its own, an encoder of vectors puts all components side by side.
        self.encoder = build_encoder(spec.model_copy(update={"hidden": ()}), spaces.observations, modules)
        actions = sum(space.size for space in spaces.actions.values())
        sizes = [self.encoder.features + actions, *spec.hidden, 1]
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
        """Return both values [2, B] of actions [B, D] in observations, each [B, *stacked_shape] or convolved."""
        features = torch.cat([self.encoder(prepared).float(), actions], -1)
        hidden = features.expand(2, *features.shape)
        *layers, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for inner_weight, inner_bias in layers:
            hidden = self._activate(torch.baddbmm(inner_bias, hidden, inner_weight))
        device = hidden.device.type
        # In full precision, as the heads of ActorCritic.
        with torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext():
            return torch.baddbmm(bias, hidden.float(), weight).squeeze(-1)


def _uniform(inputs: int, shape: tuple[int, ...]) -> nn.Parameter:
    bound = 1.0 / math.sqrt(inputs)
    return nn.Parameter(torch.empty(shape).uniform_(-bound, bound))


class Sac(Algorithm):
    """Twin critics with target critics, a squashed Gaussian policy, and a temperature alpha that keeps its entropy.

    With a' ~ pi(s') and a transition of m rewards R and discounts d (replay_buffer.py), both critics regress on

        y = R + d (min_i Q-_i(s', a') - alpha log pi(a' | s'))

    the policy descends E[alpha log pi(a | s) - min_i Q_i(s, a)], a ~ pi(s), and log alpha descends
    -log alpha (log pi(a | s) + H), with the entropy H = -D of the actions scaled to [-1, 1] as the target. All three
    gradients are those at the parameters before the update.
    """

    record = ALGORITHMS["sac"]

    def build(
        self, critics: TwinCritics, network: ActorCritic, learned: FlatParameters, *, target_rate: float, is_mixed: bool
    ) -> None:
        """Begin with these critics, and a temperature of 1, before the first update.

        Args:
          critics: on the device of the network.
          network: the policy.
          learned: its parameters that have gradients.
          target_rate: share of the way that the target critics move to the critics at each update.
          is_mixed: whether forward passes compute in bfloat16.
        """
        device = learned.values.device
        self._network, self._learned, self._critics = network, learned, critics
        self._target_critics = copy.deepcopy(self._critics).requires_grad_(False)
        self._flat = FlatParameters(self._critics.parameters())
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
        self._actions = self.distribution.normal_count  # D
        self._target_rate, self._is_mixed = target_rate, is_mixed
        self._recorder = OperationRecorder()
        self._records = device.type == "cpu" and not network.convolutional and not network.has_user_modules
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
        names = tuple(transitions.observations)
        rows = len(transitions.rewards)
        noise = torch.randn((2 * rows, self._actions), device=transitions.rewards.device)
        tensors = [
            *transitions.observations.values(),
            *transitions.next_observations.values(),
            *transitions[2:],
            noise,
        ]

        def computed(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
            size = len(names)
            now = dict(zip(names, tensors[:size], strict=True))
            then = dict(zip(names, tensors[size : 2 * size], strict=True))
            return self._gradients(now, then, *tensors[2 * size :])

        results = self._recorder.call(names, computed, tensors) if self._records else computed(tensors)
        policy, critics, temperature, *terms = results
        return {"policy": policy, "critics": critics, "log_temperature": temperature}, terms

    def _gradients(
        self, now: Components, then: Components, actions: Tensor, rewards: Tensor, discounts: Tensor, noise: Tensor
    ) -> tuple[Tensor, ...]:
        rows, temperature = len(rewards), self._log_temperature.exp()
        now, then = self._network.prepare(now), self._network.prepare(then)
        with self._precision():
            with torch.no_grad():
                next_actions, next_log_probs = self._choose(self._critics.convolve(then), noise[rows:])
                next_values = self._target_critics(self._target_critics.convolve(then), next_actions).amin(0)
                targets = rewards + discounts * (next_values - temperature * next_log_probs)
            now = self._critics.convolve(now)
            values = self._critics(now, actions)  # [2, B]
            value_loss = 0.5 * (values - targets).square().mean(-1).sum()
            critic_gradient = self._flat.differentiated(value_loss)
            now = map_components(now, Tensor.detach)  # the policy does not change the convolutions
            chosen, log_probs = self._choose(now, noise[:rows])
            first, second = self._critics(now, chosen).unbind()
            policy_loss = (temperature * log_probs - torch.minimum(first, second)).mean()
            policy_gradient = self._learned.differentiated(policy_loss)
        entropy = -log_probs.detach().mean()
        temperature_gradient = (entropy + self._actions).reshape(1)
        terms = (policy_loss.detach(), value_loss.detach(), entropy, entropy.new_zeros(()))
        return policy_gradient, critic_gradient, temperature_gradient, *terms

    def _choose(self, prepared: Components, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions of the policy [B, D] and their log-densities [B], made from noise [B, D]."""
        features = self._network.encoder(prepared).float()
        device = features.device.type
        with torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext():
            parameters = self._network.policy_head(features)
            return self.distribution.sample_and_log_prob(parameters, noise)

    def _precision(self) -> AbstractContextManager[object]:
        device = self._log_temperature.device.type
        return torch.autocast(device, torch.bfloat16) if self._is_mixed else nullcontext()

    def after_update(self, policy_version: int, forward: Forward) -> None:
        """See Algorithm: move the target critics by `target_rate` of the way to the critics."""
        self._targets.lerp_(self._flat.values, self._target_rate)
        for of_policy, of_critics, _ in self._convolutions:
            _copy(of_critics, of_policy)


def _copy(source: nn.Module, target: nn.Module) -> None:
    with torch.no_grad():
        for parameter, values in zip(target.parameters(), source.parameters(), strict=True):
            parameter.copy_(values)
