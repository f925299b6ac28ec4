"""Copies of one game whose seats belong to several runs, and the view that each run has of them.

Each run's seats are a GameEnvironments of its own, on its own thread. A copy of the game is stepped as soon as all runs
whose agents have a new observation have sent their actions; it does not wait for the others. The thread of the run that
sends its actions last makes the step.
"""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.game_copies import GameCopy, Outcome
from daedalus.actor.environments.games import GameEnvironments, close_copies, make_copies
from daedalus.actor.environments.roles import agents_named
from daedalus.actor.environments.vector_environments import BackendStep
from daedalus.policy.user_modules import NO_MODULES, UserModuleError, UserModules
from daedalus.protocol.spec import ActorSpec, EnvironmentSpec
from daedalus.protocol.texts import listed

_WAIT_SECONDS = 0.1  # between two calls of `on_wait`
_MADE_FROM = ("id", "backend", "kwargs", "training_kwargs")  # settings that decide which game is made


class _Copy:
    """One copy of the game, and what its runs still have to see and to answer. The lock of SharedGames guards it."""

    def __init__(self, game: GameCopy, run_of: Mapping[str, str], seed: int) -> None:
        """`run_of` is the run of each agent that one plays; `seed` is that of the first match."""
        self.game, self._run_of = game, run_of
        self._seed: int | None = seed  # None: the first match has begun
        self.chosen: dict[str, Any] = {}
        self.news: dict[str, list[Outcome]] = {}  # of each run, until it has taken them
        self.awaited: set[str] = set()  # runs that were shown something, and have not answered

    def begin(self) -> None:
        """Begin the first match, if it has not begun."""
        if self._seed is not None:
            seed, self._seed = self._seed, None
            self._show(self.game.reset(seed))

    def go_on(self) -> None:
        """Play until a run must answer."""
        while not self.awaited:
            self._show(self.game.reset(None) if self.game.is_over else self.game.step(self.chosen))

    def _show(self, outcomes: list[Outcome]) -> None:
        for outcome in outcomes:
            run = self._run_of[outcome.agent]
            self.news.setdefault(run, []).append(outcome)
            self.awaited.add(run)


class _SeatsOfCopy:
    """The GameCopy that one run plays: its calls return what is new for the run, which may be nothing yet."""

    def __init__(self, copy: _Copy, run: str, agents: Sequence[str]) -> None:
        self._copy, self._run, self._agents = copy, run, frozenset(agents)

    def reset(self, seed: int | None) -> list[Outcome]:
        """See GameCopy. The first match has the seed of the copy."""
        self._copy.begin()
        return self.step({})

    @property
    def turns(self) -> Sequence[str]:
        """See GameCopy."""
        return [agent for agent in self._copy.game.turns if agent in self._agents] if self._is_awaited else ()

    @property
    def _is_awaited(self) -> bool:
        """Whether the run has taken what is new, and must answer."""
        return self._run in self._copy.awaited and self._run not in self._copy.news

    def step(self, actions: Mapping[str, Any]) -> list[Outcome]:
        """See GameCopy. The actions are the answer to what was returned last; they have no effect before that."""
        copy, run = self._copy, self._run
        if self._is_awaited:
            copy.chosen.update(actions)
            copy.awaited.remove(run)
            copy.go_on()
        return copy.news.pop(run, [])

    @property
    def is_over(self) -> bool:
        """See GameCopy."""
        return self._copy.game.is_over


class RoleEnvironments(GameEnvironments):
    """The seats of one run in shared games.

    Attributes:
      on_wait: called about ten times a second while others have to act; what it raises ends the wait. The next `step`
        goes on with the actions that were given before.
    """

    def __init__(self, shared: "SharedGames", run: str, agents: tuple[str, ...], spec: EnvironmentSpec) -> None:
        self._begins = False
        super().__init__(spec.id, shared.environments, spec, agents)  # plays these, which shows whether there are masks
        self._shared, self._run = shared, run
        self.on_wait: Callable[[], object] = lambda: None

    def reset(self, seed: int) -> Any:
        """See BackendEnvironments. Wait until all runs have called this method. Call it once."""
        if not self._begins:
            self._begins = True
            return super().reset(seed)
        copies = self._shared.begin(self._run, seed, self.on_wait)
        self._games = [_SeatsOfCopy(copy, self._run, [*self._numbers]) for copy in copies]
        with self._shared.playing():
            return super().reset(seed)

    def step(self, actions: Any) -> BackendStep:
        """See BackendEnvironments. Wait until one of the run's seats has something new."""
        while True:
            with self._shared.playing() as changed:
                step = super().step(actions)
                changed.notify_all()
                if np.count_nonzero(self.acting):
                    return step
                changed.wait(_WAIT_SECONDS)
            self.on_wait()

    def close(self) -> None:
        """Leave the games to the other runs: SharedGames closes them."""


class SharedGames:
    """Copies of one game for several runs, each of which plays some of the agents. Any thread may use it."""

    def __init__(
        self, seats: Mapping[str, Sequence[str]], count: int | None = None, modules: UserModules = NO_MODULES
    ) -> None:
        """Make no game yet.

        Args:
          seats: the roles or agents that each run plays, by the name of the run.
          count: number of copies; None: as many as the runs specify.
          modules: the modules that may be imported for the game.
        """
        self._seats, self._count, self._modules = dict(seats), count, modules
        self.environments: list[Any] = []
        self._changed = threading.Condition(threading.RLock())
        self._name = ""  # of the game
        self._joined: dict[str, ActorSpec] = {}
        self._agents: dict[str, tuple[str, ...]] = {}  # of each run
        self._seeds: dict[str, int] = {}  # of the runs that have begun
        self._copies: list[_Copy] = []  # from when all have begun
        self._others: GameEnvironments | None = None  # acts for the agents that no run plays
        self._failed: EnvironmentSetupError | None = None

    def join(self, run: str, spec: ActorSpec) -> RoleEnvironments:
        """Return the seats of a run; the first one that joins makes the game.

        Raises EnvironmentSetupError if the runs do not fit together.
        """
        with self._changed:
            self._check(run, spec)
            if not self.environments:
                self._make(spec)
            self._check_agents(run, spec.environment)
            seats = RoleEnvironments(self, run, self._agents[run], spec.environment)
            self._others = self._others or seats
            self._joined[run] = spec
            return seats

    def _check(self, run: str, spec: ActorSpec) -> None:
        if spec.league.openings:
            raise EnvironmentSetupError(
                f"the run {run!r} sets league.openings, but games that several runs share have no random openings: "
                "unset it"
            )
        for other, before in self._joined.items():
            for name in _MADE_FROM:
                own, theirs = getattr(spec.environment, name), getattr(before.environment, name)
                if own != theirs:
                    raise EnvironmentSetupError(
                        f"the runs {other!r} and {run!r} cannot share games: environment.{name} is {theirs!r} and "
                        f"{own!r}"
                    )
            if self._count is None and spec.collection.envs_per_actor != before.collection.envs_per_actor:
                raise EnvironmentSetupError(
                    f"the runs {other!r} and {run!r} ask for {before.collection.envs_per_actor} and "
                    f"{spec.collection.envs_per_actor} copies of the game (collection.envs_per_actor): choose a number "
                    "with --envs"
                )
            if spec.algorithm.synchronous and before.algorithm.synchronous:
                raise EnvironmentSetupError(
                    f"the learners of the runs {other!r} and {run!r} both wait for all actors (training.algorithm is "
                    "synchronous), so that they could wait for each other: use impala, appo or a3c for one of them"
                )

    def _make(self, spec: ActorSpec) -> None:
        try:
            self._modules.check(spec.environment.user_modules)
        except UserModuleError as error:
            raise EnvironmentSetupError(str(error)) from None
        count = self._count or spec.collection.envs_per_actor
        environments = make_copies(spec.environment, count, self._modules)
        try:
            self._agents = self._divided(tuple(environments[0].possible_agents))
        except EnvironmentSetupError:
            for each in environments:
                each.close()
            raise
        self._name, self.environments = spec.environment.id, environments

    def _divided(self, possible: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
        """Return the agents of each run."""
        named = {str(agent): agent for agent in possible}
        agents = {
            run: tuple(named[name] for name in agents_named(names, tuple(named))) for run, names in self._seats.items()
        }
        taken: dict[str, str] = {}
        for run, own in agents.items():
            for agent in own:
                if agent in taken:
                    raise EnvironmentSetupError(
                        f"{agent} would be played by the runs {taken[agent]!r} and {run!r}: name it in one --seat only"
                    )
                taken[agent] = run
        return agents

    def _check_agents(self, run: str, spec: EnvironmentSpec) -> None:
        possible = tuple(self.environments[0].possible_agents)
        own, wanted = self._agents[run], tuple(agent for agent in possible if str(agent) in spec.agents) or possible
        if own != wanted or set(spec.agents) - set(map(str, possible)):
            raise EnvironmentSetupError(
                f"--seat gives {listed(own)} to the run {run!r}, whose environment.agents are "
                f"{listed(spec.agents or possible)}: name a run that plays exactly the agents of these seats"
            )

    def begin(self, run: str, seed: int, on_wait: Callable[[], object]) -> list[_Copy]:
        """Wait until all runs have begun, and return the copies, in their first match. See RoleEnvironments."""
        while True:
            with self.playing() as changed:
                self._seeds[run] = seed
                if not self._copies and len(self._seeds) == len(self._seats):
                    self._copies = self._made()
                    changed.notify_all()
                if self._copies:
                    return self._copies
                changed.wait(_WAIT_SECONDS)
            on_wait()

    def _made(self) -> list[_Copy]:
        assert self._others is not None
        run_of = {agent: run for run, agents in self._agents.items() for agent in agents}
        seeds = np.random.SeedSequence([self._seeds[run] for run in sorted(self._seeds)])
        first = int(seeds.generate_state(1)[0]) // 2  # below 2**31: see EnvironmentCollector
        games = self._others.copies_for(tuple(run_of))
        return [_Copy(game, run_of, max(first - len(games), 0) + number) for number, game in enumerate(games)]

    @contextmanager
    def playing(self) -> Iterator[threading.Condition]:
        """Hold the lock of the games; yield the condition that is notified when they have gone on.

        Raises EnvironmentSetupError if a game has failed, on whichever thread.
        """
        with self._changed:
            if self._failed is not None:
                raise EnvironmentSetupError(str(self._failed))
            try:
                yield self._changed
            except EnvironmentSetupError as error:
                self._failed = error
                self._changed.notify_all()
                raise

    def close(self) -> None:
        """Close the copies, then raise the first exception that one of them raised. Idempotent."""
        with self._changed:
            environments, self.environments = self.environments, []
            close_copies(self._name, environments)
