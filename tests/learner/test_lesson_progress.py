"""learner/run/lesson_progress.py: what actors draw next, from the returns of what they played."""

import json
import threading
import time
from typing import Any

import numpy as np
import pytest
from building import make_rollout, run_spec

from daedalus.learner.run.counters import check_counters
from daedalus.learner.run.lesson_progress import LessonProgress, LessonState, lessons_violation
from daedalus.learner.run.resuming import differing
from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout

NAME = "gravity"


def spec(true_value: float = 10.0, **lesson: Any) -> RunSpec:
    plain = run_spec(target_episodes=4).model_dump(mode="json")
    environment = {**plain["environment"], "parameters": {NAME: true_value}}
    return RunSpec.model_validate({**plain, "environment": environment, "lessons": {NAME: lesson}})


def episodes(*played: tuple[float, float]) -> Rollout:
    """Return a rollout with episodes, each with the value that it was played with and its return."""
    values, returns = np.array(played, np.float64).reshape(-1, 2).T.copy()
    return make_rollout(
        episode_returns=returns,
        episode_lengths=np.ones(len(returns), np.int32),
        lessons={NAME: values},
    )


def drawn(lessons: LessonProgress, env_steps: int = 0) -> list[tuple[float, float, float]]:
    plan = lessons.plan(env_steps)
    assert plan is not None
    return [(each.low, each.high, each.weight) for each in plan.ranges[NAME]]


def test_a_schedule_ends_at_the_true_task() -> None:
    lessons = LessonProgress(spec(start=2.0, until_env_steps=100))
    assert [drawn(lessons, env_steps)[0][0] for env_steps in (0, 25, 100, 999)] == [2.0, 4.0, 10.0, 10.0]
    assert lessons.texts(25) == {NAME: "4 (until 100 env_steps)"}
    assert lessons.texts(100) == {NAME: "10 (the true task)"}
    whole = LessonProgress(spec(10, start=2, until_env_steps=100))
    assert [drawn(whole, env_steps)[0][0] for env_steps in (0, 30, 60)] == [2, 4, 7]


def test_numbers_of_lessons_may_be_numpys() -> None:
    given = spec(np.float32(10.0), start=np.int64(2), until_env_steps=1e2)  # pyright: ignore[reportArgumentType]
    assert given == spec(10.0, start=2, until_env_steps=100)
    assert type(given.lessons[NAME].start) is int


def test_only_episodes_with_the_present_value_lead_to_the_next_one() -> None:
    lessons = LessonProgress(spec(steps=[1.0, 5.0], above=0.5))
    lessons.add([episodes((1.0, 1.0), (1.0, 1.0), (1.0, 0.0))], 7)
    assert drawn(lessons) == [(1.0, 1.0, 1.0)]  # three of target_episodes
    lessons.add([episodes((1.0, 0.0))], 8)
    assert drawn(lessons) == [(5.0, 5.0, 1.0)]
    assert lessons.texts(8) == {NAME: "5 (step 2 of 3)"}
    lessons.add([episodes(*[(1.0, 1.0)] * 3, (5.0, 0.0))], 9)  # three have begun before
    assert drawn(lessons) == [(5.0, 5.0, 1.0)]
    lessons.add([episodes(*[(5.0, 0.0)] * 9, *[(5.0, 1.0)] * 2)], 10)  # the newest four have 0.5
    assert drawn(lessons) == [(10.0, 10.0, 1.0)]
    lessons.add([episodes(*[(10.0, 1.0)] * 9)], 11)
    assert lessons.texts(11) == {NAME: "10 (the true task)"}
    assert lessons.means() == {NAME: 10.0}  # as acknowledged, over the newest episodes


def test_one_false_return_does_not_end_a_step() -> None:
    run = spec(steps=[1.0, 5.0], above=0.5)
    run = run.model_copy(update={"training": run.training.model_copy(update={"target_episodes": 20})})
    lessons = LessonProgress(run)
    lessons.add([episodes((1.0, 1e6)), *[episodes((1.0, 0.0))] * 30], 1)
    assert drawn(lessons) == [(1.0, 1.0, 1.0)]
    lessons.add([episodes((1.0, 0.6))] * 20, 2)
    assert drawn(lessons) == [(5.0, 5.0, 1.0)]


def test_the_mean_of_many_returns_is_looked_at_after_each_twentieth_of_them() -> None:
    run = spec(steps=[1.0, 5.0], above=0.51)
    run = run.model_copy(update={"training": run.training.model_copy(update={"target_episodes": 40})})
    lessons = LessonProgress(run)
    lessons.add([episodes((1.0, 0.0))] * 40 + [episodes((1.0, 1.0))] * 21, 1)
    assert drawn(lessons) == [(1.0, 1.0, 1.0)]  # 21 of 40 are enough, but 61 is odd
    resumed = LessonProgress(run, {NAME: LessonState.model_validate(lessons.states()[NAME])})
    resumed.add([episodes((1.0, 1.0))], 2)
    assert drawn(resumed) == [(5.0, 5.0, 1.0)]
    fewer = run.model_copy(update={"training": run.training.model_copy(update={"target_episodes": 2})})
    resumed = LessonProgress(fewer, {NAME: LessonState.model_validate(lessons.states()[NAME])})
    resumed.add([episodes((1.0, 0.0))], 2)
    assert drawn(resumed) == [(1.0, 1.0, 1.0)]  # the newest two have 0.5


def test_a_run_may_resume_with_and_without_a_lesson() -> None:
    plain = run_spec(target_episodes=4).model_dump(mode="json")
    without = RunSpec.model_validate({**plain, "environment": {**plain["environment"], "parameters": {NAME: 10.0}}})
    with_one = spec(start=2.0, until_env_steps=100)
    assert differing(without, with_one) == differing(with_one, without) == [f"lessons.{NAME}"]


def test_a_range_is_drawn_more_often_where_the_return_changes() -> None:
    assert drawn(LessonProgress(spec(between=[5.0, 15.0]))) == [(5.0, 15.0, 1.0)]
    lessons = LessonProgress(spec(10, between=[1, 3], where="progress"))
    assert drawn(lessons) == [(value, value, pytest.approx(1 / 3)) for value in (1, 2, 3)]
    for step in range(40):
        lessons.add([episodes((1, 1.0), (2, step / 40), (3, 0.0))], step)
    weights = [weight for _, _, weight in drawn(lessons)]
    assert weights == pytest.approx([0.2 / 3, 0.8 + 0.2 / 3, 0.2 / 3])
    assert lessons.texts(0) == {NAME: "1 to 3 (most often 2)"}
    wide = drawn(LessonProgress(spec(10, between=[0, 999_999_999_999], where="progress")))
    assert len(wide) == 8
    assert sum(high - low + 1 for low, high, _ in wide) == 10**12


def test_a_checkpoint_has_the_state_and_another_lesson_begins_anew(tmp_path: Any) -> None:
    steps = {"steps": [1.0, 5.0], "above": 0.5}
    context = RunContext.begin(tmp_path, spec(**steps), threading.Event())
    context.lessons.add([episodes(*[(1.0, 1.0)] * 4, *[(5.0, 1.0)] * 3)], 1)
    saved = check_counters(json.loads(json.dumps(context.saved(time.monotonic()))))
    states = {name: LessonState.model_validate(state) for name, state in saved["lessons"].items()}
    resumed = LessonProgress(spec(**steps), states)
    assert drawn(resumed) == [(5.0, 5.0, 1.0)]
    resumed.add([episodes((5.0, 1.0))], 2)
    assert drawn(resumed) == [(10.0, 10.0, 1.0)]
    assert drawn(LessonProgress(spec(steps=[1.0, 6.0], above=0.5), states)) == [(1.0, 1.0, 1.0)]
    saved["lessons"][NAME]["step"] = -1
    with pytest.raises(ValueError, match="step"):
        check_counters(saved)


@pytest.mark.parametrize(
    ("lessons", "violation"),
    [
        ({}, "lessons are of no parameter, and those of the run of gravity"),
        ({NAME: [5.0, 10.0]}, ""),
        ({"speed": [5.0, 5.0]}, "lessons are of speed, and those of the run of gravity"),
        ({NAME: [5.0, 11.0]}, "lessons 'gravity' has a value that is not from 1 to 10"),
        ({NAME: [5.0, np.nan]}, "lessons 'gravity' has a value that is not from 1 to 10"),
    ],
)
def test_an_actor_must_acknowledge_the_lessons_of_its_episodes(lessons: dict[str, Any], violation: str) -> None:
    ended = {"episode_returns": np.zeros(2), "episode_lengths": np.ones(2, np.int32)}
    rollout = make_rollout(**ended, lessons={name: np.array(values) for name, values in lessons.items()})
    assert lessons_violation(rollout, spec(steps=[1.0, 5.0], above=0.5)) == violation
    none = lessons_violation(rollout, run_spec())
    assert none == (f"lessons are of {', '.join(lessons)}, and those of the run of none" if lessons else "")


def test_lessons_that_do_not_have_one_value_for_each_episode_are_no_rollout() -> None:
    with pytest.raises(ValueError, match=r"lessons 'gravity' must be float64 \[2\]"):
        make_rollout(episode_returns=np.zeros(2), episode_lengths=np.ones(2, np.int32), lessons={NAME: np.zeros(1)})
