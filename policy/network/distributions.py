"""Action distributions in torch, for learning. policy/acting/sampling.py is the same in numpy."""

from torch import Tensor


def categorical_log_probs(logits: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probability of the actions taken, and the entropy, of softmax policies.

    Args:
      logits: [..., A].
      actions: [...] int64, from 0 to A - 1.

    Returns: log pi(a | s) [...] and H(pi(. | s)) = - sum_a pi(a | s) log pi(a | s) [...], in nats.
    """
    log_probs = logits.log_softmax(-1)
    chosen = log_probs.gather(-1, actions.unsqueeze(-1)).squeeze(-1)
    return chosen, -(log_probs.exp() * log_probs).sum(-1)
