"""Episodes that evaluators of this machine play at once, with policies that this process offers.

The evaluators have a transport of their own, which nobody else reaches: they need no certificate, and no actor can
report in their place. Each asks for a policy, plays its episodes, reports them, and asks for the next policy.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
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


class EvaluatorError(Exception):
    """The episodes cannot be played."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodePlan:
    """Episodes to play with each policy."""

    spec: RunSpec
    environment: EnvironmentSpec  # to play
    spaces: Spaces  # of the policies
    episodes: int
    seed: int
    actions: Literal["greedy", "sampled"]

    def unfit(self, spaces: Spaces | None) -> str:
        """Return why these policies cannot play an environment with other spaces."""
        environment = self.environment
        return (
            f"{environment.id} (backend {environment.backend}) has {spaces}; the policy was trained on {self.spaces}: "
            "choose another evaluation.final_backend, or install the versions that the run used (versions.json)"
        )

    def welcome(self, run: str, epoch: int) -> Welcome:
        """Return what an evaluator receives when it joins. `epoch` is that of the plan, in place of a learner's."""
        evaluation = self.spec.evaluation.model_copy(update={"actions": self.actions})
        spec = self.spec.model_copy(update={"environment": self.environment, "evaluation": evaluation})
        return Welcome(
            run=run,
            learner_epoch=epoch,
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


class _Playing:
    """Which evaluator plays with which policy, and what they reported. No I/O; the host has a lock."""

    def __init__(self, plan: EpisodePlan, policies: Sequence[OfferedPolicy], run: str, epoch: int) -> None:
        self.plan, self.epoch, self.welcome = plan, epoch, encode(plan.welcome(run, epoch))
        self.programs = {policy.program.hash: policy.program for policy in policies}
        self.limits = Limits(max_bytes=16 * plan.episodes + (1 << 10), max_arrays=2)
        self.reports: dict[int, EvaluationReport] = {}  # by policy version
        self.failure = ""  # why there are not all reports
        self.over = threading.Event()
        self._waiting, self._count = deque(policies), len(policies)
        self._playing: dict[str, OfferedPolicy] = {}  # by evaluator: one that was restarted plays the same again

    def fail(self, reason: str) -> None:
        """End the episodes without all reports."""
        self.failure = self.failure or reason
        self.over.set()

    def snapshot_for(self, evaluator: str) -> Snapshot | None:
        """Return the policy that an evaluator has to play with, or None if there is no further one."""
        if evaluator not in self._playing:
            if not self._waiting:
                return None
            self._playing[evaluator] = self._waiting.popleft()
        policy = self._playing[evaluator]
        return Snapshot(
            learner_epoch=self.epoch,
            policy_version=policy.policy_version,
            program=policy.program.hash,
            weights=policy.weights,
        )

    def take(self, report: EvaluationReport) -> Acknowledgement:
        """Keep a report, or reject it."""
        policy = self._playing.get(report.evaluator)
        expected = None if policy is None else (policy.policy_version, self.plan.episodes)
        if (report.policy_version, len(report.returns)) != expected:
            return Acknowledgement(verdict="rejected", reason="these are not the episodes that were asked for")
        del self._playing[report.evaluator]
        self.reports[report.policy_version] = report
        if len(self.reports) == self._count:
            self.over.set()
        return Acknowledgement(verdict="accepted")


_NOTHING = encode(Refusal(code="not_ready", reason="there is nothing to play now"))


class EvaluatorHost:
    """What the evaluators of a transport are answered, on its threads: what to play, and with which policy."""

    def __init__(self, run: str, transport: Transport) -> None:
        """Answer the evaluators of a run, from now on. The caller closes the transport, and ends the evaluators."""
        self._run = run
        self._playing: _Playing | None = None
        self._idle: list[Request] = []  # for a policy: they are answered when there is another plan
        self._lock = threading.Lock()  # guards both
        self._epoch = 0  # each plan has its own, so that the evaluators join again
        transport.serve(keys.program(run, "*"), self._on_program)
        transport.serve(keys.evaluations(run, "*"), self._on_evaluation)
        transport.serve(keys.join(run, "*"), self._on_join)

    def play(
        self, plan: EpisodePlan, policies: Sequence[OfferedPolicy], goes_on: Callable[[], bool]
    ) -> list[EvaluationReport] | None:
        """Let the evaluators play, and return their reports, one for each policy.

        Args:
          plan: what to play.
          policies: of different versions.
          goes_on: called again and again meanwhile. If it returns False, the result is None.

        Raises EvaluatorError if an evaluator says that it cannot play, and as `goes_on`.
        """
        self._epoch += 1
        playing = _Playing(plan, policies, self._run, self._epoch)
        with self._lock:
            self._playing, idle, self._idle = playing, self._idle, []
        for request in idle:
            request.reply(_NOTHING)
        try:
            while not playing.over.wait(_POLL_SECONDS):
                if not goes_on():
                    return None
        finally:
            with self._lock:
                self._playing = None
        if playing.failure:
            raise EvaluatorError(playing.failure)
        return [playing.reports[policy.policy_version] for policy in policies]

    def _on_program(self, request: Request) -> None:
        playing = self._playing
        program = playing.programs.get(request.key.rpartition("/")[2]) if playing else None
        request.reply(encode(program) if program else _NOTHING)

    def _on_join(self, request: Request) -> None:
        playing, message = self._playing, read_request(request.payload, JOIN_LIMITS, Join)
        if isinstance(message, Refusal):
            request.reply(encode(message))
        elif playing is None:
            request.reply(_NOTHING)
        elif message.failure or message.spaces not in (None, playing.plan.spaces):
            # Without an answer: the evaluator waits for it, and whoever watches its process learns of the reason first.
            playing.fail(bounded_text(message.failure) or playing.plan.unfit(message.spaces))
        else:
            request.reply(playing.welcome)

    def _on_evaluation(self, request: Request) -> None:
        with self._lock:
            playing = self._playing
            if playing is None:
                self._idle.append(request)
                return
            message = read_request(request.payload, playing.limits, EvaluationRequest, EvaluationReport)
            answer = message if isinstance(message, Refusal) else None
            if isinstance(message, EvaluationReport):
                answer = playing.take(message)
            elif isinstance(message, EvaluationRequest):
                answer = playing.snapshot_for(message.evaluator)
                if answer is None:
                    self._idle.append(request)
        if answer is not None:
            request.reply(encode(answer))
