"""Hypothesis strategies for every kind of message."""

import inspect
from typing import Any, get_args

import numpy as np
from hypothesis import strategies as st
from wire_format import DTYPES, bits

from daedalus.protocol.league import (
    LeagueStatus,
    MatchCount,
    Matches,
    Plan,
    PlannedOpponent,
    PlannedRating,
    RatedPlayer,
    Score,
)
from daedalus.protocol.messages import (
    ActorsPage,
    ActorsReport,
    ActorStatus,
    ClientReport,
    CompactSnapshot,
    EvaluationReport,
    Event,
    EventsPage,
    EventsReport,
    Join,
    LeaguePlan,
    Message,
    MetricsPage,
    MetricsReport,
    Program,
    RefusedJoin,
    RunStatus,
    Snapshot,
    SnapshotPart,
    StatusReport,
    Welcome,
)
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import (
    CollectionSpec,
    EnvironmentSpec,
    EvaluationSpec,
    PolicySpec,
    RunSpec,
    ServiceSpec,
    TrainingSpec,
)
from daedalus.protocol.uploads import Gradient, Rollout, RolloutIdentity

text = st.text(max_size=20)
counters = st.integers(0, 2**63 - 1)
positive = st.integers(1, 10_000)
floats = st.floats(allow_nan=False, allow_infinity=False)
sizes = st.integers(1, 4)
generators = st.integers(0, 2**32).map(np.random.default_rng)
names = st.text("abcXYZ019_.-", min_size=1, max_size=64)
array_spaces = st.builds(
    ArraySpace,
    shape=st.lists(st.integers(1, 20), min_size=1, max_size=4).map(tuple),  # four of them have at most 64 MiB, stacked
    dtype=st.sampled_from(["float32", "uint8"]),
    frames=st.integers(1, 16),
)
discrete_spaces = st.builds(
    DiscreteSpace,
    counts=st.lists(st.integers(1, 16_384), min_size=1, max_size=4).map(tuple),
    masked=st.booleans(),
)
bounds = st.lists(
    st.tuples(st.none() | st.floats(-1e6, 0.0), st.none() | st.floats(0.5, 1e6)), min_size=1, max_size=5
).map(lambda pairs: tuple(zip(*pairs, strict=True)))
continuous_spaces = bounds.map(lambda pair: ContinuousSpace(low=pair[0], high=pair[1]))
spaces = st.builds(
    Spaces,
    observations=st.dictionaries(names, array_spaces | discrete_spaces, min_size=1, max_size=4),
    actions=st.dictionaries(names, discrete_spaces | continuous_spaces, min_size=1, max_size=4),
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | floats | text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=6,
)
run_specs = st.builds(
    RunSpec,
    environment=st.builds(
        EnvironmentSpec,
        id=st.sampled_from(["Any-v0", "ALE/Pong-v5", "my.module:Mine-v0", "ä"]),
        wrap=st.none() | st.just("my.module:wrap"),
        kwargs=st.dictionaries(text, json_values, max_size=3),
        max_episode_steps=st.none() | positive,
        action_table=st.none() | st.lists(st.tuples(floats, floats), min_size=2, max_size=3).map(tuple),
        crop=st.none() | st.tuples(*[st.integers(0, 99)] * 4),
        grey=st.booleans(),
        resize=st.none() | st.tuples(positive, positive),
        frame_stack=st.integers(1, 16) | st.dictionaries(names, st.integers(1, 16), max_size=3),
        reward_clip=st.none() | st.floats(0.1, 10),
        reward_scale=st.floats(1e-6, 1e6),
        bootstrap_terminations=st.booleans(),
    ),
    policy=st.builds(
        PolicySpec,
        encoder=st.sampled_from(["mlp", "nature", "impala", "article", "my.module:Encoder"]),
        hidden=st.lists(positive, max_size=8).map(tuple),
        memory=st.sampled_from(["none", "gru"]),
        activation=st.sampled_from(["tanh", "relu"]),
    ),
    collection=st.builds(CollectionSpec, actors=positive, window=st.integers(1, 64)),
    training=st.builds(
        TrainingSpec,
        algorithm=st.sampled_from(["a2c", "a3c", "impala", "appo"]),
        seed=st.integers(0, 2**32 - 1),
        target_return=st.none() | floats,
        discount_factor=st.floats(0, 1),
        learning_rate_final=st.none() | st.floats(0, 1),
    ),
    evaluation=st.builds(EvaluationSpec, seconds=st.none() | st.floats(0.1, 1e4)),
    service=st.builds(ServiceSpec, log_seconds=st.floats(0.01, 100)),
)
for of_kind, strategy in ((str, text), (int, counters), (float, floats)):
    st.register_type_strategy(of_kind, lambda _kind, strategy=strategy: strategy)


def inferred(kind: type, **chosen: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Return a strategy whose fields have the strategies of their types, unless others are chosen."""
    return st.builds(kind, **{**dict.fromkeys(inspect.signature(kind).parameters, ...), **chosen})


def few(content: st.SearchStrategy[Any]) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.lists(content, max_size=3).map(tuple)


players = st.text(min_size=1, max_size=20)
shares = st.floats(0, 1)
plans = st.builds(
    Plan,
    revision=counters,
    training=few(st.builds(PlannedOpponent, player=players, weight=shares)),
    rating=few(st.builds(PlannedRating, first=players, second=players, weight=shares)),
)
matches = st.builds(
    Matches,
    counts=few(
        st.builds(
            MatchCount,
            purpose=st.sampled_from(["training", "rating"]),
            first=players,
            second=players,
            side=st.integers(0, 9),
            wins=counters,
        )
    ),
)
league_statuses = st.builds(
    LeagueStatus,
    players=few(st.builds(RatedPlayer, player=players, rating=floats, deviation=floats, matches=counters)),
    scores=few(st.builds(Score, first=players, second=players, wins=floats)),
)
rejections = st.dictionaries(text, counters, max_size=3)
actor_statuses = inferred(ActorStatus, rollouts_rejected=rejections)
statuses = inferred(
    RunStatus,
    rollouts_rejected=rejections,
    problems=few(text),
    league=st.none() | league_statuses,
    refused_joins=few(inferred(RefusedJoin)),
    actors=few(actor_statuses),
)


@st.composite
def rollouts(draw: st.DrawFn) -> Rollout:
    random = draw(generators)
    rows, environments = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    episodes = draw(st.integers(0, rows * environments))
    dtype = draw(st.sampled_from(["<f4", "|u1"]))
    length, frame = draw(st.integers(rows + 1, rows + 4)), draw(st.lists(st.integers(1, 5), min_size=1, max_size=3))
    if draw(st.booleans()):  # with the environment axis first in memory, and so on the wire
        frames = bits(random, dtype, (environments, length, *frame)).swapaxes(0, 1)
    else:
        frames = bits(random, dtype, (length, environments, *frame))
    shape = (rows, environments)
    return Rollout(
        identity=draw(
            st.builds(RolloutIdentity, actor=text, incarnation=counters, sequence=counters, learner_epoch=counters)
        ),
        policy_version=draw(counters),
        frames=dict.fromkeys(draw(st.lists(names, min_size=1, max_size=3, unique=True)), frames),
        initial_state=bits(random, "<f4", (environments, draw(st.integers(0, 3)))),
        actions={
            name: bits(random, draw(st.sampled_from(["|u1", "<u2", "<i4", "<i8", "<f4"])), (*shape, draw(sizes)))
            for name in draw(st.lists(names, min_size=1, max_size=3, unique=True))
        },
        masks={
            name: bits(random, "|b1", (*shape, draw(sizes))) for name in draw(st.lists(names, max_size=2, unique=True))
        },
        behaviour_log_probs=bits(random, "<f4", shape),
        rewards=bits(random, "<f4", shape),
        terminated=bits(random, "|b1", shape),
        truncated=bits(random, "|b1", shape),
        valid=bits(random, "|b1", shape),
        episode_returns=bits(random, "<f4", (episodes,)),
        episode_lengths=bits(random, "<i4", (episodes,)),
        episode_info={
            name: bits(random, "<f4", (draw(st.integers(1, episodes)),))
            for name in (
                draw(st.lists(st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"), max_size=3)) if episodes else ()
            )
        },
        overridden=bits(random, "|b1", shape) if draw(st.booleans()) else None,
        taught=bits(random, "|b1", shape) if draw(st.booleans()) else None,
        matches=draw(st.none() | matches),
    )


@st.composite
def gradients(draw: st.DrawFn) -> Gradient:
    random, episodes = draw(generators), draw(st.integers(0, 4))
    shapes = st.lists(st.integers(0, 4), max_size=3).map(tuple)
    compact = draw(st.booleans())
    layout = draw(st.dictionaries(text, shapes, min_size=1, max_size=4))
    return Gradient(
        identity=draw(
            st.builds(RolloutIdentity, actor=text, incarnation=counters, sequence=counters, learner_epoch=counters)
        ),
        policy_version=draw(counters),
        gradient={
            name: bits(random, "|u1", (2, *shape)) if compact else bits(random, "<f4", shape)
            for name, shape in layout.items()
        },
        env_steps=draw(counters),
        metrics={name: bits(random, "<f4", ()) for name in draw(st.lists(text, max_size=3, unique=True))},
        moments={
            name: bits(random, "<f8", (2, *draw(shapes))) for name in draw(st.lists(text, max_size=3, unique=True))
        },
        action_counts={
            name: bits(random, "<i8", (draw(sizes),)) for name in draw(st.lists(text, max_size=3, unique=True))
        },
        episode_returns=bits(random, "<f4", (episodes,)),
        episode_lengths=bits(random, "<i4", (episodes,)),
    )


@st.composite
def evaluation_reports(draw: st.DrawFn) -> EvaluationReport:
    random, episodes = draw(generators), (draw(st.integers(1, 5)),)
    return EvaluationReport(
        evaluator=draw(text),
        learner_epoch=draw(counters),
        policy_version=draw(counters),
        returns=bits(random, "<f4", episodes),
        lengths=bits(random, "<i4", episodes),
    )


@st.composite
def snapshots(draw: st.DrawFn) -> Snapshot:
    random = draw(generators)
    shapes = st.lists(st.integers(0, 6), max_size=4).map(tuple)
    layout = draw(st.dictionaries(text, st.tuples(st.sampled_from(DTYPES), shapes), max_size=6))
    weights = {name: bits(random, dtype, shape) for name, (dtype, shape) in layout.items()}
    return Snapshot(learner_epoch=draw(counters), policy_version=draw(counters), program=draw(text), weights=weights)


@st.composite
def compact_snapshots(draw: st.DrawFn) -> CompactSnapshot:
    random = draw(generators)
    layout = draw(st.dictionaries(text, st.lists(st.integers(0, 6), max_size=4), max_size=6))
    weights = {name: bits(random, "|u1", (2, *shape)) for name, shape in layout.items()}
    return CompactSnapshot(
        learner_epoch=draw(counters),
        policy_version=draw(counters),
        program=draw(text),
        base_version=draw(st.none() | counters),
        weights=weights,
    )


@st.composite
def snapshot_parts(draw: st.DrawFn) -> SnapshotPart:
    parts = draw(st.integers(1, 2**60))
    return SnapshotPart(
        learner_epoch=draw(counters),
        policy_version=draw(counters),
        part=draw(st.integers(0, parts - 1)),
        parts=parts,
        data=np.frombuffer(draw(st.binary(max_size=300)), "|u1"),
    )


@st.composite
def metrics_reports(draw: st.DrawFn) -> MetricsReport:
    random, columns, rows = draw(generators), draw(st.lists(text, max_size=4)), draw(st.integers(0, 4))
    return MetricsReport(
        page=MetricsPage(run=draw(text), learner_epoch=draw(counters), columns=tuple(columns)),
        numbers=bits(random, "<i8", (rows,)),
        values=bits(random, "<f8", (rows, len(columns))),
    )


programs = st.binary(max_size=300).map(lambda data: np.frombuffer(data, "|u1"))
# Of messages whose values depend on each other, or whose types do not say them all.
_OWN: dict[type, st.SearchStrategy[Any]] = {
    Join: inferred(Join, spaces=st.none() | spaces, environments=st.integers(0, 4096)),
    Welcome: inferred(Welcome, epsilon=st.floats(0, 1), spec=run_specs.map(RunSpec.for_actors)),
    ClientReport: inferred(
        ClientReport,
        **dict.fromkeys(
            ("rollout_seconds", "waiting_seconds", "round_trip_seconds", "processor_share"), st.floats(0, 1e9)
        ),
    ),
    LeaguePlan: inferred(LeaguePlan, plan=plans),
    Program: inferred(Program, model=programs),
    Rollout: rollouts(),
    Gradient: gradients(),
    Snapshot: snapshots(),
    SnapshotPart: snapshot_parts(),
    CompactSnapshot: compact_snapshots(),
    EvaluationReport: evaluation_reports(),
    StatusReport: inferred(StatusReport, status=statuses),
    EventsReport: inferred(EventsReport, page=inferred(EventsPage, events=few(inferred(Event)))),
    ActorsReport: inferred(ActorsReport, page=inferred(ActorsPage, actors=few(actor_statuses))),
    MetricsReport: metrics_reports(),
}
KINDS = {kind: _OWN[kind] if kind in _OWN else inferred(kind) for kind in get_args(Message)}
messages = st.one_of(*KINDS.values())
