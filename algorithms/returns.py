"""Targets and advantages from rollouts. Pure functions of tensors, all [T, B], time first.

Row t is observation t, the action from it, the reward it earned. `next_values` is V of the true successor
of row t: under NEXT_STEP resets that is the value of row t+1's observation at every row, the end of an episode
included. Rows that only reset take part in the recursions, but nothing flows from them into other rows: the
row before them ended the episode. The caller masks them afterwards.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Targets(NamedTuple):
    """What the value should become, and how much better than it the action did. Both [T, B], constants."""

    values: Tensor
    advantages: Tensor


def lambda_returns(
    rewards: Tensor, discounts: Tensor, next_values: Tensor, truncated: Tensor, trace_lambda: float
) -> Tensor:
    """Discounted returns, mixed over all horizons within the rollout.

        G_t = r_t + d_t ((1 - lambda) V(s_{t+1}) + lambda G_{t+1})

    with V(s_{t+1}) in place of G_{t+1} where the rollout ends (t = T-1) or a limit cut the episode.
    Termination needs no flag: its discount is 0. Truncation does: the episode would have gone on.
    With lambda = 1 these are the n-step returns, with 0 the one-step ones.

    Args:
      rewards: reward earned by the action of row t.
      discounts: discount_factor * (1 - terminated).
      next_values: V of the true successor.
      truncated: bool, episode cut by a limit and not by the environment.
      trace_lambda: from 0 to 1.

    Returns: [T, B] targets G_t. Sutton & Barto (2018), equation 12.2 in its recursive form, and 7.1 for lambda = 1.
    """
    traces = trace_lambda * (~truncated)
    constants = rewards + discounts * (1.0 - traces) * next_values
    return _accumulate(constants, discounts * traces, next_values[-1])


def n_step_returns(rewards: Tensor, discounts: Tensor, next_values: Tensor, truncated: Tensor) -> Tensor:
    """Discounted returns, bootstrapped where the rollout or an episode is cut.

        G_t = r_t + d_t (V(s_{t+1}) if truncated_t or t = T-1 else G_{t+1})

    Arguments and result as in `lambda_returns`. Mnih et al. (2016), algorithm S3; Sutton & Barto (2018), equation 7.1.
    """
    return lambda_returns(rewards, discounts, next_values, truncated, 1.0)


def actor_critic_targets(
    rewards: Tensor,
    discounts: Tensor,
    values: Tensor,
    next_values: Tensor,
    truncated: Tensor,
    trace_lambda: float,
) -> Targets:
    """Lambda-returns, and how far they are above the value: A_t = G_t - V(s_t).

    Schulman et al. (2016), equation 16, is the same advantage written as a sum.
    """
    returns = lambda_returns(rewards, discounts, next_values, truncated, trace_lambda)
    return Targets(returns, returns - values)


def vtrace_targets(
    log_ratios: Tensor,
    rewards: Tensor,
    discounts: Tensor,
    values: Tensor,
    next_values: Tensor,
    truncated: Tensor,
    trace_lambda: float,
    rho_clip: float,
    trace_clip: float,
) -> Targets:
    """V-trace: value targets and advantages corrected for the policy's lag.

        rho_t   = min(rho_clip, pi(a_t|s_t) / mu(a_t|s_t))
        c_t     = lambda min(trace_clip, pi(a_t|s_t) / mu(a_t|s_t))
        delta_t = rho_t (r_t + d_t V(s_{t+1}) - V(s_t))
        v_t     = V(s_t) + delta_t + d_t c_t (v_{t+1} - V(s_{t+1}))
        A_t     = rho_t (r_t + d_t ((1 - lambda) V(s_{t+1}) + lambda v_{t+1}) - V(s_t))

    with v_{t+1} = V(s_{t+1}) where the rollout ends or a limit cut the episode. On-policy (ratios of 1, clips
    of at least 1) v_t is the lambda-return.

    Args:
      log_ratios: log pi(a_t|s_t) - log mu(a_t|s_t), target policy over behaviour policy.
      values: V(s_t) under the weights being learned.
      rho_clip, trace_clip: the paper's rho-bar and c-bar.
      the others: as in `lambda_returns`.

    Espeholt et al. (2018), equation 1 and section 4.2; lambda as in its remark 2.
    """
    ratios = log_ratios.exp()
    rhos = ratios.clamp(max=rho_clip)
    traces = trace_lambda * ratios.clamp(max=trace_clip) * (~truncated)
    deltas = rhos * (rewards + discounts * next_values - values)
    corrections = _accumulate(deltas, discounts * traces, torch.zeros_like(values[0]))  # v_t - V(s_t)
    # v_{t+1} - V(s_{t+1}), which is 0 past a cut
    following = torch.cat([corrections[1:], torch.zeros_like(corrections[:1])]) * (~truncated)
    advantages = rhos * (rewards + discounts * (next_values + trace_lambda * following) - values)
    return Targets(values + corrections, advantages)


def _accumulate(constants: Tensor, factors: Tensor, last: Tensor) -> Tensor:
    """Solves x_t = constants_t + factors_t x_{t+1} backwards from x_T = last. [T, B], [T, B], [B] -> [T, B]."""
    result = torch.empty_like(constants)
    following = last
    for row in range(len(constants) - 1, -1, -1):
        following = torch.addcmul(constants[row], factors[row], following, out=result[row])
    return result
