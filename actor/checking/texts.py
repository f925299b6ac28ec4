"""Texts in the observations of an environment: the policy cannot read them. State, no threads."""

import time
from contextlib import suppress
from typing import Any

import gymnasium

from daedalus.actor.environments.components import is_text
from daedalus.actor.environments.leaves import leaves

_RESETS, _SECONDS = 20, 2.0  # the most resets, and the time for those after the second
_SHOWN = 60  # characters of a text in a message


class Texts:
    """The texts of one environment, and whether they change."""

    def __init__(self, space: gymnasium.Space, leave_out: tuple[str, ...]) -> None:
        """Construct from the observation space, and the names of the components that nobody reads."""
        found = leaves(space, "observation")
        self._leaves = [leaf for leaf in found if leaf.path and is_text(leaf.space) and leaf.name not in leave_out]
        self._seen: dict[str, list[str]] = {leaf.name: [] for leaf in self._leaves}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components that are texts."""
        return tuple(self._seen)

    @property
    def constant(self) -> dict[str, str]:
        """The texts that never changed, by component."""
        return {name: seen[0] for name, seen in self._seen.items() if len(seen) == 1}

    @property
    def problem(self) -> str:
        """A description of the first text that changes, or an empty string."""
        for name, seen in self._seen.items():
            if len(seen) > 1:
                return (
                    f"observation component {name!r} is a text that changes ({_shown(seen[0])}, {_shown(seen[1])}): "
                    "make numbers of it with --wrap MODULE:FUNCTION, or leave it out if the policy does not need it: "
                    f"--set \"environment.leave_out=['{name}']\""
                )
        return ""

    def watch(self, environment: gymnasium.Env, seed: int) -> None:
        """Reset the environment several times: a text may be another in each episode."""
        until = time.monotonic() + _SECONDS
        with suppress(Exception, SystemExit):  # of the user's code; playing reports it
            for episode in range(_RESETS if self._leaves else 0):
                self.add(environment.reset(seed=seed + episode)[0])
                if episode > 0 and time.monotonic() > until:
                    return

    def add(self, observation: Any) -> None:
        """Take note of the texts of an observation."""
        for leaf in self._leaves:
            text, seen = str(leaf.of(observation)), self._seen[leaf.name]
            if text not in seen and len(seen) < 2:
                seen.append(text)


def _shown(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")
