"""A gamepad in a person's hands: what its sticks, triggers and buttons make of the actions of an environment.

Its parts have the names that SDL gives those of all known gamepads. pygame reads them; only this file imports its
controllers.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError

INSTALL_PYGAME = "pip install pygame-ce"

_logger = logging.getLogger(__name__)

# In SDL's order.
BUTTONS = (
    *("a", "b", "x", "y", "back", "guide", "start", "leftstick", "rightstick", "leftshoulder", "rightshoulder"),
    *("dpup", "dpdown", "dpleft", "dpright"),
)
STICKS, TRIGGERS = ("leftx", "lefty", "rightx", "righty"), ("lefttrigger", "righttrigger")
AXES = STICKS + TRIGGERS
_DIRECTIONS = (*(f"{stick}{sign}" for stick in STICKS for sign in "-+"), *(f"{trigger}+" for trigger in TRIGGERS))
_LARGEST = 32_767.0  # of an axis
_REST = 0.1  # of the way: where a stick may stand when nobody moves it
_HALF = 0.5  # of the way, from which on a direction is pressed


class Gamepad:
    """What a person does with a gamepad, as actions of an environment.

    An axis moves one number of a Box: at rest the number is that of the idle action, to the right, down, or pressed it
    goes up to its highest, to the left or up it goes down to its lowest. Names that are pressed together are an action
    if they have one, which then replaces what the axes say.
    """

    def __init__(
        self,
        space: gymnasium.Space,
        idle: Any,
        pressed: Mapping[frozenset[str], Any],
        axes: Sequence[tuple[str, int, bool]],
    ) -> None:
        """Take the first gamepad.

        Args:
          space: of the actions.
          idle: the action while nobody touches it.
          pressed: the action of each set of names that are pressed together: buttons, or directions such as `leftx-`.
          axes: name of an axis, the number of the action that it moves, and whether the other way round. Without any
            axes and `pressed`, sticks and triggers are given to the numbers of a Box in order.

        Raises EnvironmentSetupError if there is no gamepad, or a name or a number does not exist, or nothing is
        pressed and the space is no Box.
        """
        is_box = isinstance(space, gymnasium.spaces.Box) and np.dtype(space.dtype).kind == "f"
        if axes and not is_box:
            raise EnvironmentSetupError(f"--axis moves a number of a Box, and the actions are {space}: use --key")
        if not axes and not pressed:
            if not is_box:
                raise EnvironmentSetupError(
                    f"the actions are {space}: give buttons theirs, as in --key dpleft=0 --key a=1; the names are "
                    f"{', '.join(BUTTONS)}, and the directions {', '.join(_DIRECTIONS)}"
                )
            axes = _given_out(space)
        self._space, self._idle, self._pressed, self._axes = space, idle, dict(pressed), tuple(axes)
        self._check()
        self._names = frozenset[str]().union(*self._pressed)
        self._controller = _first_controller()
        self._told = set[str]()
        _logger.info("%s: %s", self._controller.name, "; ".join(self._facts()))

    def _check(self) -> None:
        known = {*BUTTONS, *_DIRECTIONS}
        for name in sorted(frozenset().union(*self._pressed)):
            if name not in known:
                raise EnvironmentSetupError(
                    f"a gamepad has no button {name!r}: the names are {', '.join(BUTTONS)}, and the directions "
                    f"{', '.join(_DIRECTIONS)}"
                )
        count = np.size(self._idle)
        for name, number, _ in self._axes:
            if name not in AXES:
                raise EnvironmentSetupError(f"a gamepad has no axis {name!r}: the names are {', '.join(AXES)}")
            if not number < count:
                raise EnvironmentSetupError(
                    f"--axis {name}={number}: an action of {self._space} has the numbers 0 to {count - 1}"
                )

    def _facts(self) -> list[str]:
        """Return what each part does, in words."""
        facts = []
        for name, number, reverse in self._axes:
            low, high = (float(bound.flat[number]) for bound in _bounds(self._space))
            ways = (high, low) if reverse else (low, high)
            shown = f"{ways[1]:g} pressed" if name in TRIGGERS else f"from {ways[0]:g} to {ways[1]:g}"
            facts.append(f"{name} moves number {number}, {shown}")
        facts += [f"{'+'.join(sorted(names))} is {_shown(action)}" for names, action in self._pressed.items()]
        return [*facts, f"{_shown(self._idle)} otherwise; press a button to see its name here"]

    def action(self) -> Any:
        """Return the action of what is pressed and moved now. Raises EnvironmentSetupError if it was unplugged."""
        if not self._controller.attached():
            raise EnvironmentSetupError("the gamepad was unplugged")
        moved = {name: self._controller.get_axis(index) / _LARGEST for index, name in enumerate(AXES)}
        pressed = {name for index, name in enumerate(BUTTONS) if self._controller.get_button(index)}
        pressed |= {f"{name}{'+' if value > 0.0 else '-'}" for name, value in moved.items() if abs(value) > _HALF}
        self._tell(pressed)
        if (held := frozenset(pressed & self._names)) in self._pressed:
            return self._pressed[held]
        return self._moved(moved) if self._axes else self._idle

    def close(self) -> None:
        """Release the gamepad. Call this before pygame.quit(), after which SDL would crash at the next one."""
        from pygame._sdl2 import controller

        self._controller.quit()
        controller.quit()

    def _moved(self, moved: Mapping[str, float]) -> Any:
        rest = np.array(self._idle, np.float64).ravel()
        low, high = (bound.ravel() for bound in _bounds(self._space))
        values = rest.copy()
        for name, number, reverse in self._axes:
            share = max(abs(moved[name]) - _REST, 0.0) / (1.0 - _REST)
            goal = high if (moved[name] > 0.0) != reverse else low
            values[number] += share * (goal[number] - rest[number])
        assert self._space.shape is not None
        return values.clip(low, high).reshape(self._space.shape).astype(self._space.dtype)

    def _tell(self, pressed: set[str]) -> None:
        """Say once of each button what it is called, and whether it is of use."""
        for name in sorted(pressed & {*BUTTONS} - self._told):
            self._told.add(name)
            action = "" if name in self._names else f"; give it an action with --key {name}=ACTION"
            _logger.info("%s is pressed%s", name, action)


def _given_out(space: gymnasium.Space) -> list[tuple[str, int, bool]]:
    """Return axes for the numbers of a Box: triggers where 0 is the lowest, sticks for the others."""
    low = _bounds(space)[0].ravel()
    triggers, sticks = list(reversed(TRIGGERS)), list(STICKS)
    found = []
    for number, lowest in enumerate(low.tolist()):
        parts = triggers if lowest == 0.0 and triggers else sticks
        if parts:
            name = parts.pop(0)
            found.append((name, number, name.endswith("y")))  # up is more
    return found


def _bounds(space: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest numbers that an axis makes: -1 and 1 where the space has no bound."""
    low, high = (bound.astype(np.float64) for bound in (space.low, space.high))
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


def _shown(action: Any) -> str:
    return str(np.asarray(action).tolist())


def _first_controller() -> Any:
    try:
        import pygame
        from pygame._sdl2 import controller
    except ImportError:
        raise EnvironmentSetupError(f"a gamepad needs pygame: {INSTALL_PYGAME}") from None
    pygame.joystick.init()
    controller.init()
    count = pygame.joystick.get_count()
    for index in range(count):
        if controller.is_controller(index):
            return controller.Controller(index)
    if count:
        raise EnvironmentSetupError(
            f"{pygame.joystick.Joystick(0).get_name()} has no layout that SDL knows: set SDL_GAMECONTROLLERCONFIG to "
            "its line of https://github.com/mdqinc/SDL_GameControllerDB"
        )
    raise EnvironmentSetupError("no gamepad is connected: plug one in, or use --by keys")
