"""The session engine in given time: joining, silence, the link, the choice of snapshots. No test here waits."""

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from log_lines import LINES
from plain import vector_spaces

from daedalus.actor.errors import ActorRefusedError, NameInUseError, NoLearnerError
from daedalus.actor.session.actor_config import ActorConfig, LinkChoice
from daedalus.actor.session.conversation import (
    Ask,
    DeclarePresence,
    Query,
    Reopen,
    RunOverError,
    Subscribe,
    Unsubscribe,
    Wait,
    Work,
)
from daedalus.actor.session.session_engine import ActorSession, Begin, Collect, Encode, Load, Prepare
from daedalus.learner.serving.snapshot_publisher import CompactSnapshotCache
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    ClientReport,
    Join,
    Message,
    Program,
    Refusal,
    RunEnded,
    Snapshot,
    SnapshotRequest,
    new_epoch,
    program_hash,
)
from daedalus.protocol.messages import Welcome as WelcomeMessage
from daedalus.protocol.spec import RunSpec

SPACES = vector_spaces(4, 2)
SPEC = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}, "collection": {"window": 2}})
PROGRAM = b"program"


def welcome(run: str = "r", epoch: int = 1, spec: RunSpec = SPEC) -> WelcomeMessage:
    return WelcomeMessage(run=run, learner_epoch=epoch, seed=1, spec=spec.for_actors())


class PlayedSession:
    """The session of an actor `a`, and the learners that it meets.

    Attributes:
      learners: answers to a request to join, by run.
      silent: nobody answers a query, which then takes the whole time it waits.
      seconds: how long each kind of action takes, by its type.
      performed: all actions so far, besides Work.
    """

    def __init__(self, config: ActorConfig | None = None, *, weights: int = 8) -> None:
        self.session = ActorSession(config or ActorConfig(name="a", incarnation=7))
        self.learners: dict[str, list[Message]] = {"r": [welcome()]}
        self.seconds: dict[type, float] = {}
        self.silent = False
        self.performed: list[Any] = []
        self.now = 1000.0
        self.verdict: Any = "accepted"  # of each rollout; None: there is no answer
        self.version = 0
        self._weights = {"w": np.zeros(weights, np.float32)}
        self._compact = CompactSnapshotCache(1)
        self._steps, self._came = self.session.play(), None

    def of(self, kind: type[Any]) -> list[Any]:
        """Return the actions of a kind."""
        return [action for action in self.performed if isinstance(action, kind)]

    def requests(self, kind: type[Any]) -> list[Any]:
        """Return the messages of a kind that were sent as queries."""
        payloads = [action.payload for action in self.performed if isinstance(action, Ask | Query)]
        messages = [decode(payload, Limits()) for payload in payloads if payload not in (b"", b"rollout")]
        return [message for message in messages if isinstance(message, kind)]

    def go(self, is_over: Callable[[], bool], steps: int = 2000) -> None:
        """Let the session go on until something holds. Raises what the session raises."""
        for _ in range(steps):
            self.session.now = self.now
            action = self._steps.send(self._came)
            self._act()
            if not isinstance(action, Work):
                self.performed.append(action)
            self.now += self.seconds.get(type(action), 0.001)
            self._came = self._come_of(action)
            if is_over():
                return
        raise AssertionError(f"not within {steps} steps; the last: {self.performed[-5:]}")

    def event(self, event: Callable[..., None], *arguments: Any) -> None:
        self.session.now = self.now
        event(*arguments)
        self._act()

    def _act(self) -> None:
        while actions := self.session.take_actions():
            for action in actions:
                self.performed.append(action)
                if isinstance(action, Query):
                    self._answer(action)

    def _answer(self, query: Query) -> None:
        answer: Message | bytes | None = None
        if "/rollouts/" in query.key:
            if self.verdict is None:
                return
            answer = Acknowledgement(verdict=self.verdict, policy_version=self.version)
        elif query.key == keys.snapshots(self.session.run):
            request = decode(query.payload, Limits())
            assert isinstance(request, SnapshotRequest)
            newest = encode(self.snapshot())
            answer = self._compact.answer(request, newest) if request.compact else newest
        data = answer if isinstance(answer, bytes) or answer is None else encode(answer)
        query.on_answer(data, self.now)

    def snapshot(self) -> Snapshot:
        return Snapshot(
            learner_epoch=self.session.learner_epoch,
            policy_version=self.version,
            program=program_hash(PROGRAM),
            weights=self._weights,
        )

    def _come_of(self, action: Any) -> Any:
        match action:
            case Ask() if self.silent:
                self.now += action.timeout
                return []
            case Ask(key):
                return [encode(message) for message in self._answers(key, action.payload)]
            case Wait(until):
                assert until is None or until < self.now + 100.0
                self.now = max(self.now, until or 0.0)
            case Work(call):
                return call()
            case Prepare():
                return SPACES, 2
            case Collect():
                return object()
            case Encode():
                return b"rollout"
            case _:
                assert isinstance(action, Load | Begin | Reopen)
        return None

    def _answers(self, key: str, payload: bytes) -> list[Message]:
        if "/program/" in key:
            return [Program.of(PROGRAM)]
        if key == keys.snapshots(self.session.run):
            return [self.snapshot()]
        assert isinstance(decode(payload, Limits()), Join)
        return [answer for run, there in self.learners.items() for answer in there if keys_match(key, run)]


def keys_match(key: str, run: str) -> bool:
    return key in (keys.join(run, "a"), keys.join(keys.ANY_RUN, "a"))


def refusal(code: Any) -> list[Message]:
    return [Refusal(code=code, reason="why")]


def rollouts(played: PlayedSession) -> list[Query]:
    return [query for query in played.of(Query) if "/rollouts/" in query.key]


def test_engine_has_no_threads_no_clock_and_no_transport() -> None:
    code = """
import sys
import daedalus.actor.session.session_engine as engine
for name in ("actor_config", "conversation", "session_engine", "snapshots", "uploading"):
    module = sys.modules["daedalus.actor.session." + name]
    used = {getattr(value, "__name__", "") for value in vars(module).values()}
    assert not used & {"threading", "time", "queue", "asyncio", "random", "SessionThread"}, (name, used)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


# ----------------------------------------------------------------------------------------------------- joining


def test_session_is_reopened_every_five_seconds_without_an_answer() -> None:
    played = PlayedSession()
    played.learners.clear()
    played.go(lambda: len(played.of(Reopen)) == 3)
    assert 1015.0 < played.now < 1020.0
    played.learners["r"] = [welcome()]
    played.go(lambda: bool(rollouts(played)))


@pytest.mark.parametrize(("leaves", "seconds"), [(True, 2.0), (False, 5.0)])
def test_newer_of_two_learners_is_joined_once_the_older_has_left_or_after_five_seconds(
    leaves: bool, seconds: float
) -> None:
    older, newer = welcome(epoch=new_epoch(1)), welcome(epoch=new_epoch(2))
    played = PlayedSession()
    played.learners["r"] = [older, newer]
    if leaves:
        played.go(lambda: played.now >= 1002.0)
        played.learners["r"] = [newer]
    played.go(lambda: bool(played.of(DeclarePresence)))
    assert played.session.learner_epoch == newer.learner_epoch
    assert played.now == pytest.approx(1000.0 + seconds, abs=1.1)
    assert any(line.startswith("2 learners of run 'r' answer") for line in LINES)
    assert "waiting for the older learner to step down" in LINES


def test_name_in_use_is_waited_for() -> None:
    played = PlayedSession()
    played.learners["r"] = refusal("name_taken")
    with pytest.raises(NameInUseError):
        played.go(lambda: False)
    assert 1010.0 < played.now < 1012.0


@pytest.mark.parametrize("waits", [False, True])
def test_time_to_look_for_a_learner(waits: bool) -> None:
    played = PlayedSession(ActorConfig(name="a", incarnation=7, timeout=30.0, waits_for_return=waits))
    played.go(lambda: bool(rollouts(played)))
    played.learners.clear()
    played.event(played.session.presence_changed, False)
    began = played.now
    if waits:
        played.go(lambda: played.now > began + 100.0)
        return
    with pytest.raises(NoLearnerError, match="no learner answered within 30 s"):
        played.go(lambda: False)
    assert began + 30.0 < played.now < began + 32.0


@pytest.mark.parametrize("run", [keys.ANY_RUN, "r"])
def test_time_to_look_for_a_learner_holds_where_queries_get_no_answer(run: str) -> None:
    """It begins before there is a connection; each query waits 5 s."""
    config = ActorConfig(name="a", incarnation=7, run=run, timeout=8.0, searched_since=998.0)
    played = PlayedSession(config)
    played.silent = True
    with pytest.raises(NoLearnerError, match="no learner answered within 8 s"):
        played.go(lambda: False)
    assert 1006.0 < played.now <= 1007.1


@pytest.mark.parametrize("any_run", [False, True])
def test_actor_stays_with_the_run_that_it_joined_first_unless_told_otherwise(any_run: bool) -> None:
    played = PlayedSession(ActorConfig(name="a", incarnation=7, any_run=any_run))
    played.learners = {"first": [welcome("first")]}
    played.go(lambda: bool(rollouts(played)))
    played.learners = {"other": [welcome("other", epoch=2)]}
    played.event(played.session.presence_changed, False)
    if any_run:
        played.go(lambda: rollouts(played)[-1].key == keys.rollouts("other", "a"))
        return
    played.go(lambda: "waiting for a learner of run 'first'; the runs here are 'other'" in LINES)
    played.learners["first"] = [welcome("first", epoch=3)]
    played.go(lambda: played.session.learner_epoch == 3)


# ----------------------------------------------------------------------------------------- silence and the end


def test_silent_learner_is_probed_and_joined_again_if_it_does_not_respond() -> None:
    played = PlayedSession()
    played.verdict = None
    played.go(lambda: len(rollouts(played)) == 2)
    joins = len(played.requests(Join))
    played.go(lambda: len(played.requests(Join)) == joins + 3)
    assert all(join.spaces is None for join in played.requests(Join)[joins:])
    assert played.now == pytest.approx(1030.0, abs=1.0)  # it answers each probe: it is only slow
    assert not any("went away" in line for line in LINES)
    played.learners.clear()
    played.go(lambda: any("went away" in line for line in LINES))
    played.learners["r"] = [welcome()]
    sent = len(rollouts(played))
    played.go(lambda: len(rollouts(played)) == sent + 2)  # the same again
    assert len(played.of(Collect)) == 2


def test_actor_that_is_asked_to_leave_finishes_its_rollout_and_awaits_the_verdicts() -> None:
    played = PlayedSession()
    played.seconds[Collect] = 3.0
    played.go(lambda: len(rollouts(played)) == 2)
    played.event(played.session.leave, played.now + 30.0)
    with pytest.raises(RunOverError, match=r"^asked by a signal to leave: no rollout is lost$") as over:
        played.go(lambda: False)
    assert not over.value.finished
    assert len(played.of(Collect)) == len(rollouts(played)) <= 3  # none was begun since
    played = PlayedSession()
    played.verdict = None
    played.go(lambda: len(rollouts(played)) == 2)
    leave_by = played.now + 30.0
    played.event(played.session.leave, leave_by)
    with pytest.raises(RunOverError, match=r"leave: 2 uploaded rollouts had no verdict yet, and may be lost$"):
        played.go(lambda: False)
    assert played.now == pytest.approx(leave_by, abs=1.0)
    played = PlayedSession()
    played.verdict = None
    played.go(lambda: len(rollouts(played)) == 1)  # there is room for another
    played.event(played.session.leave, played.now + 30.0)
    with pytest.raises(RunOverError, match="leave: 1 uploaded rollouts"):
        played.go(lambda: False)


def test_actor_that_is_asked_to_leave_drops_a_rollout_that_takes_too_long_and_says_so() -> None:
    played = PlayedSession()
    played.go(lambda: bool(played.of(Collect)))
    session = played.session
    for _ in range(58):  # 57 rows, and another has begun
        session.begin_row(played.now)
    played.event(session.leave, played.now + 30.0)
    played.event(session.check_over)
    played.now += 24.9
    played.event(session.check_over)
    played.now += 0.2  # too late to upload what the next row completes
    with pytest.raises(RunOverError, match=r"the rollout under way is lost \(57 rows in each environment\)$"):
        played.event(session.check_over)


def test_actor_that_is_drained_while_it_sends_nothing_ends() -> None:
    """Because it waits for the other actors of a2c."""
    played = PlayedSession()
    played.verdict = None
    played.go(lambda: len(rollouts(played)) == 2)
    played.learners["r"] = refusal("drained")
    with pytest.raises(RunOverError, match=r"^why: this actor leaves the run$"):
        played.go(lambda: False)


@pytest.mark.parametrize("verdict", ["quarantined", "finished", "drained"])
def test_verdict_ends_a_rollout_that_is_being_collected(verdict: str) -> None:
    played = PlayedSession()
    played.verdict = None
    played.go(lambda: len(played.of(Collect)) == 2)
    answer = encode(Acknowledgement(verdict=verdict, reason="why"))  # type: ignore[arg-type] - one of its literals
    played.event(rollouts(played)[0].on_answer, answer, played.now)
    with pytest.raises(ActorRefusedError if verdict == "quarantined" else RunOverError):
        played.session.check_over()


@pytest.mark.parametrize(("starts", "is_over"), [(1, False), (2, True), (3, True)])
def test_only_an_older_learner_cannot_say_that_the_run_is_over(starts: int, is_over: bool) -> None:
    """Two processes that resumed from the same checkpoint differ in random bits only: either may end the run."""
    played = PlayedSession()
    played.learners["r"] = [welcome(epoch=new_epoch(2))]
    played.go(lambda: bool(rollouts(played)))
    ended = RunEnded(learner_epoch=new_epoch(starts), outcome="finished", reason="solved")
    played.event(played.session.received, keys.run_end("r"), encode(ended))
    if is_over:
        with pytest.raises(RunOverError, match="the run is over: solved"):
            played.go(lambda: False)
    else:
        sent = len(rollouts(played))
        played.go(lambda: len(rollouts(played)) > sent + 3)


# -------------------------------------------------------------------------------------------------- snapshots


def test_actor_on_a_slow_link_subscribes_to_no_snapshots() -> None:
    played = PlayedSession()
    played.seconds[Ask] = 0.3
    played.go(lambda: bool(rollouts(played)))
    assert any(line.startswith("slow link: ") for line in LINES)
    assert played.of(Subscribe) == [Subscribe(keys.run_end("r"))]
    assert all(request.compact for request in played.requests(SnapshotRequest))


def test_snapshots_are_pushed_until_the_first_has_come_and_fetched_then() -> None:
    played = PlayedSession()
    played.go(lambda: len(rollouts(played)) > 20)
    requests = played.requests(SnapshotRequest)
    assert requests
    assert not any(request.compact for request in requests)
    assert not played.of(Unsubscribe)  # the program and the first snapshot were there at once


@pytest.mark.parametrize(
    ("seconds", "weights", "link", "fetches_differences"),
    [(1.0, 8, "auto", True), (0.1, 8, "auto", False), (1.0, 1 << 20, "auto", False), (1.0, 8, "lan", False)],
    ids=["slow rollouts", "fast rollouts", "a large network", "if told otherwise"],
)
def test_differences_are_fetched_after_three_slow_rollouts_with_a_small_network(
    seconds: float, weights: int, link: LinkChoice, fetches_differences: bool
) -> None:
    played = PlayedSession(ActorConfig(name="a", incarnation=7, link=link), weights=weights)
    played.seconds[Collect] = seconds
    for version in range(1, 12):
        played.version = version
        sent = len(rollouts(played))
        played.go(lambda sent=sent: len(rollouts(played)) > sent)
    compact = [request.compact for request in played.requests(SnapshotRequest)]
    assert any(compact) == fetches_differences
    assert not any(compact[:3])
    loaded = [load.snapshot.policy_version for load in played.of(Load) if load.snapshot is not None]
    assert loaded == sorted(loaded)
    assert loaded[-1] >= 9  # as promptly as whole ones


def test_synchronous_actor_plays_each_version_once() -> None:
    spec = SPEC.model_copy(update={"training": SPEC.training.model_copy(update={"algorithm": "a2c"})})
    played = PlayedSession()
    played.learners["r"] = [welcome(spec=spec)]
    played.go(lambda: len(rollouts(played)) == 1)
    began = played.now
    played.version = 1
    played.go(lambda: len(rollouts(played)) == 2)  # its push was lost: it is requested after a second
    assert played.now == pytest.approx(began + 1.0, abs=0.1)


def test_actor_reports_every_five_seconds_while_it_plays_or_waits() -> None:
    played = PlayedSession()
    played.go(lambda: bool(played.of(Collect)))
    rows, length = 300, SPEC.collection.rollout_length
    for _ in range(rows):  # 30 s of a slow environment
        played.now += 0.1
        due = played.session.begin_row(played.now)
        played.event(played.session.act_in_rollout if due else played.session.check_over)
    in_rollout = played.requests(ClientReport)
    assert len(in_rollout) in (5, 6)
    assert [report.rows for report in in_rollout] == sorted({report.rows for report in in_rollout})
    assert in_rollout[-1].rollout_seconds == pytest.approx(0.1 * length, rel=0.01)
    played.verdict = None  # the learner acknowledges nothing
    began = len(in_rollout)
    played.go(lambda: len(played.requests(ClientReport)) >= began + 4)
    waiting = played.requests(ClientReport)[-2:]
    assert waiting[1].rows == waiting[0].rows
    assert waiting[1].waiting_seconds == pytest.approx(waiting[0].waiting_seconds + 5.0, abs=0.5)
