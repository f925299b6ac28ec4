"""Memory of a policy between rows: none, or a gated recurrent unit."""

from typing import Protocol

import torch
from torch import Tensor, nn


class Memory(Protocol):
    """Module that maps the features of a row and the state before it to the inputs of the heads and the next state."""

    state_size: int  # S
    features: int  # F', the number of inputs of the heads

    def step(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Process one row: features [N, F], state [N, S] -> [N, F'], next state [N, S]."""
        ...

    def unroll(self, features: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Process R consecutive rows.

        Args:
          features: [R, B, F].
          state: [B, S] float32, before row 0.
          starts: [R, B] bool, whether an episode starts with the row; the state is then reset to zeros.

        Returns: [R, B, F'], and the state after the last row [B, S].
        """
        ...


class NoMemory(nn.Module):
    """No memory: S is 0, and the inputs of the heads are the features."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.state_size = 0
        self.features = features

    def step(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See Memory."""
        return features, state

    def unroll(self, features: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """See Memory."""
        return features, state


class Gru(nn.Module):
    """A gated recurrent unit (Cho et al. 2014), the equations and the order of weights as in torch.nn.GRUCell.

        r = sigmoid(W_ir x + b_ir + W_hr h + b_hr)
        z = sigmoid(W_iz x + b_iz + W_hz h + b_hz)
        n = tanh(W_in x + b_in + r (W_hn h + b_hn))
        h' = (1 - z) n + z h

    Two linear layers, for x and for h, so that the inputs of all rows are projected at once. The state is float32
    also under autocast: rounding must not add up over the rows.
    """

    def __init__(self, features: int, units: int) -> None:
        super().__init__()
        self.state_size = units
        self.features = units
        self.input = nn.Linear(features, 3 * units)
        self.hidden = nn.Linear(units, 3 * units)
        for layer in (self.input, self.hidden):
            for gate in layer.weight.chunk(3):
                nn.init.orthogonal_(gate)
            nn.init.zeros_(layer.bias)

    def step(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See Memory."""
        state = self._next(self.input(features), state)
        return state, state

    def unroll(self, features: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """See Memory."""
        states = []
        for inputs, start in zip(self.input(features), starts.unsqueeze(-1), strict=True):
            state = self._next(inputs, state.masked_fill(start, 0.0))
            states.append(state)
        return torch.stack(states), state

    def _next(self, inputs: Tensor, state: Tensor) -> Tensor:
        """Return the next state: projected inputs [N, 3S], state [N, S] -> [N, S]."""
        input_r, input_z, input_n = inputs.split(self.state_size, -1)
        hidden_r, hidden_z, hidden_n = self.hidden(state).split(self.state_size, -1)
        reset = (input_r + hidden_r).sigmoid()
        update = (input_z + hidden_z).sigmoid()
        candidate = (input_n + reset * hidden_n).tanh()
        return candidate + update * (state - candidate)
