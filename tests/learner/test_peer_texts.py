"""Texts of peers: the learner bounds them where they enter its state; its memory and its messages stay small."""

from dataclasses import replace
from itertools import combinations

import pytest
from building import ENVIRONMENTS, EPOCH, SPACES, identity, joined_fleet, make_rollout, run_context, run_spec

from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import JoinResponses, page, totals
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.league import LeagueStatus, RatedPlayer, Score
from daedalus.protocol.limits import STATUS_LIMITS, Limits
from daedalus.protocol.messages import (
    PAGE_ACTORS,
    ActorsPage,
    ActorsReport,
    ClientReport,
    Join,
    Origin,
    Refusal,
    RunStatus,
    StatusReport,
)
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

FACE = "\U0001f600"  # four bytes in UTF-8
ORIGIN = Origin(host=FACE * 64, software=FACE * 64, address=FACE * 64)
CAUSES = ("malformed", "unfit", "duplicate", "stale", "surplus", "quarantined", "epoch", "unknown_actor", "non_finite")


def quarantine(fleet: Fleet, name: str, component: str) -> str:
    """Let an actor send rollouts with a component of this name until it is quarantined; return the reason it gets."""
    judge = RolloutJudge(run_spec(), EPOCH, fleet)
    verdict = None
    for sequence in range(3):
        rollout = make_rollout(identity(name, sequence))
        data = encode(replace(rollout, frames={component: rollout.frames["observation"]}))
        verdict = judge.decide(name, judge.read(name, data), 0, 1.0)
    assert isinstance(verdict, Rejected)
    assert fleet.actors[name].quarantined
    return verdict.reason


def test_the_reason_of_a_quarantine_is_bounded_and_printable() -> None:
    fleet = joined_fleet("a")
    reason = quarantine(fleet, "a", "\x1b[2J\n" + "x" * 200_000)
    assert reason == fleet.actors["a"].quarantined
    assert len(reason.encode()) <= 300
    assert reason.isprintable()
    assert reason.startswith("3 unfit rollouts in a row, the last: frames has the components [2J x")
    assert reason.endswith(", expected observation")
    fleet.set_present("a", 1, False, 1.0)
    fleet.forget_absent(100.0)
    assert fleet._former["a", 1].quarantined == reason


def _largest_league(name: str = FACE * 196) -> LeagueStatus:
    players = ("newest", *(f"v{number}" for number in range(256)), *(f"{name}{number:02d}" for number in range(64)))
    return LeagueStatus(
        players=tuple(RatedPlayer(player=each, rating=1.5, deviation=1.5, matches=2**53) for each in players),
        scores=tuple(Score(first=one, second=other, wins=1.5) for one, other in combinations(players, 2)),
    )


def test_a_league_is_bounded_to_what_a_person_can_read() -> None:
    shown = _largest_league("bot").bounded()
    names = [each.player for each in shown.players]
    assert names[:3] == ["newest", "v0", "v23"]
    assert names[12:14] == ["v255", "bot00"]
    assert (len(names), len(shown.scores), shown.left_out) == (24, 24 * 23 // 2, 1 + 256 + 64 - 24)
    few = LeagueStatus(players=shown.players[:13])
    assert few.bounded() == few


def test_the_largest_status_is_within_the_limits_of_its_readers() -> None:
    names = [f"a.{number:02d}".ljust(64, "x") for number in range(PAGE_ACTORS)]
    context = run_context()
    fleet, responses = context.fleet, JoinResponses(context)
    for name in names:
        join = Join(actor=name, incarnation=1, spaces=SPACES, environments=ENVIRONMENTS, origin=ORIGIN)
        responses.join(name, encode(join), 0.0)
        responses.report(name, encode(ClientReport(actor=name, incarnation=1, safe_reason=FACE * 300)), 1.0)
        quarantine(fleet, name, FACE * 3000)
        fleet.actors[name].rejected.update(dict.fromkeys(CAUSES, 2**40))
    for number in range(40):
        name, origin = f"b.{number:02d}".ljust(64, "x"), replace(ORIGIN, host=f"{number}{FACE * 64}")
        failed = Join(actor=name, incarnation=1, origin=origin, failure=FACE * 300)
        responses.join(name, encode(failed), 0.0)
    actors = page(fleet, "", 1.0)
    assert (len(actors), len(fleet.refused_joins.report(1.0))) == (PAGE_ACTORS, 32)
    status = RunStatus(
        **dict.fromkeys(("run", "algorithm", "environment"), "x" * 200),
        **dict.fromkeys(("learner_epoch", "env_steps", "env_steps_budget", "updates", "updates_skipped"), 2**53),
        **dict.fromkeys(("queue_bytes", "queue_bytes_limit", "rollouts_accepted"), 2**53),
        **dict.fromkeys(("uptime_seconds", "env_steps_per_second", "updates_per_second", "policy_lag_mean"), 1.5),
        **dict.fromkeys(("episode_return_mean", "checkpoint_age_seconds", "certificate_days_left"), 1.5),
        problems=(),
        rollouts_rejected=dict.fromkeys(CAUSES, 2**53),
        refused_joins=fleet.refused_joins.report(1.0),
        actors=actors,
        league=_largest_league().bounded(),
        **totals(fleet),
    )
    for message in (
        StatusReport(status=status),
        ActorsReport(page=ActorsPage(learner_epoch=EPOCH, actors=actors)),
    ):
        assert type(decode(encode(message), STATUS_LIMITS)) is type(message)


@pytest.mark.parametrize("name", ["\x01" * 65_000, FACE * 16_000])
def test_a_refusal_that_names_a_peer_is_small(name: str) -> None:
    """A name can have the 64 KiB of a key, and as a literal four times as many."""
    context = run_context(spaces=None)
    responses = JoinResponses(context)
    for answer in (
        responses.join(name, encode(Join(actor=name, incarnation=1)), 0.0),
        responses.join(name, encode(Join(actor="a", incarnation=1)), 0.0),
        responses.join("a", encode(Join(actor=name, incarnation=1)), 0.0),
        responses.report(name, encode(ClientReport(actor="a", incarnation=1)), 1.0),
        SnapshotPublisher(context, MemoryTransport(MemoryNetwork())).program(name),
    ):
        refusal = decode(answer, Limits(max_header_bytes=2048))
        assert isinstance(refusal, Refusal)
