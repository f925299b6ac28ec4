"""A person against a saved policy at a terminal: shows the game, lists the legal actions and reads numbers."""

import os
import queue
import sys
import threading
from typing import TextIO

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.evaluation.person_match import Action, PersonMatch, Turn, board_of, choices_of, result_of
from daedalus.launch.evaluation_options import (
    EvaluationOptions,
    actions_of,
    check_spaces,
    chosen_policy,
    environment_of,
    loaded_runtime,
    modules_of,
)
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.user_code import Surroundings
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.texts import printable

_POLL_SECONDS = 0.1
_MOST_LISTED = 60  # choices in a question
_LONGEST_LINE = 10_000  # bytes that a person types
_MARKS = ("", "X", "O")  # of the first and the second agent


class LeaveError(Exception):
    """The person wants to go: the end of standard input, or Ctrl-C."""


def play_at_terminal(options: EvaluationOptions, seat: str | None, stop: threading.Event, out: TextIO) -> None:
    """Let a person play one match after the other against the policy, until she leaves.

    Args:
      options: which policy, and how it acts.
      seat: the agent of the person; None: she is asked.
      stop: ends the match.
      out: where the game is shown; answers come from standard input.

    Raises the errors of run_evaluation, and EnvironmentSetupError for a seat that does not exist.
    """
    policy = chosen_policy(options)
    spec = policy.spec.for_actors().model_copy(update={"environment": environment_of(policy, options)})
    with Surroundings():
        match = PersonMatch(spec, modules_of(policy, options))
        try:
            if seat is not None and seat not in match.agents:
                raise EnvironmentSetupError(f"--seat is {seat!r}: choose from {', '.join(match.agents)}")
            check_spaces(match.spaces, spec.environment, policy)
            actions = actions_of(policy, options)
            table = _Table(match, loaded_runtime(policy, stop), spec, actions == "sampled", Conversation(stop, out))
            table.conversation.say(
                f"{spec.environment.id}, policy version {policy.policy_version}, {actions} actions. Ctrl-D: end"
            )
            try:
                table.sit(seat, options.seed)
            except LeaveError:
                table.conversation.say("\nbye")
        finally:
            match.close()


class Conversation:
    """Questions to a person, and her answers."""

    def __init__(self, stop: threading.Event, out: TextIO) -> None:
        self._stop, self._out = stop, out
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="terminal-input", daemon=True).start()

    def say(self, text: str) -> None:
        """Show lines."""
        self._out.write("\n".join(map(printable, text.split("\n"))) + "\n")
        self._out.flush()

    def ask(self, question: str) -> str:
        """Return the answer to a question, without spaces around it. Raises LeaveError."""
        self._out.write(f"{printable(question)} ")
        self._out.flush()
        while not self._stop.is_set():
            try:
                line = self._lines.get(timeout=_POLL_SECONDS)
            except queue.Empty:
                continue
            if line is None:
                break
            return line.strip()
        raise LeaveError

    def _read(self) -> None:
        # Not with sys.stdin, whose lock this thread would hold when the process ends.
        rest = b""
        try:
            while data := os.read(sys.stdin.fileno(), 4096):
                *lines, rest = (rest + data).split(b"\n")
                rest = rest[-_LONGEST_LINE:]
                for line in lines:
                    self._lines.put(line.decode(errors="replace"))
        except (OSError, ValueError):  # there is no standard input
            pass
        self._lines.put(None)


class _Table:
    """Matches of one person."""

    def __init__(
        self, match: PersonMatch, runtime: OnnxRuntime, spec: ActorSpec, sampled: bool, conversation: Conversation
    ) -> None:
        self._match, self._runtime, self._spec, self._sampled = match, runtime, spec, sampled
        self.conversation = conversation

    def sit(self, seat: str | None, seed: int | None) -> None:
        """Play until the person leaves. Raises LeaveError."""
        agent = self._agent(f"Your seat: {', '.join(self._match.agents)}") if seat is None else seat
        while True:
            turn = self._match.begin(self._runtime, agent, sampled=self._sampled, seed=seed)
            while not turn.is_over:
                self._show(turn, agent)
                turn = self._moved(turn)
            self._show(turn, agent)
            self.conversation.say(result_of(turn, agent))
            seed = None if seed is None else seed + 1
            agent = self._agent(f"Another game as {agent}, or which seat? (Ctrl-D ends)", agent)

    def _agent(self, question: str, default: str | None = None) -> str:
        agents = self._match.agents
        default = default or agents[0]
        while True:
            answer = self.conversation.ask(f"{question} [{default}]:")
            if not answer or answer in agents:
                return answer or default
            self.conversation.say(f"There is no {answer!r}: choose from {', '.join(agents)}.")

    def _show(self, turn: Turn, agent: str) -> None:
        for mover, action in turn.moves:
            values = "; ".join(" ".join(f"{value:g}" for value in part) for part in action.values())
            self.conversation.say(f"{mover} plays {values}")
        picture = self._match.picture()
        if isinstance(picture, str):
            self.conversation.say(picture.rstrip("\n"))
        else:
            self.conversation.say(self._board(turn, agent) or _observed(turn))

    def _board(self, turn: Turn, agent: str) -> str:
        board = board_of(self._spec, self._match.spaces, turn, self._match.agents.index(agent))
        if board is None:
            return ""
        rows: list[list[int]] = board["rows"]
        if board["moves"] == "columns":
            lines = [" ".join(_MARKS[cell] or "." for cell in row) for row in rows]
            return "\n".join([*lines, " ".join(map(str, range(len(rows[0]))))])
        numbers = [[str(column * len(rows) + row) for column in range(len(rows[0]))] for row in range(len(rows))]
        return "\n".join(
            " ".join(_MARKS[cell] or number for cell, number in zip(*both, strict=True))
            for both in zip(rows, numbers, strict=True)
        )

    def _moved(self, turn: Turn) -> Turn:
        """Ask for an action until one is legal, and return the next turn."""
        while True:
            action: Action = {}
            for name, space in self._match.spaces.actions.items():
                label = "Your move" if len(self._match.spaces.actions) == 1 else f"Your {name}"
                match space:
                    case DiscreteSpace():
                        variables = choices_of(space, turn.masks.get(name))
                        action[name] = [
                            self._choice(label if len(variables) == 1 else f"{label}, part {number}", legal)
                            for number, legal in enumerate(variables, start=1)
                        ]
                    case ContinuousSpace():
                        action[name] = self._numbers(label, space)
            try:
                return self._match.play(action)
            except ValueError as error:
                self.conversation.say(f"{error}.")

    def _choice(self, label: str, legal: list[int]) -> float:
        listed = " ".join(map(str, legal[:_MOST_LISTED]))
        more = f" and {len(legal) - _MOST_LISTED} more" if len(legal) > _MOST_LISTED else ""
        while True:
            answer = self.conversation.ask(f"{label} ({listed}{more}):")
            if answer.isascii() and answer.isdigit() and len(answer) < 10 and int(answer) in legal:
                return int(answer)
            self.conversation.say(f"{answer[:40]!r} is no legal move: type one of the numbers.")

    def _numbers(self, label: str, space: ContinuousSpace) -> list[float]:
        while True:
            answer = self.conversation.ask(f"{label} ({space}, with spaces between the numbers):")
            try:
                values = [float(word) for word in answer.split()]
            except ValueError:
                values = []
            if len(values) == space.size:
                return values
            self.conversation.say(f"Type {space.size} numbers.")


def _observed(turn: Turn) -> str:
    """Return the observation of the person's agent, by component."""
    with np.printoptions(precision=3, suppress=True, threshold=500, linewidth=100):
        return "\n".join(
            f"{name}: {values}" if values.ndim < 2 else f"{name} {list(values.shape)}:\n{values}"
            for name, values in turn.observation.items()
        )
