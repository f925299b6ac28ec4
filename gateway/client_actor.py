"""One client as an actor towards the learner: its rows and its rollouts. For the gateway's event loop."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from daedalus.actor.collecting.client_rows import ClientRows, check_run
from daedalus.actor.collecting.client_seats import MatchSeat, seated_space
from daedalus.actor.collecting.loop_recorder import EpisodeTape
from daedalus.actor.collecting.rollout_writer import RowInputs
from daedalus.actor.environments.components import without
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.info import mask_of_one
from daedalus.actor.environments.precision import FirstLosses
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.errors import ActorError
from daedalus.gateway.client_messages import Act, ClientError, EndEpisode
from daedalus.gateway.client_spaces import ClientSpaces, check_images
from daedalus.gateway.client_uploads import ClientUploads
from daedalus.gateway.policy_versions import PolicyVersion
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import Choice
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.messages import Join, Welcome
from daedalus.protocol.spec import ActorSpec

_logger = logging.getLogger(__name__)


class ClientActor:
    """The state of one client, across its connections and the learner's epochs."""

    def __init__(self, join: Join, spaces: ClientSpaces, uploads: ClientUploads) -> None:
        """`join` names the actor and its incarnation."""
        self.join, self.spaces, self.uploads = join, spaces, uploads
        self._seat: MatchSeat | None = None
        self.heard_at = time.monotonic()
        self.version: PolicyVersion | None = None  # of the rollout that is being written
        self._losses: FirstLosses | None = None
        self._told = set[str]()  # components whose losses were reported
        self._on_action: Callable[[Any], None] = _ignore  # receives the action that the client waits for
        self._session: Welcome | None = None  # that it has joined
        self._transforms: Transforms | None = None  # of that session
        self._rows: ClientRows | None = None
        self._rows_epoch = -1  # of the learner that the rows are for
        self._full_version = -1  # of the last full rollout for that learner
        # The action that is played in the row that has begun, in place of the policy's: as it came, and as gymnasium
        # has it.
        self._override = self._played = None
        self.tape: EpisodeTape | None = None  # records the episodes, if somebody asked for it
        self._seen: Any = None  # the observation of that row, as gymnasium has it

    @property
    def name(self) -> str:
        """The actor's name towards the learner."""
        return self.join.actor

    @property
    def epoch(self) -> int:
        """The learner epoch that it has joined; -1 before the first."""
        return -1 if self._session is None else self._session.learner_epoch

    @property
    def seat(self) -> MatchSeat | None:
        """Its seat in the match that the client hosts, or None."""
        return self._seat

    @seat.setter
    def seat(self, seat: MatchSeat | None) -> None:
        self._seat = seat
        if self._rows is not None:
            self._rows.seat = seat

    # --------------------------------------------------------------------------------------------- joining

    def prepare(self, spec: ActorSpec) -> tuple[Join, Transforms]:
        """Return the request to join a run, and the transforms of its spaces. Raises ClientError if they do not fit."""
        mask = None if self.spaces.example_mask is None else mask_of_one(self.spaces.example_mask)
        try:
            check_run(spec)
            observed = seated_space(spec, self._seat, self.spaces.observation_space)
            transforms = Transforms(spec.environment, observed, self.spaces.action_space, mask)
        except (ActorError, EnvironmentSetupError) as error:
            raise ClientError("refused", str(error)) from None
        check_images(self.spaces.stated, spec.environment)
        self._losses = FirstLosses(without(self.spaces.observation_space, spec.environment.leave_out), self._told)
        return replace(self.join, spaces=transforms.spaces, environments=1), transforms

    def joined(self, session: Welcome, transforms: Transforms) -> None:
        """Take part in a session from now on; the rollouts for an earlier one are dropped."""
        if session.learner_epoch != self.epoch:
            self.uploads.begin(session)
        else:
            self.uploads.resume()
        self._session, self._transforms = session, transforms

    # ---------------------------------------------------------------------------------------------- acting

    def parameters(self, current: PolicyVersion) -> Parameters:
        """Return the parameters of the episode that begins next. Raises ClientError."""
        if self._begins(current):
            self._begin(self._new_rows(current), current)
        rows = self.rows
        if rows.draws is not None and current.lessons is not None:
            rows.draws.plan = current.lessons
        return rows.parameters

    def observe(self, message: Act, current: PolicyVersion, on_action: Callable[[Any], None]) -> None:
        """Note an observation to act on, and what to call with the action.

        Raises ClientError if the message does not fit; nothing has changed then.
        """
        values = self.spaces.observation(message.observation)
        mask = self.spaces.action_mask(message.action_mask)
        played = None if message.override is None else self.spaces.checked_action(message.override)
        self._check_reward(message.reward)
        begins = self._begins(current)
        try:
            rows = self._new_rows(current, message.reward) if begins else self.rows
            rows.observe(values, mask, 0.0 if begins else message.reward)
        except ValueError as error:
            raise ClientError("misfit", str(error)) from None
        if begins:
            self._begin(rows, current)
        for text in self._losses.add(values) if self._losses is not None else ():
            _logger.warning("client %s: %s", self.name, text)
        self._on_action, self._override, self._played = on_action, message.override, played
        if self.tape is not None:
            self.tape.reward(message.reward)
            self._seen = values

    def _begins(self, current: PolicyVersion) -> bool:
        """Whether rows for the learner epoch of a policy begin. The unfinished rollout of others is dropped."""
        epoch = current.session.learner_epoch
        return self._rows is None or (self._rows_epoch != epoch and self.epoch == epoch)

    def _begin(self, rows: ClientRows, current: PolicyVersion) -> None:
        self._rows, self._rows_epoch = rows, current.session.learner_epoch
        self._full_version, self.version = -1, current

    def _check_reward(self, value: float) -> None:
        if value and (self._rows is None or not self._rows.in_episode):
            raise ClientError("out_of_turn", "a reward came before any action of the episode: send an act first")

    def _new_rows(self, current: PolicyVersion, reward: float = 0.0) -> ClientRows:
        """Return rows for the learner epoch of a policy, after a reward of the last action.

        Raises ClientError if it cannot explore as the client must.
        """
        assert self._transforms is not None
        assert self._session is not None
        try:
            rows = ClientRows(
                current.session.spec,
                self._transforms,
                current.runtime,
                np.random.default_rng((self._session.entropy(self.name), 0)),
                on_full=self._keep,
                has_masks=self.spaces.example_mask is not None,
                epsilon=self._session.epsilon,
                seat=self._seat,
            )
        except PolicyError as error:
            raise ClientError("refused", str(error)) from None
        if self._rows is not None:
            rows.take_over(self._rows, reward)
        return rows

    @property
    def rows(self) -> ClientRows:
        """The rows that are being written. Call `observe` before."""
        assert self._rows is not None
        return self._rows

    def select_version(self, current: PolicyVersion) -> PolicyVersion:
        """Return the version that chooses the next row: the current one if the row begins a rollout."""
        if self.rows.is_between_rollouts and self._rows_epoch == current.session.learner_epoch:
            self.version = current
        assert self.version is not None
        return self.version

    def begin_row(self) -> RowInputs:
        """Return what the policy chooses from. Call `select_version` before."""
        return self.rows.begin_row(override=self._played, idle=self._awaits_update)

    @property
    def _awaits_update(self) -> bool:
        """Whether the run makes its actors wait for each update: the client goes on, and its rows are not written."""
        assert self.version is not None
        synchronous = self.version.session.spec.algorithm.synchronous
        return synchronous and self.rows.is_between_rollouts and self.version.version <= self._full_version

    def take(self, choice: Choice) -> bool:
        """Take a choice; return False if the policy must choose once more, after a reset row."""
        if not self.rows.take_choice(choice):
            return False
        self.uploads.rows += 1
        played = self.rows.env_action(choice.actions) if self._override is None else self._played
        if self.tape is not None:
            self.tape.act(self._seen, played)
        if self._override is None:
            self._on_action(self.spaces.action(played))
        else:
            self.uploads.overridden_actions += 1
            self._on_action(self._override)
        return True

    def reward(self, value: float) -> None:
        """Add to the reward of the last action. Raises ClientError if the episode has none, or it is too large."""
        self._check_reward(value)
        if not value:
            return
        try:
            self.rows.reward(value)
        except ValueError as error:
            raise ClientError("misfit", str(error)) from None
        if self.tape is not None:
            self.tape.reward(value)

    def end_episode(self, message: EndEpisode) -> None:
        """End the episode. Raises ClientError if the message does not fit; nothing has changed then."""
        if message.observation is None and not message.terminated:
            raise ClientError("misfit", "a truncated episode needs its last observation for the bootstrap value")
        values = None if message.observation is None else self.spaces.observation(message.observation)
        if self._rows is None or not self._rows.in_episode:
            if self.tape is not None:
                self.tape.drop()
            return  # another learner has come since the last action, whose row is dropped
        try:
            self._rows.end_episode(values, terminated=message.terminated, reward=message.reward)
            self._rows.complete_episode()
        except ValueError as error:
            raise ClientError("misfit", str(error)) from None
        if self.tape is not None:
            self.tape.reward(message.reward)
            self.tape.end(values, terminated=message.terminated)
            self.tape.finish()

    def cut(self) -> None:
        """End the episode as truncated: the client disconnected."""
        self._on_action = _ignore
        if self._rows is not None:
            self._rows.cut()
        if self.tape is not None:
            self.tape.drop()

    def release(self) -> None:
        """Let go of the policy version: this actor will not act again."""
        self.version = self._rows = None

    def _keep(self, rows: ClientRows) -> None:
        assert self.version is not None
        rollout = rows.finished_copy(self.version.version)
        self._full_version = self.version.version
        if self._rows_epoch == self.epoch:  # otherwise it is meant for a previous learner
            self.uploads.keep(rollout)


def _ignore(action: Any) -> None:
    """Receive an action that no client waits for."""
