"""A person against a policy: whose actions reach the game, what is refused, and the returns of all agents."""

import numpy as np
import pytest
import scripted_games
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st
from plain import PlainPolicy

from daedalus.actor.environments.components import ActionComponents
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.evaluation.person_match import PersonMatch, checked_action
from daedalus.policy.acting.noise import Noise
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import RunSpec

MODULES = UserModules(frozenset({"scripted_games"}), "the test")


class Fourth(PlainPolicy):
    """A policy that takes one action always; a person who never takes it knows the policy's from her own."""

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PlainPolicy."""
        return np.full(len(observations), 4), np.zeros(len(observations), np.float32), state


def spec_of(name: str, **environment: object) -> RunSpec:
    return RunSpec.model_validate({"environment": {"id": name, "backend": "pettingzoo", **environment}})


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    agents=st.integers(1, 4),
    own=st.integers(0, 3),
    kind=st.sampled_from(["Turns", "Together"]),
)
def test_a_persons_actions_are_those_of_her_seat_only(seed: int, agents: int, own: int, kind: str) -> None:
    spec = spec_of(f"scripted_games:{kind}", kwargs={"seed": seed, "agents": agents})
    scripted_games.PLAYED.clear()
    match = PersonMatch(spec.for_actors(), MODULES)
    own %= agents
    random = np.random.default_rng(seed)
    for number in (1, 2):  # the game was reset once before
        scripted_games.PLAYED.clear()
        turn = match.begin(Fourth(), f"agent_{own}")
        mine = []
        while not turn.is_over:
            assert turn.observation["observation"].tolist() == [number, own, turn.number]
            with pytest.raises(ValueError, match="whole numbers from 0, below 5"):
                match.play({"action": [5]})
            mine.append(int(random.integers(4)))
            turn = match.play({"action": [mine[-1]]})
            assert all(action == {"action": [4]} and agent != f"agent_{own}" for agent, action in turn.moves)
        played = {key: action for (_, key), action in scripted_games.PLAYED.items()}
        assert [action for key, action in sorted(played.items()) if key[1] == own] == mine
        assert {action for key, action in played.items() if key[1] != own} <= {4}
        totals = scripted_games.totals(seed, number, agents, together=kind == "Together")
        assert turn.returns == {f"agent_{agent}": total for agent, total in enumerate(totals)}
        with pytest.raises(ValueError, match="not your turn"):
            match.play({"action": [0]})
    match.close()


def test_environments_without_several_agents_are_refused() -> None:
    spec = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}})
    with pytest.raises(EnvironmentSetupError, match="no game with several agents"):
        PersonMatch(spec.for_actors(), MODULES)


def test_numbers_of_a_person_are_those_of_the_environment() -> None:
    space = Box(np.array([0.0, -np.inf, 3.0], np.float32), np.array([10.0, np.inf, 3.0], np.float32))
    components = ActionComponents(space)
    spaces = Spaces(observations={"o": ArraySpace(shape=(1,), dtype="float32")}, actions=components.spaces)
    played = checked_action(spaces, {}, {"action": [2.5, -70.0, 3.0]})
    assert components.env_actions({"action": played["action"][None]})[0].tolist() == [2.5, -70.0, 3.0]
    with pytest.raises(ValueError, match="must be numbers within"):
        checked_action(spaces, {}, {"action": [10.5, 0.0, 3.0]})
