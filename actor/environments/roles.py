"""The roles of a game with several agents: those with equal spaces, which one policy can play. Pure functions."""

import re
from collections.abc import Mapping, Sequence

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.protocol.texts import listed

_NUMBER = re.compile(r"_[0-9]+$")


class DifferentSpacesError(EnvironmentSetupError):
    """Error of a game whose agents have different spaces, so that each role needs a policy of its own.

    Attributes:
      roles: the agents of each role, by its name.
    """

    def __init__(self, game: str, roles: Mapping[str, tuple[str, ...]]) -> None:
        parts = "; ".join(listed(agents) for agents in roles.values())
        first = list(next(iter(roles.values())))
        super().__init__(
            f"the agents of {game} have different spaces ({parts}), and one policy plays agents with the same ones: "
            f"`daedalus train` starts a learner for each role ({', '.join(roles)}) if environment.agents is unset, or "
            f'choose one role, as in --set "environment.agents={first}"; the others then take random actions'
        )
        self.roles = dict(roles)


def role_of(agent: str) -> str:
    """Return the role of an agent: its name without a number at the end, as `adversary` of `adversary_0`."""
    return _NUMBER.sub("", agent) or agent


def agents_named(names: Sequence[str], possible: Sequence[str]) -> tuple[str, ...]:
    """Return the agents of roles or with names, in the order of the game. Raises EnvironmentSetupError."""
    for name in names:
        if name not in possible and name not in map(role_of, possible):
            roles = dict.fromkeys(map(role_of, possible))
            raise EnvironmentSetupError(
                f"--seat {name}: the game has no such role or agent; it has the roles {listed(list(roles))} and the "
                f"agents {listed(possible)}"
            )
    exact = {name for name in names if name in possible}
    roles = {name for name in names if name not in exact}
    return tuple(agent for agent in possible if agent in exact or role_of(agent) in roles)


def seat_names(agents: Sequence[str], possible: Sequence[str]) -> tuple[str, ...]:
    """Return the fewest names for which `agents_named` returns these agents."""
    names = dict[str, None]()
    for agent in agents:
        role = role_of(agent)
        alone = all(each in agents for each in possible if role_of(each) == role) and role not in possible
        names[role if alone else agent] = None
    return tuple(names)


def roles_of(groups: Sequence[Sequence[str]], possible: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return groups of agents by a name for each, which is made of its roles."""
    return {"-".join(seat_names(group, possible)): tuple(group) for group in groups}
