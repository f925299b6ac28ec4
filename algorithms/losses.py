"""Terms of the actor-critic loss. Pure functions from [T, B] tensors to a scalar over the valid rows.

`shares` [T, B] float32 says how much each row counts in a mean: 1/N for each of N valid rows, else 0. It is computed
once for all terms, because small networks learn as fast as few operations are made.
"""

from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import huber_loss, mse_loss

from daedalus.algorithms.returns import Targets
from daedalus.protocol.spec import LossSpec, Surrogate

_ROUNDING = 1e-4  # a deviation below this share of the mean may be only the rounding of float32
_NEGLIGIBLE = 1e-6  # a variance of the targets below this share of their mean square: they are equal
_MAX_LOG_RATIO = 20.0  # a ratio of 5e8: beyond it the exponential overflows, and the gradient is not a number


def shares_of(valid: Tensor) -> Tensor:
    """Return the shares of rows in a mean, from `valid` [T, B] (float, 1 or 0); all 0 without valid rows."""
    return valid / valid.sum().clamp(min=1.0)


def mean(values: Tensor, shares: Tensor) -> Tensor:
    """Return the mean of `values` [T, B] over the valid rows, or 0 without valid rows."""
    return values.flatten().dot(shares.flatten())


def normalized(advantages: Tensor, valid: Tensor) -> Tensor:
    """Return advantages [T, B] with mean 0 and standard deviation 1 over the valid rows.

    The deviation is less than 1 where the advantages are equal except for rounding. `valid` [T, B] is 1 or 0.
    """
    # Not by shares, whose rounding would make equal advantages differ from 0.
    number = valid.sum().clamp(min=1.0)
    average = (advantages * valid).sum() / number
    centred = advantages - average
    deviation = ((centred.square() * valid).sum() / number).sqrt()
    return centred / (deviation.maximum(_ROUNDING * average.abs()) + 1e-8)


def policy_factors(spec: LossSpec, targets: Targets, valid: Tensor) -> Tensor:
    """Return w_t A_t [T, B], the factor of row t in the policy loss, with A_t normalised over the valid rows if asked.

    A_t is normalised before it is weighted: normalised after, a row with weight 0 would get -mean / std.
    """
    if not spec.normalize_advantages:
        return targets.weights * targets.advantages
    return targets.weights * normalized(targets.advantages, valid)


def policy_gradient_loss(log_probs: Tensor, factors: Tensor, shares: Tensor) -> Tensor:
    """Return - mean log pi(a_t|s_t) A_t, with the factors A_t constants. Its gradient is minus the policy gradient.

    Mnih et al. (2016), section 4.
    """
    return -mean(log_probs * factors.detach(), shares)


def surrogate_policy_loss(
    log_ratios: Tensor, factors: Tensor, shares: Tensor, clip_range: float, surrogate: Surrogate
) -> tuple[Tensor, Tensor]:
    """Return the policy loss of a pass over a batch, and the share of rows whose ratio r_t is not in 1 +- c.

    With `clip`, PPO's: - mean min(r_t A_t, clip(r_t, 1 - c, 1 + c) A_t). The minimum removes the gain from moving r_t
    out of the range: such rows have no gradient, and nothing brings back those that others moved out. Where the share
    is near 0 the passes change the policy little, where it is near 1 too much. Schulman et al. (2017), equation 7.

    With `spo`, - mean (r_t A_t - |A_t| (r_t - 1)^2 / (2 c)): its best r_t is 1 + c sign(A_t), and what is beyond comes
    back. Xie et al. (2025), "Simple Policy Optimization".

    Args:
      log_ratios: [T, B], log r_t: log pi(a_t|s_t) minus that of the proximal policy.
      factors: [T, B], A_t, constants.
      shares: [T, B].
      clip_range: c.
      surrogate: see above.
    """
    loss, outside = _SurrogateLoss.apply(log_ratios, factors, shares, clip_range, surrogate == "spo")  # pyright: ignore
    return loss, outside


class _SurrogateLoss(torch.autograd.Function):
    """Both passes of `surrogate_policy_loss`; those that autograd derives take twice as many operations."""

    @staticmethod
    def forward(
        ctx: Any, log_ratios: Tensor, factors: Tensor, shares: Tensor, clip_range: float, is_spo: bool
    ) -> tuple[Tensor, Tensor]:
        ratios = log_ratios.clamp(max=_MAX_LOG_RATIO).exp()
        clipped = ratios.clamp(1.0 - clip_range, 1.0 + clip_range)
        gains, without_gradient = ratios * factors, log_ratios > _MAX_LOG_RATIO
        if is_spo:
            changes = (ratios - 1.0) / clip_range
            objective = gains.addcmul(factors.abs() * changes, ratios - 1.0, value=-0.5)
            slopes = ratios * (factors - factors.abs() * changes)  # by the logarithm of the ratio
        else:
            objective, slopes = gains.minimum(clipped * factors), gains  # a ratio is its own slope by the logarithm
            without_gradient |= gains > objective  # rows whose ratio is clipped
        ctx.save_for_backward((slopes * shares).masked_fill_(without_gradient, 0.0))
        outside = mean((ratios != clipped).to(shares.dtype), shares)
        ctx.mark_non_differentiable(outside)
        return -mean(objective, shares), outside

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (rows,) = ctx.saved_tensors
        return -gradients[0] * rows, None, None, None, None


def value_loss(values: Tensor, targets: Tensor, shares: Tensor, kind: Literal["mse", "huber"]) -> Tensor:
    """Return the mean of (V - G)^2, or of the Huber loss (half the square within 1, linear beyond); G is a constant.

    The squared error has no factor of 1/2: the usual 0.5 is the weight of the value loss in the sum of the losses.
    """
    loss = mse_loss if kind == "mse" else huber_loss
    return mean(loss(values, targets.detach(), reduction="none"), shares)


def explained_variance(values: Tensor, targets: Tensor, shares: Tensor) -> Tensor:
    """Return 1 - Var[G - V] / Var[G]: 1 for a perfect critic, 0 for a constant one, negative for a worse one.

    It is nan where the targets G are equal, or there are none: there is nothing to explain.
    """
    spread = variance(targets, shares)
    differ = spread > _NEGLIGIBLE * mean(targets.square(), shares)
    return (1.0 - variance(targets - values, shares) / spread).masked_fill(~differ, torch.nan)


def variance(values: Tensor, shares: Tensor) -> Tensor:
    """Return the variance of `values` [T, B] over the valid rows."""
    return mean((values - mean(values, shares)).square(), shares)
