"""algorithms/replay_buffer.py against a slow oracle that looks at one row of one column at a time."""

from collections import deque
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from building import make_rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from daedalus.algorithms.replay_buffer import ReplayBuffer
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout


def spaces_of(stack: int) -> Spaces:
    return Spaces(
        observations={
            "picture": ArraySpace(shape=(2,), dtype="float32", frames=stack),
            "choice": DiscreteSpace(counts=(500,)),
        },
        actions={"arm": ContinuousSpace(low=(-1.0,), high=(1.0,)), "leg": ContinuousSpace(low=(-1.0,), high=(1.0,))},
    )


def rollout_of(seed: int, rows: int, environments: int, stack: int, *, overridden: bool = True) -> Rollout:
    """Return a rollout with terminations, truncations, reset rows and overridden rows."""
    random, plain = np.random.default_rng(seed), make_rollout(seed=seed, rows=rows, environments=environments)
    cells = (rows, environments)
    frames = {
        "picture": random.standard_normal((rows + stack, environments, 2), np.float32),
        "choice": random.integers(0, 500, (rows + 1, environments, 1), np.uint16),
    }
    actions = {name: random.uniform(-1.0, 1.0, (*cells, 1)).astype(np.float32) for name in ("arm", "leg")}
    helped = plain.valid & (random.random(cells) < 0.2)
    replaced: dict[str, Any] = {"frames": frames, "actions": actions}
    taught = helped & (random.random(cells) < 0.7)
    if overridden:
        replaced |= {"overridden": helped, "taught": taught if seed % 2 else None}
    return make_rollout(seed=seed, rows=rows, environments=environments, **replaced)


class Column(NamedTuple):
    """One environment of a rollout."""

    rollout: Rollout
    environment: int

    def cell(self, name: str, row: int) -> Any:
        return getattr(self.rollout, name)[row, self.environment]

    def is_learned(self, row: int) -> bool:
        helped = self.rollout.overridden is not None and self.cell("overridden", row)
        return bool(self.cell("valid", row) and not helped)

    def is_taught(self, row: int) -> bool:
        return self.rollout.taught is not None and bool(self.cell("taught", row))

    def stack(self, row: int, depth: int) -> np.ndarray:
        """The newest `depth` frames at an observation; the first one of its episode stands for those before it."""
        begins = [start for start in range(1, row + 1) if not self.cell("valid", start - 1)]
        earliest = begins[-1] if begins else -(depth - 1)
        frames = self.rollout.frames["picture"][:, self.environment]
        stacked = np.stack([frames[max(row - back, earliest) + depth - 1] for back in reversed(range(depth))])
        return stacked[0] if depth == 1 else stacked

    def target(self, row: int, n_step: int, gamma: float) -> tuple[float, float, int]:
        """Return the sum of the rewards, the discount of the next value, and the row of its observation."""
        total, same = 0.0, self.is_taught if self.is_taught(row) else self.is_learned
        for i in range(n_step):
            at = row + i
            total += gamma**i * self.cell("rewards", at)
            if self.cell("terminated", at):
                return total, 0.0, at + 1
            if self.cell("truncated", at) or at + 1 == self.rollout.rows or not same(at + 1):
                return total, gamma ** (i + 1), at + 1
        return total, gamma**n_step, row + n_step


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 6),
    st.lists(st.tuples(st.integers(0, 10_000), st.integers(1, 3)), min_size=1, max_size=6),
    st.integers(1, 8),
    st.integers(1, 4),
    st.integers(1, 4),
)
def test_transitions_are_those_of_the_newest_columns(
    rows: int, rollouts: list[tuple[int, int]], columns: int, stack: int, n_step: int
) -> None:
    buffer = ReplayBuffer(spaces_of(stack), rows, columns * rows)
    held: deque[Column] = deque(maxlen=columns)
    for seed, environments in rollouts:
        rollout = rollout_of(seed, rows, environments, stack, overridden=seed % 3 > 0)
        buffer.add(rollout)
        held.extend(Column(rollout, environment) for environment in range(environments))
    learned, taught = (
        [(column, row) for column in held for row in range(rows) if chosen(column, row)]
        for chosen in (Column.is_learned, Column.is_taught)
    )
    assert (len(buffer), buffer.taught) == (len(learned), len(taught))
    found = buffer.transitions(
        np.concatenate([buffer._queues[kind].rows for kind in ("learned", "taught")]), n_step, 0.9
    )
    for index, (column, row) in enumerate([*learned, *taught]):
        total, discount, following = column.target(row, n_step, 0.9)
        assert float(found.rewards[index]) == pytest.approx(total, abs=1e-5)
        assert float(found.discounts[index]) == pytest.approx(discount)
        for observations, at in ((found.observations, row), (found.next_observations, following)):
            np.testing.assert_array_equal(observations["picture"][index], column.stack(at, stack))
            assert observations["choice"][index] == column.rollout.frames["choice"][at, column.environment, 0]
        played = [column.rollout.actions[name][row, column.environment, 0] for name in ("arm", "leg")]
        np.testing.assert_array_equal(found.actions[index], played)


def test_rows_are_drawn_uniformly() -> None:
    buffer = ReplayBuffer(spaces_of(1), 6, 30)
    for seed in range(4):
        buffer.add(rollout_of(seed, 6, 2, 1))
    torch.manual_seed(1)
    drawn = buffer.sample(40_000, 1, 0.9).rewards.numpy()
    rewards = buffer.transitions(buffer.learned_rows, 1, 0.9).rewards.numpy()
    counts = np.array([np.count_nonzero(drawn == reward) for reward in rewards])
    assert counts.sum() == len(drawn)  # nothing else is drawn
    expected = len(drawn) / len(rewards)
    assert (np.abs(counts - expected) < 5.0 * np.sqrt(expected)).all()


def test_a_buffer_without_rows_to_learn_from_is_empty() -> None:
    buffer = ReplayBuffer(spaces_of(2), 6, 12)
    buffer.add(rollout_of(1, 6, 2, 2))
    assert len(buffer)
    for seed in (2, 3):
        rollout = rollout_of(seed, 6, 1, 2)
        rollout.valid[:] = False
        buffer.add(rollout)
    assert not len(buffer)
