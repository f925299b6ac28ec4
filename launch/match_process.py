"""The process of a match on the gateway's page: one person plays against the policy that the gateway sends.

See playing_child.py, and gateway/watching/person_matches.py for the orders.
"""

import argparse
import logging
import queue
import threading
from typing import Any

import numpy as np

from daedalus.actor.evaluation.episode_camera import jpeg
from daedalus.actor.evaluation.person_match import PersonMatch, Turn, board_of, choices_of, result_of
from daedalus.gateway.watching.playing_process import frame, note
from daedalus.launch.playing_child import GatewayPipes, run_player
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.messages import Program, Welcome
from daedalus.protocol.spaces import ActionSpace, DiscreteSpace

_logger = logging.getLogger("daedalus.launch.match_process")

_POLL_SECONDS = 0.2  # how soon a stop is noticed
_MOST_TEXT = 20_000  # characters of a game that renders texts


class _Table:
    """The game, the policy, and the match that is being played."""

    def __init__(self, welcome: Welcome, program: Program, modules: UserModules, stop: threading.Event) -> None:
        """Raises EnvironmentSetupError or PolicyError."""
        self._spec = welcome.spec
        self._runtime = OnnxRuntime(program.model.tobytes(), stop)
        self._match = PersonMatch(welcome.spec, modules)
        self._agent, self._version = self._match.agents[0], 0
        self._turn: Turn | None = None

    def close(self) -> None:
        """Close the game."""
        self._match.close()

    def obey(self, order: dict[str, Any], gateway: GatewayPipes) -> bytes:
        """Perform an order, and return what the page shows then."""
        remark = ""
        if order["type"] == "BeginMatch":
            snapshot = gateway.newest
            assert snapshot is not None
            self._runtime.load(snapshot.weights)
            self._version = snapshot.policy_version
            self._agent = order["agent"] if order["agent"] in self._match.agents else self._match.agents[0]
            self._turn = self._match.begin(self._runtime, self._agent, sampled=order["sampled"])
        elif self._turn is not None and order["turn"] == self._turn.number:
            try:
                self._turn = self._match.play(order["action"])
            except ValueError as error:
                remark = str(error)
        return self._shown(remark)

    def _shown(self, remark: str) -> bytes:
        turn, match = self._turn, self._match
        if turn is None:
            return note("There is no match: begin one.")
        board = board_of(self._spec, match.spaces, turn, match.agents.index(self._agent))
        picture = None if board else match.picture()
        facts = {
            "agents": match.agents,
            "agent": self._agent,
            "version": self._version,
            "turn": turn.number,
            "remark": remark,
            "moves": turn.moves,
            "returns": turn.returns,
            "result": result_of(turn, self._agent) if turn.is_over else "",
            "actions": [_described(name, space, turn) for name, space in match.spaces.actions.items()],
            "board": board,
            "text": picture[:_MOST_TEXT] if isinstance(picture, str) else "",
        }
        return frame(facts, _jpeg(picture) if isinstance(picture, np.ndarray) else b"")


def _described(name: str, space: ActionSpace, turn: Turn) -> dict[str, Any]:
    """Return what the page asks for, of one component of the action: legal choices, or bounds of numbers."""
    if isinstance(space, DiscreteSpace):
        return {"name": name, "choices": [] if turn.is_over else choices_of(space, turn.masks.get(name))}
    return {"name": name, "low": space.low, "high": space.high}


def _jpeg(picture: np.ndarray) -> bytes:
    try:
        return jpeg(picture)
    except ImportError:
        _logger.warning('pictures of games need Pillow: pip install "daedalus-rl[gateway]"')
        return b""


def _play(gateway: GatewayPipes, modules: UserModules, _arguments: argparse.Namespace) -> int:
    """Play until the gateway stops this process, and return the exit status."""
    welcome, program = gateway.begin()
    table = _Table(welcome, program, modules, gateway.stop)
    try:
        while not gateway.stop.is_set():
            try:
                order = gateway.orders.get(timeout=_POLL_SECONDS)
            except queue.Empty:
                continue
            gateway.write(table.obey(order, gateway))
    finally:
        table.close()
    return 0


if __name__ == "__main__":
    run_player("match", "The match cannot be played", _play, argparse.ArgumentParser(description=__doc__))
