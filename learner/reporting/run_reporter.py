"""Metrics rows, status and summary of one run, from its counters, fleet and health, and their files."""

import logging
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daedalus.learner.reporting.csv_writer import cut_rows
from daedalus.learner.reporting.hints import EpisodeHint, LearningHint, ObservationHint, bottleneck
from daedalus.learner.reporting.metrics_rows import ENV, LESSON, Details, league_columns, read_rows
from daedalus.learner.reporting.rates import RateMeter
from daedalus.learner.reporting.recorder import Recorder
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.run_directory import EVALUATION, METRICS, SUMMARY, read_json, write_json
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.events import RESUMED
from daedalus.learner.serving.query_responses import page, totals
from daedalus.learner.serving.run_context import RunContext
from daedalus.policy.saving.best_checkpoints import set_aside_newer
from daedalus.protocol.league import LeagueStatus
from daedalus.protocol.messages import RunStatus
from daedalus.protocol.releases import own_release
from daedalus.protocol.uploads import Upload, mean_return
from daedalus.transport.process_usage import UsageMeter

if TYPE_CHECKING:
    from daedalus.learner.training.learner import Learner

_DETAILS_SECONDS = 10.0  # between details: they take far more space than a row,
_DETAILS = 100  # and in an old run their distance is this part of its age

_logger = logging.getLogger(__name__)


def episode_statistics(counters: RunCounters) -> dict[str, float]:
    """Return statistics of the newest training episodes; empty before the first episode."""
    if not counters.returns:
        return {}
    returns = np.array(counters.returns)
    return {
        "episode_return_mean": mean_return(returns),
        "episode_return_std": float(returns.std()),
        "episode_return_min": float(returns.min()),
        "episode_return_max": float(returns.max()),
        "episode_length_mean": float(np.mean(counters.lengths)),
    }


class RunReporter:
    """Reporter of one run: its status, and during training, from `begin` to `close`, its metrics rows and summary.

    It reads the counters and the fleet under their lock. A disk error is logged and does not end the run.
    """

    def __init__(self, context: RunContext, user_metrics: UserMetrics) -> None:
        self._context, self._counters, self._user_metrics = context, context.counters, user_metrics
        self._recorder: Recorder | None = None  # None: training has not begun
        self._details_at = -math.inf  # when the next details are due
        training = context.spec.training
        self._meter = RateMeter(self._counters, context.health.started)
        self._bottleneck = ""  # at the newest row
        self._usage = UsageMeter()
        self._episode_hint = EpisodeHint(training.env_steps, context.spec.environment.remedy_of_endless)
        self._learning_hint = LearningHint(training)
        self._observation_hint = ObservationHint()

    def begin(self, recorder: Recorder, now: float) -> None:
        """Start to measure rates, at the start of training. The recorder is closed with the reporter."""
        self._recorder, health = recorder, self._context.health
        self._meter = RateMeter(self._counters, now)
        health.updated = health.awaited_since = health.actor_seen = now
        health.recording_since = lambda: recorder.busy_since

    def look(self, batch: Sequence[Upload]) -> None:
        """Look at the observations of a batch that was trained on."""
        self._observation_hint.look(batch)

    def record(self, learner: "Learner", now: float, *, last: bool = False) -> None:
        """Record a row of metrics, and log a hint if one is due. `last` marks the row of a stop."""
        assert self._recorder is not None
        row = self.row(learner, now, last=last)
        self._context.history.add(row)
        details = self._details(learner, now, last=last)
        # Until there is a batch, this is all that is known.
        waits_for = "" if "updates_per_second" in row else self._bottleneck
        self._recorder.record(row, replace(details, waits_for=waits_for))
        if not last and (hint := self._hint()):
            _logger.warning("%s", hint)

    def close(self) -> None:
        """Write the queued rows."""
        assert self._recorder is not None
        self._recorder.close()

    def row(self, learner: "Learner", now: float, *, last: bool = False) -> dict[str, float]:
        """Return a metrics row: columns of metrics_rows.py, and the scalars of the environment and of the program.

        Means are since the previous row, rates over at least 10 s (rates.py). `last` marks the row of a stop.
        """
        learned = {**learner.metrics.take_means(), **learner.take_diagnostics()}
        context, counters, fleet = self._context, self._counters, self._context.fleet
        league = None if context.league is None else context.league.status()  # with all opponents
        with context.lock:
            progress = context.progress
            context.health.note_actors(len(fleet.live), now)
            is_stalled = context.health.is_stalled(now, context.expected_batch_seconds)
            rates = self._meter.measure(counters, fleet, now, last=last, is_stalled=is_stalled)
            if not last:
                self._bottleneck = self._waits_for()
            row = {
                "wall_seconds": context.wall_seconds(now),
                "env_steps": counters.env_steps,
                **self._agent_steps(),
                "updates": counters.updates,
                "episodes": counters.episodes,
                **episode_statistics(counters),
                **rates,
                "policy_lag_max": counters.policy_lag_max,
                "actors": len(fleet.live),
                "rollouts_accepted": counters.rollouts_accepted,
                "rollouts_rejected": counters.rollouts_rejected.total(),
                "updates_skipped": counters.updates_skipped,
                **learned,
                **context.evaluations.take_newest(),
                **league_columns(league or LeagueStatus()),
                "learning_rate": learner.learning_rate(progress),
                "entropy_bonus": learner.entropy_bonus(progress),
                **self._user_metrics.take(),
                **{ENV + name: float(np.mean(values)) for name, values in counters.info.items()},
                **{LESSON + name: mean for name, mean in context.lessons.means().items()},
            }
        self._learning_hint.add(row)
        return row

    def _agent_steps(self) -> dict[str, int]:
        """Return the agent_steps of a game, by their name; nothing for an environment with one agent."""
        game = self._context.spec.environment.is_game
        return {"agent_steps": self._counters.agent_steps} if game else {}

    def _league(self) -> LeagueStatus | None:
        """Return the league of a game with opponents, bounded; None before it begins, and for other environments."""
        league = None if self._context.league is None else self._context.league.status()
        return league and league.bounded()

    def _waits_for(self) -> str:
        """Return what the run waits for. Needs the lock."""
        spec, fleet = self._context.spec, self._context.fleet
        reports = filter(None, (fleet.actors[name].report for name in fleet.live))
        together, length = spec.algorithm.synchronous, spec.collection.rollout_length
        return bottleneck(self._meter.rates, reports, rollout_length=length, together=together) if fleet.live else ""

    def _hint(self) -> str:
        """Return a hint for the user if one is due, else an empty string."""
        with self._context.lock:
            hint = self._episode_hint.take(self._counters, self._context.fleet)
        return hint or self._observation_hint.take() or self._learning_hint.take()

    def _details(self, learner: "Learner", now: float, *, last: bool) -> Details:
        """Return the distributions and the picture that belong to a metrics row; most rows have none."""
        if now < self._details_at and not last:
            return Details()
        self._details_at = now + max(_DETAILS_SECONDS, self._context.wall_seconds(now) / _DETAILS)
        with self._context.lock:
            returns, lengths = list(self._counters.returns), list(self._counters.lengths)
        return Details(
            returns=returns,
            lengths=lengths,
            action_counts=learner.metrics.take_action_counts(),
            picture=learner.metrics.take_observation_image(),
        )

    def status(self, queue_bytes: int, now: float) -> RunStatus:
        """Return the status of the run with its first actors. The caller holds the lock.

        Args:
          queue_bytes: size of the rollouts that wait.
          now: time on the monotonic clock, in seconds.
        """
        context, spec, counters, fleet = self._context, self._context.spec, self._counters, self._context.fleet
        rates, health, usage = self._meter.rates, context.health, self._usage.measure()
        fleet.forget_absent(now)
        return RunStatus(
            run=context.name,
            learner_epoch=context.learner_epoch,
            algorithm=spec.training.algorithm,
            environment=spec.environment.id,
            problems=health.problems(now, len(fleet.live), context.expected_batch_seconds),
            uptime_seconds=now - health.started,
            env_steps=counters.env_steps,
            env_steps_budget=spec.training.env_steps,
            updates=counters.updates,
            updates_skipped=counters.updates_skipped,
            episode_return_mean=counters.episode_return_mean,
            env_steps_per_second=rates.env_steps_per_second,
            updates_per_second=rates.updates_per_second,
            policy_lag_mean=rates.policy_lag_mean,
            queue_bytes=queue_bytes,
            queue_bytes_limit=spec.service.queue_bytes,
            checkpoint_age_seconds=None if health.saved is None else now - health.saved,
            certificate_days_left=health.certificate_days_left(),
            rollouts_accepted=counters.rollouts_accepted,
            rollouts_rejected=dict(counters.rollouts_rejected),
            **totals(fleet),
            refused_joins=fleet.refused_joins.report(now),
            actors=page(fleet, "", now),
            updates_per_batch=spec.training.updates_per_batch,
            agent_steps=counters.agent_steps if spec.environment.is_game else None,
            processor_share=usage.processor_share,
            memory_bytes=usage.memory_bytes,
            bottleneck=self._bottleneck,
            learning_share=rates.learning_share,
            decoding_share=rates.decoding_share,
            league=self._league(),
            lessons=context.lessons.texts(counters.env_steps),
            software=own_release(),
        )

    def summary(self, *, finished: bool, now: float, stopped_by: str = "") -> dict[str, Any]:
        """Return the content of summary.json at the end of training. A final evaluation adds its results later.

        Its env_steps_per_second is over the training of this process.
        """
        spec, counters, league = self._context.spec, self._counters, self._league()
        return {
            "run": self._context.name,
            "algorithm": spec.training.algorithm,
            "environment": spec.environment.id,
            "seed": spec.training.seed,
            "solved": counters.seconds_to_target is not None,
            "finished": finished,
            "stopped_by": stopped_by or None,
            "env_steps": counters.env_steps,
            **self._agent_steps(),
            "updates": counters.updates,
            "updates_skipped": counters.updates_skipped,
            "episodes": counters.episodes,
            "wall_seconds": self._context.wall_seconds(now),
            "seconds_to_target": counters.seconds_to_target,
            "env_steps_per_second": self._meter.overall(counters, now),
            "episode_return_mean": counters.episode_return_mean,
            "evaluation_return_mean": None,
            "evaluation_return_std": None,
            "confirmation_return_mean": None,
            "policy_lag_mean": counters.policy_lag_mean,
            "policy_lag_max": counters.policy_lag_max,
            "rollouts_accepted": counters.rollouts_accepted,
            "rollouts_rejected": dict(counters.rollouts_rejected),
            "rollout_bytes_per_env_step": counters.rollout_bytes / max(counters.accepted_env_steps, 1),
            "snapshots_published": counters.snapshots_published,
            "bottleneck": self._bottleneck,
            **({} if league is None else {"league": league.model_dump(mode="json")}),
            **({"lessons": lessons} if (lessons := self._context.lessons.texts(counters.env_steps)) else {}),
        }

    def write_summary(
        self, *, finished: bool, stopped_by: str, ended: float, confirmation: dict[str, Any] | None
    ) -> None:
        """Write summary.json.

        Args:
          finished: whether the run is over, rather than stopped.
          stopped_by: the operator or other cause that stopped the run; empty if it is over.
          ended: when training ended, on the monotonic clock, in seconds.
          confirmation: result of the new episodes that confirmed the target; None without them.
        """
        content = self.summary(finished=finished, now=ended, stopped_by=stopped_by)
        if confirmation is not None:
            content["confirmation"] = confirmation
            content["confirmation_return_mean"] = confirmation["return_mean"]
        try:
            write_json(self._context.directory / SUMMARY, content)
        except OSError as error:
            _logger.warning("summary not written: %s", error.strerror)


def continue_records(context: RunContext) -> None:
    """Undo what the learner processes before recorded after the checkpoint; read the rest.

    Rows of the metrics and best checkpoints of env_steps that the run makes again would be those of other weights.
    Scores of episodes with another environment.max_episode_steps are no longer comparable.
    """
    directory, env_steps, policy_version = context.directory, context.counters.env_steps, context.start_version
    try:
        rows = cut_rows(directory / METRICS, env_steps)
        if rows:
            writer = TensorBoardWriter(directory)
            writer.purge(env_steps)
            writer.close()
            context.evaluations.carry_over(rows)
        undone = [f"{len(rows):,} rows of {METRICS}"] if rows else []
        comparable = -1 if context.other_episodes else policy_version  # the highest version whose score is
        undone += [f"{each.name}, whose policy is kept" for each in set_aside_newer(directory, comparable)]
        undone += _remove_later_results(directory, env_steps, policy_version)
        if undone:
            text = f"continues at {env_steps:,} env_steps: undone are {', '.join(undone)}"
            context.events.add("checkpoint", f"{RESUMED}{text}")
        for row in read_rows(directory / METRICS):
            context.history.add(row)
    except FileNotFoundError:
        return  # no row yet
    except (OSError, ValueError) as error:
        _logger.warning("the metrics before the checkpoint cannot be read: %s", error)


def _remove_later_results(directory: Path, env_steps: int, policy_version: int) -> list[str]:
    """Remove the results of a run that had come further than the checkpoint, and return their names."""
    removed = []
    for name, key, reached in ((SUMMARY, "env_steps", env_steps), (EVALUATION, "policy_version", policy_version)):
        with suppress(SettingsError):  # missing, or damaged: others say so
            later = read_json(directory / name).get(key)
            if isinstance(later, int) and later > reached:
                (directory / name).unlink()
                removed.append(name)
    return removed
