"""Games with several agents: the rows of each seat, what is refused, and a training of one policy in all seats."""

import re
import sys
from typing import Any

import numpy as np
import pytest
import scripted_games
from collectors import collect, started_collector
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.classic.tictactoe import tictactoe
from pettingzoo.utils.conversions import aec_to_parallel_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper
from plain import Always, RowCounter

from daedalus.actor.checking.check_report import EnvironmentReport
from daedalus.actor.checking.play import check_environment
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import play_episodes
from daedalus.learner.run.settings import SettingsError, run_spec
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.league import MatchCount, Plan, PlannedOpponent, PlannedRating
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.protocol.spec import EnvironmentSpec, LeagueSpec, PolicySpec, TrainingSpec

ROLLOUTS = 6


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    agents=st.integers(1, 4),
    copies=st.integers(1, 3),
    length=st.integers(1, 7),
    kind=st.sampled_from(["Turns", "Together"]),
    share=st.sampled_from([0.0, 0.4, 1.0]),
)
def test_rows_of_each_seat_are_those_of_a_slow_account(
    seed: int, agents: int, copies: int, length: int, kind: str, share: float
) -> None:
    spec = EnvironmentSpec(id=f"scripted_games:{kind}", backend="pettingzoo", kwargs={"seed": seed, "agents": agents})
    scripted_games.PLAYED.clear()
    first_copy, together = scripted_games.Scripted.made, kind == "Together"
    side = agents // 2 if agents in (2, 4) else agents
    names = [f"agent_{number}" for number in range(agents)]
    sides = (tuple(names[:side]), tuple(names[side:])) if side < agents else ()
    opponents = {"random": share if sides else 0.0}
    league = LeagueSpec(past_share=0.0, opponents=opponents, rating_share=0.2, sides=sides)
    collector = started_collector(spec, RowCounter(), count=copies, rollout_length=length, league=league)
    alone = copies - (round(share * copies) if sides else 0)  # the others play against an opponent
    accounts: dict[int, dict] = {}
    seen, members, results = set(), dict[tuple[int, int], set[int]](), list[MatchCount]()
    last: dict[int, tuple[int, int]] = {}
    counted = 0
    try:
        for _ in range(ROLLOUTS):
            rollout = collect(collector)
            assert rollout.environments == alone * agents + (copies - alone) * side
            frames, steps = rollout.frames["observation"], set()
            for column in range(rollout.environments):
                copy = column // agents if column < alone * agents else alone + (column - alone * agents) // side
                for row in np.flatnonzero(rollout.valid[:, column]):
                    match, agent, number = (int(number) for number in frames[row, column])
                    key = match, agent, number
                    assert (match, number) > last.get(column, (-1, -1))  # in order
                    last[column] = match, number
                    assert (copy, key) not in seen  # none twice
                    seen.add((copy, key))
                    members.setdefault((copy, match), set()).add(agent)
                    if row and rollout.valid[row - 1, column]:
                        assert tuple(frames[row - 1, column]) == (match, agent, number - 1)
                    elif row:
                        assert number == 0  # after a row that only resets
                    if match not in accounts:
                        accounts[match] = scripted_games.rows(seed, match, agents, together=together)
                    wanted = accounts[match][key]
                    assert rollout.rewards[row, column] == wanted.reward
                    assert rollout.terminated[row, column] == wanted.terminated
                    assert rollout.truncated[row, column] == wanted.truncated
                    if not (wanted.terminated or wanted.truncated):
                        assert tuple(frames[row + 1, column]) == (match, agent, number + 1)
                    assert rollout.behaviour_log_probs[row, column] == number
                    assert rollout.actions["action"][row, column, 0] == scripted_games.PLAYED[first_copy + copy, key]
                    steps.add((copy, match, wanted.step))
                if rollout.valid[0, column]:  # the memory goes on in an episode, and begins anew in the next
                    assert rollout.initial_state[column, 0] == frames[0, column, 2]
            assert rollout.agent_steps == np.count_nonzero(rollout.valid)
            # The steps of opponents in the same matches count, too.
            most = len(steps) if alone == copies else rollout.agent_steps * 2
            assert len(steps) <= rollout.env_steps <= most
            counted += rollout.env_steps
            played = sum(number < first_copy + copies for number, _ in scripted_games.PLAYED)  # not those that rate
            assert counted <= played
            for match in {key[0] for _, key in scripted_games.PLAYED}:
                accounts.setdefault(match, scripted_games.rows(seed, match, agents, together=together))
            episodes = {
                (sum(row.reward for row in played), len(played))
                for account in accounts.values()
                for agent in range(agents)
                if (played := [row for key, row in account.items() if key[1] == agent])
            }
            found = zip(rollout.episode_returns.tolist(), rollout.episode_lengths.tolist(), strict=True)
            assert set(found) <= episodes
            results += rollout.matches.counts if rollout.matches is not None else ()
    finally:
        collector.close()
    for (copy, _), playing in members.items():
        if copy >= alone:  # one side only
            assert len({agent // side for agent in playing}) == 1
    totals = {match: scripted_games.totals(seed, match, agents, together=together) for match in accounts}
    check_results(results, totals, [first_copy + copy for copy in range(alone, copies)], side)


def check_results(results: list[MatchCount], totals: dict[int, list[float]], games: list[int], side: int) -> None:
    """Check the results against newest-against-random matches of some games, whoever had which side."""
    assert {(each.purpose, each.first, each.second) for each in results} <= {("training", "newest", "random")}
    most = np.zeros((2, 3))
    finished = 0
    for game in games:
        played = {key[0] for number, key in scripted_games.PLAYED if number == game}
        finished += len(played)
        for match in played:
            means = [sum(totals[match][:side]), sum(totals[match][side:])]
            for own in range(2):
                most[own, 1 - int(np.sign(means[own] - means[1 - own]))] += 1
    counted = np.zeros((2, 3))
    for each in results:
        counted[each.side] += each.wins, each.draws, each.losses
    assert (counted <= most).all()
    assert finished - len(games) <= counted.sum() <= finished  # the newest match of a game may go on


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    agents=st.integers(1, 4),
    kind=st.sampled_from(["Turns", "Together"]),
    openings=st.integers(1, 20),
)
def test_rows_after_random_openings_are_those_of_a_slow_account(
    seed: int, agents: int, kind: str, openings: int
) -> None:
    spec = EnvironmentSpec(id=f"scripted_games:{kind}", backend="pettingzoo", kwargs={"seed": seed, "agents": agents})
    scripted_games.PLAYED.clear()
    league = LeagueSpec(past_share=0.0, opponents={}, rating_share=0.0, openings=openings)
    collector = started_collector(spec, RowCounter(), rollout_length=20, league=league)
    learned, steps, counted = set(), set[tuple[int, int]](), 0
    try:
        for _ in range(ROLLOUTS):
            rollout = collect(collector)
            frames = rollout.frames["observation"]
            counted += rollout.env_steps
            for row, column in np.argwhere(rollout.valid):
                match, agent, number = (int(number) for number in frames[row, column])
                account = scripted_games.rows(seed, match, agents, together=kind == "Together")
                wanted = account[match, agent, number]
                found = rollout.rewards[row, column], rollout.terminated[row, column], rollout.truncated[row, column]
                assert found == (wanted.reward, wanted.terminated, wanted.truncated)
                if not (wanted.terminated or wanted.truncated):
                    assert tuple(frames[row + 1, column]) == (match, agent, number + 1)
                assert (match, agent, number) not in learned
                if row and number and (match, agent, number - 1) not in learned:
                    assert account[match, agent, number - 1].step < openings
                learned.add((match, agent, number))
                steps.add((match, wanted.step))
    finally:
        collector.close()
    played = {
        (match, scripted_games.rows(seed, match, agents, together=kind == "Together")[match, agent, number].step)
        for _, (match, agent, number) in scripted_games.PLAYED
    }
    assert counted < len(played)


def test_openings_have_every_length_up_to_the_largest() -> None:
    spec = EnvironmentSpec(id="scripted_games:Together", backend="pettingzoo", kwargs={"seed": 1, "agents": 1})
    league = LeagueSpec(past_share=0.0, opponents={}, rating_share=0.0, openings=3)
    collector = started_collector(spec, RowCounter(), count=8, rollout_length=100, league=league)
    rollout = collect(collector)
    collector.close()
    matches, _, numbers = rollout.frames["observation"][:-1].transpose(2, 0, 1).astype(int)
    firsts = [
        numbers[rollout.valid[:, column] & (matches[:, column] == match), column].min()
        for column in range(8)
        for match in np.unique(matches[rollout.valid[:, column], column])
    ]
    shares = np.bincount(firsts, minlength=4) / len(firsts)
    assert len(shares) == 4
    assert shares.min() > 0.05  # a match that ends in its opening begins again without one


def test_policies_of_opponents_play_their_seats_alone_and_lose() -> None:
    """Each action earns itself: the newest policy always wins with 1 against 0, and its rows have no action 0."""
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": "free"})
    league = LeagueSpec(past_share=0.5, rating_share=0.5)
    modules = UserModules(frozenset({"test_games"}))
    collector = started_collector(spec, Always(1), count=4, rollout_length=10, league=league, modules=modules)
    lineup = collector.lineup
    assert lineup is not None
    assert lineup.describe().endswith("2 against itself, 2 against opponents, 4 to rate players")
    counts: dict[tuple[str, str, str], np.ndarray] = {}
    for number in range(12):
        if number == 1:
            lineup.plan = Plan(
                training=(PlannedOpponent(player="v1", weight=0.5),),
                rating=(PlannedRating(first="v1", second="v2", weight=1.0),),
            )
        if lineup.wanted and number > 1:
            lineup.add_policy(lineup.wanted, Always(0))
        rollout = collect(collector)
        assert rollout.environments == 2 * 2 + 2
        assert (rollout.actions["action"][rollout.valid] == 1).all()
        assert set(rollout.episode_returns.tolist()) <= {5.0}
        for each in rollout.matches.counts if rollout.matches is not None else ():
            key = each.purpose, each.first, each.second
            counts[key] = counts.get(key, np.zeros(3)) + np.array([each.wins, each.draws, each.losses])
    collector.close()
    assert set(counts) == {("training", "newest", "v1"), ("rating", "v1", "v2")}
    wins, *others = counts["training", "newest", "v1"]
    assert wins > 10
    assert others == [0, 0]
    rated = counts["rating", "v1", "v2"]
    assert rated.sum() == rated[1]
    assert rated[1] > wins / 2  # as many as all training matches, half of which count


def test_the_steps_of_an_opponent_count_also_if_it_is_the_newest_policy() -> None:
    """Before the first version is kept, the newest policy plays the other side, whose rows are not learned from."""
    spec = EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3")
    environments = make_environments(spec, 1)
    learner = Learner(TrainingSpec(), PolicySpec(hidden=(8,)), environments.spaces)
    environments.close()
    runtime = OnnxRuntime(learner.program())
    collector = started_collector(
        spec, runtime, count=2, rollout_length=40, league=LeagueSpec(past_share=1.0), weights=learner.weights()
    )
    rollout = collect(collector)
    collector.close()
    assert rollout.environments == 2
    assert 1.8 < rollout.env_steps / rollout.agent_steps < 2.2


class KeptChecks(OrderEnforcingWrapper):
    """A wrapper that the backend does not know, with those of PettingZoo in it."""


class KeptConversion(aec_to_parallel_wrapper):
    """A conversion that the backend does not know."""


def tic_tac_toe(*, kept: bool) -> Any:
    return KeptChecks(tictactoe.env()) if kept else tictactoe.env()


def zombies(*, kept: bool) -> Any:
    from pettingzoo.butterfly.knights_archers_zombies import knights_archers_zombies  # it asks for no bytecode

    game = knights_archers_zombies.env(spawn_delay=5, max_cycles=60)  # agents die early
    return KeptConversion(game) if kept else aec_to_parallel_wrapper(game)


@pytest.mark.parametrize("fields", [{}, {"leave_out": ("action_mask",)}, {"id": "test_games:zombies"}])
def test_games_are_the_same_without_pettingzoo_s_checks(fields: dict[str, Any]) -> None:
    tapes = []
    for kept in (False, True):
        spec = EnvironmentSpec(
            **{"id": "test_games:tic_tac_toe", "backend": "pettingzoo", "kwargs": {"kept": kept}, **fields}
        )
        environments = make_environments(spec, 2, modules=UserModules(frozenset({"test_games"})))
        random = np.random.default_rng(4)
        observed, tape = environments.reset(2), []
        for _ in range(80):
            legal = observed.masks.get("action", np.ones((environments.count, 6)))
            if "leave_out" in fields:
                legal = np.ones((environments.count, 9))  # the wrapper ends the match at an illegal action
            actions = np.argmax(legal * random.random(legal.shape), axis=1)[:, None]
            observed, *outcome = environments.step({"action": actions})
            tape.append((*(values.copy() for values in observed.frames.values()), observed.acting, *outcome))
        environments.close()
        tapes.append(tape)
    for one, other in zip(*tapes, strict=True):
        for values, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(values, same)


@pytest.mark.parametrize(
    ("league", "text"),
    [
        (
            {"sides": [["red", "blue"]], "past_share": 0.5},
            r"league\.past_share is set, but .* \(red, blue\) are one side",
        ),
        ({"sides": [["red", "blue"]], "opponents": {"random": 0.1}}, r"league\.opponents is set, but"),
        ({"sides": [["red"]]}, "must name each agent of the policy once"),
        ({"sides": [["red", "blue"], ["red"]]}, "must name each agent of the policy once"),
    ],
)
def test_opponents_that_a_game_cannot_have_are_refused(league: dict[str, Any], text: str) -> None:
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": "free"})
    modules = UserModules(frozenset({"test_games"}))
    with pytest.raises(EnvironmentSetupError, match=text):
        started_collector(spec, Always(1), rollout_length=5, league=LeagueSpec.model_validate(league), modules=modules)


@pytest.mark.parametrize(("share", "columns"), [(1.0, 10), (0.9, 10), (0.5, 13)])
def test_past_versions_have_what_the_opponents_leave(share: float, columns: int) -> None:
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": "free"})
    league, modules = LeagueSpec(opponents={"random": share}), UserModules(frozenset({"test_games"}))
    collector = started_collector(spec, Always(1), count=10, rollout_length=5, league=league, modules=modules)
    rollout = collect(collector)
    collector.close()
    assert rollout.environments == columns  # 2 of a copy without opponents, 1 of the others
    assert rollout.agent_steps == 5 * columns


def test_too_few_copies_for_the_opponents_are_said(caplog: pytest.LogCaptureFixture) -> None:
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": "free"})
    for copies in (2, 3):
        modules = UserModules(frozenset({"test_games"}))
        started_collector(spec, Always(1), count=copies, rollout_length=5, modules=modules).close()
        said = [record.message for record in caplog.records if "no match is played against opponents" in record.message]
        assert len(said) == 1
        assert "0.2 of 2 copies" in said[0]
        assert "to 3 or more" in said[0]


def test_a_match_that_only_rates_and_does_not_end_is_abandoned(caplog: pytest.LogCaptureFixture) -> None:
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": "endless"})
    modules, league = UserModules(frozenset({"test_games"})), LeagueSpec(past_share=0.0, rating_share=0.5)
    collector = started_collector(
        spec, Always(1), count=2, rollout_length=12, league=league, modules=modules, longest=10
    )
    lineup = collector.lineup
    assert lineup is not None
    lineup.add_policy("v1", Always(0))  # the match ends when red takes 1
    pairs = (("v1", "v2"), ("newest", "random"))
    lineup.plan = Plan(rating=tuple(PlannedRating(first=one, second=two, weight=0.5) for one, two in pairs))
    lineup.add_policy("v2", Always(0))
    players = set()
    for _ in range(30):
        rollout = collect(collector)
        assert (rollout.actions["action"][rollout.valid] == 1).all()
        counts = rollout.matches.counts if rollout.matches is not None else ()
        players |= {(each.first, each.second) for each in counts}
    collector.close()
    assert players == {("newest", "random")}
    warnings = [record for record in caplog.records if "is abandoned without a result" in record.message]
    assert len(warnings) == 1


def make(problem: str = "", **fields: Any) -> EnvironmentReport:
    """Check a game of this module, with a fault."""
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": problem}, **fields)
    return check_environment(spec, UserModules(frozenset({"test_games"})), seconds=5.0, env_steps=20)


class Duel(ParallelEnv):
    """Two agents guess a bit of their observation; a match has five steps."""

    def __init__(self, problem: str = "") -> None:
        self.metadata, self.possible_agents = {"name": "duel"}, ["red", "blue"]
        self.problem = problem
        if problem == "same name":
            self.possible_agents = ["red", "red"]

    def observation_space(self, agent: str) -> Box:
        return Box(0.0, 1.0, (3 if self.problem == "spaces" and agent == "blue" else 2,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        return Discrete(2)

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        self.agents, self.left = list(self.possible_agents), 5
        seen = self._seen()
        if self.problem == "unknown agent":
            self.agents, seen = ["green", *self.agents], seen | {"green": seen["red"]}
        return seen, self._info()

    def step(self, actions: dict[str, int]) -> Any:
        if self.problem == "raises":
            raise RuntimeError("the table broke")
        self.left -= 1
        here, over = self.agents, self.left <= 0 and (self.problem != "endless" or actions["red"] == 1)
        rewards: dict[str, Any] = {
            agent: float(actions[agent]) if self.problem != "reward" else np.nan for agent in here
        }
        self.agents = here if not over or self.problem.endswith("stays") else []
        terminated: dict[str, Any] = dict.fromkeys(here, over and self.problem not in ("no end", "all, stays"))
        if self.problem == "other agent":
            rewards = {"Red": 1.0, "__all__": 1.0}
        if self.problem == "reward in a list":
            rewards["blue"] = [1.0]
        if self.problem == "end as text":
            terminated["blue"] = str(over)
        if self.problem == "all, stays":
            terminated["__all__"] = over
        if self.problem == "late reward":
            terminated["blue"], self.agents = True, [each for each in self.agents if each != "blue"]
            rewards["blue"] = 2.0 if over else 0.0
        return self._seen(), rewards, terminated, dict.fromkeys(here, False), self._info()

    def _seen(self) -> dict[str, np.ndarray]:
        more = 2 if self.problem == "shape" and self.left < 5 else 0
        agents = self.agents if self.problem == "no last observation" else self.possible_agents
        return {agent: np.full(self.observation_space(agent).shape[0] + more, 0.5, np.float32) for agent in agents}

    def _info(self) -> dict[str, dict]:
        if self.problem in ("free", "endless"):
            return {agent: {} for agent in self.possible_agents}
        mask = np.array([0, 0 if self.problem == "no choice" and self.left < 5 else 1], np.int8)
        return {agent: {"action_mask": mask} for agent in self.possible_agents}


def test_a_game_whose_observations_stand_still_is_a_warning() -> None:
    def warnings(game: str) -> tuple[str, ...]:
        spec = EnvironmentSpec(id=game, backend="pettingzoo")
        modules = UserModules(frozenset({"test_games"}))
        return check_environment(spec, modules, seconds=60.0, env_steps=40).warnings

    (still,) = warnings("test_games:Duel")  # four of five steps, because the last ends the match
    assert still.startswith("environment test_games:Duel: the observation has changed in none of 56 rows within an epi")
    assert warnings("pettingzoo.classic.tictactoe_v3") == ()


class Board(Duel):
    """Both agents see how many steps are left; with `own`, also which agent sees it."""

    def __init__(self, own: bool = False) -> None:
        super().__init__("free")
        self.own = own

    def _seen(self) -> dict[str, np.ndarray]:
        return {
            agent: np.array([self.left / 5, self.own and agent == "red"], np.float32) for agent in self.possible_agents
        }


@pytest.mark.parametrize("fields", [{}, {"kwargs": {"own": True}}, {"agent_ids": True}, {"agents": ("red",)}])
def test_agents_that_always_observe_the_same_are_a_warning(fields: dict[str, Any]) -> None:
    spec = EnvironmentSpec(id="test_games:Board", backend="pettingzoo", **fields)
    report = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=80)
    # Nor is it one that the number of the agent, which differs between the agents, never changes for one of them.
    assert ["--set environment.agent_ids=true" in warning for warning in report.warnings] == [True] * (not fields)


class Lists(Board):
    """Its masks are lists of different lengths, as `sample` of a MultiDiscrete takes them."""

    def action_space(self, agent: str) -> Any:
        return MultiDiscrete([2, 3])

    def step(self, actions: dict[str, Any]) -> Any:
        assert all(action[0] == 0 and action[1] > 0 for action in actions.values())
        return super().step({agent: action[0] for agent, action in actions.items()})

    def _info(self) -> dict[str, dict]:
        return {agent: {"action_mask": ([1, 0], [0, 1, 1])} for agent in self.possible_agents}


def test_masks_of_a_game_may_be_lists_of_different_lengths() -> None:
    spec = EnvironmentSpec(id="test_games:Lists", backend="pettingzoo")
    report = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=20)
    assert (report.problems, set(report.lengths)) == ((), {5})


class Drawn(Board):
    """Its constructor draws the rewards, or each reset; `info` or the observation says which choices are legal."""

    def __init__(self, drawn_by: str = "", legal_in: str = "") -> None:
        super().__init__(own=True)
        self.drawn_by, self.legal_in, self.reward = drawn_by, legal_in, np.random.default_rng().random()

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        if self.drawn_by != "constructor":
            self.reward = np.random.default_rng(seed if self.drawn_by == "seed" else None).random()
        return super().reset(seed, options)

    def step(self, actions: Any) -> Any:
        seen, rewards, *rest = super().step(actions)
        return seen, dict.fromkeys(rewards, self.reward), *rest

    def _info(self) -> dict[str, dict]:
        return {agent: {"legal_moves": [0]} if self.legal_in == "info" else {} for agent in self.possible_agents}


@pytest.mark.parametrize(("drawn_by", "said"), [("constructor", True), ("seed", False), ("reset", False)])
def test_a_game_whose_constructor_draws_its_task_is_a_warning(drawn_by: str, said: bool) -> None:
    spec = EnvironmentSpec(id="test_games:Drawn", backend="pettingzoo", kwargs={"drawn_by": drawn_by})
    report = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=20)
    assert report.problems == ()
    assert ["every environment of training and of evaluations" in each for each in report.warnings] == [True] * said


@pytest.mark.parametrize("legal_in", ["info", ""])
def test_a_mask_that_no_agent_reads_is_a_warning(legal_in: str) -> None:
    spec = EnvironmentSpec(
        id="test_games:Drawn", backend="pettingzoo", kwargs={"drawn_by": "seed", "legal_in": legal_in}
    )
    report = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=20)
    assert ["'legal_moves' of info seems to say" in each for each in report.warnings] == [True] * bool(legal_in)


class Dealt(Board):
    """Each match deals a card; without a seed it may be always the same."""

    def __init__(self, fixed: bool) -> None:
        super().__init__(own=True)
        self.fixed = fixed

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.card = np.random.default_rng(42 if seed is None and self.fixed else seed).random()
        return super().reset(seed, options)

    def _seen(self) -> dict[str, np.ndarray]:
        return {agent: seen * self.card for agent, seen in super()._seen().items()}


@pytest.mark.parametrize("fixed", [False, True])
def test_matches_that_all_begin_alike_without_a_seed_are_a_warning(fixed: bool) -> None:
    spec = EnvironmentSpec(id="test_games:Dealt", backend="pettingzoo", kwargs={"fixed": fixed})
    report = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=20)
    assert report.problems == ()
    assert ["training gives a seed to the first episode" in each for each in report.warnings] == [True] * fixed


class Alternate(AECEnv):
    """Two agents in turns, with the faults that rewards of an AECEnv can have."""

    metadata = {"name": "alternate"}  # noqa: RUF012  # as PettingZoo has it

    def __init__(self, fault: str) -> None:
        super().__init__()
        self.possible_agents, self.fault = ["red", "blue"], fault

    def observation_space(self, agent: str) -> Box:
        return Box(0.0, 9.0, (2,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        return Discrete(3)

    def observe(self, agent: str) -> np.ndarray:
        return np.array([self.turn, agent == "red"], np.float32)

    def reset(self, seed: int | None = None, options: Any = None) -> None:
        self.turn, self.agents = 0, list(self.possible_agents)
        self.rewards, self._cumulative_rewards = dict.fromkeys(self.agents, 0.0), dict.fromkeys(self.agents, 0.0)
        self.terminations, self.truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        self.infos, self.agent_selection = {agent: {} for agent in self.agents}, "red"

    def step(self, action: Any) -> None:
        agent, other = self.agent_selection, {"red": "blue", "blue": "red"}[self.agent_selection]
        if self.terminations[agent]:
            if self.fault != "stays":
                self._was_dead_step(action)
            return
        if self.fault != "not set to 0":
            self._cumulative_rewards[agent] = 0
        self.turn, self.rewards, self.agent_selection = self.turn + 1, {agent: 1.0, other: -3.0}, other
        self.terminations = dict.fromkeys(self.agents, self.turn >= 6)
        if self.fault != "not accumulated":
            self._accumulate_rewards()
        if self.fault == "no end" and self.turn >= 6:
            self.agents = []


@pytest.mark.parametrize(("fault", "received"), [("", ""), ("not set to 0", "-12"), ("not accumulated", "0")])
def test_rewards_of_a_game_in_turns_that_its_agents_do_not_get_are_a_warning(fault: str, received: str) -> None:
    spec = EnvironmentSpec(id="test_games:Alternate", backend="pettingzoo", kwargs={"fault": fault})
    report = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=20)
    assert report.problems == ()
    text = f"`rewards` of red in a match add up to -6, but it gets {received} by `last`"
    assert [text in each for each in report.warnings] == [True] * bool(fault)


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("stays", "red has ended, but is still in its `agents` after step(None): call _was_dead_step(action) there"),
        ("no end", "red has left its `agents` without an end"),
    ],
)
def test_ends_of_a_game_in_turns_that_are_none_are_named(fault: str, text: str) -> None:
    spec = EnvironmentSpec(id="test_games:Alternate", backend="pettingzoo", kwargs={"fault": fault})
    (found,) = check_environment(spec, UserModules(frozenset({"test_games"})), seconds=60.0, env_steps=20).problems
    assert text in found


class Numbers(Board):
    """It observes numbers that float32 rounds, and bytes that may be codes; the reward is an argument."""

    def __init__(self, reward: float = 1.0) -> None:
        super().__init__()
        self.reward = reward

    def observation_space(self, agent: str) -> Any:
        return Dict({"clock": Box(-np.inf, np.inf, (1,), np.float64), "cells": Box(0, 255, (4, 4), np.uint8)})

    def _seen(self) -> dict[str, Any]:
        cells = np.full((4, 4), self.left, np.uint8)
        return {agent: {"clock": np.array([1e9 + self.left]), "cells": cells} for agent in self.possible_agents}

    def step(self, actions: Any) -> Any:
        seen, rewards, *rest = super().step(actions)
        return seen, dict.fromkeys(rewards, self.reward), *rest


def test_numbers_of_a_game_that_learning_would_change_are_named() -> None:
    spec = EnvironmentSpec(id="test_games:Numbers", backend="pettingzoo")
    modules = UserModules(frozenset({"test_games"}))
    report = check_environment(spec, modules, seconds=60.0, env_steps=20)
    (warning,) = (each for each in report.warnings if "float32" in each)
    assert "observation component 'clock' has the value 1,000,000,00" in warning
    assert "in the game, subtract a reference" in warning
    assert report.byte_maxima == {"cells": (5,)}
    large = spec.model_copy(update={"kwargs": {"reward": 1e10}})
    (problem,) = check_environment(large, modules, seconds=60.0, env_steps=20).problems
    assert "the reward 1e+10, but learning takes rewards within +-1e+09: set environment.reward_scale" in problem


def dark(render_mode: str) -> Duel:
    return Duel()


class Stubborn:
    """A bot whose action is outside the space."""

    def act(self, observation: np.ndarray, action_mask: np.ndarray | None) -> int:
        return 7


def test_opponents_that_are_code_are_checked() -> None:
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", kwargs={"problem": "free"})
    modules = UserModules(frozenset({"test_games"}))
    for bots, problem in (
        (("random",), ""),
        (("random", "test_games:Stubborn"), "opponent test_games:Stubborn, as red"),
    ):
        found = check_environment(spec, modules, seconds=5.0, env_steps=20, bots=bots).problems
        assert [problem in text for text in found] == ([True] if problem else [])


def test_a_game_is_checked() -> None:
    report = make()
    assert report.problems == ()
    assert set(report.lengths) == {5}
    assert set(report.returns) == {5.0}  # the mask leaves one action


@pytest.mark.parametrize(
    ("problem", "fields", "text"),
    [
        ("spaces", {}, r"have different spaces \(red; blue\).*environment.agents=\['red'\]"),
        ("", {"agents": ("green",)}, "names 'green', but the agents of test_games:Duel are red, blue"),
        ("shape", {}, "(red|blue) observes .* which is not of its space"),
        ("no last observation", {}, "no observation of red after its action"),
        (
            "other agent",
            {},
            "its rewards have an entry for 'Red', which is no agent: its possible_agents are red, blue",
        ),
        ("unknown agent", {}, "'green' is in its `agents`, but not in its possible_agents, which are red, blue"),
        ("no choice", {}, "forbids every choice"),
        ("same name", {}, r"its possible_agents are \['red', 'red'\]: name at least one"),
        ("stays", {}, "red has ended, but is still in its `agents` after its last step: remove it there"),
        ("all, stays", {}, "red has ended, but is still in its `agents`"),
        ("no end", {}, "red has left its `agents` without an end"),
        ("reward in a list", {}, r"blue has the reward \[1.0\]: it must be a number"),
        ("end as text", {}, "blue: step returns terminated='False', of type str: it must be a bool"),
        ("reward", {}, "red has the reward nan: it must be finite"),
        ("raises", {}, "step raises RuntimeError: the table broke"),
    ],
)
def test_faults_of_games_are_named(problem: str, fields: dict[str, Any], text: str) -> None:
    (found,) = make(problem, **fields).problems
    assert re.search(text, found), found
    assert "\n" not in found


def test_a_reward_of_an_agent_that_has_left_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    assert set(make("late reward").returns) == {2.5}
    assert "blue has the reward 2 after it has left the match: such rewards count nowhere" in caplog.messages[0]


def test_the_backend_of_a_game_of_one_s_own_is_suggested() -> None:
    modules = UserModules(frozenset({"test_games"}))
    report = check_environment(EnvironmentSpec(id="test_games:Duel"), modules, seconds=5.0, env_steps=20)
    assert "--set environment.backend=pettingzoo" in report.problems[0]


@pytest.mark.parametrize(("field", "reason"), [("problem", "what makes it has no"), ("render_mode", "its metadata")])
def test_games_that_render_no_images_cannot_be_filmed(field: str, reason: str) -> None:
    game = {"problem": "test_games:Duel", "render_mode": "test_games:dark"}[field]
    spec = as_on_gymnasium(EnvironmentSpec(id=game, backend="pettingzoo"))
    with pytest.raises(EnvironmentSetupError, match=f"cannot render rgb_array images: {reason}"):
        make_environments(spec, 1, render_mode="rgb_array", modules=UserModules(frozenset({"test_games"})))


def test_a_package_that_a_game_needs_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "pettingzoo.classic.rps_v2", raising=False)
    monkeypatch.setitem(sys.modules, "pettingzoo.classic.rps.rps", None)
    game = EnvironmentSpec(id="pettingzoo.classic.rps_v2")
    (problem,) = check_environment(game, UserModules(), seconds=0.0, env_steps=0).problems
    assert problem.endswith('(pettingzoo.classic.rps.rps): pip install "pettingzoo[classic]"')


def test_one_agent_of_two_may_be_the_policys() -> None:
    report = make("spaces", agents=("red",))
    assert report.problems == ()
    assert report.spaces is not None
    assert report.spaces.observations["observation"].shape == (2,)


def test_agent_ids_are_a_component_of_the_observation() -> None:
    spec = EnvironmentSpec(id="test_games:Duel", backend="pettingzoo", agent_ids=True, kwargs={"problem": ""})
    environments = make_environments(spec, 2, modules=UserModules(frozenset({"test_games"})))
    observed = environments.reset(1)
    environments.close()
    assert environments.spaces.observations["agent"] == DiscreteSpace(counts=(2,))
    assert observed.frames["agent"].ravel().tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    "fields",
    [
        {"environment": {"id": "CartPole-v1", "agents": ["red"]}},
        {"environment": {"id": "pettingzoo.classic.rps_v2", "action_repeat": 2}},
        {
            "environment": {"id": "mpe2.simple_v3"},
            "collection": {"upload": "gradients"},
            "training": {"algorithm": "a3c"},
        },
    ],
)
def test_settings_that_do_not_fit_games_are_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match="game"):
        run_spec(fields)


@pytest.mark.parametrize("name", ["pettingzoo.classic.tictactoe_v3", "pettingzoo.classic.rps_v2"])
def test_games_of_pettingzoo_can_be_evaluated(name: str) -> None:
    spec = EnvironmentSpec(id=name)
    environments = make_environments(spec, 3, one_episode=True)
    learner = Learner(TrainingSpec(), PolicySpec(hidden=(8,)), environments.spaces)
    runtime = OnnxRuntime(learner.program())
    runtime.load(learner.weights())
    try:
        played = play_episodes(runtime, environments, 7, 1, sampled=True)
        again = play_episodes(runtime, environments, 7, 1, sampled=True)
    finally:
        environments.close()
    assert played.returns.tolist() == again.returns.tolist() == [0.0] * 7  # what one wins the other loses
    assert played.lengths.tolist() == again.lengths.tolist()
    assert not played.cut.any()
