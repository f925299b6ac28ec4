"""ClientRows: what an interrupted loop leaves in its rollouts."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import stack_rows

from daedalus.actor.collecting.client_rows import ClientRows
from daedalus.actor.environments.transforms import Transforms
from daedalus.learner.serving.rollout_judge import episode_violation
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

ROWS = 5
SPEC = RunSpec.model_validate(
    {"environment": {"id": "Any-v0", "frame_stack": 2}, "collection": {"rollout_length": ROWS}}
)
IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)
OBSERVATIONS, ACTIONS = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32), gymnasium.spaces.Discrete(3)
TRANSFORMS = Transforms(SPEC.environment, OBSERVATIONS, ACTIONS, None)
NETWORK = ActorCritic(PolicySpec(memory="gru", memory_units=4, hidden=(8,)), TRANSFORMS.spaces)
RUNTIME = OnnxRuntime(export_program(NETWORK, TRANSFORMS.spaces))
RUNTIME.load({name: parameter.detach().numpy() for name, parameter in NETWORK.named_parameters()})


def rows_of(transforms: Transforms, runtime: OnnxRuntime, rollouts: list[Rollout], **more: Any) -> ClientRows:
    """Return rows whose full rollouts are added to a list."""

    def keep(rows: ClientRows) -> None:
        rollouts.append(rows.finished_copy(0))

    random = np.random.default_rng(1)
    return ClientRows(SPEC.for_actors(), transforms, runtime, random, on_full=keep, **more)


class Loop:
    """A loop whose observations are [episode, step], and each of whose rewards says where it belongs."""

    def __init__(self) -> None:
        self.rollouts: list[Rollout] = []
        self.rows = rows_of(TRANSFORMS, RUNTIME, self.rollouts)
        self.episode, self.step = 1, 0

    def observe(self) -> None:
        self.rows.observe(np.array([self.episode, self.step], np.float32))

    def act(self, override: int | None = None) -> None:
        self.observe()
        while self.rows.choose(override=override) is None:
            pass
        self.rows.reward(self.episode + self.step / 100)
        self.step += 1

    def begin_episode(self) -> None:
        self.episode, self.step = self.episode + 1, 0

    def end(self, *, terminated: bool) -> None:
        if self.rows.in_episode:
            self.rows.end_episode(np.array([self.episode, self.step], np.float32), terminated=terminated)
            self.begin_episode()

    def cut(self, *, while_it_waits: bool) -> None:
        """Interrupt the loop after an action, or between an observation and its action."""
        if while_it_waits:
            self.observe()
        self.rows.cut()
        self.begin_episode()


def check(rollout: Rollout) -> None:
    """Each row must have the reward of its own observation, and each episode its own frames."""
    assert episode_violation(rollout) == ""
    frames = rollout.frames["observation"]  # [1 + ROWS + 1, 1, 2]
    stacks = np.zeros((ROWS + 1, 1, 2, 2), np.float32)
    stack_rows(frames, rollout.valid, stacks)
    for row in range(ROWS):
        (before_episode, before), (episode, step) = stacks[row, 0]
        if not rollout.valid[row, 0]:
            continue
        assert rollout.rewards[row, 0] == np.float32(episode + step / 100)
        assert (before_episode, before) == (episode, max(step - 1, 0))
        ended = bool(rollout.terminated[row, 0] or rollout.truncated[row, 0])
        assert tuple(frames[row + 2, 0]) == (episode, step + 1), "the successor is of the same episode"
        if row + 1 < ROWS:
            assert bool(rollout.valid[row + 1, 0]) is not ended


def test_episode_of_an_interrupted_loop_is_truncated_at_its_newest_observation() -> None:
    loop = Loop()
    for _ in range(3):
        loop.act()
    loop.cut(while_it_waits=False)
    for _ in range(3):
        loop.act()
    (rollout,) = loop.rollouts
    assert rollout.truncated[:, 0].tolist() == [False, True, False, False, False]
    assert rollout.valid[:, 0].tolist() == [True, True, False, True, True]
    assert rollout.frames["observation"][1:, 0].tolist() == [[1, 0], [1, 1], [1, 2], [2, 0], [2, 1], [2, 2]]
    assert rollout.episode_lengths.tolist() == [2]
    np.testing.assert_allclose(rollout.episode_returns, [1.0 + 1.01])
    check(rollout)


def test_override_of_an_interrupted_loop_is_in_no_row() -> None:
    loop = Loop()
    for override in (None, None, 1):
        loop.act(override)
    loop.cut(while_it_waits=False)
    for _ in range(3):
        loop.act()
    (rollout,) = loop.rollouts
    assert rollout.overridden is None
    check(rollout)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.sampled_from(["act", "act", "act", "terminate", "truncate", "cut", "cut while it waits"]), max_size=60)
)
def test_rollouts_of_any_loop_keep_the_rules(events: list[str]) -> None:
    loop = Loop()
    for event in events:
        match event:
            case "act":
                loop.act()
            case "terminate" | "truncate":
                loop.end(terminated=event == "terminate")
            case _:
                loop.cut(while_it_waits=event == "cut while it waits")
    for rollout in loop.rollouts:
        check(rollout)


def test_last_observation_of_an_episode_allows_every_choice() -> None:
    """The mask with which a client was constructed is an example of any state."""
    transforms = Transforms(SPEC.environment, OBSERVATIONS, ACTIONS, np.array([[True, False, False]]))
    network = ActorCritic(PolicySpec(hidden=(8,)), transforms.spaces)
    runtime = OnnxRuntime(export_program(network, transforms.spaces))
    runtime.load({name: parameter.detach().numpy() for name, parameter in network.named_parameters()})
    rollouts: list[Rollout] = []
    rows = rows_of(transforms, runtime, rollouts, has_masks=True)
    for _ in range(ROWS):
        rows.observe(np.zeros(2, np.float32), [False, True, True])
        while rows.choose() is None:
            pass
        rows.end_episode(np.zeros(2, np.float32), terminated=False)
    masks = rollouts[0].masks["action"][:, 0].astype(bool).tolist()
    assert masks[:4] == [[False, True, True], [True, True, True]] * 2


def test_end_of_an_episode_with_a_wrong_reward_has_changed_nothing() -> None:
    loop = Loop()
    loop.act()
    last = np.array([1, 1], np.float32)
    for wrong in (1e39, float("nan")):
        with pytest.raises(ValueError, match="it must be finite"):
            loop.rows.end_episode(last + 5, terminated=True, reward=wrong)
    assert loop.rows.in_episode
    loop.rows.end_episode(last, terminated=False, reward=0.5)
    loop.begin_episode()
    for _ in range(3):
        loop.act()
    loop.observe()
    (rollout,) = loop.rollouts
    assert (rollout.terminated[0, 0], rollout.truncated[0, 0], rollout.rewards[0, 0]) == (False, True, 1.5)
    assert rollout.frames["observation"][2, 0].tolist() == [1, 1]


def test_an_episode_goes_on_under_another_learner_with_its_return() -> None:
    loop = Loop()
    for _ in range(3):
        loop.act()
    before, loop.rows = loop.rows, rows_of(TRANSFORMS, RUNTIME, loop.rollouts)
    with pytest.raises(ValueError, match="it must be finite"):
        loop.rows.take_over(before, 1e39)
    loop.rows.take_over(before, 0.25)
    for terminated in (True, False):
        loop.act()
        loop.end(terminated=terminated)
    loop.act()
    loop.observe()
    (rollout,) = loop.rollouts
    assert rollout.episode_lengths.tolist() == [4, 1]
    np.testing.assert_allclose(rollout.episode_returns, [1.0 + 1.01 + 1.02 + 0.25 + 1.03, 2.0])
    assert rollout.rewards[0, 0] == np.float32(1.03), "the rows before are of the other learner"


def test_memory_begins_anew_after_an_interruption() -> None:
    loop = Loop()
    for _ in range(ROWS + 1):  # the first row of the second rollout has begun
        loop.act()
    loop.cut(while_it_waits=False)
    for _ in range(ROWS + 1):
        loop.act()
    first, second = loop.rollouts
    assert not first.truncated.any()
    assert second.initial_state.tolist() == [[0.0] * 4]
    assert second.valid.all()
    check(second)
