"""Games whose seats belong to several runs: the rows of each, no wait for ever, and what is refused."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scripted_games
from collectors import IDENTITY, snapshot
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plain import RowCounter

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.roles import agents_named, roles_of
from daedalus.actor.environments.shared_games import SharedGames
from daedalus.actor.errors import ActorError
from daedalus.actor.session.role_actor import RoleCollector
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import ActorSpec, RunSpec
from daedalus.protocol.uploads import Rollout

MODULES = UserModules(frozenset({"scripted_games"}))
LONGEST_SECONDS = 60.0  # for a test on a busy machine: more is a wait for ever


class OverError(Exception):
    """The run of these seats is over."""


def run_spec(kind: str, seed: int, agents: int, plays: tuple[str, ...], **changes: Any) -> ActorSpec:
    """Return what an actor learns of a run that plays some agents of a scripted game."""
    environment = {
        "id": f"scripted_games:{kind}",
        "backend": "pettingzoo",
        "kwargs": {"seed": seed, "agents": agents},
        "agents": plays,
    }
    collection = {"envs_per_actor": changes.pop("copies", 1), "rollout_length": changes.pop("length", 3)}
    league = {"sides": [plays] if plays else [], "openings": changes.pop("openings", 0)}
    return RunSpec.model_validate(
        {
            "environment": environment,
            "collection": collection,
            "training": changes,
            "league": league,
        }
    ).for_actors()


def check_rows(rollout: Rollout, seed: int, agents: int, own: list[int], first_copy: int, *, together: bool) -> None:
    """Compare the rows of a run's seats with the slow account of the matches."""
    frames = rollout.frames["observation"]
    for column in range(rollout.rewards.shape[1]):
        for row in np.flatnonzero(rollout.valid[:, column]):
            match, agent, number = key = tuple(int(each) for each in frames[row, column])
            wanted = scripted_games.rows(seed, match, agents, together=together)[match, agent, number]
            assert agent in own
            assert rollout.rewards[row, column] == wanted.reward
            assert rollout.terminated[row, column] == wanted.terminated
            assert rollout.truncated[row, column] == wanted.truncated
            assert tuple(frames[row + 1, column]) == (match, agent, number + 1)
            played = scripted_games.PLAYED[first_copy + column // len(own), (match, agent, number)]
            assert rollout.actions["action"][row, column, 0] == played, key
        if rollout.valid[0, column]:  # also after its learner has returned, the memory goes on
            assert rollout.initial_state[column, 0] == frames[0, column, 2]


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    kind=st.sampled_from(["Turns", "Together"]),
    owners=st.lists(st.integers(0, 2), min_size=2, max_size=4).filter(lambda owners: len(set(owners)) > 1),
    copies=st.integers(1, 3),
)
# In its third match an agent leaves before its first turn; a run that joins again there begins with that news.
@example(seed=32558, kind="Turns", owners=[2, 1], copies=1)
def test_runs_that_share_games_get_the_rows_of_their_own_seats(
    seed: int, kind: str, owners: list[int], copies: int
) -> None:
    scripted_games.PLAYED.clear()
    first_copy, agents = scripted_games.Scripted.made, len(owners)
    runs = {f"run-{owner}": [agent for agent, each in enumerate(owners) if each == owner] for owner in set(owners)}
    names = {run: tuple(f"agent_{agent}" for agent in own) for run, own in runs.items()}
    games, errors, ends = SharedGames(names, modules=MODULES), list[Exception](), threading.Event()
    busy = set(runs)

    def check_over() -> None:
        if ends.is_set():
            raise OverError

    def play(run: str) -> None:
        random = np.random.default_rng([seed, *run.encode()])
        collector = RoleCollector(games, run, modules=MODULES)
        spec = run_spec(kind, seed, agents, names[run], copies=copies, length=int(random.integers(1, 6)))
        interrupted_at = random.integers(40)

        def on_row() -> None:
            nonlocal interrupted_at
            interrupted_at -= 1
            if random.random() < 0.05:
                time.sleep(0.001)  # its policy or its learner is slow
            if interrupted_at == 0 and not random.integers(3):
                raise OverError
            check_over()

        collector.on_wait = check_over
        try:
            for _ in range(int(random.integers(1, 6))):
                if random.random() < 0.5:  # its learner is there, or has returned
                    time.sleep(random.random() * 0.01)
                if random.random() < 0.5 or not collector.has_policy:
                    collector.prepare(spec)
                    collector.begin(RowCounter(), spec, seed=1)
                    collector.load(snapshot(0, {}))
                rollout = collector.collect(IDENTITY, on_row)
                check_rows(rollout, seed, agents, runs[run], first_copy, together=kind == "Together")
        except OverError:
            pass
        except Exception as error:
            errors.append(error)
        busy.discard(run)
        if not busy or errors:
            ends.set()
        try:
            collector.play_on(check_over)
        except OverError:
            pass
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=play, args=(run,), daemon=True) for run in runs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONGEST_SECONDS)
    assert not any(thread.is_alive() for thread in threads), "runs wait for each other for ever"
    games.close()
    if errors:
        raise errors[0]


def joined(first: ActorSpec, second: ActorSpec, seats: dict[str, tuple[str, ...]] | None = None) -> None:
    """Let two runs share games."""
    games = SharedGames(seats or {"one": ("agent_0",), "two": ("agent_1",)}, modules=MODULES)
    try:
        games.join("one", first)
        games.join("two", second)
    finally:
        games.close()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"seed": 8}, r"'one' and 'two' cannot share games: environment.kwargs is \{'seed': 7"),
        ({"kind": "Turns"}, "environment.id is 'scripted_games:Together' and 'scripted_games:Turns'"),
        ({"copies": 2}, "ask for 1 and 2 copies of the game .*--envs"),
        ({"plays": ("agent_0", "agent_1")}, "--seat gives agent_1 to the run 'two', .* are agent_0, agent_1"),
        ({"plays": ()}, "--seat gives agent_1 to the run 'two', .* are agent_0, agent_1"),
        ({"algorithm": "a2c"}, "could wait for each other"),
        ({"openings": 2}, "the run 'two' sets league.openings, .* unset it"),
    ],
)
def test_runs_that_do_not_fit_together_are_refused(change: dict[str, Any], reason: str) -> None:
    both = {"kind": "Together", "seed": 7, "agents": 2, "algorithm": change.get("algorithm", "impala")}
    with pytest.raises(EnvironmentSetupError, match=reason):
        joined(run_spec(**{**both, "plays": ("agent_0",)}), run_spec(**{**both, "plays": ("agent_1",), **change}))


def test_seats_that_overlap_or_are_unknown_are_refused() -> None:
    spec = run_spec("Together", 7, 2, ("agent_0",))
    with pytest.raises(EnvironmentSetupError, match="agent_0 would be played by the runs 'one' and 'two'"):
        joined(spec, spec, {"one": ("agent_0",), "two": ("agent",)})
    with pytest.raises(EnvironmentSetupError, match=r"--seat wolf: the game has no such role .* roles agent and"):
        joined(spec, spec, {"one": ("agent_0",), "two": ("wolf",)})


def test_a_failure_of_the_game_ends_all_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Any, actions: Any) -> Any:
        raise RuntimeError("the table broke")

    monkeypatch.setattr(scripted_games.Together, "step", fail)
    games = SharedGames({"one": ("agent_0",), "two": ("agent_1",)}, modules=MODULES)
    errors: list[str] = []

    def play(run: str, agent: str) -> None:
        collector, spec = RoleCollector(games, run, modules=MODULES), run_spec("Together", 7, 2, (agent,))
        collector.prepare(spec)
        collector.begin(RowCounter(), spec, seed=1)
        collector.load(snapshot(0, {}))
        with pytest.raises(EnvironmentSetupError) as raised:
            collector.collect(IDENTITY)
        errors.append(str(raised.value))

    _together(lambda: play("one", "agent_0"), lambda: play("two", "agent_1"))
    games.close()
    assert len(errors) == 2
    assert all("the table broke" in error for error in errors)


def _together(*calls: Callable[[], None]) -> None:
    threads = [threading.Thread(target=call, daemon=True) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONGEST_SECONDS)
        assert not thread.is_alive()


def test_a_run_that_returns_with_other_settings_is_refused() -> None:
    plays = ("agent_0", "agent_1")
    games, spec = SharedGames({"one": plays}, modules=MODULES), run_spec("Together", 7, 2, plays)
    collector = RoleCollector(games, "one", modules=MODULES)
    collector.prepare(spec)
    collector.begin(RowCounter(), spec, seed=1)
    collector.load(snapshot(0, {}))
    collector.collect(IDENTITY)
    for returns in (
        lambda: collector.prepare(run_spec("Together", 7, 2, plays, length=5)),
        lambda: collector.begin(RowCounter(), spec, seed=1, epsilon=0.5),
    ):
        with pytest.raises(ActorError, match="'one' has other settings than before"):
            returns()
    games.close()


def test_roles_are_named_after_their_agents() -> None:
    tag = ("adversary_0", "adversary_1", "agent_0", "leader")
    assert agents_named(("adversary", "leader"), tag) == ("adversary_0", "adversary_1", "leader")
    groups = [("adversary_0", "adversary_1"), ("agent_0", "leader")]
    assert list(roles_of(groups, tag)) == ["adversary", "agent-leader"]
    halves = roles_of([("adversary_0",), ("adversary_1", "agent_0", "leader")], tag)
    assert list(halves) == ["adversary_0", "adversary_1-agent-leader"]
