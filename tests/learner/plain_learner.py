"""Reference implementation of the learner: one row of one environment at a time, in the papers' notation."""

from typing import Any

import numpy as np
import torch
from building import SPACES
from oracles import Stream, lambda_return, rho, vtrace, vtrace_advantage
from plain import plain
from torch import Tensor, nn

from daedalus.algorithms.batch import Batch
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spec import PolicySpec, TrainingSpec

Cell = tuple[int, int]  # row and environment
Played = dict[Cell, Tensor]


class PlainLearner:
    """Slow learner without vectorisation, with torch's optimisers and losses."""

    def __init__(self, spec: TrainingSpec, policy: PolicySpec, start: dict[str, np.ndarray]) -> None:
        self.spec = spec
        self.network = ActorCritic(policy, SPACES, training=spec)
        self.network.load_state_dict({name: torch.from_numpy(array) for name, array in start.items()})
        self.parameters = list(self.network.parameters())
        self.adam = torch.optim.Adam(self.parameters, eps=spec.optimizer_epsilon)
        self.squares = [torch.zeros_like(parameter) for parameter in self.parameters]

    def step(self, batch: Batch, rate: float, bonus: float) -> dict[str, float]:
        """Make all updates of a batch, and return the means of their metrics."""
        with torch.no_grad():
            before, _, values = self._play_back(batch)
        streams = [self._stream(batch, b, before, values) for b in range(batch.rewards.shape[1])]
        targets = {(t, b): self._targets(streams[b], t) for t, b in batch.valid.nonzero().tolist()}
        if self.spec.proximal_policy == "behaviour" and not self.spec.explores:
            before = {cell: batch.behaviour_log_probs[cell] for cell in targets}
        first = self._first_pass_metrics(list(targets), targets, values)
        measured = [first | self._update(batch, cells, targets, before, rate, bonus) for cells in self._parts(batch)]
        return {name: float(np.mean([each[name] for each in measured])) for name in measured[0]}

    def _parts(self, batch: Batch) -> list[list[Cell]]:
        """Return the cells of each update, without shuffling."""
        cells = [(t, b) for t, b in batch.valid.nonzero().tolist()]
        if self.spec.algorithm != "appo":
            return [cells]
        if self.network.state_size:
            columns = evenly(list(range(batch.rewards.shape[1])), self.spec.minibatches)
            parts = [[cell for cell in cells if cell[1] in part] for part in columns]
        else:
            parts = evenly(cells, self.spec.minibatches)
        return parts * self.spec.passes

    def _update(
        self,
        batch: Batch,
        cells: list[Cell],
        targets: dict[Cell, tuple[float, float, float]],
        before: Played,
        rate: float,
        bonus: float,
    ) -> dict[str, float]:
        spec = self.spec
        log_probs, entropies, values = self._play_back(batch, cells)
        advantages = torch.tensor([targets[cell][1] for cell in cells])
        if spec.normalize_advantages:
            whole = torch.tensor([advantage for _, advantage, _ in targets.values()])  # of the batch
            advantages = (advantages - whole.mean()) / (whole.std(correction=0) + 1e-8)
        advantages = torch.tensor([targets[cell][2] for cell in cells]) * advantages  # rho_t A_t
        predicted = torch.stack([values[cell] for cell in cells])
        goals = torch.tensor([targets[cell][0] for cell in cells])
        entropy = torch.stack([entropies[cell] for cell in cells]).mean()
        ratios = torch.stack([(log_probs[cell] - before[cell]).exp() for cell in cells])
        if spec.algorithm == "appo" and spec.surrogate == "spo":
            penalties = advantages.abs() * (ratios - 1.0) ** 2 / (2.0 * spec.clip_range)
            policy_loss = (penalties - ratios * advantages).mean()
        elif spec.algorithm == "appo":
            clipped = ratios.clip(1.0 - spec.clip_range, 1.0 + spec.clip_range)
            policy_loss = -torch.minimum(ratios * advantages, clipped * advantages).mean()
        else:
            policy_loss = -(torch.stack([log_probs[cell] for cell in cells]) * advantages).mean()
        criterion = nn.MSELoss() if spec.value_loss == "mse" else nn.HuberLoss()
        value_loss = criterion(predicted, goals)
        self.network.zero_grad()
        (policy_loss + spec.value_coefficient * value_loss - bonus * entropy).backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, spec.max_gradient_norm)
        self._descend(rate)
        return {
            "policy_loss": policy_loss.item(),
            "value_loss": value_loss.item(),
            "entropy": entropy.item(),
            "gradient_norm": norm.item(),
            "clipped_fraction": ((ratios - 1.0).abs() > spec.clip_range).float().mean().item(),
        }

    @staticmethod
    def _first_pass_metrics(
        cells: list[Cell], targets: dict[Cell, tuple[float, float, float]], values: Played
    ) -> dict[str, float]:
        goals = torch.tensor([targets[cell][0] for cell in cells])
        predicted = torch.stack([values[cell] for cell in cells])
        return {
            "explained_variance": (1.0 - (goals - predicted).var(correction=0) / goals.var(correction=0)).item(),
            "value_mean": predicted.mean().item(),
        }

    def _play_back(self, batch: Batch, cells: list[Cell] | None = None) -> tuple[Played, Played, Played]:
        """Return log-probabilities, entropies and values by cell, from one forward pass per row.

        `cells` are those that are needed (default: all). A memory also needs the other rows of their environments.
        """
        log_probs, entropies, values = {}, {}, {}
        rows, environments = batch.rewards.shape
        needed = None if cells is None else {b if self.network.state_size else (t, b) for t, b in cells}
        for b in range(environments):
            state = batch.initial_state[b : b + 1]
            for t in range(rows + 1):
                if needed is not None and not {b, (t, b)} & needed:
                    continue
                if batch.starts[t, b]:
                    state = torch.zeros_like(state)
                seen = {name: values[t, b : b + 1] for name, values in batch.observations.items()}
                row = {name: values.unsqueeze(0) for name, values in seen.items()}
                _, value = self.network(row, state, torch.zeros(1, 1, dtype=torch.bool))
                logits, state = self.network.step(seen, state)
                values[t, b] = value.squeeze()
                if t < rows:
                    policy = torch.distributions.Categorical(logits=logits[0])
                    log_probs[t, b] = policy.log_prob(plain(batch.actions)[t, b, 0])
                    entropies[t, b] = policy.entropy()
        return log_probs, entropies, values

    @staticmethod
    def _stream(batch: Batch, b: int, log_probs: Played, values: Played) -> Stream:
        """Return the rows of an environment in the papers' notation."""
        rows = range(len(batch.rewards))
        return Stream(
            r=batch.rewards[:, b].tolist(),
            V=[values[t, b].item() for t in range(len(batch.rewards) + 1)],
            log_ratios=[(log_probs[t, b] - batch.behaviour_log_probs[t, b]).item() for t in rows],
            terminated=batch.terminated[:, b].tolist(),
            truncated=batch.truncated[:, b].tolist(),
            valid=batch.valid[:, b].tolist(),
        )

    def _targets(self, x: Stream, t: int) -> tuple[float, float, float]:
        """The value target, the advantage, and the weight of the row in the policy gradient."""
        spec = self.spec
        gamma, lam = spec.discount_factor, spec.trace_lambda
        if spec.algorithm == "impala":
            clips = (spec.rho_clip, spec.trace_clip)
            return (
                vtrace(x, gamma, lam, *clips, t),
                vtrace_advantage(x, gamma, lam, *clips, t),
                rho(x, t, spec.rho_clip),
            )
        goal = lambda_return(x, gamma, lam, t)
        return goal, goal - x.V[t], rho(x, t, spec.rho_clip) if spec.explores else 1.0

    def _descend(self, rate: float) -> None:
        if self.spec.optimizer == "adam":
            self.adam.param_groups[0]["lr"] = rate
            self.adam.step()
            return
        decay, epsilon = self.spec.rmsprop_decay, self.spec.optimizer_epsilon
        with torch.no_grad():
            for parameter, square in zip(self.parameters, self.squares, strict=True):
                assert parameter.grad is not None
                square.copy_(decay * square + (1.0 - decay) * parameter.grad**2)
                parameter -= rate * parameter.grad / (square + epsilon).sqrt()


def evenly(items: list[Any], count: int) -> list[list[Any]]:
    """Split items into `count` parts in order; the first parts are longer by one if necessary."""
    size, longer = divmod(len(items), count)
    lengths = [size + 1] * longer + [size] * (count - longer)
    ends = np.cumsum(lengths)
    return [items[end - length : end] for end, length in zip(ends, lengths, strict=True)]
