"""Terms of the actor-critic loss. Pure functions from [T, B] tensors to a scalar over the valid rows."""

from typing import Literal

from torch import Tensor
from torch.nn.functional import huber_loss

_MAX_LOG_RATIO = 20.0  # a ratio of 5e8: beyond it the exponential overflows, and the gradient is not a number


def masked_mean(values: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of `values` [T, B] where `valid` [T, B] (float, 1 or 0) is 1, or 0 without valid rows."""
    return (values * valid).sum() / valid.sum().clamp(min=1.0)


def normalized(advantages: Tensor, valid: Tensor) -> Tensor:
    """Return advantages with mean 0 and standard deviation 1 over the valid rows."""
    centred = advantages - masked_mean(advantages, valid)
    return centred / (masked_mean(centred.square(), valid).sqrt() + 1e-8)


def policy_weights(advantages: Tensor, weights: Tensor, valid: Tensor, normalize: bool) -> Tensor:
    """Return w_t A_t [T, B], the factor of row t in the policy loss, with A_t normalised over the valid rows if asked.

    A_t is normalised before it is weighted: normalised after, a row with weight 0 would get -mean / std.
    """
    return weights * (normalized(advantages, valid) if normalize else advantages)


def policy_gradient_loss(log_probs: Tensor, advantages: Tensor, valid: Tensor) -> Tensor:
    """Return - mean log pi(a_t|s_t) A_t, with A_t a constant. Its gradient is minus the policy gradient.

    Mnih et al. (2016), section 4.
    """
    return -masked_mean(log_probs * advantages.detach(), valid)


def clipped_policy_loss(log_ratios: Tensor, advantages: Tensor, valid: Tensor, clip_range: float) -> Tensor:
    """Return - mean min(r_t A_t, clip(r_t, 1 - c, 1 + c) A_t), with A_t a constant and c the clip range.

    The minimum removes the gain from moving r_t out of the clip range.

    Schulman et al. (2017), equation 7. The denominator of r_t is the policy before the first update of the batch, not
    the behaviour policy: V-trace's rho in A_t corrects for the behaviour policy (Hilton et al. 2022, section 3).

    Args:
      log_ratios: [T, B], log r_t: log pi(a_t|s_t) minus its value before the first update of the batch.
      advantages: [T, B].
      valid: [T, B], float, 1 or 0.
      clip_range: c.
    """
    ratios = log_ratios.clamp(max=_MAX_LOG_RATIO).exp()
    constants = advantages.detach()
    clipped = ratios.clamp(1.0 - clip_range, 1.0 + clip_range)
    return -masked_mean((ratios * constants).minimum(clipped * constants), valid)


def clipped_fraction(log_ratios: Tensor, valid: Tensor, clip_range: float) -> Tensor:
    """Return the share of valid rows whose ratio is outside the clip range.

    Near 0 the passes change the policy little, near 1 too much.
    """
    return masked_mean(((log_ratios.exp() - 1.0).abs() > clip_range).float(), valid)


def value_loss(values: Tensor, targets: Tensor, valid: Tensor, kind: Literal["mse", "huber"]) -> Tensor:
    """Return the mean of (V - G)^2, or of the Huber loss (half the square within 1, linear beyond); G is a constant.

    The squared error has no factor of 1/2: the usual 0.5 is the weight of the value loss in the sum of the losses.
    """
    if kind == "mse":
        return masked_mean((values - targets.detach()).square(), valid)
    return masked_mean(huber_loss(values, targets.detach(), reduction="none"), valid)


def explained_variance(values: Tensor, targets: Tensor, valid: Tensor) -> Tensor:
    """Return 1 - Var[G - V] / Var[G]: 1 for a perfect critic, 0 for a constant one, negative for a worse one."""
    residual = targets - values
    variance = masked_mean((targets - masked_mean(targets, valid)).square(), valid)
    unexplained = masked_mean((residual - masked_mean(residual, valid)).square(), valid)
    return 1.0 - unexplained / variance.clamp(min=1e-8)
