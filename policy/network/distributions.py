"""Distributions of actions, one component at a time; action_distribution.py composes them for a whole action."""

import math
from typing import Any

import torch
from numpy.polynomial.legendre import leggauss
from torch import Tensor, nn
from torch.nn.functional import softplus

from daedalus.policy.network.layers import variables_and_values
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace
from daedalus.protocol.spec import PolicySpec


class Distribution(nn.Module):
    """Family of distributions over D actions; the policy head computes the parameters of one of them.

    Samples are made from noise that the caller draws, so that a program without random numbers can make them. The
    neutral noise, 0.5 for every uniform number and 0 for every normal one, gives the greedy action.

    To write one of your own (`policy.distribution = "module:Class"`), derive from this class. The constructor is
    called with the component's space, a ContinuousSpace or DiscreteSpace (daedalus/protocol/spaces.py), and sets the
    three counts. `sample` and `log_prob` become part of the exported program: use operations that ONNX has. Learned
    numbers that do not depend on the observation are nn.Parameters of the class.
    """

    parameter_count: int  # P, outputs of the policy head
    uniform_count: int = 0  # U, uniform random numbers that a sample is made from
    normal_count: int = 0  # G, standard normal random numbers that a sample is made from

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """Return one sample of each row.

        Args:
          parameters: [N, P] float32.
          uniform: [N, U] float32, from 0 to 1, 1 excluded.
          normal: [N, G] float32.

        Returns: actions [N, D], int64 or float32. Continuous actions between two bounds are scaled to [-1, 1]; values
        beyond are clipped by the actor, after the log-probability was computed.
        """
        raise NotImplementedError

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """Return the log-probability, or log-density, of actions: parameters [..., P], actions [..., D] -> [...], nats.

        The density is that of the scaled actions. It must be finite for every action that `sample` can return.
        """
        raise NotImplementedError

    def entropy(self, parameters: Tensor) -> Tensor:
        """Return the entropy, differential for densities: [..., P] -> [...], nats."""
        raise NotImplementedError

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return `log_prob` and `entropy`. Override it where both share a computation."""
        return self.log_prob(parameters, actions), self.entropy(parameters)


def expectation(points: int) -> tuple[Tensor, Tensor]:
    """Return nodes and weights of the Gauss-Hermite rule: E[f(X)] is about sum_q weights_q f(nodes_q), X ~ N(0, 1).

    Returns: nodes [Q] and weights [Q], float32. The rule is exact for polynomials up to degree 2 Q - 1.
    """
    import numpy as np

    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    return torch.tensor(nodes, dtype=torch.float32), torch.tensor(weights / weights.sum(), dtype=torch.float32)


def bounded(values: Tensor, low: float, high: float) -> Tensor:
    """Return the values clamped to [low, high]; beyond a bound, only gradients that lead back to it pass.

    torch's clamp has no gradient beyond its bounds: a value that has crossed one, such as by the momentum of the
    optimiser, would stay there for ever.
    """
    if not torch.is_grad_enabled():  # also in the export: the exporter knows clamp
        return values.clamp(low, high)
    return _Bounded.apply(values, low, high)  # pyright: ignore[reportReturnType]


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, low: float, high: float) -> Tensor:
        clamped = values.clamp(low, high)
        ctx.save_for_backward(values, clamped)
        return clamped

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (outer,) = gradients
        values, clamped = ctx.saved_tensors
        leaves = (values - clamped) * outer < 0.0  # descent, which subtracts the gradient, leads further beyond
        return outer.masked_fill(leaves, 0.0), None, None


_SMALLEST = 1e-30  # of uniform noise: at 0 a legal choice would be less probable than one that is not
_FEW_CHOICES = 16  # on a CPU, torch's softmax and sums of so many take half the time over the first axis
_ABSENT = -1e30  # logit of a choice that a variable does not have, or that is not legal: its probability is exactly 0


class Categorical(Distribution):
    """D independent softmax policies, one for each variable of a DiscreteSpace; the parameters are all their logits.

    Samples by the Gumbel-max trick: the largest of log pi(a) - log(-log u_a) has the distribution pi (Gumbel 1954).
    """

    def __init__(self, space: DiscreteSpace) -> None:
        super().__init__()
        self._counts = space.counts
        self._equal = len(set(space.counts)) == 1
        self._columns, self._missing = _padded(space.counts)  # [D, A] index into the logits, [D, A] bool
        self.parameter_count = self.uniform_count = space.choices

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution."""
        gumbel = -torch.log(-torch.log(uniform.clamp(min=_SMALLEST)))
        return self._by_variable(parameters + gumbel).argmax(-1)  # [N, D]

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log pi_d(a_d | s)."""
        return _chosen(self._log_probs(parameters), actions)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: - sum_d sum_a pi_d(a | s) log pi_d(a | s)."""
        return _categorical_entropy(self._log_probs(parameters))

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See Distribution."""
        arranged, axis = self._by_variable(parameters), -1
        if arranged.shape[-1] <= _FEW_CHOICES:
            arranged, axis = arranged.movedim(-1, 0), 0
        log_probs = arranged.log_softmax(axis)
        return _chosen(log_probs, actions, axis), _categorical_entropy(log_probs, axis)

    def probabilities(self, parameters: Tensor) -> Tensor:
        """Return pi_d(a | s) [..., D, A], A being the largest number of choices; 0 where a variable has fewer."""
        return self._log_probs(parameters).exp()

    def _log_probs(self, parameters: Tensor) -> Tensor:
        return self._by_variable(parameters).log_softmax(-1)  # [..., D, A]

    def _by_variable(self, values: Tensor) -> Tensor:
        """Arrange values of all choices [..., P] by variable [..., D, A], A being the largest number of choices."""
        if len(self._counts) == 1:
            return values.unsqueeze(-2)
        if self._equal:
            return values.unflatten(-1, (len(self._counts), self._counts[0]))
        columns, missing = self._columns.to(values.device), self._missing.to(values.device)
        arranged = values.index_select(-1, columns).unflatten(-1, missing.shape)
        return arranged.masked_fill(missing, _ABSENT)


def without_illegal(logits: Tensor, mask: Tensor) -> Tensor:
    """Return logits [..., P] whose softmax gives probability 0 where `mask` [..., P] bool is False."""
    return logits.masked_fill(~mask, _ABSENT)


def _chosen(log_probs: Tensor, actions: Tensor, axis: int = -1) -> Tensor:
    return log_probs.gather(axis, actions.unsqueeze(axis)).squeeze(axis).sum(-1)


def _categorical_entropy(log_probs: Tensor, axis: int = -1) -> Tensor:
    return -(log_probs.exp() * log_probs).sum(axis).sum(-1)


def _padded(counts: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return, for each variable and choice, its index among all choices [D * A], and where there is none [D, A]."""
    variables, values = variables_and_values(counts)
    columns = torch.zeros((len(counts), max(counts)), dtype=torch.int64)
    missing = torch.ones_like(columns, dtype=torch.bool)
    columns[variables, values] = torch.arange(len(variables))
    missing[variables, values] = False
    return columns.flatten(), missing


_LOG_STD_RANGE = (-5.0, 2.0)  # keeps densities and gradients finite
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_LARGEST_SQUASHED = 1.0 - 1e-6  # a squashed action is at most so far from 0: beyond it float32 has too few digits left
_FREE_MEAN, _LARGEST_MEAN = 4.0, 6.0  # of a squashed action: means up to the first are as the head computes them
_GAUSSIAN_POINTS = 16


class Gaussian(Distribution):
    """D independent normal distributions N(mu(s), sigma^2).

    The head computes the means. log sigma is learned, and does not depend on the observation unless
    `state_dependent`: then the head computes it too, relative to the learned one.
    """

    def __init__(self, space: ContinuousSpace, *, initial_std: float, state_dependent: bool) -> None:
        super().__init__()
        self._size, self._state_dependent = space.size, state_dependent
        self.parameter_count = 2 * space.size if state_dependent else space.size
        self.normal_count = space.size
        self.log_std = nn.Parameter(torch.full((space.size,), math.log(initial_std)))

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: mu + sigma * normal."""
        mean, log_std = self._mean_and_log_std(parameters)
        return mean + log_std.exp() * normal

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log N(a_d; mu_d, sigma_d^2)."""
        return _gaussian_log_density(*self._mean_and_log_std(parameters), actions)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: sum_d (log sigma_d + log(2 pi e) / 2)."""
        return _gaussian_entropy(*self._mean_and_log_std(parameters))

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See Distribution."""
        mean, log_std = self._mean_and_log_std(parameters)
        return _gaussian_log_density(mean, log_std, actions), _gaussian_entropy(mean, log_std)

    def _mean_and_log_std(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        if not self._state_dependent:
            return parameters, bounded(self.log_std, *_LOG_STD_RANGE)
        mean, relative = parameters.split(self._size, -1)
        return mean, bounded(self.log_std + relative, *_LOG_STD_RANGE)


class SquashedGaussian(Gaussian):
    """tanh of a Gaussian: actions never leave their bounds (Haarnoja et al. 2018, appendix C).

    The means of the Gaussian approach +-6 beyond +-4, where an action is within 1e-3 of its bound. Samples around a
    larger mean would all be the largest action that float32 can tell from the bound, artanh(1 - 1e-6) = 7.25, whose
    density under that Gaussian is next to nothing although it is nearly always taken.
    """

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: tanh(mu + sigma * normal)."""
        return super().sample(parameters, uniform, normal).tanh().clamp(-_LARGEST_SQUASHED, _LARGEST_SQUASHED)

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: log N(u) - sum_d log(1 - a_d^2), with u = artanh(a)."""
        actions = actions.clamp(-_LARGEST_SQUASHED, _LARGEST_SQUASHED)
        above, below = (1.0 + actions).log(), (1.0 - actions).log()
        return super().log_prob(parameters, 0.5 * (above - below)) - (above + below).sum(-1)

    def sample_and_log_prob(self, parameters: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Return `sample` [..., D] and its log-density [...], both with the gradients of reparameterised samples.

        The density is computed from u = mu + sigma * normal: u = artanh(a) would lose digits near the bounds.
        """
        mean, log_std = self._mean_and_log_std(parameters)
        u = mean + log_std.exp() * normal
        log_densities = -0.5 * normal.square() - log_std - _log_slope(u)
        return u.tanh(), log_densities.sum(-1) - _HALF_LOG_2_PI * self._size

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: H(u) + sum_d E[log(1 - tanh^2 u_d)], the expectation by Gauss-Hermite quadrature."""
        mean, log_std = self._mean_and_log_std(parameters)
        nodes, weights = (part.to(mean.device) for part in expectation(_GAUSSIAN_POINTS))
        u = mean.unsqueeze(-1) + log_std.exp().unsqueeze(-1) * nodes  # [..., D, Q]
        return super().entropy(parameters) + (_log_slope(u) * weights).sum(-1).sum(-1)

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See Distribution."""
        return self.log_prob(parameters, actions), self.entropy(parameters)

    def _mean_and_log_std(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = super()._mean_and_log_std(parameters)
        inner = mean.clamp(-_FREE_MEAN, _FREE_MEAN)
        beyond = mean - inner
        # Not by tanh, whose gradient vanishes: a mean that is far beyond must come back.
        return inner + beyond / (1.0 + beyond.abs() / (_LARGEST_MEAN - _FREE_MEAN)), log_std


def _log_slope(u: Tensor) -> Tensor:
    """Return log(1 - tanh^2 u), without overflow."""
    return 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))


def _gaussian_log_density(mean: Tensor, log_std: Tensor, actions: Tensor) -> Tensor:
    """Return sum_d log N(a_d; mu_d, sigma_d^2): mean and actions [..., D], log_std [D] or [..., D] -> [...]."""
    deviations = (actions - mean) * (-log_std).exp()
    return -0.5 * deviations.square().sum(-1) - (log_std + _HALF_LOG_2_PI).sum(-1)


def _gaussian_entropy(mean: Tensor, log_std: Tensor) -> Tensor:
    """Return sum_d (log sigma_d + log(2 pi e) / 2), arguments as for `_gaussian_log_density`."""
    return (log_std + (_HALF_LOG_2_PI + 0.5)).sum(-1).expand(mean.shape[:-1])


_NEVER = -1e30  # log-probability of an action that is not chosen: finite, and its exponential is 0


class Greedy(Distribution):
    """The choice with the largest value Q(s, a); the parameters are the values of all choices of one variable.

    Without exploration (policy/network/exploration.py) its log-probability is 0 for that choice. It has no gradient.
    """

    def __init__(self, space: DiscreteSpace) -> None:
        super().__init__()
        self.parameter_count = space.choices

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution. Needs no noise."""
        return parameters.argmax(-1, keepdim=True)

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: 0 for the greedy action, and -1e30 for all others."""
        chosen = parameters.argmax(-1, keepdim=True) == actions
        return torch.where(chosen, 0.0, _NEVER).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: 0."""
        return parameters.new_zeros(parameters.shape[:-1])


_QUADRATURE_POINTS = 16


class GaussianMixture(Distribution):
    """D independent mixtures of K normal distributions: sum_k w_k(s) N(mu_k(s), sigma_k^2). Bishop (1994).

    The head computes the weights' logits and the means. sigma_k is learned, and does not depend on the observation.
    The greedy action is the mean of the most probable component.
    """

    def __init__(self, space: ContinuousSpace, *, initial_std: float, components: int) -> None:
        super().__init__()
        self._size, self._components = space.size, components
        self.parameter_count = 2 * space.size * components
        self.uniform_count = space.size * components  # to choose the component
        self.normal_count = space.size
        # Different means from the start: equal components would have equal gradients for ever.
        spread = torch.linspace(-0.5, 0.5, components) if components > 1 else torch.zeros(1)
        self.offsets = nn.Parameter(spread.repeat(space.size, 1))  # [D, K]
        self.log_std = nn.Parameter(torch.full((space.size, components), math.log(initial_std)))

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution. The component is chosen by the Gumbel-max trick."""
        log_weights, means, log_std = self._mixture(parameters)
        gumbel = -torch.log(-torch.log(uniform)).unflatten(-1, log_weights.shape[-2:])
        chosen = (log_weights + gumbel).argmax(-1, keepdim=True)  # [N, D, 1]
        mean = means.gather(-1, chosen).squeeze(-1)
        return mean + log_std.expand_as(means).gather(-1, chosen).squeeze(-1).exp() * normal

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log sum_k w_dk N(a_d; mu_dk, sigma_dk^2)."""
        return _mixture_log_density(actions.unsqueeze(-1), *self._mixture(parameters)).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: - sum_d sum_k w_dk E_k[log p_d], the expectations by Gauss-Hermite quadrature."""
        log_weights, means, log_std = self._mixture(parameters)
        nodes, weights = (part.to(means.device) for part in expectation(_QUADRATURE_POINTS))
        points = means.unsqueeze(-1) + log_std.exp().unsqueeze(-1) * nodes  # [..., D, K, Q]
        every = (part.unsqueeze(-2).unsqueeze(-2) for part in (log_weights, means, log_std))  # [..., D, 1, 1, K]
        expected = (_mixture_log_density(points.unsqueeze(-1), *every) * weights).sum(-1)  # [..., D, K]
        return -(log_weights.exp() * expected).sum(-1).sum(-1)

    def _mixture(self, parameters: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log w [..., D, K], mu [..., D, K] and log sigma [D, K]."""
        logits, means = parameters.unflatten(-1, (2, self._size, self._components)).unbind(-3)
        return logits.log_softmax(-1), means + self.offsets, bounded(self.log_std, *_LOG_STD_RANGE)


def _mixture_log_density(points: Tensor, log_weights: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Return log sum_k w_k N(x; mu_k, sigma_k^2), the last axis of every argument being k."""
    deviations = (points - means) * (-log_std).exp()
    return (log_weights - 0.5 * deviations.square() - log_std - _HALF_LOG_2_PI).logsumexp(-1)


_EDGE = 1e-5  # samples keep this distance from the bounds, where the density may be 0
_LARGEST_PARAMETER = 1e3  # of both parameters: keeps densities finite
_EULER = 0.5772156649015329
_TINY = 1e-30  # keeps logarithms finite
_KUMARASWAMY_POINTS = 8


class Kumaraswamy(Distribution):
    """D independent Kumaraswamy distributions on [-1, 1]: like Beta, and its inverse is closed. Kumaraswamy (1980).

        p(x) = a b x^(a-1) (1 - x^a)^(b-1) on [0, 1], with x = (action + 1) / 2
        x = (1 - (1 - u)^(1/b))^(1/a) for u uniform

    a and b are 1 + softplus of the head's outputs: above 1 the density has one peak and no pole. The greedy action is
    the mean. The median is a worse choice where the density is skewed: a car that was trained with samples drove far
    worse with it (docs/results.md, "What was tried").
    """

    def __init__(self, space: ContinuousSpace) -> None:
        super().__init__()
        self._size = space.size
        self.parameter_count = 2 * space.size
        self.uniform_count = space.size

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: by the inverse of the distribution function.

        The noise is shifted, modulo 1, so that 0.5 gives the mean. A shifted uniform number is uniform, too.
        """
        a, b = self._shapes(parameters)
        shifted = uniform + _probability_below(_mean(a, b), a, b) - 0.5
        x = _quantile(shifted - shifted.floor(), a, b)
        return 2.0 * x.clamp(_EDGE, 1.0 - _EDGE) - 1.0

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log p((a_d + 1) / 2) / 2, the half from scaling [0, 1] to [-1, 1]."""
        a, b = self._shapes(parameters)
        log_x = (0.5 * (actions + 1.0)).clamp(_EDGE, 1.0 - _EDGE).log()
        above = (1.0 - (a * log_x).exp()).clamp(min=1e-7).log()  # log(1 - x^a)
        return (a.log() + b.log() + (a - 1.0) * log_x + (b - 1.0) * above - math.log(2.0)).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: sum_d (1 - 1/b) + (1 - 1/a) H_b - log(a b) + log 2, H_b the harmonic number."""
        a, b = self._shapes(parameters)
        harmonic = torch.digamma(b + 1.0) + _EULER
        return (1.0 - 1.0 / b + (1.0 - 1.0 / a) * harmonic - a.log() - b.log() + math.log(2.0)).sum(-1)

    def _shapes(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        a, b = bounded(1.0 + softplus(parameters), 1.0, _LARGEST_PARAMETER).split(self._size, -1)
        return a, b


def _quantile(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the x in [0, 1] below which the probability is u: (1 - (1 - u)^(1/b))^(1/a)."""
    tail = ((1.0 - u).clamp(min=_TINY).log() / b).exp()  # (1 - u)^(1/b)
    return ((1.0 - tail).clamp(min=_TINY).log() / a).exp()


def _probability_below(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the probability of values below x: 1 - (1 - x^a)^b."""
    above = 1.0 - (a * x.clamp(min=_TINY).log()).exp()
    return 1.0 - (b * above.clamp(min=_TINY).log()).exp()


def _mean(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean of x: the integral of the quantiles, by Gauss-Legendre quadrature.

    The closed form needs the gamma function, which ONNX does not have.
    """
    nodes, weights = (
        torch.tensor(each, dtype=a.dtype, device=a.device) / 2.0 for each in leggauss(_KUMARASWAMY_POINTS)
    )
    return (_quantile(nodes + 0.5, a.unsqueeze(-1), b.unsqueeze(-1)) * weights).sum(-1)


# Actions keep this distance from the bounds, where the densities of some distributions are 0 or infinite.
_LARGEST_UNIFORM = 1.0 - 1e-4


class Uniform(Distribution):
    """Uniform distribution over D bounded continuous actions, which are scaled to [-1, 1]. It has no parameters."""

    def __init__(self, space: ContinuousSpace) -> None:
        super().__init__()
        self.parameter_count = 0
        self.uniform_count = space.size
        self._log_density = -space.size * math.log(2.0 * _LARGEST_UNIFORM)

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution."""
        return _LARGEST_UNIFORM * (2.0 * uniform - 1.0)

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: -1e30 for actions that are never chosen."""
        outside = (actions.abs() > _LARGEST_UNIFORM).any(-1)
        return torch.where(outside, _NEVER, self._log_density)


def continuous_distribution(spec: PolicySpec, space: ContinuousSpace) -> Distribution:
    """Return the built-in distribution `spec.distribution`. Raises ValueError if it needs bounds that `space` lacks."""
    match spec.distribution:
        case "squashed_gaussian" | "kumaraswamy" if not space.bounded:
            raise ValueError("needs bounded actions")
        case "squashed_gaussian":
            return SquashedGaussian(space, initial_std=spec.initial_std, state_dependent=spec.state_dependent_std)
        case "gaussian_mixture":
            return GaussianMixture(space, initial_std=spec.initial_std, components=spec.mixture_components)
        case "kumaraswamy":
            return Kumaraswamy(space)
        case _:
            return Gaussian(space, initial_std=spec.initial_std, state_dependent=spec.state_dependent_std)
