"""The terms of the actor-critic loss. Pure functions; [T, B] in, a scalar out, over the valid rows only."""

from typing import Literal

from torch import Tensor
from torch.nn.functional import huber_loss


def masked_mean(values: Tensor, valid: Tensor) -> Tensor:
    """Mean of `values` [T, B] where `valid` [T, B] (float, 1 or 0) is 1; 0 where nothing is."""
    return (values * valid).sum() / valid.sum().clamp(min=1.0)


def normalized(advantages: Tensor, valid: Tensor) -> Tensor:
    """Advantages with mean 0 and standard deviation 1 over the valid rows."""
    centred = advantages - masked_mean(advantages, valid)
    return centred / (masked_mean(centred.square(), valid).sqrt() + 1e-8)


def policy_gradient_loss(log_probs: Tensor, advantages: Tensor, valid: Tensor) -> Tensor:
    """- mean log pi(a_t|s_t) A_t, with A_t a constant. Its gradient is minus the policy gradient.

    Mnih et al. (2016), section 4.
    """
    return -masked_mean(log_probs * advantages.detach(), valid)


def clipped_policy_loss(log_ratios: Tensor, advantages: Tensor, valid: Tensor, clip_range: float) -> Tensor:
    """- mean min(r_t A_t, clip(r_t, 1 - c, 1 + c) A_t): no gain from leaving the trust region, A_t a constant.

    Schulman et al. (2017), equation 7; r_t compares with the policy that the batch found, not with the behaviour
    policy: V-trace's rho in A_t accounts for that one (Hilton et al. 2022, section 3).

    Args (all [T, B]): log_ratios: log pi(a_t|s_t) minus that of the policy at the batch's start; advantages; valid.
    """
    ratios = log_ratios.exp()
    constants = advantages.detach()
    clipped = ratios.clamp(1.0 - clip_range, 1.0 + clip_range)
    return -masked_mean((ratios * constants).minimum(clipped * constants), valid)


def clipped_fraction(log_ratios: Tensor, valid: Tensor, clip_range: float) -> Tensor:
    """The share of valid rows whose ratio left the trust region: near 0 the passes do little, near 1 too much."""
    return masked_mean(((log_ratios.exp() - 1.0).abs() > clip_range).float(), valid)


def value_loss(values: Tensor, targets: Tensor, valid: Tensor, kind: Literal["mse", "huber"]) -> Tensor:
    """Mean of (V - G)^2, or the Huber loss (half of that within 1, linear beyond); G is a constant.

    The squared error carries no half: the coefficient of 0.5 that is usual belongs to the sum of the losses.
    """
    if kind == "mse":
        return masked_mean((values - targets.detach()).square(), valid)
    return masked_mean(huber_loss(values, targets.detach(), reduction="none"), valid)


def explained_variance(values: Tensor, targets: Tensor, valid: Tensor) -> Tensor:
    """1 - Var[G - V] / Var[G]: 1 for a perfect critic, 0 for one that only knows the mean, negative for worse."""
    residual = targets - values
    variance = masked_mean((targets - masked_mean(targets, valid)).square(), valid)
    unexplained = masked_mean((residual - masked_mean(residual, valid)).square(), valid)
    return 1.0 - unexplained / variance.clamp(min=1e-8)
