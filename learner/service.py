"""Transport -> intake -> buffer -> learner -> snapshots. The learner's threads meet here.

    transport's threads   answer queries at once; rollouts only go onto a byte-bounded queue
    intake thread         decodes and judges rollouts, answers them, fills the buffer
    main thread           takes batches, learns, publishes snapshots, saves checkpoints
    recorder thread       writes metrics (learner/recorder.py)

One condition guards what they share: fleet, buffer, counters, and the version that rollouts are held against.
Torch is imported only when all of that already runs: it takes a second, in which actors connect and make
their environments.
"""

import secrets
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from learner.counters import RunCounters
from learner.fleet import Fleet
from learner.front_desk import FrontDesk
from learner.intake import Intake, Rejected, acknowledgement
from learner.progress import Progress
from learner.recorder import Recorder
from learner.report import RateMeter, metrics_row, run_status, summary
from learner.request_queue import RequestQueue
from learner.rollout_buffer import BarrierBuffer, RolloutBuffer, StreamBuffer, Taken
from learner.run_directory import SUMMARY, write_json
from policy.runtime import program_hash
from protocol import keys
from protocol.codec import encode
from protocol.messages import Acknowledgement, Farewell, Program, Rollout, Snapshot, StatusReport
from protocol.spec import RunSpec
from protocol.transport import Request, Transport

if TYPE_CHECKING:
    from learner.checkpoint import Checkpoint
    from learner.learner import Learner

_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_HINT_SECONDS = 3.0  # without an actor for so long, say how to start one


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
        self._transport, self._stop, self._progress = transport, stop, progress
        self._started = started
        self._restored = restored
        self._epoch = secrets.randbits(62)
        self._changed = threading.Condition()
        self._over = False
        self._counters = RunCounters(spec.training.target_episodes)
        if restored is not None:
            self._counters.restore(restored.counters)
        self._version = restored.policy.policy_version if restored else 0  # rollouts of it are on-policy
        self._fleet = Fleet(spec.training.seed, restored.policy.spaces if restored else None)
        self._intake = Intake(spec, self._epoch, self._fleet)
        self._desk = FrontDesk(self._run, spec, self._epoch, self._version, self._fleet, self._changed)
        self._requests = RequestQueue(int(spec.service.queue_megabytes * 2**20))
        self._buffer = _buffer(spec)
        self._meter = RateMeter(self._counters, started)
        self._program = b""

    def run(self) -> Outcome:
        """Serves actors and learns until the target, the budget's end, or the order to stop.

        Once it has begun to learn, it ends with a checkpoint and a summary, however it ends.
        """
        intake = threading.Thread(target=self._judge_requests, name="intake", daemon=True)
        intake.start()
        try:
            self._serve()
            from learner.learner import Learner

            if not self._await_spaces():
                return Outcome(solved=False, finished=False, seconds_to_target=None)
            assert self._fleet.spaces is not None
            learner = Learner(self._spec.training, self._spec.policy, self._fleet.spaces)
            if self._restored is not None:
                policy = self._restored.policy
                learner.restore(policy.policy_version, policy.weights, self._restored.state)
            return self._learn(learner)
        finally:
            self._leave()
            self._requests.close()
            intake.join(timeout=5.0)

    # ------------------------------------------------------------------------------------------ learning

    def _learn(self, learner: "Learner") -> Outcome:
        """The main loop, and what surrounds it."""
        self._offer_program(learner)
        self._publish(learner)
        recorder = Recorder(self._directory, self._progress)
        begun, first_env_steps = time.monotonic(), self._counters.env_steps
        self._meter = RateMeter(self._counters, begun)
        try:
            seconds_to_target = self._loop(learner, recorder)
        finally:
            ended = time.monotonic()
            self._leave()
            recorder.record(self._row(learner, ended))
            recorder.close()
            self._save(learner)
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

    def _loop(self, learner: "Learner", recorder: Recorder) -> float | None:
        """Updates until there is a reason to end; returns when the target was reached, if it was."""
        training, service = self._spec.training, self._spec.service
        seconds_to_target = None
        now = time.monotonic()
        log_at, save_at = now + service.log_seconds, now + service.checkpoint_seconds
        while not self._stop.is_set() and self._counters.env_steps < training.env_steps:
            self._update(learner)
            now = time.monotonic()
            if seconds_to_target is None and self._counters.reached(training.target_return):
                seconds_to_target = now - self._started
            if seconds_to_target is not None and training.stop_when_solved:
                break
            if now >= log_at:
                recorder.record(self._row(learner, now))
                log_at = now + service.log_seconds
            if now >= save_at:
                self._save(learner)
                save_at = time.monotonic() + service.checkpoint_seconds
        return seconds_to_target

    def _update(self, learner: "Learner") -> None:
        """One batch, one update, one snapshot; none of them if no batch is complete within a heartbeat."""
        from learner.batch import join_rollouts

        progress = self._counters.env_steps / self._spec.training.env_steps
        taken = self._take_batch(learner.policy_version)
        if taken.rollouts:
            learner.step(join_rollouts(taken.rollouts), progress)
            self._publish(learner)

    def _take_batch(self, version: int) -> Taken:
        with self._changed:
            taken = self._buffer.take(self._fleet.live, version)
            if not taken.rollouts and not taken.stale:
                self._changed.wait(_HEARTBEAT_SECONDS)
                taken = self._buffer.take(self._fleet.live, version)
            for rollout in taken.stale:
                self._counters.rollouts_rejected["stale"] += 1
                self._fleet.actors[rollout.identity.actor].rejected["stale"] += 1
            if taken.rollouts:
                self._counters.trained(taken.rollouts, version)
                for rollout in taken.rollouts:
                    steps = int(np.count_nonzero(rollout.valid))
                    self._fleet.actors[rollout.identity.actor].env_steps += steps
                # From here on, rollouts of the coming version are the on-policy ones.
                self._version = version + 1
            self._changed.notify_all()
        return taken

    def _await_spaces(self) -> bool:
        """Waits for an actor that knows the environment's spaces; False if told to stop first."""
        hint_at: float | None = time.monotonic() + _HINT_SECONDS
        with self._changed:
            while self._fleet.spaces is None:
                if self._stop.is_set():
                    return False
                self._changed.wait(_HEARTBEAT_SECONDS)
                if hint_at is not None and time.monotonic() > hint_at:
                    self._progress.say("waiting for the first actor: `daedalus actor --connect ADDRESS` starts one")
                    hint_at = None
        return True

    # ------------------------------------------------------------------------------------------ the wire

    def _serve(self) -> None:
        transport, run, desk = self._transport, self._run, self._desk
        transport.watch(keys.presence(run, "*"), self._on_presence)
        transport.serve(keys.rollouts(run, "*"), self._on_rollout)
        transport.serve(keys.snapshots(run), lambda request: request.reply(desk.snapshot()))
        transport.serve(
            keys.program(run, "*"), lambda request: request.reply(desk.program(keys.last_chunk(request.key)))
        )
        transport.serve(keys.status(run), self._on_status)
        transport.announce(keys.learner(run))
        # Last: who is let in finds all else there.
        transport.serve(keys.join(run), lambda request: request.reply(desk.join(request.payload, time.monotonic())))

    def _on_presence(self, key: str, present: bool) -> None:
        with self._changed:
            self._fleet.set_present(keys.last_chunk(key), present)
            self._changed.notify_all()

    def _on_rollout(self, request: Request) -> None:
        if self._over:
            request.reply(encode(Acknowledgement(verdict="finished")))
        elif not self._requests.offer(request):
            request.reply(encode(Acknowledgement(verdict="busy", policy_version=self._version)))

    def _on_status(self, request: Request) -> None:
        with self._changed:
            status = run_status(
                self._run,
                self._epoch,
                self._spec,
                self._counters,
                self._fleet,
                self._meter.rates,
                self._started,
                time.monotonic(),
            )
        request.reply(encode(StatusReport(status=status)))

    def _judge_requests(self) -> None:
        """The intake thread."""
        while (request := self._requests.take()) is not None:
            sender = keys.last_chunk(request.key)
            content = self._intake.read(sender, request.payload)
            with self._changed:
                if self._spec.synchronous and isinstance(content, Rollout) and not self._buffer.has_room_for(content):
                    content = Rejected(
                        verdict="rejected", cause="surplus", reason="an update takes one rollout of an actor"
                    )
                verdict = self._intake.judge(sender, content, self._version, time.monotonic())
                if isinstance(verdict, Rollout):
                    self._store(verdict, len(request.payload))
                else:
                    self._counters.rollouts_rejected[verdict.cause] += 1
                answer = acknowledgement(verdict, self._version)
            request.reply(encode(Acknowledgement(verdict="finished") if self._over else answer))

    def _store(self, rollout: Rollout, size: int) -> None:
        """Puts a rollout into the buffer, waiting for room: the late answer is what holds its sender back."""
        while not self._buffer.has_room_for(rollout) and not self._over:
            self._changed.wait(_HEARTBEAT_SECONDS)
        self._buffer.add(rollout)
        self._counters.accepted(rollout, size)
        self._changed.notify_all()

    def _offer_program(self, learner: "Learner") -> None:
        self._program = learner.program()
        self._program_hash = program_hash(self._program)
        model = np.frombuffer(self._program, np.uint8)
        self._desk.offer_program(Program(hash=self._program_hash, model=model))

    def _publish(self, learner: "Learner") -> None:
        """Encodes the weights once, for those who follow and for those who ask."""
        snapshot = encode(
            Snapshot(
                learner_epoch=self._epoch,
                policy_version=learner.policy_version,
                program=self._program_hash,
                weights=learner.weights(),
            )
        )
        self._desk.offer_snapshot(snapshot)
        self._transport.publish(keys.snapshots(self._run), snapshot)
        self._counters.snapshots_published += 1

    def _leave(self) -> None:
        """Tells the actors that the run is over. Idempotent."""
        with self._changed:
            if self._over:
                return
            self._over = True
            self._changed.notify_all()
        reason = "the learner was stopped" if self._stop.is_set() else "the learner has finished"
        farewell = encode(Farewell(learner_epoch=self._epoch, reason=reason))
        self._desk.close(farewell)
        self._transport.publish(keys.snapshots(self._run), farewell)

    # --------------------------------------------------------------------------------------- what it leaves

    def _wall_seconds(self, now: float) -> float:
        return self._counters.wall_seconds + now - self._started

    def _row(self, learner: "Learner", now: float) -> dict[str, float]:
        with self._changed:
            progress = self._counters.env_steps / self._spec.training.env_steps
            rates = self._meter.look(self._counters, now)
            learning = {
                **learner.take_metrics(),
                "learning_rate": learner.learning_rate(progress),
                "entropy_bonus": learner.entropy_bonus(progress),
            }
            return metrics_row(self._counters, self._fleet, rates, learning, self._wall_seconds(now))

    def _save(self, learner: "Learner") -> None:
        """Saves a checkpoint; a disk that refuses costs a warning."""
        from learner.checkpoint import save_checkpoint

        assert self._fleet.spaces is not None
        with self._changed:
            counters = self._counters.state(self._wall_seconds(time.monotonic()))
        try:
            save_checkpoint(
                self._directory,
                spec=self._spec,
                spaces=self._fleet.spaces,
                policy_version=learner.policy_version,
                program=self._program,
                parameters=learner.weights(),
                state=learner.state(),
                counters=counters,
                keep=self._spec.service.keep_checkpoints,
            )
        except OSError as error:
            self._progress.say(f"no checkpoint was saved ({error.strerror}); the one before it stays")

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
            self._progress.say(f"no summary was written: {error.strerror}")


def _buffer(spec: RunSpec) -> RolloutBuffer:
    training, actors = spec.training, spec.collection.actors
    if training.algorithm == "a2c":
        return BarrierBuffer(actors)
    default = {"a3c": 1, "impala": actors}[training.algorithm]
    return StreamBuffer(training.batch_rollouts or default, training.max_policy_lag)
