"""Collectors over environments and policies that a test chooses."""

from unittest import mock

import numpy as np
from allowed_modules import TEST_MODULES

from daedalus.actor.collecting import environment_collector
from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.learner.serving.rollout_judge import episode_violation
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.lessons import LessonPlan, LessonSpec
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import CollectionSpec, EnvironmentSpec, EvaluationSpec, LeagueSpec, RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)


def started_collector(
    spec: EnvironmentSpec,
    runtime: PolicyRuntime,
    *,
    count: int = 1,
    rollout_length: int,
    seed: int = 1,
    weights: dict[str, np.ndarray] | None = None,
    environments: VectorEnvironment | None = None,
    modules: UserModules = TEST_MODULES,
    league: LeagueSpec | None = None,
    longest: int = 27_000,
    lessons: dict[str, LessonSpec] | None = None,
    plan: LessonPlan | None = None,
) -> EnvironmentCollector:
    """A collector at the start of its first rollout; it steps `environments` instead of its own if they are given."""
    collection = CollectionSpec(envs_per_actor=count, rollout_length=rollout_length)
    evaluation = EvaluationSpec(max_episode_env_steps=longest)
    league = league or LeagueSpec()
    run = RunSpec(environment=spec, collection=collection, evaluation=evaluation, league=league, lessons=lessons or {})
    collector = EnvironmentCollector(modules=modules)
    if environments is None:
        collector.prepare(run.for_actors())
    else:
        with mock.patch.object(environment_collector, "make_environments", return_value=environments):
            collector.prepare(run.for_actors())
    collector.begin(runtime, run.for_actors(), seed)
    collector.load(snapshot(0, weights or {}, plan))
    return collector


def snapshot(policy_version: int, weights: dict[str, np.ndarray], lessons: LessonPlan | None = None) -> Snapshot:
    """A snapshot of learner epoch 1."""
    return Snapshot(learner_epoch=1, policy_version=policy_version, program="", weights=weights, lessons=lessons)


def collect(collector: EnvironmentCollector) -> Rollout:
    """The collector's next rollout, which a learner must accept; its arrays are valid until the one after it."""
    rollout = collector.collect(IDENTITY)
    assert not (refused := episode_violation(rollout)), refused
    assert rollout.game_steps is None or rollout.game_steps <= 2 * rollout.agent_steps
    return rollout
