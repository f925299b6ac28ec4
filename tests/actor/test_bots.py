"""Bots in the seats of games: which actions are played, and what is said of faulty ones."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
import scripted_games
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space

from daedalus.actor.environments.bots import LegalActions, make_bot
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import make_games
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import EnvironmentSpec

MODULES = UserModules(frozenset({"test_bots", "scripted_games"}))
NUMBER = 5


class Fixed:
    """A bot that always takes one action, and notes what it observes."""

    action: Any = 3

    def __init__(self) -> None:
        self.agents, self.observed = list[str](), list[Any]()

    def reset(self, agent: str, seed: int) -> None:
        self.agents.append(agent)

    def act(self, observation: Any, action_mask: Any) -> Any:
        self.observed.append(tuple(int(number) for number in observation))
        return self.action


@pytest.mark.parametrize("kind", ["Turns", "Together"])
def test_a_bot_plays_its_seat_from_the_next_match_on(kind: str) -> None:
    spec = EnvironmentSpec(id=f"scripted_games:{kind}", backend="pettingzoo", kwargs={"seed": 5, "agents": 3})
    scripted_games.PLAYED.clear()
    games, bot = make_games(spec, 2, MODULES), Fixed()
    second = scripted_games.Scripted.made - 1
    games.reset(1)  # match 1: the games are reset when they are made
    games.seat_bot(5, bot)  # agent 2 of the second copy
    ended = 1
    while ended < 5:
        games.step(np.ones(6, np.int64))
        if games.over[1]:
            ended += 1
            games.seat_bot(5, bot if ended < 4 else None)
    games.close()
    of_bot = {key for (copy, key), action in scripted_games.PLAYED.items() if action == Fixed.action}
    of_agent = {key for copy, key in scripted_games.PLAYED if copy == second and key[1] == 2 and key[0] in (2, 3)}
    assert len(of_agent) > 2
    assert of_bot == of_agent == set(bot.observed)
    assert len(bot.observed) == len(of_bot)
    assert bot.agents == ["agent_2"] * 2
    assert set(scripted_games.PLAYED.values()) == {1, Fixed.action}


@pytest.mark.parametrize(
    ("space", "mask"),
    [
        (Discrete(5, start=2), np.array([1, 0, 0, 1, 1], np.int8)),
        (MultiDiscrete([3, 2], start=[1, 7]), [np.array([0, 1, 1]), np.array([1, 0])]),
        (Dict(a=Discrete(2), b=Box(0, 1, (2,)), c=MultiBinary(2)), {"c": np.array([1, 1, 0, 1])}),
        (Dict(a=Discrete(2), c=MultiDiscrete([2, 3])), np.array([1, 1, 0, 1, 1, 0, 1])),
        (MultiDiscrete([2, 2]), None),
    ],
)
def test_random_bots_play_all_legal_actions_alike(space: Space, mask: Any) -> None:
    legal, bot = LegalActions(space), make_bot("random", space, MODULES)
    bot.reset("red", 1)
    drawn = [bot.act(None, mask) for _ in range(600)]
    assert all(space.contains(action) and legal.allow(action, mask) for action in drawn)
    counts = Counter(repr({**action, "b": 0} if "b" in str(space) else action) for action in drawn)
    every = [space.sample() for _ in range(600)]
    allowed = {repr({**each, "b": 0} if "b" in str(space) else each) for each in every if legal.allow(each, mask)}
    assert set(counts) == allowed
    assert min(counts.values()) > 0.6 * 600 / len(counts)
    bot.reset("red", 1)
    assert repr(bot.act(None, mask)) == repr(drawn[0])


class Silent:
    """An object without act."""


class Broken:
    def act(self, observation: Any, action_mask: Any) -> Any:
        raise RuntimeError("lost the\nmap")


class Refusing(Broken):
    def __init__(self) -> None:
        raise ValueError("no licence")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("test_bots:Missing", "has no 'Missing'"),
        ("test_bots:NUMBER", "opponent test_bots:NUMBER cannot be made: TypeError: 'int' object is not callable"),
        ("test_bots:Silent", "opponent test_bots:Silent made Silent, which has no act"),
        ("test_bots:Refusing", "opponent test_bots:Refusing cannot be made: ValueError: no licence"),
        ("no_such_module:Bot", "no_such_module:Bot, but the module no_such_module may not be imported here"),
    ],
)
def test_bots_that_cannot_be_made_are_named(name: str, text: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=text) as error:
        make_bot(name, Discrete(3), MODULES)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("action", "text"),
    [
        (5, "its action is 5, which is outside Discrete"),
        (1, "its action is 1, which the action_mask forbids"),
        (0.5, "its action has the value 0.5"),
        (None, "its action has dtype object"),
        ([0, 1], r"its action has shape \(2,\)"),
    ],
)
def test_a_bots_faults_are_named(action: Any, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("test_bots.Fixed.action", action)
    bot = make_bot("test_bots:Fixed", Discrete(3), MODULES)
    bot.reset("red", 1)
    with pytest.raises(EnvironmentSetupError, match=f"^opponent test_bots:Fixed, as red: {text}") as error:
        bot.act(np.zeros(1), np.array([1, 0, 1], np.int8))
    assert "\n" not in str(error.value)


def test_an_exception_of_a_bot_is_named() -> None:
    bot = make_bot("test_bots:Broken", Discrete(3), MODULES)
    bot.reset("red", 1)  # it has none of its own
    with pytest.raises(EnvironmentSetupError, match=r"^opponent test_bots:Broken: act raises RuntimeError: lost the"):
        bot.act(np.zeros(1), None)


def test_numbers_of_a_bot_are_of_the_space_and_within_its_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    space = Box(0.0, 1.0, (2,), np.float32)
    bot = make_bot("test_bots:Fixed", space, MODULES)
    bot.reset("red", 1)
    monkeypatch.setattr("test_bots.Fixed.action", [0.25, 1])
    assert bot.act(np.zeros(1), None).tolist() == [0.25, 1.0]
    monkeypatch.setattr("test_bots.Fixed.action", [0.25, 1.5])
    with pytest.raises(EnvironmentSetupError, match="outside Box"):
        bot.act(np.zeros(1), None)
