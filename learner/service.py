"""The life of a learner: let actors in, learn from what they send, publish, save, leave. The main thread.

The other threads are the actor server's and the recorder's. Torch is imported only when actors can already join: it
takes a second, in which they make their environments.
"""

import logging
import secrets
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.learner.reporting.metrics import Details
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.recorder import Recorder
from daedalus.learner.reporting.report import Health, RateMeter, metrics_row, run_status, summary
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.run_directory import SUMMARY, write_json
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.evaluations import Evaluations
from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import EvaluationReport, Refusal
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import RunStatus
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint
    from daedalus.learner.training.learner import Learner


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How a run ended."""

    solved: bool
    finished: bool  # solved, or the budget used up; False if it was stopped before
    seconds_to_target: float | None


class LearnerService:
    """One run of one learner over one transport."""

    def __init__(
        self,
        spec: RunSpec,
        directory: Path,
        transport: Transport,
        stop: threading.Event,
        progress: Progress,
        *,
        started: float,
        restored: "Checkpoint | None" = None,
    ) -> None:
        """The run is named after its directory; `started`, on the monotonic clock, is what its seconds count from.

        With `restored` it continues from that checkpoint.
        """
        self._spec, self._run, self._directory = spec, directory.name, directory
        self._stop, self._progress, self._started = stop, progress, started
        self._restored = restored
        self._epoch = secrets.randbits(62)
        self._counters = RunCounters(spec.training.target_episodes)
        if restored is not None:
            self._counters.restore(restored.counters)
        self._evaluations = Evaluations(self._epoch)
        self._meter = RateMeter(self._counters, started)
        self._health = Health(started=started, updated=started, attended=started)
        self._server = ActorServer(
            self._run,
            spec,
            transport,
            self._counters,
            self._status,
            learner_epoch=self._epoch,
            start_version=restored.policy.policy_version if restored else 0,
            spaces=restored.policy.spaces if restored else None,
        )

    def run(self) -> Outcome:
        """Serves actors and learns until the target, the budget's end, or the order to stop.

        Once it has begun to learn, it ends with a checkpoint and a summary, however it ends.
        """
        try:
            self._server.open()
            from daedalus.learner.training.learner import Learner

            spaces = self._server.await_spaces(self._stop)
            if spaces is None:
                return Outcome(solved=False, finished=False, seconds_to_target=None)
            learner = Learner(self._spec.training, self._spec.policy, spaces)
            if self._restored is not None:
                policy = self._restored.policy
                learner.restore(policy.policy_version, policy.weights, self._restored.state)
            return self._learn(learner)
        finally:
            self._leave()

    def _learn(self, learner: "Learner") -> Outcome:
        """The main loop, and what surrounds it."""
        program = learner.program()
        self._server.offer_program(program, learner.state_size)
        self._server.publish(learner.policy_version, learner.weights())
        recorder = Recorder(self._directory, self._progress)
        begun, first_env_steps = time.monotonic(), self._counters.env_steps
        self._meter = RateMeter(self._counters, begun)
        self._health.updated = self._health.attended = begun
        try:
            seconds_to_target = self._loop(learner, program, recorder)
        finally:
            ended = time.monotonic()
            self._leave()
            recorder.record(self._row(learner, ended), self._details(learner))
            recorder.close()
            self._save(learner, program)
        solved = seconds_to_target is not None
        used_up = self._counters.env_steps >= self._spec.training.env_steps
        outcome = Outcome(
            solved=solved,
            finished=used_up or (solved and self._spec.training.stop_when_solved),
            seconds_to_target=seconds_to_target,
        )
        rate = (self._counters.env_steps - first_env_steps) / max(ended - begun, 1e-9)
        self._write_summary(outcome, self._wall_seconds(ended), rate)
        return outcome

    def _loop(self, learner: "Learner", program: bytes, recorder: Recorder) -> float | None:
        """Updates until there is a reason to end; returns when the target was reached, if it was."""
        training, service = self._spec.training, self._spec.service
        seconds_to_target = None
        now = time.monotonic()
        log_at, save_at = now + service.log_seconds, now + service.checkpoint_seconds
        while not self._stop.is_set() and self._counters.env_steps < training.env_steps:
            self._update(learner)
            now = time.monotonic()
            if seconds_to_target is None and self._counters.reached(training.target_return):
                seconds_to_target = self._wall_seconds(now)
            if seconds_to_target is not None and training.stop_when_solved:
                break
            self._attend_evaluators(learner, program)
            if now >= log_at:
                recorder.record(self._row(learner, now), self._details(learner))
                log_at = now + service.log_seconds
            if now >= save_at:
                self._save(learner, program)
                save_at = time.monotonic() + service.checkpoint_seconds
        return seconds_to_target

    def _update(self, learner: "Learner") -> None:
        """One batch, one update, one snapshot; none of them if no batch is complete soon."""
        progress = self._counters.env_steps / self._spec.training.env_steps
        rollouts = self._server.take_batch(learner.policy_version)
        if not rollouts:
            return
        skipped = learner.updates_skipped
        learner.step(rollouts, progress)
        self._server.publish_if_due(learner.policy_version, learner.weights(), len(rollouts))
        self._health.updated = self._health.attended = time.monotonic()
        skipped = learner.updates_skipped - skipped
        if skipped and not self._health.gradient_fault:
            _logger.warning("an update was skipped: its gradient was not finite; the weights stay as they were")
        self._health.gradient_fault = skipped > 0
        self._counters.updates_skipped += skipped

    def _attend_evaluators(self, learner: "Learner", program: bytes) -> None:
        """Gives evaluators the newest policy, a checkpoint of which is kept, and takes in how it played."""
        for request, message in self._server.take_evaluations():
            if isinstance(message, EvaluationReport):
                answer, news = self._evaluations.report(message)
                request.reply(encode(answer))
                if news:
                    _logger.info(news)
                continue
            directory = self._save(learner, program)
            if directory is None:
                request.reply(encode(Refusal(code="not_ready", reason="no checkpoint could be saved")))
                continue
            version, env_steps = learner.policy_version, self._counters.env_steps
            if version != self._server.published_version:
                self._server.publish(version, learner.weights())
            self._evaluations.begin(message.evaluator, directory, version, env_steps)
            request.reply(self._server.newest_snapshot())

    def _leave(self) -> None:
        stopped = self._stop.is_set()
        self._server.close("the learner was stopped" if stopped else "the learner has finished")

    # --------------------------------------------------------------------------------------- what it tells

    def _wall_seconds(self, now: float) -> float:
        return self._counters.wall_seconds + now - self._started

    def _row(self, learner: "Learner", now: float) -> dict[str, float]:
        with self._server.lock:
            progress = self._counters.env_steps / self._spec.training.env_steps
            rates = self._meter.look(self._counters, self._server.fleet, now)
            if self._server.fleet.live:
                self._health.attended = now
            learning = {
                **learner.metrics.take_means(),
                **self._evaluations.take_newest(),
                "learning_rate": learner.learning_rate(progress),
                "entropy_bonus": learner.entropy_bonus(progress),
            }
            return metrics_row(self._counters, self._server.fleet, rates, learning, self._wall_seconds(now))

    def _details(self, learner: "Learner") -> Details:
        with self._server.lock:
            returns, lengths = list(self._counters.returns), list(self._counters.lengths)
        return Details(
            returns=returns,
            lengths=lengths,
            action_counts=learner.metrics.take_action_counts(),
            picture=learner.metrics.take_observation_image(),
        )

    def _status(self, fleet: Fleet) -> RunStatus:
        return run_status(
            self._run,
            self._epoch,
            self._spec,
            self._counters,
            fleet,
            self._meter.rates,
            self._health,
            self._server.queue_bytes,
            time.monotonic(),
        )

    def _save(self, learner: "Learner", program: bytes) -> Path | None:
        """Saves a checkpoint and says where; a disk that refuses costs a warning."""
        from daedalus.learner.training.checkpoint import save_checkpoint

        spaces = self._server.fleet.spaces
        assert spaces is not None
        with self._server.lock:
            counters = self._counters.state(self._wall_seconds(time.monotonic()))
        try:
            directory = save_checkpoint(
                self._directory,
                spec=self._spec,
                spaces=spaces,
                policy_version=learner.policy_version,
                program=program,
                parameters=learner.weights(),
                state=learner.state(),
                counters=counters,
                keep=self._spec.service.keep_checkpoints,
                also_keep=self._evaluations.kept,
            )
        except OSError as error:
            if not self._health.save_fault:
                _logger.warning(
                    f"no checkpoint could be saved ({error.strerror}); the one before it stays, training goes on, "
                    f"and it is tried again every {self._spec.service.checkpoint_seconds:g} s"
                )
            self._health.save_fault = error.strerror or type(error).__name__
            return None
        if self._health.save_fault:
            _logger.info("checkpoints are saved again")
        self._health.saved, self._health.save_fault = time.monotonic(), ""
        return directory

    def _write_summary(self, outcome: Outcome, wall_seconds: float, env_steps_per_second: float) -> None:
        content = summary(
            self._run,
            self._spec,
            self._counters,
            solved=outcome.solved,
            finished=outcome.finished,
            seconds_to_target=outcome.seconds_to_target,
            wall_seconds=wall_seconds,
            env_steps_per_second=env_steps_per_second,
        )
        try:
            write_json(self._directory / SUMMARY, content)
        except OSError as error:
            _logger.warning("no summary was written: %s", error.strerror)
