"""`daedalus record --by gamepad`, with a virtual gamepad of SDL's."""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pygame
import pytest

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.evaluation.gamepad import AXES, BUTTONS, Gamepad
from daedalus.cli.commands.record import record

_GAMEPAD_TYPE = 1  # SDL_JOYSTICK_TYPE_GAMECONTROLLER, whose layout SDL knows
_UNKNOWN_TYPE = 0


class VirtualPad:
    """Somebody holds a gamepad: at rest, until `hold` says what is moved and pressed."""

    def __init__(self, kind: int = _GAMEPAD_TYPE) -> None:
        loaded = [line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "libSDL2-2" in line]
        self._sdl = ctypes.CDLL(loaded[0])
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        self._index = self._sdl.SDL_JoystickAttachVirtual(kind, len(AXES), len(BUTTONS), 0)
        self._pad = ctypes.c_void_p(self._sdl.SDL_JoystickOpen(self._index))
        self.hold()

    def hold(self, *buttons: str, **axes: float) -> None:
        for index, name in enumerate(AXES):
            value = axes.get(name, 0.0)
            raw = 2.0 * value - 1.0 if name.endswith("trigger") else value  # a trigger rests at the lowest
            self._sdl.SDL_JoystickSetVirtualAxis(self._pad, index, ctypes.c_int16(round(32767 * raw)))
        for index, name in enumerate(BUTTONS):
            self._sdl.SDL_JoystickSetVirtualButton(self._pad, index, ctypes.c_uint8(name in buttons))
        pygame.event.pump()

    def unplug(self) -> None:
        self._sdl.SDL_JoystickDetachVirtual(self._index)
        pygame.event.pump()


@pytest.fixture
def sdl(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    if not Path("/proc/self/maps").is_file():
        pytest.skip("the loaded library of SDL is found in /proc")
    pygame.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.joystick.init()
    yield
    pygame.quit()


@pytest.fixture
def pad(sdl: None) -> VirtualPad:
    return VirtualPad()


@pytest.fixture
def hold(pad: VirtualPad) -> Iterator[Callable[..., Gamepad]]:
    with ExitStack() as stack:
        yield lambda *arguments: stack.enter_context(closing(Gamepad(*arguments)))


CAR = gymnasium.spaces.Box(np.array([-1.0, 0.0, 0.0], np.float32), np.array([1.0, 1.0, 0.5], np.float32))
STILL = np.zeros(3, np.float32)


def names(*pressed: str) -> frozenset[str]:
    return frozenset(pressed)


def test_axes_move_numbers_and_buttons_replace_them(pad: VirtualPad, hold: Callable[..., Gamepad]) -> None:
    brake = np.array([0.0, 0.0, 0.5], np.float32)
    axes = [("leftx", 0, False), ("righttrigger", 1, False), ("righty", 1, True)]
    held = hold(CAR, STILL, {names("b"): brake, names("b", "dpup"): STILL}, axes)
    for moved, expected in (
        ({}, [0.0, 0.0, 0.0]),
        ({"leftx": -1.0, "righttrigger": 1.0}, [-1.0, 1.0, 0.0]),
        ({"leftx": 0.55, "righttrigger": 0.325}, [0.5, 0.25, 0.0]),
        ({"leftx": 0.09}, [0.0, 0.0, 0.0]),  # nobody moves it
        ({"righty": -0.55}, [0.0, 0.5, 0.0]),  # up, the other way round
        ({"righty": 1.0, "leftx": 1.0}, [1.0, 0.0, 0.0]),  # to the lowest
    ):
        pad.hold(**moved)
        action = held.action()
        assert CAR.contains(action)
        np.testing.assert_allclose(action, expected, atol=1e-3)
    pad.hold("b", "y", leftx=1.0)  # y has no action
    np.testing.assert_array_equal(held.action(), brake)
    pad.hold("b", "dpup")
    np.testing.assert_array_equal(held.action(), STILL)
    pad.unplug()
    with pytest.raises(EnvironmentSetupError, match="unplugged"):
        held.action()


def test_without_words_triggers_and_sticks_are_given_out_and_explained(
    pad: VirtualPad, hold: Callable[..., Gamepad], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    held = hold(CAR, STILL, {}, [])
    pad.hold("x", leftx=1.0, righttrigger=1.0, lefttrigger=1.0)
    np.testing.assert_allclose(held.action(), [1.0, 1.0, 0.5])
    held.action()
    first, *others = caplog.messages
    assert "leftx moves number 0, from -1 to 1; righttrigger moves number 1, 1 pressed; lefttrigger moves" in first
    assert others == ["x is pressed; give it an action with --key x=ACTION"]


class Held(gymnasium.Env):
    """Its person presses the next buttons after each step."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # and no rate
    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space: gymnasium.Space = gymnasium.spaces.Discrete(4, start=1)
    pad: VirtualPad
    script: list[tuple[tuple[str, ...], dict[str, float]]]

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.steps = 0
        return self._seen()

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        buttons, axes = self.script[min(self.steps, len(self.script) - 1)]
        self.pad.hold(*buttons, **axes)
        return np.full(1, self.steps, np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self._seen()[0], 0.0, self.steps == len(self.script), False, {}

    def render(self) -> Any:
        return np.zeros((32, 32, 3), np.uint8)


@pytest.fixture
def recorded(pad: VirtualPad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., list[Any]]]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Held, "pad", pad, raising=False)
    gymnasium.register("Held-v0", lambda render_mode: Held(render_mode))  # pyright: ignore[reportArgumentType]

    def run(*words: str) -> list[Any]:
        options = ("--env", "Held-v0", "--by", "gamepad", "--episodes", "1", "--rate", "1000", "--out", "./shown")
        assert record([*options, *words]) == 0
        (episode,) = minari.MinariDataset(tmp_path / "shown/data")
        return episode.actions.tolist()

    yield run
    del gymnasium.registry["Held-v0"]


def test_discrete_actions_are_recorded(recorded: Callable[..., list[Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    script = [((), {}), (("a",), {}), ((), {"leftx": -0.9}), (("a",), {"leftx": -0.9}), (("a", "b"), {})]
    monkeypatch.setattr(Held, "script", script, raising=False)
    words = ("--idle", "1", "--key", "a=2", "--key", "leftx-=3", "--key", "a,leftx-=4")
    assert recorded(*words) == [1, 2, 3, 4, 2]


def test_continuous_actions_are_recorded(recorded: Callable[..., list[Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Held, "action_space", gymnasium.spaces.Box(-2.0, 2.0, (2,), np.float32))
    monkeypatch.setattr(Held, "script", [((), {"lefty": -1.0}), ((), {"leftx": 1.0})], raising=False)
    assert recorded("--axis", "leftx=1", "--axis", "lefty=-0") == [[2.0, 0.0], [0.0, 2.0]]


@pytest.mark.parametrize(
    ("space", "pressed", "axes", "reason"),
    [
        (gymnasium.spaces.Discrete(2), {}, [], "give buttons theirs, as in --key dpleft=0"),
        (gymnasium.spaces.Discrete(2), {}, [("leftx", 0, False)], "--axis moves a number of a Box"),
        (gymnasium.spaces.Discrete(2), {names("q"): 0}, [], "no button 'q': the names are a, b, x, y"),
        (CAR, {}, [("leftz", 0, False)], "no axis 'leftz': the names are leftx"),
        (CAR, {}, [("leftx", 3, False)], "has the numbers 0 to 2"),
        (CAR, {}, [], "no gamepad is connected"),
    ],
)
def test_what_a_gamepad_cannot_do_is_said_in_a_line(
    sdl: None, space: gymnasium.Space, pressed: dict[frozenset[str], Any], axes: Any, reason: str
) -> None:
    idle = STILL if space is CAR else 0
    with pytest.raises(EnvironmentSetupError, match=reason) as refusal:
        Gamepad(space, idle, pressed, axes)
    assert "\n" not in str(refusal.value)


def test_a_joystick_without_a_layout_is_named(sdl: None) -> None:
    VirtualPad(_UNKNOWN_TYPE)
    with pytest.raises(EnvironmentSetupError, match=r"Virtual .* has no layout that SDL knows: set SDL_GAMEC"):
        Gamepad(CAR, STILL, {}, [])
