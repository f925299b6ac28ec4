"""Parameters that the learner sets: how actors apply, draw and acknowledge them."""

import itertools
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from collectors import collect, snapshot, started_collector
from lesson_environment import PathWithMethod
from plain import PlainPolicy
from test_client_collector import IDENTITY, Played

from daedalus.actor.checking.play import check_environment
from daedalus.actor.collecting.client_collector import ClientCollector
from daedalus.actor.collecting.client_seats import match_seats, seated_space
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.make import make_environments
from daedalus.actor.errors import ActorError
from daedalus.learner.run.lesson_progress import lessons_violation
from daedalus.protocol.lessons import LessonPlan, LessonRange, LessonSpec
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.uploads import Rollout

LESSONS = {"stones": LessonSpec(between=(1, 5))}


def path(name: str = "Path", **more: Any) -> EnvironmentSpec:
    values = {"id": f"lesson_environment:{name}", "kwargs": {"always_opens": True}, "parameters": {"stones": 7}}
    return EnvironmentSpec.model_validate({**values, **more})


def plan(*ranges: tuple[float, float]) -> LessonPlan:
    return LessonPlan(ranges={"stones": tuple(LessonRange(low=low, high=high) for low, high in ranges)})


def played(rollout: Rollout) -> list[int]:
    """Return the acknowledged parameter of each episode, which an episode of this length proves."""
    stones = rollout.lessons["stones"]
    assert stones.tolist() == rollout.episode_lengths.tolist()
    return stones.astype(int).tolist()


@pytest.mark.parametrize("more", [{}, {"id": "lesson_environment:PathWithMethod"}, {"processes": True}])
def test_each_episode_has_the_parameter_that_its_rollout_acknowledges(more: dict[str, Any]) -> None:
    options: dict[str, Any] = {"count": 3, "rollout_length": 40, "lessons": LESSONS, "plan": plan((1, 2), (5, 5))}
    collector = started_collector(path(**more), PlainPolicy(), **options)
    first = played(collect(collector))
    assert set(first) == {1, 2, 5}
    collector.load(snapshot(1, {}, plan((3, 3))))
    second = played(collect(collector))
    assert set(second[3:]) == {3}  # the three episodes that had begun go on with what they began with
    collector.load(snapshot(2, {}))  # without a plan, such as while a learner resumes: the old one goes on
    assert set(played(collect(collector))[3:]) == {3}
    collector.close()
    again = started_collector(path(**more), PlainPolicy(), **options)
    assert played(collect(again)) == first  # drawn by the seed of the actor
    again.close()


def test_evaluations_play_the_true_task_and_a_run_without_lessons_acknowledges_none() -> None:
    environments = make_environments(path().as_evaluated(), 1, modules=TEST_MODULES, one_episode=True)
    environments.reset(3)
    ends = [environments.step({"action": np.zeros((1, 1), np.uint8)})[2].any() for _ in range(7)]
    assert ends == [False] * 6 + [True]
    collector = started_collector(path(), PlainPolicy(), rollout_length=20)
    rollout = collect(collector)
    assert rollout.lessons == {}
    assert set(rollout.episode_lengths.tolist()) == {7}


@pytest.mark.parametrize("one_episode", [False, True])
def test_each_episode_begins_with_its_parameters_also_if_the_last_one_has_changed_them(one_episode: bool) -> None:
    wearing = path("Wearing")
    with closing(make_environments(wearing, 1, modules=TEST_MODULES, one_episode=one_episode)) as environments:
        for _ in range(2):
            environments.reset(3)
            ends = [environments.step({"action": np.zeros((1, 1), np.uint8)})[2].any() for _ in range(15)]
            assert ends == ([False] * 6 + [True] + [False] * 7 + [not one_episode])


METHOD = "lesson_environment:PathWithMethod"
FAULTS = [
    (
        path(parameters={"stone": 3}),
        "has no parameter stone: reset reads stones of its options, and the environment has no method set_parameters; "
        "did you mean stones?",
    ),
    (path(id=METHOD, parameters={"x": 3}), "has no parameter x: its set_parameters takes stones; correct "),
    (
        path(id=METHOD, parameters={"stones": 101}),
        "set_parameters(stones=101) raises ValueError: at most 100 stones fit",
    ),
    (path(parameters={"stones": -3}), "reset with the options stones=-3 raises ValueError: "),
    (EnvironmentSpec(id="CartPole-v1", parameters={"lov": -0.1}), "reset reads high, low of its options"),
]


def made_and_reset(environment: EnvironmentSpec) -> None:
    made = make_environments(environment, 2, modules=TEST_MODULES)
    try:
        made.reset(1)
    finally:
        made.close()


@pytest.mark.parametrize(("environment", "fault"), FAULTS)
def test_a_parameter_that_the_environment_does_not_have_is_named_before_a_run(
    environment: EnvironmentSpec, fault: str
) -> None:
    report = check_environment(environment, TEST_MODULES, seconds=0.1, env_steps=10)
    assert fault in report.problems[0]
    with pytest.raises(EnvironmentSetupError) as error:
        made_and_reset(environment)
    assert fault in str(error.value)


def test_a_process_names_a_parameter_that_its_environment_does_not_have() -> None:
    with pytest.raises(EnvironmentSetupError, match="has no parameter stone: reset reads stones"):
        made_and_reset(path(parameters={"stone": 3}, processes=True))


@pytest.mark.parametrize("way", ["item", "merged", "merging", "keywords", "copied", "updated"])
def test_options_may_be_read_in_any_way(way: str) -> None:
    spec = path("Odd", kwargs={"way": way})
    assert check_environment(spec, TEST_MODULES, seconds=0.1, env_steps=5).problems == ()


def test_a_range_that_this_host_refuses_is_named_when_the_actor_joins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MOST_STONES", "9")
    between = {"stones": LessonSpec(between=(1, 20))}
    with pytest.raises(EnvironmentSetupError) as error:
        started_collector(path("PathWithMethod"), PlainPolicy(), count=2, rollout_length=4, lessons=between)
    assert "set_parameters(stones=20) raises ValueError: at most 9 stones fit here" in str(error.value)


def test_environments_that_share_a_vector_entry_point_are_made_one_by_one() -> None:
    """CartPole's reset reads `low` and `high`, and its own vector entry point has one pair for all environments."""
    spec = EnvironmentSpec(id="CartPole-v1", parameters={"low": -0.01, "high": 0.01})
    lessons = {"low": LessonSpec(between=(-0.2, -0.1)), "high": LessonSpec(between=(0.1, 0.2))}
    ranges = {"low": (LessonRange(low=-0.2, high=-0.1),), "high": (LessonRange(low=0.1, high=0.2),)}
    collector = started_collector(
        spec, PlainPolicy(), count=2, rollout_length=64, lessons=lessons, plan=LessonPlan(ranges=ranges)
    )
    rollout = collect(collector)
    assert ((rollout.lessons["low"] > -0.2) & (rollout.lessons["low"] < -0.1)).all()
    assert len(set(rollout.lessons["high"].tolist())) == len(rollout.episode_returns) > 1


def test_older_actors_refuse_a_run_with_lessons() -> None:
    """They find settings in `changed` that they do not know."""
    spec = RunSpec(environment=path(), lessons=LESSONS).for_actors()
    assert {"environment.parameters", "lessons"} <= set(spec.changed)


class Walker:
    """A client's loop with a path, which it makes as long as the parameters say."""

    def __init__(self, agents: int = 1, **training: Any) -> None:
        settings = {"algorithm": "impala", **training}
        self.spec = RunSpec.model_validate(
            {
                "environment": path().model_dump(),
                "lessons": LESSONS,
                "collection": {"rollout_length": 20},
                "training": settings,
            }
        )
        self.played = Played(self.spec)
        self.path = PathWithMethod(always_opens=True)
        self.client = ClientCollector(self.path.observation_space, self.path.action_space, None, agents=agents)
        self.client.prepare(self.spec.for_actors())
        self.begin(plan((1, 2), (5, 5)))

    def begin(self, lessons: LessonPlan) -> None:
        """Let another learner begin."""
        self.client.begin(self.played.runtime(), self.spec.for_actors(), 3)
        self.load(0, lessons)

    def load(self, version: int, lessons: LessonPlan | None) -> None:
        self.client.load(replace(self.played.snapshot(version), lessons=lessons))

    def episode(self, agent: int = 0, *, truncated_after: int = 0) -> int:
        """Play an episode; return its length."""
        player = self.client.agents[agent]
        self.path.set_parameters(stones=int(player.parameters["stones"]))
        assert player.parameters == {"stones": self.path.stones}  # the same, whenever it is asked
        observation, _ = self.path.reset()
        for length in itertools.count(1):
            observation, reward, terminated, _, _ = self.path.step(player.act(observation))
            assert player.parameters == {"stones": self.path.stones}
            player.reward(reward)
            if terminated or length == truncated_after:
                player.end_episode(terminated=terminated, observation=observation)
                return length
        raise AssertionError

    def rollout(self) -> Rollout:
        taken = self.client.collect(IDENTITY)
        assert taken is not None
        return taken


def test_a_client_plays_and_acknowledges_the_parameters() -> None:
    walker = Walker()
    lengths = [walker.episode() for _ in range(12)]
    first = walker.rollout()
    assert played(first) == lengths[: len(first.episode_returns)]
    assert set(lengths) == {1, 2, 5}
    walker.load(1, plan((3, 3)))
    walker.load(2, None)  # without a plan: the last one goes on
    assert [walker.episode() for _ in range(16)][-6:] == [3] * 6
    while walker.client.has_rollout():
        rollout = walker.rollout()
        assert (lessons_violation(rollout, walker.spec), played(rollout) != []) == ("", True)


def test_a_client_that_does_not_ask_for_the_parameters_is_told_to() -> None:
    walker = Walker()
    with pytest.raises(ValueError, match=r"sets parameters of the environment \(stones\): ask for `parameters`"):
        walker.client.agents[0].act(np.zeros(1, np.float32))
    walker.episode()
    with pytest.raises(ValueError, match="before the first act of each episode"):
        walker.client.agents[0].act(np.zeros(1, np.float32))
    walker.episode()  # the refused calls have changed nothing


def test_a_client_keeps_the_parameters_of_its_episode_when_another_learner_begins() -> None:
    walker = Walker()
    agent = walker.client.agents[0]
    begun = agent.parameters
    walker.begin(plan((4, 4)))
    assert agent.parameters == begun  # with which the loop has made its environment
    agent.act(np.zeros(1, np.float32))
    walker.begin(plan((4, 4)))
    agent.act(np.zeros(1, np.float32))
    assert agent.parameters == begun
    agent.end_episode(terminated=True)
    walker.begin(plan((4, 4)))
    with pytest.raises(ValueError, match="before the first act of each episode"):  # not those of the last
        agent.act(np.zeros(1, np.float32))
    assert agent.parameters == {"stones": 4}


def test_the_seats_of_a_match_do_not_play_lessons_of_their_own() -> None:
    walker = Walker()
    two, one = (match_seats(seats, turns=True)[0] for seats in (("a", "b"), ("a",)))
    space, spec = walker.path.observation_space, walker.spec.for_actors()
    with pytest.raises(ActorError, match="lessons for stones, of which each seat of the match would"):
        seated_space(spec, two, space)
    assert seated_space(spec, one, space) == space


def test_agents_whose_rollouts_are_sent_as_one_acknowledge_all_their_episodes() -> None:
    walker = Walker(agents=3, algorithm="a2c")
    assert not walker.client.has_rollout()
    assert walker.client.collect(IDENTITY) is None  # the agents may begin
    while not walker.client.has_rollout():
        for agent in range(3):
            walker.episode(agent, truncated_after=4)
    rollout = walker.rollout()
    assert lessons_violation(rollout, walker.spec) == ""
    assert len(rollout.lessons["stones"]) == len(rollout.episode_returns) > 10
    full = rollout.lessons["stones"] < 5
    assert (rollout.lessons["stones"] == rollout.episode_lengths)[full].all()
    assert (rollout.episode_lengths[~full] == 4).all()
