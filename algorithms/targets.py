"""Value targets and advantages of a batch, with and without correction for policy lag."""

from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.returns import Targets, actor_critic_targets, vtrace_targets
from daedalus.protocol.spec import LossSpec


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
