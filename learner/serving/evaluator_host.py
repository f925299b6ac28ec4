"""Episodes that evaluators of this host play for the process that has started them, with policies that it offers.

The evaluators have a transport of their own, which nobody else reaches: they need no certificate, and no actor can
report in their place. Each asks for a policy, plays its episodes at once, reports them, and asks for the next policy.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence, Set
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from daedalus.learner.serving.waiting_requests import read_request
from daedalus.policy.saving.best_checkpoints import evaluation_result
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import JOIN_LIMITS, Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    EvaluationReport,
    EvaluationRequest,
    Join,
    Program,
    Refusal,
    Snapshot,
    Welcome,
)
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.texts import bounded_text
from daedalus.transport.interface import Request, Transport

_POLL_SECONDS = 0.05
_EPOCH = 1  # of the host, in place of a learner's


@dataclass(frozen=True, slots=True)
class Evaluators:
    """Evaluators that reach `transport`, as nobody else does."""

    transport: Transport
    # Restarts those that died, and returns why one has failed for good, or an empty string. Those with the given names
    # have left, because no policy was left for them.
    failure: Callable[[Set[str]], str]


class EvaluatorError(Exception):
    """The episodes cannot be played."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodePlan:
    """Episodes to play with each policy."""

    run: str  # name of the run
    spec: RunSpec
    environment: EnvironmentSpec  # to play
    spaces: Spaces  # of the policies
    episodes: int
    seed: int
    actions: Literal["greedy", "sampled"]

    def welcome(self) -> Welcome:
        """Return what an evaluator receives when it joins."""
        evaluation = self.spec.evaluation.model_copy(update={"actions": self.actions})
        spec = self.spec.model_copy(update={"environment": self.environment, "evaluation": evaluation})
        return Welcome(
            run=self.run,
            learner_epoch=_EPOCH,
            seed=self.spec.training.seed,
            spec=spec.for_actors(),
            play_episodes=self.episodes,
            play_seed=self.seed,
        )

    def result(self, checkpoint: Path, report: EvaluationReport) -> dict[str, Any]:
        """Return what summary.json has of the episodes of a checkpoint."""
        notes = [bounded_text(report.note)] if report.note else []
        version, returns, lengths = report.policy_version, report.returns, report.lengths
        result = evaluation_result(checkpoint, version, self.environment, returns, lengths, notes)
        return {**result, "seed": self.seed, "actions": self.actions}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OfferedPolicy:
    """A policy to play with."""

    policy_version: int
    program: Program
    weights: dict[str, np.ndarray]


class _Host:
    """What the host says to its evaluators, on the transport's threads: what to play, and with which policy."""

    def __init__(self, plan: EpisodePlan, policies: Sequence[OfferedPolicy]) -> None:
        self._plan, self._welcome = plan, encode(plan.welcome())
        self._programs = {policy.program.hash: policy.program for policy in policies}
        self._limits = Limits(max_bytes=16 * plan.episodes + (1 << 10), max_arrays=2)
        self._lock = threading.Lock()
        self._waiting, self._count = deque(policies), len(policies)
        self._playing: dict[str, OfferedPolicy] = {}  # by evaluator: one that was restarted plays the same again
        self.dismissed: set[str] = set()  # evaluators without a policy
        self.reports: dict[int, EvaluationReport] = {}  # by policy version
        self.failure = ""  # why there are not all reports
        self.over = threading.Event()

    def open(self, transport: Transport) -> None:
        """Start to answer the evaluators."""
        transport.serve(keys.program(self._plan.run, "*"), self._on_program)
        transport.serve(keys.evaluations(self._plan.run, "*"), self._on_evaluation)
        transport.serve(keys.join(self._plan.run, "*"), self._on_join)

    def _on_program(self, request: Request) -> None:
        program = self._programs.get(request.key.rpartition("/")[2])
        request.reply(encode(program or Refusal(code="unknown", reason="no program with this hash")))

    def _on_join(self, request: Request) -> None:
        message = read_request(request.payload, JOIN_LIMITS, Join)
        if isinstance(message, Refusal):
            request.reply(encode(message))
        elif message.failure:
            self._fail(bounded_text(message.failure))
            request.reply(self._welcome)
        elif message.spaces not in (None, self._plan.spaces):
            environment = self._plan.environment
            reason = (
                f"{environment.id} (backend {environment.backend}) has {message.spaces}; the policy was trained on "
                f"{self._plan.spaces}: choose another evaluation.final_backend, or install the versions that the run "
                "used (versions.json)"
            )
            self._fail(reason)
            request.reply(encode(Refusal(code="mismatch", reason=reason)))
        else:
            request.reply(self._welcome)

    def _fail(self, reason: str) -> None:
        self.failure = self.failure or reason
        self.over.set()

    def _on_evaluation(self, request: Request) -> None:
        message = read_request(request.payload, self._limits, EvaluationRequest, EvaluationReport)
        match message:
            case EvaluationRequest():
                request.reply(encode(self._policy_for(message.evaluator)))
            case EvaluationReport():
                request.reply(encode(self._verdict(message)))
            case Refusal():
                request.reply(encode(message))

    def _policy_for(self, evaluator: str) -> Snapshot | Refusal:
        with self._lock:
            if evaluator not in self._playing:
                if not self._waiting:
                    self.dismissed.add(evaluator)
                    return Refusal(code="finished", reason="all episodes are played")
                self._playing[evaluator] = self._waiting.popleft()
            policy = self._playing[evaluator]
        return Snapshot(
            learner_epoch=_EPOCH,
            policy_version=policy.policy_version,
            program=policy.program.hash,
            weights=policy.weights,
        )

    def _verdict(self, report: EvaluationReport) -> Acknowledgement:
        with self._lock:
            policy = self._playing.get(report.evaluator)
            expected = None if policy is None else (policy.policy_version, self._plan.episodes)
            if (report.policy_version, len(report.returns)) != expected:
                return Acknowledgement(verdict="rejected", reason="these are not the episodes that were asked for")
            del self._playing[report.evaluator]
            self.reports[report.policy_version] = report
            if len(self.reports) == self._count:
                self.over.set()
        return Acknowledgement(verdict="accepted")


def play(
    plan: EpisodePlan,
    policies: Sequence[OfferedPolicy],
    open_evaluators: Callable[[], AbstractContextManager[Evaluators]],
    goes_on: Callable[[], bool],
) -> list[EvaluationReport] | None:
    """Let evaluators play, and return their reports, one for each policy.

    Args:
      plan: what to play.
      policies: of different versions.
      open_evaluators: starts the evaluators, and ends them. Raises TransportError or OSError.
      goes_on: called again and again meanwhile; if it returns False, the evaluators are stopped.

    Returns: None if it was stopped. Raises EvaluatorError, and as `open_evaluators`.
    """
    host = _Host(plan, policies)
    with open_evaluators() as evaluators:
        host.open(evaluators.transport)
        while not host.over.wait(_POLL_SECONDS):
            if not goes_on():
                return None
            if failure := evaluators.failure(frozenset(host.dismissed)):
                raise EvaluatorError(failure)
    if host.failure:
        raise EvaluatorError(host.failure)
    return [host.reports[policy.policy_version] for policy in policies]
