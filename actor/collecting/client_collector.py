"""The service's side of a client: rollouts from a loop that the caller owns."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.collecting.client_agent import ClientAgent
from daedalus.actor.collecting.client_exchange import ClientExchange, LoadedPolicy
from daedalus.actor.collecting.client_rows import ClientRows, check_run, make_client_rows
from daedalus.actor.collecting.client_seats import match_seats, seated_space
from daedalus.actor.collecting.policy_guard import PolicyGuard
from daedalus.actor.environments.components import without
from daedalus.actor.environments.info import mask_of_one
from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.protocol.lessons import LessonPlan
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity


class ClientCollector:
    """A Collector whose rows the agents of the caller's loop make, on the caller's thread.

    Neither thread waits for the other. Each rollout is one agent's, of one environment. In a run whose actors wait for
    each update, a rollout is of all agents, as that of an actor with as many environments.
    """

    lineup = None  # the caller decides who plays

    def __init__(
        self,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        example_mask: Any,
        guard: PolicyGuard | None = None,
        *,
        agents: int = 1,
        seats: Sequence[str] = (),
        turns: bool = True,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Construct the collector.

        Args:
          observation_space, action_space: those of each agent.
          example_mask: a mask, or a map of masks by action component, if the loop has masks; else None.
          guard: decides when the safe action is played; None: never.
          agents: number of agents.
          seats: names of the seats of each match, which the agents hold in this order, match after match; or none.
          turns: see match_seats.
          check: called before each `act`; raises what has ended the service.
        """
        self._observation_space, self._action_space = observation_space, action_space
        self._example_mask = example_mask
        self.guard = guard or PolicyGuard(action_space, None, None, untrained=False)
        self.policy_loaded = threading.Event()  # the caller may act
        self.on_rollout: Callable[[], None] = lambda: None  # called on the caller's thread when a rollout is full
        self._transforms: Transforms | None = None  # of the run that is being joined
        self._program: OnnxRuntime | None = None
        self._plan: LessonPlan | None = None  # the newest, in a run with lessons
        self._exchange = ClientExchange(agents)
        self.agents = tuple(ClientAgent(index, self._exchange, self.guard, check) for index in range(agents))
        for first in range(0, agents if seats else 0, max(len(seats), 1)):
            for seat in match_seats(seats, turns=turns):
                self.agents[first + seat.number].seat = seat

    @property
    def dropped(self) -> int:
        """Number of rollouts, finished or not, that the service never took."""
        return self._exchange.dropped

    @property
    def has_joined(self) -> bool:
        """Whether a learner has accepted the client, and its program has come."""
        return self._program is not None

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        """See Collector."""
        check_run(spec)
        example = None if self._example_mask is None else mask_of_one(self._example_mask)
        observed = [seated_space(spec, agent.seat, self._observation_space) for agent in self.agents]
        self._transforms = Transforms(spec.environment, observed[0], self._action_space, example)
        for agent in self.agents:
            agent.watch(without(self._observation_space, spec.environment.leave_out))
        return self._transforms.spaces, len(self.agents) if spec.algorithm.synchronous else 1

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        """See Collector. Discard the rollouts of the previous policy."""
        assert isinstance(runtime, OnnxRuntime)  # a client has no other
        self._program = runtime
        self._plan = None
        rows = [self._rows(agent, spec, (seed, index), epsilon) for index, agent in enumerate(self.agents)]
        self._exchange.begin(rows, together=spec.algorithm.synchronous)

    def _rows(self, agent: ClientAgent, spec: ActorSpec, seed: tuple[int, int], epsilon: float) -> ClientRows:
        assert self._transforms is not None
        assert self._program is not None

        def keep(full: ClientRows) -> None:
            agent.keep(full)
            self.on_rollout()

        return make_client_rows(
            spec,
            self._transforms,
            self._program,
            np.random.default_rng(seed),
            epsilon=epsilon,
            example_mask=self._example_mask,
            on_full=keep,
            seat=agent.seat,
        )

    def load(self, snapshot: Snapshot) -> None:
        """See Collector. Loading takes long for a large network: it is done here and not in the caller's loop."""
        assert self._program is not None
        runtime = self._program.fork()
        runtime.load(snapshot.weights)
        self._plan = snapshot.lessons or self._plan
        self._exchange.offer(LoadedPolicy(snapshot.policy_version, runtime, self._plan))

    def confirm(self, at: float) -> None:
        """See Collector."""
        self._exchange.confirm(at)
        self.policy_loaded.set()

    def has_rollout(self) -> bool:
        """Return whether `collect` would return a rollout now. Safe from any thread."""
        return self._exchange.has_rollout()

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout | None:
        """See Collector. Return an agent's oldest full rollout. `on_row` has no effect: the loop makes the rows."""
        rollout = self._exchange.take()
        return None if rollout is None else replace(rollout, identity=identity)

    def close(self) -> None:
        """See Collector. There is nothing to release."""
