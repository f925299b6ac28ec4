"""Games with several agents: the rows of each seat, what is refused, and a training of one policy in all seats."""

import numpy as np
import scripted_games
from collectors import collect, started_collector
from hypothesis import given, settings
from hypothesis import strategies as st
from plain import PlainPolicy

from daedalus.policy.acting.noise import Noise
from daedalus.protocol.spec import EnvironmentSpec

ROLLOUTS = 6


class Counting(PlainPolicy):
    """A policy that takes random actions, and whose memory counts the rows of the episode."""

    state_size = 1

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PlainPolicy."""
        actions = (noise.uniform[:, 0] * 5).astype(np.int64)
        return actions, observations[:, 2].copy(), state + 1.0


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    agents=st.integers(1, 4),
    copies=st.integers(1, 3),
    length=st.integers(1, 7),
    kind=st.sampled_from(["Turns", "Together"]),
)
def test_rows_of_each_seat_are_those_of_a_slow_account(
    seed: int, agents: int, copies: int, length: int, kind: str
) -> None:
    spec = EnvironmentSpec(id=f"scripted_games:{kind}", backend="pettingzoo", kwargs={"seed": seed, "agents": agents})
    scripted_games.PLAYED.clear()
    first_copy = scripted_games._Scripted.made
    collector = started_collector(spec, Counting(), count=copies, rollout_length=length)
    together = kind == "Together"
    accounts: dict[int, dict] = {}
    last: dict[int, tuple[int, ...]] = {}
    try:
        for _ in range(ROLLOUTS):
            rollout = collect(collector)
            frames, steps = rollout.frames["observation"], set()
            for column in range(copies * agents):
                for row in np.flatnonzero(rollout.valid[:, column]):
                    key = tuple(int(number) for number in frames[row, column])
                    match, agent, _ = key
                    assert agent == column % agents
                    assert key > last.get(column, (-1, -1, -1))[:3]  # in order, and none twice
                    last[column] = key
                    if match not in accounts:
                        accounts[match] = scripted_games.rows(seed, match, agents, together=together)
                    wanted = accounts[match][key]
                    assert rollout.rewards[row, column] == wanted.reward
                    assert rollout.terminated[row, column] == wanted.terminated
                    assert rollout.truncated[row, column] == wanted.truncated
                    assert tuple(frames[row + 1, column]) == (match, agent, key[2] + 1)
                    assert rollout.behaviour_log_probs[row, column] == key[2]
                    copy = first_copy + column // agents
                    assert rollout.actions["action"][row, column, 0] == scripted_games.PLAYED[copy, key]
                    steps.add((column // agents, match, wanted.step))
                if rollout.valid[0, column]:  # the memory goes on in an episode, and begins anew in the next
                    assert rollout.initial_state[column, 0] == frames[0, column, 2]
            assert rollout.agent_steps == np.count_nonzero(rollout.valid)
            assert rollout.env_steps == len(steps)
            lengths = [
                len([key for key in account if key[1] == agent])
                for account in accounts.values()
                for agent in range(agents)
            ]
            assert set(rollout.episode_lengths.tolist()) <= set(lengths)
    finally:
        collector.close()
