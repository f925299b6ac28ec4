"""The interface of a distribution of actions."""

import torch
from torch import Tensor, nn


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
