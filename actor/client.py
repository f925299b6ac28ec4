"""`from daedalus.actor import Client`: an actor for a simulator or a robot that runs its own loop.

    spaces = {"observation_space": robot.observation_space, "action_space": robot.action_space}
    with Client("tcp/gpu-box:7447", **spaces) as client:
        while robot.works():
            action = client.act(robot.look())
            client.reward(robot.do(action))
            if robot.fell():
                client.end_episode(terminated=True)

A client sends the same rollouts as any actor, from a thread of its own: no call waits for the network after the first
policy has come. While the learner is away or too slow, the client keeps the newest rollouts and the last policy, or
plays a safe action. A loop with several agents passes their number and uses `client.agents`.
"""

import itertools
import math
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import TracebackType
from typing import Any, get_args

import gymnasium

from daedalus.actor.collecting.client_collector import ClientCollector
from daedalus.actor.collecting.loop_recorder import LoopRecorder
from daedalus.actor.collecting.policy_guard import PolicyGuard
from daedalus.actor.errors import ActorError
from daedalus.actor.session.actor_config import ActorConfig, LinkChoice, own_name
from daedalus.actor.session.actor_service import ActorService
from daedalus.protocol import keys
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.messages import MAX_ENVIRONMENTS, ClientReport
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import credentials_to_connect, run_for


class Clock:
    """The ticks of a loop, a fixed time apart. Each tick is the deadline for the work of the one before.

        with client.clock(rate=20) as clock:
            while clock.wait():
                ...

    A loop that comes too late goes on at the next tick that is still to come. It never hurries to catch up: the ticks
    in between are counted as missed.
    """

    def __init__(
        self,
        rate: float,
        *,
        is_over: Callable[[], bool] = lambda: False,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Construct the clock; its first tick is the first `wait`.

        Args:
          rate: ticks a second, above 0.
          is_over: whether to end the loop; asked at each tick.
          now, sleep: replaced in tests.

        Raises ValueError if the rate is not above 0.
        """
        if not 0.0 < rate < math.inf:
            raise ValueError(f"the rate is {rate}: it must be above 0 ticks a second")
        self._period, self._is_over, self._now, self._sleep = 1.0 / rate, is_over, now, sleep
        self._began: float | None = None
        self.deadlines = 0  # that have passed
        self.missed_deadlines = 0

    def wait(self) -> bool:
        """Wait for the next tick; return False if the loop shall end."""
        if self._began is None:
            self._began = self._now()
            return not self._is_over()
        due = self._began + (self.deadlines + 1) * self._period
        missed = max(math.ceil((self._now() - due) / self._period), 0)
        due += missed * self._period
        while (early := due - self._now()) > 0.0:
            self._sleep(early)
        missed += math.floor((self._now() - due) / self._period)  # if the operating system woke the loop so late
        self.missed_deadlines += missed
        self.deadlines += 1 + missed
        return not self._is_over()

    def __enter__(self) -> "Clock":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the loop. There is nothing to release."""


_REFUSAL_SECONDS = 12.0  # after `timeout`, for the last two queries of the client's thread, if nobody answers them
_RECORDING_SECONDS = 10.0  # for the last episodes to be written
_numbers = itertools.count(1)  # of the clients of this process


class Client:
    """One actor in a loop that the caller owns. Not for several threads at once.

    Attributes:
      agents: one ClientAgent for each agent of the loop, with `act`, `reward` and `end_episode` of its own. The methods
        of the same names here are those of the first.
    """

    def __init__(
        self,
        connect: str,
        *,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        name: str | None = None,
        run: str = keys.ANY_RUN,
        tls: str | Path | None = None,
        link: LinkChoice = "auto",
        timeout: float = 60.0,
        action_mask: Any = None,
        safe_action: Any = None,
        max_policy_age: float | None = None,
        untrained: bool = False,
        agents: int | None = None,
        seats: Sequence[str] = (),
        turns: bool | None = None,
        record: str | Path | None = None,
    ) -> None:
        """Join a run, and wait for the first policy.

        Args:
          connect: address of the learner or of a router, such as `tcp/gpu-box:7447`.
          observation_space: a gymnasium Box, Discrete, MultiDiscrete or MultiBinary, or a Dict or Tuple of these.
          action_space: of the same kinds.
          name: keep it after a restart; default: made of the host name and the process id.
          run: the run to join, if several share a network.
          tls: folder of this actor's certificate (`daedalus certs`), for addresses that begin with tls/.
          link: see `daedalus actor --help`.
          timeout: seconds to wait for a learner and its first policy. A learner that goes away later is waited for
            as long as the client is open.
          action_mask: an example of the masks that `act` gets, if some discrete actions are not always legal: an array
            over all choices, or a map of arrays by action component.
          safe_action: what to play while the policy is too old or untrained: an action, or a function that returns one
            for an observation. None: the policy always acts.
          max_policy_age: with a safe action, the seconds within which the learner must have confirmed that it has no
            newer policy; default: 30.
          untrained: with a safe action, whether a policy may act that no update of this run has changed. Such a policy
            is random, unless the run began with trained weights.
          agents: number of agents in the loop, each with these spaces: robots, players, or copies of a simulator;
            default: 1, or one for each seat.
          seats: of a game that the loop hosts: names of the seats of a match, in the order of the agents of the run's
            environment. The agents hold them in this order, match after match: with two seats, agents 0 and 1 play the
            first match, 2 and 3 the second.
          turns: with seats, whether they act one after the other, so that each action is a step of the game; False:
            they act together, and the actions of one match up to the next one of the same seat are one step.
          record: a new Minari dataset, for `--demonstrations`: each episode that ends is written into it, with the
            actions that were played, by the policy or in its place. A folder, which begins with `./`, `/` or `~`, or an
            id in Minari's local folder.

        Raises ValueError for a safe action that is not in the action space, a number of agents that is not from 1 to
        4096 or does not fill whole matches, unfit names of seats, seats without `turns`, another link, or a timeout
        that is not above 0; DatasetError for a dataset that exists, or without Minari; ActorError, TransportError,
        EnvironmentSetupError, AddressError or CredentialsError.
        """
        agents = _number_of_agents(agents, seats, turns)
        if link not in get_args(LinkChoice):
            raise ValueError(f"link is {link!r}: choose from {', '.join(get_args(LinkChoice))}")
        if not isinstance(timeout, Real) or not timeout > 0.0:
            raise ValueError(f"timeout is {timeout!r}: it must be a number of seconds above 0")
        timeout = min(float(timeout), threading.TIMEOUT_MAX)  # threading takes no others
        guard = PolicyGuard(action_space, safe_action, max_policy_age, untrained=untrained)
        credentials = credentials_to_connect([connect], tls, "actor")
        identity = credentials.name if credentials else ""
        config = ActorConfig(
            name=keys.check_name(name or own_name(identity, next(_numbers)), "actor name"),
            incarnation=secrets.randbits(62),
            run=run_for(credentials, run),
            link=link,
            timeout=timeout,
            searched_since=(began := time.monotonic()),
            waits_for_return=True,  # the caller's loop goes on meanwhile
            max_policy_age=guard.max_age if guard.enabled else None,
        )
        self._config = config
        self._stop = threading.Event()
        self._collector = ClientCollector(
            observation_space,
            action_space,
            action_mask,
            guard,
            agents=agents,
            seats=seats,
            turns=turns is not False,
            check=self._check,
        )
        self.agents = self._collector.agents
        self._recorder = None if record is None else LoopRecorder(str(record))
        if self._recorder is not None:
            for agent in self.agents:
                agent.tape = self._recorder.tape(observation_space, action_space)
        self._clocks: list[Clock] = []
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._serve, name="actor", daemon=True)
        transport = connect_with_retry([connect], self._stop, timeout, credentials)
        assert transport is not None  # only a stop makes it None
        self._transport = transport
        try:
            self._service = ActorService(config, transport, self._stop, self._collector, report=self._report)
            self._collector.on_rollout = self._service.wake
            self._thread.start()
            self._await_policy(began, timeout)
        except BaseException:  # also Ctrl-C: a process that ends with an open session aborts
            self.close()
            raise

    def _await_policy(self, began: float, timeout: float) -> None:
        """Wait for the first policy until `timeout` seconds after `began`. Raises ActorError without one."""
        left = max(began + timeout - time.monotonic(), 0.0)
        if not self._collector.policy_loaded.wait(left) and not self._collector.has_joined:
            self._collector.policy_loaded.wait(_REFUSAL_SECONDS)  # the thread knows why it cannot join
        if not self._collector.policy_loaded.is_set():
            raise ActorError(f"no policy came within {timeout:g} s: check that the learner is training")
        self._check()

    def act(self, observation: Any, action_mask: Any = None, *, override: Any = None) -> Any:
        """See ClientAgent.act: this is the first agent."""
        return self.agents[0].act(observation, action_mask, override=override)

    @property
    def parameters(self) -> Parameters:
        """See ClientAgent.parameters: this is the first agent."""
        return self.agents[0].parameters

    def reward(self, value: float) -> None:
        """See ClientAgent.reward: this is the first agent."""
        self.agents[0].reward(value)

    def clock(self, rate: float) -> Clock:
        """Return a clock with `rate` ticks a second, for the loop that calls `act`. The loop ends with the run."""
        self._clocks.append(Clock(rate, is_over=lambda: self.is_over))
        return self._clocks[-1]

    def end_episode(self, *, terminated: bool, observation: Any = None) -> None:
        """See ClientAgent.end_episode: this is the first agent."""
        self.agents[0].end_episode(terminated=terminated, observation=observation)

    def success(self, reward: float = 1.0, observation: Any = None) -> None:
        """See ClientAgent.success: this is the first agent."""
        self.agents[0].success(reward, observation)

    @property
    def dropped(self) -> int:
        """How many rollouts, finished or not, were dropped because the learner was away or accepted none for long."""
        return self._collector.dropped

    @property
    def safe_reason(self) -> str:
        """Why the last `act` returned the safe action; empty if the policy acted."""
        return self._collector.guard.reason

    @property
    def is_over(self) -> bool:
        """Whether the run has ended: `act` still works, but nobody learns from it.

        False after an error, so that a loop goes on and its next `act` raises it.
        """
        return self._error is None and not self._thread.is_alive()

    def close(self) -> None:
        """Leave the run. Idempotent."""
        self._stop.set()
        try:
            if self._thread.is_alive():
                self._thread.join(timeout=10.0)
        finally:  # also after another Ctrl-C
            self._transport.close()
            self._close_recording()

    def _close_recording(self) -> None:
        if self._recorder is not None:
            for agent in self.agents:
                if agent.tape is not None:
                    agent.tape.finish()
            self._recorder.close(_RECORDING_SECONDS)

    def _report(self) -> ClientReport:
        """Return what the status shows of this client. Called on the client's thread."""
        collector, clocks = self._collector, list(self._clocks)
        return ClientReport(
            actor=self._config.name,
            incarnation=self._config.incarnation,
            rows=sum(agent.actions for agent in self.agents),
            deadlines=sum(clock.deadlines for clock in clocks),
            missed_deadlines=sum(clock.missed_deadlines for clock in clocks),
            overridden_actions=sum(agent.overridden_actions for agent in self.agents),
            safe_actions=sum(agent.safe_actions for agent in self.agents),
            rollouts_dropped=collector.dropped,
            safe_reason=collector.guard.reason,
        )

    def _check(self) -> None:
        """Raise what has ended the client's thread."""
        if self._error is not None:
            raise self._error

    def _serve(self) -> None:
        try:
            self._service.run()
            if not self._collector.policy_loaded.is_set():
                self._error = ActorError("the run ended before a policy came: check that the learner is training")
        except Exception as error:  # broad: any error, ours too, is raised on the caller's thread by its next act()
            self._error = error
        finally:
            self._collector.policy_loaded.set()

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _number_of_agents(agents: int | None, seats: Sequence[str], turns: bool | None) -> int:
    if isinstance(seats, str) or (bool(seats) != (turns is not None)):
        raise ValueError("give both seats, a list of names, and turns, or neither")
    agents = agents if agents is not None else max(len(seats), 1)
    if not isinstance(agents, Integral) or not 1 <= agents <= MAX_ENVIRONMENTS:
        raise ValueError(f"agents is {agents!r}: it must be from 1 to {MAX_ENVIRONMENTS}")
    if seats and agents % len(seats):
        raise ValueError(f"agents is {agents}: with {len(seats)} seats in each match it must be a multiple of them")
    return int(agents)
