"""Slow reference implementations of the papers' sums, for one environment of one rollout.

The notation is that of the papers: gamma is the discount factor, V the values [T+1] and r the rewards [T]. Reset rows
are in no sum, because a sum stops at the end of its episode. `stack_rows` is one of the frame stacks of a rollout.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Stream:
    """Rows of one environment."""

    r: Sequence[float]  # [T]
    V: Sequence[float]  # [T+1]
    log_ratios: Sequence[float]  # [T], log pi - log mu
    terminated: Sequence[bool]  # [T]
    truncated: Sequence[bool]  # [T]
    valid: Sequence[bool]  # [T]

    @property
    def rows(self) -> list[int]:
        """Indices of the valid rows."""
        return [t for t in range(len(self.r)) if self.valid[t]]


def horizon(x: Stream, t: int) -> int:
    """Return h, such that rows t to h - 1 are the rest of the episode of row t in the rollout."""
    ends = [k for k in range(t, len(x.r)) if x.terminated[k] or x.truncated[k]]
    return ends[0] + 1 if ends else len(x.r)


def bootstrap(x: Stream, k: int) -> float:
    """Return V(s_k), or 0 if the episode terminated at row k - 1."""
    return 0.0 if x.terminated[k - 1] else x.V[k]


def n_step_return(x: Stream, gamma: float, t: int, n: int) -> float:
    """Return G_{t:t+n} = r_t + gamma r_{t+1} + ... + gamma^n V(s_{t+n}). Sutton & Barto (2018), equation 7.1."""
    h = min(t + n, horizon(x, t))
    return math.fsum(gamma ** (k - t) * x.r[k] for k in range(t, h)) + gamma ** (h - t) * bootstrap(x, h)


def lambda_return(x: Stream, gamma: float, lam: float, t: int) -> float:
    """Return G_t = (1 - lambda) sum_n lambda^(n-1) G_{t:t+n} + lambda^(h-t-1) G_{t:h}.

    Sutton & Barto (2018), equation 12.3.
    """
    last = horizon(x, t) - t
    shorter = (1.0 - lam) * math.fsum(lam ** (n - 1) * n_step_return(x, gamma, t, n) for n in range(1, last))
    return shorter + lam ** (last - 1) * n_step_return(x, gamma, t, last)


def rho(x: Stream, t: int, clip: float) -> float:
    """Return min(clip, pi(a_t | s_t) / mu(a_t | s_t))."""
    return min(clip, math.exp(x.log_ratios[t]))


def vtrace(x: Stream, gamma: float, lam: float, rho_bar: float, c_bar: float, s: int) -> float:
    """Return v_s = V(x_s) + sum_t gamma^(t-s) (prod_{i=s}^{t-1} c_i) delta_t V.

    Espeholt et al. (2018), equation 1.
    """

    def delta(t: int) -> float:
        return rho(x, t, rho_bar) * (x.r[t] + gamma * bootstrap(x, t + 1) - x.V[t])

    def c(i: int) -> float:
        return lam * rho(x, i, c_bar)  # remark 2

    return x.V[s] + math.fsum(
        gamma ** (t - s) * math.prod(c(i) for i in range(s, t)) * delta(t) for t in range(s, horizon(x, s))
    )


def vtrace_advantage(x: Stream, gamma: float, lam: float, rho_bar: float, c_bar: float, s: int) -> float:
    """Return r_s + gamma v_{s+1} - V(x_s), with v_{s+1} mixed with V(x_{s+1}) by lambda: without the factor rho_s.

    Espeholt et al. (2018), section 4.2.
    """
    inside = s + 1 < horizon(x, s)
    following = vtrace(x, gamma, lam, rho_bar, c_bar, s + 1) if inside else bootstrap(x, s + 1)
    mixed = (1.0 - lam) * bootstrap(x, s + 1) + lam * following
    return x.r[s] + gamma * mixed - x.V[s]


def stack_rows(frames: np.ndarray, valid: np.ndarray, out: np.ndarray) -> None:
    """Compute the observations of all rows of a rollout from its frames, as the learner does: see protocol/frames.py.

    Args:
      frames: [k-1 + T+1, E, *frame_shape]; the first k are the complete stack of row 0.
      valid: [T, E] bool; an episode starts after each row that is not valid.
      out: [T+1, E, k, *frame_shape], filled by this function; k is taken from its shape.
    """
    rows, depth = out.shape[0], out.shape[2]
    for age in range(depth):
        out[:, :, age] = frames[age : age + rows]
    for row, environment in np.argwhere(~valid):
        start = row + 1  # the first row of the new episode
        first = frames[start + depth - 1, environment]
        for later in range(start, min(start + depth - 1, rows)):
            # In this row's stack, the first depth - 1 - (later - start) frames are from before the start.
            out[later, environment, : depth - 1 - (later - start)] = first
