"""Targets and advantages from rollouts. Pure functions of tensors, all [T, B], time first.

Row t is observation t, the action chosen from it and the reward that the action earned. `next_values` is V of the
true successor of row t. Under NEXT_STEP resets this is the value of the observation of row t+1, also at the end of an
episode. Reset rows are part of the recursions, but they do not affect other rows, because the row before a reset row
ended the episode. The caller masks the reset rows afterwards.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.protocol.spec import LossSpec


class Targets(NamedTuple):
    """Value targets, and advantages of the actions over the value. All [T, B], without gradients.

    The policy gradient descends -weights * A * log pi, where A are the advantages, normalised or not. The weights are
    V-trace's rho, and 1 where nothing is corrected. They are apart from the advantages, because a normalised rho * A
    would move a row with rho near 0, which says nothing about the target policy.
    """

    values: Tensor
    advantages: Tensor
    weights: Tensor


def lambda_returns(
    rewards: Tensor, discounts: Tensor, next_values: Tensor, truncated: Tensor, trace_lambda: float
) -> Tensor:
    """Return discounted returns, mixed over all horizons within the rollout.

        G_t = r_t + d_t ((1 - lambda) V(s_{t+1}) + lambda G_{t+1})

    with V(s_{t+1}) in place of G_{t+1} where the rollout ends (t = T-1) or a limit cut the episode.
    Termination needs no flag, because its discount is 0. Truncation needs one, because the episode could have
    continued. With lambda = 1 the result is the n-step return, with lambda = 0 the one-step return.

    Args:
      rewards: reward earned by the action of row t.
      discounts: discount_factor * (1 - terminated).
      next_values: V of the true successor.
      truncated: bool, episode cut by a limit and not by the environment.
      trace_lambda: from 0 to 1.

    Returns: [T, B] targets G_t. Sutton & Barto (2018), equation 12.2 in its recursive form. With lambda = 1 they are
    n-step returns: equation 7.1, and Mnih et al. (2016), algorithm S3.
    """
    traces = trace_lambda * (~truncated)
    constants = rewards + discounts * (1.0 - traces) * next_values
    return _accumulate(constants, discounts * traces, next_values[-1])


def actor_critic_targets(
    rewards: Tensor,
    discounts: Tensor,
    values: Tensor,
    next_values: Tensor,
    truncated: Tensor,
    trace_lambda: float,
) -> Targets:
    """Return lambda-returns G_t and advantages A_t = G_t - V(s_t).

    Arguments as in `lambda_returns`, and the values V(s_t), [T, B].

    Schulman et al. (2016), equation 16, is the same advantage written as a sum.
    """
    returns = lambda_returns(rewards, discounts, next_values, truncated, trace_lambda)
    return Targets(returns, returns - values, torch.ones_like(returns))


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
    """Return V-trace value targets and advantages, corrected for policy lag.

        rho_t   = min(rho_clip, pi(a_t|s_t) / mu(a_t|s_t))
        c_t     = lambda min(trace_clip, pi(a_t|s_t) / mu(a_t|s_t))
        delta_t = rho_t (r_t + d_t V(s_{t+1}) - V(s_t))
        v_t     = V(s_t) + delta_t + d_t c_t (v_{t+1} - V(s_{t+1}))
        A_t     = r_t + d_t ((1 - lambda) V(s_{t+1}) + lambda v_{t+1}) - V(s_t),  weighted by rho_t

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
    advantages = rewards + discounts * (next_values + trace_lambda * following) - values
    return Targets(values + corrections, advantages, rhos)


def _accumulate(constants: Tensor, factors: Tensor, last: Tensor) -> Tensor:
    """Solve x_t = constants_t + factors_t x_{t+1} backwards from x_T = last. [T, B], [T, B], [B] -> [T, B].

    It takes about log2(T) steps, each of which doubles the rows that x_t depends on: x -> c + f x after x -> c' + f' x
    is x -> (c + f c') + f f' x. Row by row it would be T operations, which cost a GPU as much as large ones.
    """
    constants, factors = constants.clone(), factors.clone()
    constants[-1].addcmul_(factors[-1], last)
    factors[-1].zero_()
    span, rows = 1, len(constants)
    while span < rows:
        constants = torch.cat([torch.addcmul(constants[:-span], factors[:-span], constants[span:]), constants[-span:]])
        factors = torch.cat([factors[:-span] * factors[span:], factors[-span:]])
        span *= 2
    return constants


def lambda_targets(spec: LossSpec, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
    """Return lambda-returns and their advantages, as if the behaviour policy were the target policy.

    Where actors explore, rows are weighted by min(rho_clip, pi / mu): random actions of an actor are then no more
    frequent in the gradient than those of the policy (off-policy actor-critic: Degris et al. 2012).

    Args:
      log_probs: [T, B], log pi(a_t | s_t) of the target policy.
      values: [T+1, B] under the weights being learned.
    """
    discounts = spec.discount_factor * (~batch.terminated)
    ends = values[:-1], values[1:], batch.truncated
    targets = actor_critic_targets(batch.rewards, discounts, *ends, spec.trace_lambda)
    if not spec.explores:
        return targets
    return targets._replace(weights=(log_probs - batch.behaviour_log_probs).exp().clamp(max=spec.rho_clip))


def vtrace_corrected_targets(spec: LossSpec, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
    """Return V-trace targets and advantages, corrected for the lag of the behaviour policy.

    Args:
      log_probs: [T, B], log pi(a_t | s_t) of the target policy.
      values: [T+1, B] under the weights being learned.
    """
    discounts = spec.discount_factor * (~batch.terminated)
    return vtrace_targets(
        log_probs - batch.behaviour_log_probs,
        batch.rewards,
        discounts,
        values[:-1],
        values[1:],
        batch.truncated,
        spec.trace_lambda,
        spec.rho_clip,
        spec.trace_clip,
    )
