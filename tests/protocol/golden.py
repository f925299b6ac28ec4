"""One fixed message of every kind; their bytes are in golden/v11/, as the first version with such files wrote them.

Every later release reads them, and may write more fields. `PYTHONPATH=tests/protocol:tests:. python
tests/protocol/golden.py` writes them again, and adds those of new messages: once a release is tagged, its files stay.
"""

from pathlib import Path

import numpy as np

from daedalus.protocol.codec import FIRST_VERSION, encode
from daedalus.protocol.compact import bfloat16, planes
from daedalus.protocol.league import Plan, PlannedOpponent, PlannedRating
from daedalus.protocol.lessons import LessonPlan, LessonRange
from daedalus.protocol.messages import (
    Acknowledgement,
    ActorsPage,
    ActorsReport,
    ActorsRequest,
    ActorStatus,
    ClientReport,
    CompactSnapshot,
    EvaluationReport,
    EvaluationRequest,
    Event,
    EventsPage,
    EventsReport,
    EventsRequest,
    Join,
    LeaguePlan,
    LeagueRequest,
    Message,
    MetricsPage,
    MetricsReport,
    MetricsRequest,
    OrderRequest,
    Origin,
    Program,
    Refusal,
    RefusedJoin,
    RunEnded,
    RunStatus,
    Snapshot,
    SnapshotPart,
    SnapshotRequest,
    StatusReport,
    Welcome,
)
from daedalus.protocol.spaces import ArraySpace, ComponentOrder, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.uploads import Gradient, Rollout, RolloutIdentity

FOLDER = Path(__file__).parent / "golden"
_T, _E, _K = 3, 2, 4
_PIXELS = np.arange((_K + _T) * _E * 6 * 5, dtype=np.uint8).reshape(_E, _K + _T, 6, 5).swapaxes(0, 1)


def _rollout(frames: np.ndarray, overridden: np.ndarray | None = None) -> Rollout:
    cells, cells4 = np.arange(_T * _E).reshape(_T, _E), np.arange((_T + 1) * _E).reshape(_T + 1, _E)
    return Rollout(
        identity=RolloutIdentity(actor="wing-1", incarnation=2**61 + 1, sequence=7, learner_epoch=2**60 + 3),
        policy_version=41,
        frames={"camera": frames, "state.goal": np.stack([cells4 % 3, cells4 % 4], -1).astype(np.uint8)},
        initial_state=np.full((_E, 2), 0.25, np.float32),
        actions={
            "gripper": cells.astype(np.uint8)[..., None],
            "arm": np.stack([cells / 8, -cells / 4], -1).astype(np.float32),
        },
        masks={"gripper": np.arange(_T * _E * 6).reshape(_T, _E, 6) % 7 != 0},
        behaviour_log_probs=(-0.5 - cells).astype(np.float32),
        rewards=(cells / 4).astype(np.float32),
        terminated=cells == 2,
        truncated=cells == 3,
        valid=cells != 4,
        episode_returns=np.array([1.5, -2.0], np.float32),
        episode_lengths=np.array([12, 9], np.int32),
        episode_info={"distance": np.array([3.5], np.float32), "goals": np.array([0.0, 2.0], np.float32)},
        overridden=overridden,
    )


def _gradient(gradient: dict[str, np.ndarray]) -> Gradient:
    return Gradient(
        identity=RolloutIdentity(actor="wing-1", incarnation=2**61 + 1, sequence=7, learner_epoch=2**60 + 3),
        policy_version=41,
        gradient=gradient,
        env_steps=5,
        metrics={"policy_loss": np.array(-0.5, np.float32), "rho_mean": np.array(1.0, np.float32)},
        moments={"observations/state": np.array([[0.1, 2.0], [3.5, 0.0]]), "returns": np.array([1.5, 0.25])},
        action_counts={"gripper": np.array([2, 3], np.int64)},
        episode_returns=np.array([1.5, -2.0], np.float32),
        episode_lengths=np.array([12, 9], np.int32),
        episode_info={"goals": np.array([0.0, 2.0], np.float32)},
    )


_ORIGIN = Origin(host="arm-box", software="daedalus-rl 1.2.3", address="tcp/10.0.0.7:43092")
_ACTOR = ActorStatus(
    actor="wing-1",
    host="arm-box",
    software="daedalus-rl 1.2.3",
    address="tcp/10.0.0.7:43092",
    alive=True,
    quarantined="",
    lives=2,
    seconds_since_seen=0.25,
    environments=2,
    epsilon=0.125,
    env_steps=100,
    env_steps_per_second=50.5,
    rollouts_accepted=8,
    rollouts_rejected={"stale": 2},
    rollouts_missed=1,
    busy_answers=3,
    policy_lag=1,
    compact_snapshots=True,
    bytes_up_per_hour=7200.5,
    bytes_down_per_hour=1.5,
    deadlines=600,
    missed_deadlines=2,
    overridden_actions=5,
    safe_actions=40,
    rollouts_dropped=1,
    safe_reason="the learner did not confirm the policy within 30 s",
    rows=700,
    rollout_seconds=12.5,
    waiting_seconds=0.25,
    round_trip_seconds=0.125,
    silence_limit_seconds=75.0,
)

MESSAGES: dict[str, Message] = {
    "join": Join(
        actor="wing-1",
        incarnation=5,
        spaces=Spaces(
            observations={
                "camera": ArraySpace(shape=(6, 5), dtype="uint8", frames=4),
                "state.goal": DiscreteSpace(counts=(3, 4)),
            },
            actions={
                "gripper": DiscreteSpace(counts=(6,), masked=True),
                "arm": ContinuousSpace(low=(-1.0, None), high=(1.0, None)),
            },
        ),
        environments=2,
        origin=_ORIGIN,
    ),
    "join_asking": Join(actor="wing-1", incarnation=5),
    "join_failed": Join(actor="wing-1", incarnation=5, origin=_ORIGIN, failure="module 'corridor' is not installed"),
    "welcome": Welcome(
        run="r",
        learner_epoch=9,
        software="daedalus-rl 1.2.3",
        seed=3,
        epsilon=0.125,
        order=ComponentOrder(observations=(1, 0), actions=(0,)),
        spec=RunSpec(
            environment=EnvironmentSpec(id="CartPole-v1", kwargs={"a": 1}, training_kwargs={"b": 2.5})
        ).for_actors(),
    ),
    "refusal": Refusal(code="mismatch", reason="other spaces", software="daedalus-rl 1.2.3"),
    "program": Program(hash="0" * 64, model=np.zeros(400, np.uint8)),
    "rollout_numbers": _rollout(np.linspace(-1, 1, (_T + 1) * _E * 4, dtype=np.float32).reshape(_T + 1, _E, 4)),
    "rollout_pixels": _rollout(_PIXELS, np.arange(_T * _E).reshape(_T, _E) == 5),
    "gradient_float32": _gradient({"body.weight": np.eye(3, dtype=np.float32), "body.bias": np.ones(3, np.float32)}),
    "gradient_compact": _gradient(planes(bfloat16({"body.weight": 1.01 * np.eye(3, dtype=np.float32)}), None)),
    "acknowledgement": Acknowledgement(verdict="rejected", reason="policy lag 40", policy_version=81),
    "snapshot": Snapshot(
        learner_epoch=9,
        policy_version=41,
        program="0" * 64,
        weights={"body.weight": np.eye(3, dtype=np.float32), "body.bias": np.zeros(3, np.float32)},
    ),
    "snapshot_request": SnapshotRequest(actor="wing-1", held_version=33, policy_version=41, part=2),
    "snapshot_request_first": SnapshotRequest(actor="wing-1", held_version=None),
    "snapshot_request_whole": SnapshotRequest(actor="wing-1", held_version=40, compact=False),
    "snapshot_lessons": Snapshot(
        learner_epoch=2**60 + 3,
        policy_version=41,
        program="ab" * 32,
        weights={"layer.weight": np.array([[1.5, -2.0]], np.float32)},
        lessons=LessonPlan(
            ranges={
                "gravity": (
                    LessonRange(low=5.5, high=9.75, weight=0.25),
                    LessonRange(low=9.75, high=14.0, weight=0.75),
                ),
                "goals": (LessonRange(low=2.0, high=2.0),),
            }
        ),
    ),
    "league_request": LeagueRequest(actor="wing-1", held_revision=4),
    "league_request_player": LeagueRequest(actor="wing-1", player="v33"),
    "league_plan": LeaguePlan(
        learner_epoch=7,
        plan=Plan(
            revision=5,
            training=(PlannedOpponent(player="v33", weight=0.5), PlannedOpponent(player="my_bots:Greedy", weight=0.5)),
            rating=(PlannedRating(first="newest", second="random", weight=1.0),),
        ),
    ),
    "snapshot_part": SnapshotPart(
        learner_epoch=9, policy_version=41, part=2, parts=3, data=np.arange(11, dtype=np.uint8)
    ),
    "compact_snapshot": CompactSnapshot(
        learner_epoch=9,
        policy_version=41,
        program="0" * 64,
        base_version=33,
        weights=planes(
            bfloat16({"body.weight": 1.01 * np.eye(3, dtype=np.float32), "body.bias": np.zeros(3, np.float32)}),
            bfloat16({"body.weight": np.eye(3, dtype=np.float32), "body.bias": np.ones(3, np.float32)}),
        ),
    ),
    "client_report": ClientReport(
        actor="wing-1",
        incarnation=5,
        deadlines=600,
        missed_deadlines=2,
        overridden_actions=5,
        safe_actions=40,
        rollouts_dropped=1,
        safe_reason="the learner did not confirm the policy within 30 s",
        rows=700,
        rollout_seconds=12.5,
        waiting_seconds=0.25,
        round_trip_seconds=0.125,
    ),
    "evaluation_request": EvaluationRequest(evaluator="judge"),
    "evaluation_report": EvaluationReport(
        evaluator="judge",
        learner_epoch=9,
        policy_version=41,
        returns=np.array([1.0, 2.5], np.float32),
        lengths=np.array([10, 20], np.int32),
    ),
    "run_ended": RunEnded(learner_epoch=9, outcome="finished", reason="the learner has finished"),
    "status_report": StatusReport(
        status=RunStatus(
            run="r",
            learner_epoch=9,
            algorithm="impala",
            environment="CartPole-v1",
            problems=("no update for 61 s",),
            uptime_seconds=1.5,
            env_steps=100,
            env_steps_budget=1000,
            updates=10,
            updates_skipped=1,
            episode_return_mean=None,
            env_steps_per_second=50.5,
            updates_per_second=5.5,
            policy_lag_mean=1.5,
            queue_bytes=0,
            queue_bytes_limit=2**26,
            checkpoint_age_seconds=None,
            certificate_days_left=600.5,
            rollouts_accepted=8,
            rollouts_rejected={"stale": 2, "unfit": 1},
            rollouts_missed=1,
            busy_answers=3,
            actors_alive=1,
            actors_quarantined=2,
            actors_gone=3,
            refused_joins=(
                RefusedJoin(
                    actor="wing-2",
                    host="arm-box",
                    software="daedalus-rl 1.2.2",
                    reason="the other end uses protocol version 5",
                    count=4,
                    seconds_since_last=1.5,
                ),
            ),
            actors=(_ACTOR,),
            software="daedalus-rl 1.2.3",
        )
    ),
    "events_request": EventsRequest(),
    "events_report": EventsReport(
        page=EventsPage(
            run="r",
            learner_epoch=9,
            events=(
                Event(time="2026-11-22T13:16:45.123Z", kind="joined", actor="wing-1", text="joined", count=1),
                Event(time="2026-11-22T13:17:45.123Z", kind="checkpoint", actor="", text="checkpoint saved", count=2),
            ),
        )
    ),
    "actors_request": ActorsRequest(after="wing-0"),
    "actors_report": ActorsReport(page=ActorsPage(learner_epoch=9, actors=(_ACTOR,))),
    "metrics_request": MetricsRequest(first=4),
    "metrics_report": MetricsReport(
        page=MetricsPage(run="r", learner_epoch=9, columns=("env_steps", "entropy")),
        numbers=np.array([4, 6], np.int64),
        values=np.array([[128.0, 0.5], [256.0, -0.25]]),
    ),
    "order_request": OrderRequest(
        order="drain", run="r", learner_epoch=9, number=7, actor="wing-1", host="laptop", token="operator alice"
    ),
}


def path(name: str, version: int = FIRST_VERSION) -> Path:
    """Return the file with the bytes of a message."""
    return FOLDER / f"v{version}" / f"{name}.bin"


if __name__ == "__main__":
    for name, message in MESSAGES.items():
        path(name).parent.mkdir(parents=True, exist_ok=True)
        path(name).write_bytes(encode(message))
