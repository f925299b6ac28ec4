"""ClientCollector, compared with an EnvironmentCollector that steps the same environment."""

import copy
import time
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from allowed_modules import TEST_MODULES
from collectors import started_collector

from daedalus.actor.collecting.client_collector import _MAX_FULL_ROLLOUTS, ClientCollector
from daedalus.actor.collecting.client_rows import ClientRows
from daedalus.actor.collecting.policy_guard import PolicyGuard
from daedalus.actor.environments.make import make_environments
from daedalus.actor.errors import ActorError
from daedalus.learner.serving.rollout_judge import episode_violation
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.algorithms import AlgorithmRecord
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)
ROWS = 5


def run_spec(**environment: Any) -> RunSpec:
    settings = {"id": "counting_environment:Counting-v0", **environment}
    return RunSpec.model_validate({"environment": settings, "collection": {"rollout_length": ROWS}})


class Played:
    """A policy with a memory for an environment, and weights of several versions."""

    def __init__(self, spec: RunSpec) -> None:
        self.spec = spec
        environments = make_environments(spec.environment, 1, modules=TEST_MODULES)
        self.spaces = environments.spaces
        environments.close()
        policy = spec.policy.model_copy(update={"memory": "gru", "memory_units": 4, "hidden": (8,)})
        self.network = ActorCritic(policy, self.spaces)
        self.model = export_program(self.network, self.spaces)

    def runtime(self) -> OnnxRuntime:
        return OnnxRuntime(self.model)

    def snapshot(self, version: int) -> Snapshot:
        weights = {
            name: parameter.detach().numpy() * np.float32(1 + 0.1 * version)
            for name, parameter in self.network.named_parameters()
        }
        return Snapshot(learner_epoch=1, policy_version=version, program="", weights=weights)


def take(client: ClientCollector) -> Rollout:
    """The oldest full rollout."""
    rollout = client.collect(IDENTITY)
    assert rollout is not None
    return rollout


@dataclass
class Robot:
    """An environment and its current observation."""

    environment: gymnasium.Env
    observation: np.ndarray


def drive(client: ClientCollector, robot: Robot, steps: int) -> None:
    """Run the caller's loop; continue where the last call ended."""
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = robot.environment.step(client.agents[0].act(robot.observation))
        client.agents[0].reward(float(reward) / 2)
        client.agents[0].reward(float(reward) / 2)
        if terminated or truncated:
            client.agents[0].end_episode(observation=observation, terminated=terminated)
            observation, _ = robot.environment.reset()
        robot.observation = observation


def begun(played: Played) -> tuple[ClientCollector, Robot]:
    environment = gymnasium.make(played.spec.environment.id).unwrapped
    client = ClientCollector(environment.observation_space, environment.action_space, None)
    assert client.prepare(played.spec.for_actors()) == (played.spaces, 1)
    client.begin(played.runtime(), played.spec.for_actors(), 3)
    client.load(played.snapshot(0))
    return client, Robot(environment, environment.reset(seed=1)[0])


@pytest.mark.parametrize(
    "environment",
    [{}, {"frame_stack": 3}, {"reward_scale": 0.25, "reward_clip": 1.0}, {"bootstrap_terminations": True}],
    ids=["plain", "stacked", "scaled", "bootstrap_terminations"],
)
def test_client_rollouts_equal_those_of_an_environment_collector(environment: dict[str, Any]) -> None:
    played = Played(run_spec(**environment))
    client, robot = begun(played)
    collector = started_collector(
        played.spec.environment, played.runtime(), rollout_length=ROWS, seed=3, weights=played.snapshot(0).weights
    )
    # Each collector samples from one generator: give the client the seed that the other derives for its actions.
    _, *action_seed = np.random.SeedSequence(3).generate_state(4).astype("<u4")
    client.begin(played.runtime(), played.spec.for_actors(), int.from_bytes(np.array(action_seed).tobytes(), "little"))
    client.load(played.snapshot(0))
    found: list[Rollout] = []
    for version in range(8):
        collector.load(played.snapshot(version))
        expected = copy.deepcopy(collector.collect(IDENTITY))
        while not client.has_rollout():
            drive(client, robot, 1)
            if client.agents[0]._loaded is not None and client.agents[0]._loaded.version == version:
                client.load(played.snapshot(version + 1))  # for the next rollout
        found.append(take(client))
        for name in Rollout.__dataclass_fields__:
            left, right = getattr(found[-1], name), getattr(expected, name)
            np.testing.assert_equal(left, right, f"{name} of version {version}")
    assert sum(len(rollout.episode_returns) for rollout in found) > 5
    collector.close()


def test_oldest_rollouts_are_dropped_when_nobody_takes_them() -> None:
    client, robot = begun(Played(run_spec()))
    drive(client, robot, 200)
    assert len(client._exchange._full[0]) == _MAX_FULL_ROLLOUTS
    assert client.dropped > 0


@pytest.mark.parametrize("steps", [0, 3])
def test_new_policy_acts_from_the_first_step_after_its_weights_came(steps: int) -> None:
    played = Played(run_spec())
    client, robot = begun(played)
    drive(client, robot, steps)
    client.begin(played.runtime(), played.spec.for_actors(), 4)
    drive(client, robot, 40)  # before its weights came, the previous policy acts, and its rollouts are discarded
    assert not client.has_rollout()
    client.load(played.snapshot(7))
    drive(client, robot, 2 * ROWS)
    assert take(client).policy_version == 7


def test_agent_acts_on_when_another_learner_is_joined_while_it_changes_to_the_policy_of_the_last_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    played = Played(run_spec())
    client, robot = begun(played)
    observe = ClientRows.observe

    def join_another(rows: ClientRows, *arguments: Any) -> None:
        """Stand for the service's thread, which may do this at any moment."""
        monkeypatch.setattr(ClientRows, "observe", observe)
        client.begin(played.runtime(), played.spec.for_actors(), 4)
        rows.observe(*arguments)

    monkeypatch.setattr(ClientRows, "observe", join_another)
    drive(client, robot, 40)
    assert not client.has_rollout(), "no learner takes the rollouts of the policy before"
    client.load(played.snapshot(2))
    drive(client, robot, 40)
    assert take(client).policy_version == 2


def test_invalid_calls_raise_and_change_nothing() -> None:
    client, robot = begun(Played(run_spec()))
    with pytest.raises(ValueError, match="before any action"):
        client.agents[0].reward(1.0)
    with pytest.raises(ValueError, match="without any action"):
        client.agents[0].end_episode(terminated=True)
    client.agents[0].act(robot.observation)
    with pytest.raises(ValueError, match="must be finite"):
        client.agents[0].reward(float("nan"))
    client.agents[0].reward(3e38)
    with pytest.raises(ValueError, match=r"the reward is 6e\+38: it must be finite, and a number of 32 bits holds it"):
        client.agents[0].reward(3e38)
    client.agents[0].reward(-3e38)
    with pytest.raises(ValueError, match="needs its last observation"):
        client.agents[0].end_episode(terminated=False)
    with pytest.raises(ValueError, match="the observation has shape"):
        client.agents[0].act(np.zeros(99, np.float32))
    client.agents[0].reward(1.0)
    client.agents[0].end_episode(terminated=True)
    drive(client, robot, ROWS)
    rollout = take(client)
    assert rollout.terminated[0, 0]
    assert rollout.episode_returns[0] == 1.0


def synchronous(played: Played) -> Played:
    training = played.spec.training.model_copy(update={"algorithm": "a2c"})
    played.spec = played.spec.model_copy(update={"training": training})
    return played


def test_rows_between_the_rollouts_of_a_synchronous_run_are_not_written() -> None:
    """The next rollout begins with the newest weights once the service asks for it; the memory goes on meanwhile."""
    played = synchronous(Played(run_spec()))
    client, robot = begun(played)
    drive(client, robot, 4)  # the service has not asked for a rollout yet
    assert not client.has_rollout()
    assert client.collect(IDENTITY) is None
    drive(client, robot, 4 * ROWS)
    first = take(client)
    assert not client.has_rollout()
    client.load(played.snapshot(1))
    drive(client, robot, ROWS)
    assert not client.has_rollout()
    assert client.collect(IDENTITY) is None
    drive(client, robot, 2 * ROWS)
    second = take(client)
    assert (first.policy_version, second.policy_version) == (0, 1)
    assert first.initial_state.any(), "the memory began before the rollout"
    assert client.dropped == 0
    for rollout in (first, second):
        assert episode_violation(rollout) == ""


def test_a_rollout_of_one_row_is_no_reset_row() -> None:
    """A synchronous run of episodes of one step would else wait for their reset rows, and learn from no others."""
    spec = run_spec()
    spec = spec.model_copy(update={"collection": spec.collection.model_copy(update={"rollout_length": 1})})
    played = synchronous(Played(spec))
    client, robot = begun(played)
    robot.environment = gymnasium.make(spec.environment.id, ends=(1,)).unwrapped
    robot.environment.reset(seed=1)
    for version in range(1, 5):
        assert client.collect(IDENTITY) is None  # the service asks for a rollout
        drive(client, robot, 2)
        rollout = take(client)
        assert rollout.valid.all()
        assert rollout.episode_lengths.tolist() == [1]
        client.load(played.snapshot(version))


def observations(count: int) -> np.ndarray:
    shape = gymnasium.make(run_spec().environment.id).observation_space.shape
    assert shape is not None
    return np.random.default_rng(5).standard_normal((count, *shape)).astype(np.float32)


def played_with(overrides: dict[int, int], steps: int) -> tuple[list[Rollout], list[int]]:
    """Return the rollouts of a loop without ends whose actions are overridden at some steps, and the actions."""
    torch.manual_seed(1)
    client, _ = begun(Played(run_spec()))
    rollouts: list[Rollout] = []
    actions = []
    for step, observation in enumerate(observations(steps)):
        actions.append(int(client.agents[0].act(observation, override=overrides.get(step))))
        client.agents[0].reward(step)
        rollouts += [] if not client.has_rollout() else [take(client)]
    assert client.agents[0].overridden_actions == len(overrides)
    return rollouts, actions


def test_overridden_action_is_played_and_the_policy_goes_on_as_without_it() -> None:
    plain, plain_actions = played_with({}, 3 * ROWS + 1)
    rollouts, actions = played_with({step: (plain_actions[step] + 1) % 4 for step in (2, 7)}, 3 * ROWS + 1)
    assert [step for step in range(len(actions)) if actions[step] != plain_actions[step]] == [2, 7]
    assert len(rollouts) == len(plain) == 3
    for rollout, other in zip(rollouts, plain, strict=True):
        for name in Rollout.__dataclass_fields__:
            if name != "overridden":
                np.testing.assert_equal(getattr(rollout, name), getattr(other, name), name)
    found = [None if rollout.overridden is None else rollout.overridden[:, 0].tolist() for rollout in rollouts]
    assert found == [[False, False, True, False, False], [False, False, True, False, False], None]


def test_a_run_that_learns_from_people_gets_what_they_played() -> None:
    played = Played(run_spec())
    training = {"algorithm": "module:Own", "algorithm_record": AlgorithmRecord(learns_overrides=True)}
    played.spec = played.spec.model_copy(update={"training": played.spec.training.model_copy(update=training)})
    client, _ = begun(played)
    rollouts = []
    for step, observation in enumerate(observations(2 * ROWS + 1)):
        # The first rollout is a person's alone; an action that the space does not have is nobody's to learn from.
        override = step % 4 if step < ROWS else 9 if step == ROWS + 2 else None
        assert override in (None, int(client.agents[0].act(observation, override=override)))
        rollouts += [] if not client.has_rollout() else [take(client)]
    first, second = rollouts
    assert first.taught is not None
    assert first.taught.all()
    assert not first.learned.any()
    assert first.actions["action"][:, 0, 0].tolist() == [step % 4 for step in range(ROWS)]
    assert (episode_violation(first, True), second.taught) == ("", None)
    assert second.learned[:, 0].tolist() == [True, True, False, True, True]


def test_success_rewards_the_last_action_and_ends_the_episode() -> None:
    client, _ = begun(Played(run_spec()))
    for observation in observations(ROWS):
        client.agents[0].act(observation)
    client.agents[0].success(2.0)
    client.agents[0].act(observations(1)[0])
    rollout = take(client)
    assert rollout.rewards[:, 0].tolist() == [0.0] * (ROWS - 1) + [2.0]
    assert rollout.terminated[:, 0].tolist() == [False] * (ROWS - 1) + [True]


def test_no_rollout_begins_with_an_overridden_row() -> None:
    """A person who drives for long fills one rollout, and no further ones that hold nothing to learn from."""
    rollouts, _ = played_with(dict.fromkeys(range(3, 40), 0), 40 + ROWS + 1)
    first, second = rollouts
    assert first.learned[:, 0].tolist() == [True] * 3 + [False] * 2
    assert second.learned.all()
    assert second.rewards[0, 0] == 40.0
    assert second.initial_state.any()


def guarded(played: Played, **settings: Any) -> tuple[ClientCollector, Robot]:
    environment = gymnasium.make(played.spec.environment.id).unwrapped
    space = environment.action_space
    guard = PolicyGuard(space, 1, settings.get("max_policy_age"), untrained=settings.get("untrained", False))
    client = ClientCollector(environment.observation_space, space, None, guard)
    client.prepare(played.spec.for_actors())
    client.begin(played.runtime(), played.spec.for_actors(), 3)
    client.load(played.snapshot(settings.get("version", 1)))
    client.confirm(time.monotonic())
    return client, Robot(environment, environment.reset(seed=1)[0])


def test_old_policy_does_not_act_and_nothing_is_learned_from_its_rows() -> None:
    client, robot = guarded(Played(run_spec()))
    drive(client, robot, 3)
    assert client.agents[0].safe_actions == 0
    client.confirm(time.monotonic() - 31.0)
    assert [client.agents[0].act(robot.observation) for _ in range(4 * ROWS)] == [1] * 4 * ROWS
    assert (client.agents[0].safe_actions, client.dropped) == (4 * ROWS, 1)
    assert client.guard.reason == "the learner did not confirm the policy within 30 s"
    assert not client.has_rollout()
    client.confirm(time.monotonic())
    drive(client, robot, ROWS + 1)
    assert client.guard.reason == ""
    assert client.agents[0].safe_actions == 4 * ROWS
    assert take(client).overridden is None


def test_untrained_policy_acts_only_if_asked_for() -> None:
    client, robot = guarded(Played(run_spec()), version=0)
    assert [client.agents[0].act(robot.observation) for _ in range(20)] == [1] * 20
    assert "no update has changed the policy yet" in client.guard.reason
    client, robot = guarded(Played(run_spec()), version=0, untrained=True)
    drive(client, robot, 20)
    assert client.agents[0].safe_actions == 0


def test_another_learner_with_an_untrained_policy_does_not_drive() -> None:
    played = Played(run_spec())
    client, robot = guarded(played, version=500)
    drive(client, robot, 3)
    client.begin(played.runtime(), played.spec.for_actors(), 4)
    client.load(played.snapshot(0))
    assert [client.agents[0].act(robot.observation) for _ in range(20)] == [1] * 20
    client.load(played.snapshot(1))
    drive(client, robot, 1)
    assert client.agents[0].safe_actions == 20


def test_override_has_precedence_over_the_safe_action() -> None:
    client, robot = guarded(Played(run_spec()), version=0)
    assert client.agents[0].act(robot.observation, override=0) == 0
    assert (client.agents[0].overridden_actions, client.agents[0].safe_actions) == (1, 0)


def test_safe_action_is_what_it_was_although_the_loop_changes_an_action_that_it_got() -> None:
    given = np.zeros(2, np.float32)
    guard = PolicyGuard(gymnasium.spaces.Box(-1.0, 1.0, (2,)), given, None, untrained=False)
    guard.action(None)[:] = 0.5
    given[:] = 1.0
    assert guard.action(None).tolist() == [0.0, 0.0]


def test_safe_action_is_taken_in_the_dtype_of_its_space() -> None:
    """numpy makes float64 and int64, and the spaces of actions often have float32 and int32."""
    box, choice = gymnasium.spaces.Box(-1.0, 1.0, (2,)), gymnasium.spaces.Discrete(3, dtype=np.int32)
    both = gymnasium.spaces.Dict({"move": box, "grip": choice})
    action = PolicyGuard(both, {"move": np.zeros(2), "grip": np.int64(1)}, None, untrained=False).action(None)
    assert both.contains(action)
    assert (action["move"].tolist(), int(action["grip"])) == ([0.0, 0.0], 1)
    with pytest.raises(ValueError, match="is not in the action space"):
        PolicyGuard(box, [0.0, 2.0], None, untrained=False)


def test_safe_action_may_depend_on_the_observation() -> None:
    guard = PolicyGuard(gymnasium.spaces.Discrete(9), lambda observation: observation + 1, None, untrained=False)
    assert guard.action(4) == 5


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((None, 30.0), "pass a safe_action"),
        ((7, None), r"safe_action is 7, which is outside Discrete\(2\)"),
        (([1], None), "safe_action has shape"),
        ((1, 0.0), "must be above 0 seconds"),
        ((1, float("nan")), "must be above 0 seconds"),
    ],
)
def test_settings_of_the_safe_action_are_checked(arguments: tuple[Any, float | None], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        PolicyGuard(gymnasium.spaces.Discrete(2), *arguments, untrained=False)


def test_reward_may_come_after_the_end_of_its_episode() -> None:
    client, robot = begun(Played(run_spec()))
    client.agents[0].act(robot.observation)
    client.agents[0].end_episode(terminated=True)
    client.agents[0].reward(2.0)
    client.agents[0].reward(3.0)
    with pytest.raises(ValueError, match="without any action"):
        client.agents[0].end_episode(terminated=True)
    drive(client, robot, ROWS)
    rollout = take(client)
    assert rollout.rewards[:2, 0].tolist() == [5.0, 0.0]
    assert rollout.terminated[0, 0]
    assert rollout.episode_returns[0] == 5.0


def test_terminated_episode_needs_its_last_observation_where_terminations_are_bootstrapped() -> None:
    """Without that observation the value of the one before it would be learned from."""
    client, robot = begun(Played(run_spec(bootstrap_terminations=True)))
    client.agents[0].act(robot.observation)
    with pytest.raises(ValueError, match=r"bootstraps terminated episodes.*pass the last observation"):
        client.agents[0].end_episode(terminated=True)
    client.agents[0].end_episode(observation=robot.observation, terminated=True)


@pytest.mark.parametrize(
    ("setting", "value"), [("action_repeat", 4), ("no_reward_limit", 30), ("max_episode_steps", 200)]
)
def test_run_whose_settings_only_an_environment_of_ours_applies_is_refused(setting: str, value: int) -> None:
    spec = run_spec()
    environment = gymnasium.make(spec.environment.id)
    changed = spec.model_copy(update={"environment": spec.environment.model_copy(update={setting: value})})
    client = ClientCollector(environment.observation_space, environment.action_space, None)
    with pytest.raises(ActorError, match=rf"environment\.{setting}={value}"):
        client.prepare(changed.for_actors())
