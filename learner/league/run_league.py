"""The league of a run: its players, their policies for actors, and the plan of whom to play.

    transport's threads        `plan`
    compact snapshots' thread  `snapshot`
    intake thread              `add`
    learner's thread           `open`, `advance`
    checkpoints' thread        writes versions

A league exists for each game. It begins when an actor asks for a plan: only actors know whether a game has opponents.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daedalus.learner.league.ratings import LeagueState, Ratings
from daedalus.learner.league.versions import KeptVersion, VersionFolder, encoded, opponent_run, thinned
from daedalus.learner.run.resuming import other_spaces
from daedalus.learner.run.run_directory import LEAGUE
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import SavedPolicy
from daedalus.policy.saving.sealed import DamagedError, UnreadableError
from daedalus.protocol.codec import encode
from daedalus.protocol.league import LeagueStatus, Matches, Plan, is_bot, version_name, version_of
from daedalus.protocol.messages import LeaguePlan, Program, Refusal, Snapshot, program_hash
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import bounded_text

if TYPE_CHECKING:
    from daedalus.learner.training.learner import Learner

_PLAN_SECONDS = 5.0  # between two plans that differ in the weights only
_KEEP_PARTS = 50  # of the budget, after each of which a version is kept by default
_CACHED_BYTES = 64 << 20  # of encoded snapshots: all actors ask for a new version at about the same time

_logger = logging.getLogger(__name__)


class League:
    """The league of one learner process. Any thread may call its methods, except where they name one."""

    def __init__(self, directory: Path, spec: RunSpec, learner_epoch: int, state: LeagueState | None = None) -> None:
        """Construct the league of the run in a directory, and read nothing yet. `state` is from a checkpoint."""
        self._spec, self._epoch = spec, learner_epoch
        self._fixed = spec.league.opponents
        self._folder = directory / LEAGUE
        self._versions = VersionFolder(self._folder)
        self._lock = threading.RLock()
        self._began = state is not None
        self._missing: SettingsError | None = None
        try:
            self._ratings: Ratings | None = Ratings(self._fixed.keys(), state)
        except SettingsError as error:  # it matters only if the game has opponents
            self._ratings, self._missing = None, error
        self._kept: list[KeptVersion] = []  # from old to new
        self._keeping = False  # whether a version is being written
        self._keep_at = 0  # env_steps
        self._plan, self._encoded_plan = Plan(), b""
        self._plan_at, self._changed = 0.0, False
        self._runs: dict[str, SavedPolicy] = {}
        self._programs: dict[str, bytes] = {}  # encoded, of other runs
        self._snapshots: OrderedDict[str, bytes] = OrderedDict()  # encoded, the one that was asked for last at the end
        self._warned = False  # that matches are ignored

    # ------------------------------------------------------------------------------------ the learner's thread

    def load_opponents(self) -> None:
        """Read the policies of other runs that are opponents. Raises SettingsError."""
        for name in self._fixed:
            if not is_bot(name):
                policy = self._runs[name] = opponent_run(name, self._folder)
                program = Program.of(policy.program)
                self._programs[program.hash] = encode(program)

    def check_opponents(self, spaces: Spaces) -> None:
        """Raise SettingsError if the policy of another run is for other spaces than those of this run."""
        for name, policy in self._runs.items():
            if difference := other_spaces(policy, self._spec.environment, spaces):
                raise SettingsError(
                    f"league.opponents: the policy of {name} is for other spaces: {difference}; name a run of the same "
                    "game and the same [environment] settings"
                )

    def open(self, policy_version: int) -> None:
        """Find the kept versions. Remove those that are newer than the learner's: it makes them again."""
        found = self._versions.versions()
        undone = [each for each in found if each.policy_version > policy_version]
        if undone:
            names = ", ".join(version_name(each.policy_version) for each in undone)
            _logger.info("versions of the league that are newer than the checkpoint are removed: %s", names)
        kept = thinned([each for each in found if each not in undone], self._spec.league.versions)
        for each in found:
            if each not in kept:
                self._versions.remove(each.policy_version)
        with self._lock:
            self._kept = kept
            if kept:
                self._keep_at = kept[-1].env_steps + self._interval
            if self._ratings is not None:
                for version in {*self._ratings.versions} - {each.policy_version for each in kept}:
                    self._ratings.retire(version_name(version))
                for each in kept:
                    self._ratings.keep(each.policy_version)
                self._make_plan()

    def advance(self, learner: "Learner", env_steps: int, write: Callable[[Callable[[], None]], None]) -> None:
        """Keep a version and renew the plan, if that is due. Call this before each update.

        Args:
          learner: has the newest policy.
          env_steps: of the run.
          write: lets another thread do something; what it does may take long.

        Raises SettingsError if there are opponents, and no openskill.
        """
        if not self._began:
            return
        if self._missing is not None:
            raise self._missing
        with self._lock:
            if self._changed and time.monotonic() >= self._plan_at:
                self._make_plan()
            if self._keeping or env_steps < self._keep_at:
                return
            self._keeping, self._keep_at = True, env_steps + self._interval
        version = KeptVersion(learner.policy_version, env_steps)
        write(partial(self._keep, version, encoded(learner.weights())))

    @property
    def _interval(self) -> int:
        return self._spec.league.keep_env_steps or max(self._spec.training.env_steps // _KEEP_PARTS, 1)

    # ---------------------------------------------------------------------------------- the thread that writes

    def _keep(self, version: KeptVersion, weights: bytes) -> None:
        try:
            self._versions.write(version, weights)
        except OSError as error:
            _logger.warning(
                "version %d is not kept for the league: %s; training continues, and the next version is kept after "
                "%s env_steps more",
                version.policy_version,
                error.strerror or type(error).__name__,
                f"{self._interval:,}",
            )
            with self._lock:
                self._keeping = False
            return
        with self._lock:
            assert self._ratings is not None
            every = [each for each in self._kept if each.policy_version != version.policy_version] + [version]
            self._kept = thinned(every, self._spec.league.versions)
            self._ratings.keep(version.policy_version)
            gone = [each.policy_version for each in every if each not in self._kept]
            for old in gone:
                self._ratings.retire(version_name(old))
            self._make_plan()
            self._keeping = False
        for old in gone:
            self._versions.remove(old)

    # ------------------------------------------------------------------------------------------------- results

    @property
    def has_begun(self) -> bool:
        """Whether the game has opponents: then the mean return says little, for what one side wins the other loses."""
        return self._began

    def violation(self, matches: Matches) -> str:
        """Return why matches cannot have been played in this league, or an empty string."""
        for each in matches.counts:
            for player in (each.first, each.second):
                if self._ratings is not None and not self._ratings.is_known(player):
                    return f"matches name the player {bounded_text(player, 64)!r}, who is not in the league"
            if each.first == each.second:
                return f"matches has results of {bounded_text(each.first, 64)!r} against itself"
        return ""

    def add(self, matches: Matches) -> None:
        """Add the results of one rollout. The caller does so once for each."""
        with self._lock:
            self._began = self._changed = True
            if self._ratings is None:
                return
            self._ratings.add(matches.counts, rate_training=self._spec.league.rating_actions == "sampled")
            if self._ratings.ignored and not self._warned:
                self._warned = True
                _logger.warning("results of matches of versions that were dropped long ago are ignored")

    @property
    def reaches_target(self) -> bool:
        """Whether the newest policy has the win rate or the rating at which the run is solved."""
        return self._began and self._ratings is not None and self._ratings.reach(self._spec.league)

    # ------------------------------------------------------------------------------------------------- answers

    def plan(self, held_revision: int | None) -> bytes:
        """Return the answer to an actor that asks for the plan and holds one. Does not block."""
        self._began = True
        revision, answer = self._plan.revision, self._encoded_plan
        if not answer or revision == held_revision:
            return encode(Refusal(code="not_ready", reason="there is no newer plan"))
        return answer

    def _make_plan(self) -> None:
        """Renew the plan. Needs the lock."""
        assert self._ratings is not None
        settings = self._spec.league
        self._plan_at, self._changed = time.monotonic() + _PLAN_SECONDS, False
        training = self._ratings.training_plan(settings.past, self._fixed, prioritized=settings.choice == "prioritized")
        rating = self._ratings.rating_plan(self._fixed) if settings.rating_share else ()
        if self._encoded_plan and (training, rating) == (self._plan.training, self._plan.rating):
            return
        plan = Plan(revision=self._plan.revision + 1, training=training, rating=rating)
        self._encoded_plan = encode(LeaguePlan(learner_epoch=self._epoch, plan=plan))
        self._plan = plan

    def snapshot(self, player: str, program: str) -> bytes:
        """Return the answer to an actor that asks for the policy of a player: a Snapshot or a Refusal. Reads a file.

        `program` is the hash of the run's program.
        """
        answer = self._snapshots.get(player)
        if answer is None or not self._has_policy(player):
            answer = self._read(player, program)
            if answer is None:
                reason = f"the league has no policy of {bounded_text(player, 64)!r}: play another opponent"
                return encode(Refusal(code="unknown", reason=reason))
            self._snapshots[player] = answer
        self._snapshots.move_to_end(player)
        while len(self._snapshots) > 1 and sum(map(len, self._snapshots.values())) > _CACHED_BYTES:
            self._snapshots.popitem(last=False)
        return answer

    def _has_policy(self, player: str) -> bool:
        with self._lock:
            return player in self._runs or version_of(player) in {each.policy_version for each in self._kept}

    def _read(self, player: str, program: str) -> bytes | None:
        if player in self._runs:
            policy = self._runs[player]
            return self._encoded(policy.policy_version, program_hash(policy.program), policy.weights)
        version = version_of(player)
        if version is None or not self._has_policy(player):
            return None
        try:
            return self._encoded(version, program, self._versions.read(version))
        except DamagedError as error:
            with self._lock:
                kept = [each for each in self._kept if each.policy_version != version]
                if isinstance(error, UnreadableError) or kept == self._kept:  # it may pass, or the version was dropped
                    return None
                assert self._ratings is not None
                self._kept, self._keep_at = kept, self._keep_at if kept else 0
                self._ratings.retire(player)
                self._make_plan()
            _logger.warning("version %d of the league plays no more: %s", version, error)
            return None

    def _encoded(self, policy_version: int, program: str, weights: dict[str, np.ndarray]) -> bytes:
        return encode(
            Snapshot(learner_epoch=self._epoch, policy_version=policy_version, program=program, weights=weights)
        )

    def program(self, name: str) -> bytes | None:
        """Return the encoded program of another run that is an opponent, by its hash; None if there is none."""
        return self._programs.get(name)

    # ------------------------------------------------------------------------------------------------- reports

    def state(self) -> LeagueState | None:
        """Return what a checkpoint keeps; None if the league has not begun."""
        with self._lock:
            return self._ratings.state() if self._began and self._ratings is not None else None

    def status(self) -> LeagueStatus | None:
        """Return ratings and results for people; None if the league has not begun."""
        with self._lock:
            if not self._began or self._ratings is None:
                return None
            return self._ratings.status()
