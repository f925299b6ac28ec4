"""What an actor of a game asks its learner about opponents: whom to play, and their policies. Part of its session."""

from dataclasses import dataclass
from functools import partial

from daedalus.actor.session.conversation import Conversation, Query, Steps, Work
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.league import Plan
from daedalus.protocol.messages import LeaguePlan, LeagueRequest, Refusal, Snapshot

_PLAN_SECONDS = 2.0  # between two questions for a newer plan
_ANSWER_SECONDS = 10.0  # for an answer, which may be a large policy
_RETRY_SECONDS = 60.0  # for a learner of an earlier release, which has no league


@dataclass(frozen=True, slots=True)
class Oppose:
    """Take a plan, or the policy of a player, or neither; send back the name of a player whose policy is wanted."""

    plan: Plan | None = None
    player: str = ""
    snapshot: Snapshot | None = None  # None, with a player: its policy is not to be had now
    program: bytes | None = None  # None: the run's own


class LeagueFeed:
    """The plan of one learner after the other, and the policies of opponents, one at a time.

    Without an answer the actor plays on by the plan that it has.
    """

    def __init__(self, conversation: Conversation) -> None:
        self._conversation = conversation
        self.begin()

    def begin(self) -> None:
        """Begin with a learner, whose plan is not known."""
        self._revision: int | None = None
        self._asked: LeagueRequest | None = None  # what is being asked
        self._answer: bytes | None = None
        self._next_at = 0.0
        self._refused: set[str] = set()  # players, until the next plan

    def follow(self, own_program: str) -> Steps[None]:
        """Pass on what has come, and ask for what is due. Call this between rollouts.

        `own_program` is the hash of the run's program.
        """
        data, self._answer = self._answer, None
        if data is not None:
            yield from self._take(data, own_program)
        wanted: str = yield Oppose()
        if self._asked is not None:
            return
        if wanted in self._refused:
            wanted = yield Oppose(player=wanted)
        if wanted and wanted not in self._refused:
            self._ask(LeagueRequest(actor=self._conversation.join.actor, player=wanted))
        elif self._conversation.now >= self._next_at:
            self._next_at = self._conversation.now + _PLAN_SECONDS
            self._ask(LeagueRequest(actor=self._conversation.join.actor, held_revision=self._revision))

    def _ask(self, request: LeagueRequest) -> None:
        self._asked = request
        key = keys.snapshots(self._conversation.run)
        self._conversation.act(Query(key, encode(request), _ANSWER_SECONDS, partial(self._answered, request)))

    def _answered(self, request: LeagueRequest, data: bytes | None, now: float) -> None:
        if request is not self._asked:  # of an earlier learner
            return
        if data is None:
            self._asked, self._next_at = None, now + _PLAN_SECONDS
        else:
            self._answer = data
            self._conversation.heard(now)

    def _take(self, data: bytes, own_program: str) -> Steps[None]:
        asked, self._asked = self._asked, None
        message = yield Work(partial(self._conversation.decode, data))
        player = "" if asked is None else asked.player
        match message:
            case LeaguePlan() if message.learner_epoch == self._conversation.learner_epoch and not player:
                self._revision = message.plan.revision
                self._refused.clear()
                yield Oppose(plan=message.plan)
            case Snapshot() if player:
                program = None
                if message.program != own_program:
                    program = yield from self._conversation.program(message.program)
                if message.program == own_program or program is not None:
                    yield Oppose(player=player, snapshot=message, program=program)
                else:
                    self._refused.add(player)
            case Refusal(code="not_ready") if not player:
                pass
            case Refusal() if player:
                self._refused.add(player)
                self._next_at = self._conversation.now  # the plan may have changed
            case _:
                self._next_at = self._conversation.now + _RETRY_SECONDS
