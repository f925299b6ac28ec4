"""An actor of a game asks for its opponents, and plays on without an answer."""

import queue
import time
from dataclasses import replace
from typing import Any

import pytest
from processes import LIMIT
from scripted_learner import Policy, RunningActor, ScriptedLearner, acknowledge

from daedalus.actor.environments.make import make_environments
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.league import Plan, PlannedOpponent, PlannedRating
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import LeaguePlan, LeagueRequest, Refusal, Snapshot
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork

SPEC = RunSpec.model_validate(
    {
        "environment": {"id": "pettingzoo.classic.rps_v2"},
        "collection": {"envs_per_actor": 4, "rollout_length": 40, "window": 2},
        "policy": {"hidden": [8]},
        "league": {"past_share": 0.5, "rating_share": 0.2},
    }
)


def policy() -> Policy:
    """Return a policy for the game."""
    environments = make_environments(SPEC.environment, 1)
    environments.close()
    return Policy.of(PolicySpec(hidden=(8,)), environments.spaces)


class League(ScriptedLearner):
    """A learner that leaves every question about opponents to the test."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.asked: queue.Queue[tuple[LeagueRequest, Request]] = queue.Queue()
        super().__init__(network, SPEC, policy=policy())

    def _newest(self, request: Request) -> None:
        message = decode(request.payload, Limits()) if request.size else None
        if isinstance(message, LeagueRequest):
            self.asked.put((message, request))
        else:
            super()._newest(request)

    def answer(self, message: Any) -> LeagueRequest:
        """Answer the next question, which comes between two rollouts, and return it."""
        deadline = time.monotonic() + LIMIT
        while self.asked.empty():
            assert time.monotonic() < deadline
            self.play()
        asked, request = self.asked.get()
        request.reply(message if isinstance(message, bytes) else encode(message))
        return asked

    def play(self, rollouts: int = 1) -> set[tuple[str, str, str]]:
        """Take some rollouts, and return who played whom in them."""
        found = set()
        for _ in range(rollouts):
            rollout, request = self.receive()
            acknowledge(request, "accepted")
            counts = rollout.matches.counts if rollout.matches is not None else ()
            found |= {(each.purpose, each.first, each.second) for each in counts}
        return found

    def play_until(self, wanted: tuple[str, str, str]) -> None:
        """Take rollouts until two players have met."""
        deadline = time.monotonic() + LIMIT
        while wanted not in self.play():
            assert time.monotonic() < deadline


def plan(revision: int, *opponents: str, rating: tuple[str, str] = ("newest", "random")) -> LeaguePlan:
    """Return a plan with equal weights."""
    training = tuple(PlannedOpponent(player=name, weight=0.5) for name in opponents)
    return LeaguePlan(
        learner_epoch=1,
        plan=Plan(
            revision=revision,
            training=training,
            rating=(PlannedRating(first=rating[0], second=rating[1], weight=1.0),),
        ),
    )


def test_an_actor_asks_whom_to_play_and_for_their_policies() -> None:
    network = MemoryNetwork()
    learner = League(network)
    learner.publish(5)
    actor = RunningActor(network)
    try:
        assert learner.play(3) == set()  # the newest policy plays alone while there is no answer
        assert learner.answer(plan(1, "v3")) == LeagueRequest(actor="a")
        learner.play_until(("rating", "newest", "random"))
        assert learner.answer(learner.snapshot) == LeagueRequest(actor="a", player="v3")
        learner.play_until(("training", "newest", "v3"))
        assert learner.answer(plan(2, "v4", rating=("v4", "v3"))) == LeagueRequest(actor="a", held_revision=1)
        learner.play(2)
        refused = Refusal(code="unknown", reason="v4 is not kept any more")
        assert learner.answer(refused) == LeagueRequest(actor="a", player="v4")
        learner.play(3)
        # It is not asked for again until there is another plan, which may have changed.
        assert learner.answer(plan(3, "random")) == LeagueRequest(actor="a", held_revision=2)
        learner.play_until(("training", "newest", "random"))
    finally:
        actor.end()


@pytest.mark.parametrize("damage", [b"no message", encode(Refusal(code="malformed", reason="an older release"))])
def test_an_answer_that_is_no_plan_does_not_end_the_actor(damage: bytes) -> None:
    network = MemoryNetwork()
    learner = League(network)
    learner.publish(5)
    actor = RunningActor(network)
    try:
        learner.play(2)
        learner.answer(damage)
        assert learner.play(5) == set()
    finally:
        actor.end()


def test_a_policy_of_another_shape_does_not_play() -> None:
    network = MemoryNetwork()
    learner = League(network)
    learner.publish(5)
    good = learner.snapshot
    actor = RunningActor(network)
    try:
        learner.play(2)
        learner.answer(plan(1, "v3"))
        learner.play(2)
        message = decode(good, Limits())
        assert isinstance(message, Snapshot)
        other = replace(message, weights={name: array[:1] for name, array in message.weights.items()})
        assert learner.answer(other).player == "v3"
        assert ("training", "newest", "v3") not in learner.play(5)
    finally:
        actor.end()
