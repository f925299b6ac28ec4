"""The backend `gymnasium`: repeats, no_reward_limit, wrappers, cameras and processes."""

import math
import multiprocessing
import os
import signal
import subprocess
import sys
from contextlib import closing, nullcontext
from ctypes.util import find_library
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from gymnasium.envs.registration import EnvSpec
from picture_environment import Picture
from plain import PlainEnvironments, choices
from processes import LIMIT, until

from daedalus.actor.environments import environment_processes, gymnasium_backend, gymnasium_environments, make
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from daedalus.actor.environments.gymnasium_backend import EnvironmentFactory, as_on_gymnasium, make_gymnasium
from daedalus.actor.environments.rendering import FrameRate, frame_rate
from daedalus.actor.environments.wrappers import RepeatedSteps
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.texts import bounded_text

created = partial(make.make_environments, modules=TEST_MODULES)


def make_environments(spec: EnvironmentSpec, count: int, **options: Any) -> PlainEnvironments:
    return PlainEnvironments(created(spec, count, **options))


FAULTY = UserModules(frozenset({"faulty_environments"}))
TABLE = ((-1.0, 0.5), (0.0, 0.0), (0.0, 0.5))  # rewards -0.5, 0 and 0.5


def _counting(**fields) -> EnvironmentSpec:
    return EnvironmentSpec(id="counting_environment:Counting-v0", **fields)


def _picture(**fields) -> EnvironmentSpec:
    return EnvironmentSpec(id="picture_environment:Picture-v0", action_table=TABLE, **fields)


def _rows(environments: PlainEnvironments, actions: list[int]) -> list[tuple]:
    """(frame, reward, terminated, truncated) of the first environment for each action in turn."""
    rows = []
    for action in actions:
        frames, rewards, terminated, truncated = environments.step(np.full(environments.count, action))
        rows.append((frames[0].tolist(), round(float(rewards[0]), 4), bool(terminated[0]), bool(truncated[0])))
    return rows


@pytest.mark.parametrize("processes", [False, True])
def test_repeats_sum_rewards_and_stop_at_the_end_of_an_episode(processes: bool) -> None:
    """Counting's episodes have 3 steps (terminated), 2 (truncated) and 1 (terminated), and rewards identify them."""
    with closing(make_environments(_counting(action_repeat=2, processes=processes), 2)) as environments:
        assert environments.reset(1).tolist() == [[0.0, 0.0]] * 2
        assert _rows(environments, [1, 0, 3, 0, 0, 2, 0]) == [
            ([0.0, 2.0], 1.2, False, False),  # 0 + 1, plus a tenth of the action twice
            ([0.0, 3.0], 2.0, True, False),  # one step was left
            ([1.0, 0.0], 0.0, False, False),  # the reset step
            ([1.0, 2.0], 21.0, False, True),
            ([2.0, 0.0], 0.0, False, False),
            ([2.0, 1.0], 20.2, True, False),
            ([3.0, 0.0], 0.0, False, False),
        ]


class Doubling(gymnasium.Env):
    """An environment that changes its action in place."""

    observation_space, action_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self) -> None:
        self.taken: list[float] = []

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action *= 2.0
        self.taken.append(float(action[0]))
        return 0, 0.0, False, False, {}


def test_each_repeat_gets_the_action_that_was_chosen() -> None:
    environment = Doubling()
    action = np.array([0.25], np.float32)
    RepeatedSteps(environment, "Any-v0", repeat=3, no_reward_limit=None).step(action)
    assert environment.taken == [0.5] * 3
    assert action.tolist() == [0.25]


@pytest.mark.parametrize(("mode", "calls"), [("rgb_array", 1), ("human", 0), (None, 0)])
def test_render_mode_of_the_arguments_prepares_a_host_without_display(
    monkeypatch: pytest.MonkeyPatch, mode: str | None, calls: int
) -> None:
    """An environment may observe its own pictures: --wrap gymnasium.wrappers:AddRenderObservation."""
    called: list[str] = []
    monkeypatch.setattr(gymnasium_backend, "render_without_display", lambda: called.append("render_without_display"))
    monkeypatch.setattr(gymnasium, "make", lambda *_, **kwargs: called.append(kwargs["render_mode"]) or Doubling())
    EnvironmentFactory(spec=EnvironmentSpec(id="CartPole-v1", kwargs={"render_mode": mode}))()
    assert called == [*["render_without_display"] * calls, mode], "before the environment is made"


def test_episode_limit_counts_the_environments_own_steps() -> None:
    environments = make_environments(_counting(action_repeat=2, max_episode_steps=5, kwargs={"ends": [100]}), 1)
    environments.reset(1)
    assert _rows(environments, [0] * 4) == [
        ([0.0, 2.0], 1.0, False, False),
        ([0.0, 4.0], 5.0, False, False),
        ([0.0, 5.0], 4.0, False, True),
        ([1.0, 0.0], 0.0, False, False),
    ]


@pytest.mark.parametrize(("limit", "refused"), [(201, True), (200, False), (5, False)])
def test_a_limit_beyond_that_of_the_environment_itself_is_refused(
    limit: int, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = EnvSpec("Made-v0", lambda **kwargs: gymnasium.make("Pendulum-v1", **kwargs))
    monkeypatch.setitem(gymnasium.registry, "Made-v0", made)
    text = "environment.max_episode_steps=201 has no effect.*truncates its episodes after 200 steps itself"
    with pytest.raises(EnvironmentSetupError, match=text) if refused else nullcontext():
        make_environments(EnvironmentSpec(id="Made-v0", max_episode_steps=limit), 1).close()


def test_an_argument_of_the_constructor_may_have_the_name_of_the_episode_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """gymnasium.make keeps max_episode_steps for its own limit: the constructor would have its default."""

    def made(max_episode_steps: int = 2) -> gymnasium.Env:
        return EnvironmentFactory(spec=_counting(kwargs={"ends": [max_episode_steps]}), modules=TEST_MODULES)()

    monkeypatch.setitem(gymnasium.registry, "Made-v0", EnvSpec("Made-v0", cast(Any, made)))
    for limit, ends in ((None, 4), (3, 3)):
        spec = EnvironmentSpec(id="Made-v0", kwargs={"max_episode_steps": 4}, max_episode_steps=limit)
        environments = make_environments(spec, 1)
        environments.reset(1)
        assert [row[2] or row[3] for row in _rows(environments, [0] * ends)] == [False] * (ends - 1) + [True]


def test_no_reward_limit_ends_episodes_after_steps_without_a_positive_reward() -> None:
    environments = make_environments(_picture(no_reward_limit=2, kwargs={"end": 100}), 1)
    environments.reset(1)
    bad, nothing, good = 0, 1, 2
    rows = _rows(environments, [bad, good, nothing, bad, good, nothing, nothing, good])
    assert [row[1] for row in rows] == [-0.5, 0.5, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0]
    assert [row[3] for row in rows] == [False, False, False, True, False, False, True, False]
    assert [tuple(row[0][0][0][:2]) for row in rows[3:6]] == [(1, 4), (2, 0), (2, 1)], "and one reset before, for masks"
    assert [row[2] for row in rows] == [row[3] for row in rows], "nothing more is to come: terminated, too"


def test_no_reward_limit_counts_rows_and_restarts_with_each_episode() -> None:
    """Episodes of 3 steps repeated twice are 2 rows: a no_reward_limit of 2 is reached just where they end."""
    for no_reward_limit, cut in ((3, False), (2, False), (1, True)):
        environments = make_environments(
            _picture(no_reward_limit=no_reward_limit, action_repeat=2, kwargs={"end": 3}), 1
        )
        environments.reset(1)
        rows = _rows(environments, [0] * 9)
        assert any(row[3] for row in rows) == cut, "a termination takes precedence"
        assert any(row[2] for row in rows)


def test_second_reset_restarts_all_episodes() -> None:
    environments = make_environments(_picture(no_reward_limit=3, kwargs={"end": 4}), 2)
    first = [environments.reset(7)]
    first += [environments.step(np.array([0, 2]))[0] for _ in range(2)]
    again = [environments.reset(7)]
    again += [environments.step(np.array([0, 2]))[0] for _ in range(2)]
    first, again = np.stack(first), np.stack(again)
    assert first[:, :, 0, 0, 0].tolist() == [[1, 0]] * 3, "the first was reset once more, to learn whether it has masks"
    assert again[:, :, 0, 0, 0].tolist() == [[2, 1]] * 3
    np.testing.assert_array_equal(first[:, :, 1:], again[:, :, 1:])
    _, _, terminated, truncated = environments.step(np.array([0, 2]))
    assert (terminated.tolist(), truncated.tolist()) == ([True, False], [True, False])


# ---------------------------------------------------------------------------------------------- wrap, camera


def test_wrapper_is_applied_before_the_repeats() -> None:
    wrap = "picture_environment:with_doubled_rewards"
    environments = make_environments(_counting(action_repeat=2, wrap=wrap), 1)
    environments.reset(1)
    assert _rows(environments, [0, 0])[1] == ([0.0, 3.0], 4.0, True, False)


@pytest.mark.parametrize(
    ("wrap", "reason"),
    [
        ("no_such_module:function", "the module no_such_module may not be imported here"),
        ("picture_environment:no_such_function", "picture_environment.py has no 'no_such_function'"),
        ("picture_environment:__doc__", "is not a function: name it as module:function"),
        ("picture_environment:with_nothing_to_play", "returned str for .*must return a gymnasium.Env"),
    ],
)
def test_invalid_wrapper_is_reported(wrap: str, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=f"environment.wrap={wrap}.*{reason}"):
        make_environments(_picture(wrap=wrap), 1)


@pytest.mark.parametrize("processes", [False, True])
def test_the_module_of_an_environment_is_not_imported_unless_it_is_allowed(
    processes: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trap.py").write_text("import pathlib; pathlib.Path('sprung').touch()")
    monkeypatch.chdir(tmp_path)
    for spec in (EnvironmentSpec(id="trap:Env-v0"), EnvironmentSpec(id="CartPole-v1", wrap="trap:wrap")):
        for make_some in (make.make_environments, make_gymnasium):
            with pytest.raises(EnvironmentSetupError, match="the module trap may not be imported here"):
                make_some(spec.model_copy(update={"processes": processes}), 1, modules=NO_MODULES)
    assert [entry.name for entry in tmp_path.iterdir()] == ["trap.py"]
    assert str(tmp_path) not in sys.path


def test_camera_receives_every_step_of_the_environment() -> None:
    film: list[np.ndarray] = []
    spec = _picture(action_repeat=3, kwargs={"end": 4}, processes=True, crop=(1, 1, 1, 1))
    environments = make_environments(spec, 1, render_mode="rgb_array", camera=lambda picture, _: film.append(picture))
    environments.reset(1)
    _rows(environments, [0, 0, 0, 0])
    assert [int(picture[0, 0, 0]) for picture in film] == [0, 1, 2, 3, 4, 0, 1, 2, 3]
    assert film[0].shape == (2, 2, 3)


def _rate(spec: EnvironmentSpec) -> FrameRate:
    """The rate that a camera receives with the second picture."""
    rates: list[FrameRate] = []
    camera = lambda _, rate: rates.append(rate)  # noqa: E731
    environments, _ = make.make_bare(spec, 1, TEST_MODULES, "rgb_array", camera)
    shape = environments.action_space.shape
    assert shape is not None
    try:
        environments.reset(1)
        environments.step(np.zeros((1, *shape), environments.action_space.dtype))
    finally:
        environments.close()
    return rates[1]


@pytest.mark.parametrize(
    ("environment", "kwargs", "rate"),
    [
        ("CartPole-v1", {}, 50.0),
        ("ALE/Pong-v5", {}, 15.0),
        ("ALE/Pong-v5", {"frameskip": 1}, 60.0),
        ("Pong-v4", {}, 20.0),  # repeats an action two to four times
        ("PongNoFrameskip-v4", {}, 60.0),
        ("Hopper-v5", {}, 125.0),  # the class says nothing, the instance computes it
        ("Hopper-v5", {"frame_skip": 2}, 250.0),
        ("HalfCheetah-v5", {}, 20.0),
    ],
)
def test_camera_receives_the_rate_of_the_environment_itself(
    environment: str, kwargs: dict[str, Any], rate: float
) -> None:
    if environment.startswith("H") and find_library("EGL") is None:
        pytest.skip("libEGL is not installed")
    spec = EnvironmentSpec(id=environment, kwargs=kwargs, action_repeat=2)  # each action has two frames
    found = _rate(spec)
    assert (found.per_second, found.guess) == (pytest.approx(rate), "")


@pytest.mark.parametrize(
    ("stated", "rate"),
    [(125, 125.0), (np.float32(12.5), 12.5), (0.1, 0.1), (10_000, 10_000.0)]
    + [
        (wrong, None) for wrong in (None, 0, -5, math.nan, math.inf, "60", "x\n\x1b[2J", True, 10**400, 0.01, 1e9, [30])
    ],
)
def test_rate_that_no_video_can_have_is_guessed_and_the_reason_names_it(stated: object, rate: float | None) -> None:
    environment = Picture()
    environment.metadata = {"render_fps": stated}
    found = frame_rate(environment)
    if rate is not None:
        assert found == (rate, "")
        return
    assert found.per_second == 30.0
    assert "30 frames a second are a guess" in found.guess
    assert ("states no render_fps" if stated is None else bounded_text(repr(stated), 60)) in found.guess
    assert found.guess.isprintable()


@pytest.mark.parametrize(
    ("wrap", "rate", "guess"),
    [
        ("with_skipped_frames", 12.5, False),
        ("with_skipped_frames_that_it_states", 10.0, False),
        ("with_a_rate_of_its_own", 7.0, False),
        ("without_rate", 30.0, True),
    ],
)
def test_wrapper_of_the_user_may_skip_frames_and_change_the_rate(wrap: str, rate: float, guess: bool) -> None:
    found = _rate(EnvironmentSpec(id="CartPole-v1", wrap=f"picture_environment:{wrap}"))
    assert (found.per_second, bool(found.guess)) == (rate, guess)


def test_camera_requires_one_environment() -> None:
    with pytest.raises(ValueError, match="a camera needs one environment"):
        make_environments(_picture(), 2, render_mode="rgb_array", camera=lambda *_: None)


def test_camera_requires_an_environment_that_renders_images() -> None:
    class Dark(Picture):
        def render(self) -> None:  # type: ignore[override] - on purpose
            return None

    class Broken(Picture):
        def render(self) -> np.ndarray:
            raise RuntimeError("no display")

    class Without(Picture):
        def render(self) -> np.ndarray:
            raise NotImplementedError  # as gymnasium.Env does

    for environment, reason in (
        (Dark(), " renders NoneType instead of an image"),
        (Broken(), r": render raises RuntimeError: no display \(.*test_gymnasium_backend.py, line \d+\)"),
        (Without(), " cannot render rgb_array images"),
    ):
        filmed = RepeatedSteps(environment, "Mine-v0", repeat=1, no_reward_limit=None, camera=lambda *_: None)
        with pytest.raises(EnvironmentSetupError, match=f"environment Mine-v0{reason}: a video of it cannot be recor"):
            filmed.reset()


def test_environment_whose_constructor_takes_no_render_mode_cannot_be_filmed() -> None:
    spec = EnvironmentSpec(id="faulty_environments:Faulty-v0")
    with pytest.raises(EnvironmentSetupError, match="Faulty-v0 cannot render rgb_array images: its constructor has no"):
        make_gymnasium(spec, 1, modules=FAULTY, render_mode="rgb_array", camera=lambda *_: None)


# ------------------------------------------------------------------------------------------------- processes


def test_processes_give_the_same_steps_as_one_process() -> None:
    spec = _picture(action_repeat=2, no_reward_limit=2, grey=True, crop=(1, 0, 0, 1), kwargs={"end": 9})
    actions = np.random.default_rng(3).integers(0, 3, (25, 3))
    played = []
    for processes in (False, True):
        with closing(make_environments(spec.model_copy(update={"processes": processes}), 3)) as environments:
            steps = [environments.step(row) for row in actions] if environments.reset(11) is not None else []
        played.append([np.stack(part) for part in zip(*steps, strict=True)])
    for here, there in zip(*played, strict=True):
        np.testing.assert_array_equal(here, there)
    assert played[0][2].any() or played[0][3].any(), "some episodes ended"


def _processes(**fields) -> EnvironmentProcesses:
    return EnvironmentProcesses("Mine-v0", [EnvironmentFactory(spec=_counting(**fields), modules=TEST_MODULES)] * 2)


def test_close_ends_the_processes() -> None:
    environments = _processes()
    environments.reset(seed=1)
    environments.close()
    assert [process.exitcode for process in environments.processes] == [0, 0]


def test_close_after_an_interrupted_step_ends_the_processes() -> None:
    """The pipes hold answers of the unfinished step: a request to end would wait for ever."""
    environments = _processes()
    environments.reset(seed=1)
    pipe = environments.parent_pipes[1]

    def interrupted() -> None:
        raise KeyboardInterrupt

    environments.parent_pipes[1] = SimpleNamespace(send=pipe.send, recv=interrupted)  # type: ignore[assignment] - the two methods in use
    with pytest.raises(KeyboardInterrupt):
        environments.step(np.zeros(2, np.int64))
    environments.parent_pipes[1] = pipe
    environments.close()
    assert not any(process.is_alive() for process in environments.processes)


def test_close_ends_processes_whose_environments_do_not_close(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment_processes, "_CLOSE_SECONDS", 0.5)
    monkeypatch.setattr(environment_processes, "_TERMINATE_SECONDS", 0.1)
    spec = EnvironmentSpec(id="faulty_environments:Faulty-v0", kwargs={"fault": "close"})
    environments = EnvironmentProcesses("Mine-v0", [EnvironmentFactory(spec=spec, modules=FAULTY)] * 2)
    environments.reset(seed=1)
    environments.step(np.zeros(2, np.int64))
    environments.close()
    assert [process.exitcode for process in environments.processes] == [-signal.SIGKILL] * 2


def test_environment_in_a_process_may_start_processes() -> None:
    environments = make_environments(_faulty("child process", processes=True), 1, modules=FAULTY)
    assert environments.reset(1) is not None
    environments.close()


def test_processes_say_why_an_environment_cannot_be_made() -> None:
    """The first is made by this process, for its spaces."""
    makers = [EnvironmentFactory(spec=_faulty(fault), modules=FAULTY) for fault in ("", "constructor")]
    with pytest.raises(EnvironmentSetupError) as caught:
        EnvironmentProcesses("Mine-v0", makers)
    assert str(caught.value).startswith("environment Mine-v0 cannot be created: FileNotFoundError: level.txt (")
    assert "environment 2 of 2 of this process: if only one can run at a time" in str(caught.value)
    assert not [each for each in multiprocessing.active_children() if "EnvironmentProcesses" in each.name]


LEFT_OPEN = """
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from counting_environment import Counting

environments = EnvironmentProcesses("Mine-v0", [Counting] * 2)
environments.reset(seed=1)
print("open", flush=True)
"""


def test_processes_that_nobody_has_closed_do_not_hold_up_the_end_of_their_parent() -> None:
    path = os.pathsep.join(sys.path)
    command = [sys.executable, "-c", LEFT_OPEN]
    ended = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert (ended.returncode, ended.stdout) == (0, "open\n"), ended.stderr


@pytest.mark.parametrize("count", [1, 3])
def test_close_that_does_not_return_is_given_up(
    count: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What an evaluation has played would be lost."""
    monkeypatch.setattr(gymnasium_environments, "CLOSE_SECONDS", 0.3)
    monkeypatch.setattr(gymnasium_environments, "_NEXT_SECONDS", 0.1)
    environments = make_environments(_faulty("close alone"), count, modules=FAULTY)
    environments.reset(1)
    environments.step(np.zeros(count, np.int64))
    handler = signal.getsignal(signal.SIGALRM)
    environments.close()
    assert "close raises TimeoutError: it does not return (" in caplog.text
    assert (signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)) == (handler, (0.0, 0.0))


def _faulty(fault: str, **fields: Any) -> EnvironmentSpec:
    return EnvironmentSpec(id="faulty_environments:Faulty-v0", kwargs={"fault": fault}, **fields)


def test_killed_process_is_reported_and_close_ends_the_others() -> None:
    environments = _processes()
    environments.reset(seed=1)
    environments.processes[0].kill()
    environments.processes[0].join()
    with pytest.raises(
        EnvironmentSetupError, match=r"environment Mine-v0: .* has died \(signal 9\): .* lack of memory"
    ):
        environments.step(np.zeros(2, np.int64))
    environments.close()
    assert not any(process.is_alive() for process in environments.processes)


HANGING = """
import multiprocessing
import os
import time
from counting_environment import Counting
from daedalus.actor.environments import environment_processes


class Hanging(Counting):
    def __init__(self):
        super().__init__()
        environment_processes._CLOSE_SECONDS = 0.1  # of this process

    def step(self, action):
        print(os.getpid(), flush=True)
        time.sleep(1000)
"""
PARENT = """
import numpy
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from hanging import Hanging

environments = EnvironmentProcesses("Mine-v0", [Hanging])
environments.reset(seed=1)
environments.step(numpy.zeros(1, numpy.int64))
"""


def test_process_whose_environment_hangs_ends_after_its_parent_was_killed(tmp_path: Path) -> None:
    (tmp_path / "hanging.py").write_text(HANGING)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    command = [sys.executable, "-c", PARENT]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        process = int(parent.stdout.readline())
        assert process != parent.pid
        parent.kill()
        until(lambda: not Path(f"/proc/{process}").exists())


def test_processes_ignore_interrupts() -> None:
    with closing(_processes()) as environments:
        environments.reset(seed=1)
        for process in environments.processes:
            assert process.pid is not None
            os.kill(process.pid, signal.SIGINT)
        environments.step(np.zeros(2, np.int64))
        assert all(process.is_alive() for process in environments.processes)
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []), (
            "the parent does not ignore interrupts"
        )


# ------------------------------------------------------------------------------- observations outside their space


class Drifting(gymnasium.Env):
    """Environment that returns another observation in its second step."""

    observation_space = gymnasium.spaces.Dict({"a": gymnasium.spaces.Box(0, 255, (2,), np.uint8)})
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, later: Any) -> None:
        self._later, self._step = later, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        return {"a": np.zeros(2, np.uint8)}, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        self._step += 1
        if self._step == 2 and isinstance(self._later, Exception):
            raise self._later
        return self._later if self._step == 2 else self.reset()[0], 0.0, False, False, {}


@pytest.mark.parametrize(
    ("later", "reason"),
    [
        ({"b": 1}, r"an observation with the parts \['b'\], but observation_space has the parts \['a'\]"),
        (
            {"a": np.zeros(3, np.uint8)},
            r"whose part 'a' is of shape \(3,\), but observation_space\['a'\] has shape \(2,\)",
        ),
        ({"a": np.array([1.5, 300.0])}, r"whose part 'a' is of dtype float64, but .* has dtype uint8"),
    ],
)
def test_observation_that_stops_to_fit_is_named(monkeypatch: pytest.MonkeyPatch, later: Any, reason: str) -> None:
    monkeypatch.setitem(gymnasium.registry, "Drifting-v0", EnvSpec("Drifting-v0", lambda **_: Drifting(later)))
    environments = created(EnvironmentSpec(id="Drifting-v0"), 2)
    environments.reset(1)
    environments.step({"action": np.zeros((2, 1), np.int64)})
    with pytest.raises(EnvironmentSetupError, match=reason):
        environments.step({"action": np.zeros((2, 1), np.int64)})


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.parametrize(
    ("space", "dtype", "number", "reason"),
    [
        ("int8", "int64", 300, "the value 300, but its space has dtype int8"),
        ("int16", "int32", -40_000, "the value -40000, but its space has dtype int16"),
        ("uint8", "uint16", 256, "the value 256, but its space has dtype uint8"),
    ],
)
def test_number_that_the_dtype_of_its_space_cannot_hold_is_refused(
    space: str, dtype: str, number: Any, reason: str, processes: bool
) -> None:
    kwargs = {"shown": [0, number, 0], "space": space, "dtype": dtype}
    spec = EnvironmentSpec(id="showing_environments:Showing-v0", kwargs=kwargs, processes=processes)
    with closing(created(spec, 2, modules=UserModules(frozenset({"showing_environments"})))) as environments:
        environments.reset(1)
        with pytest.raises(EnvironmentSetupError, match=f"Showing-v0: step returns an observation .*{reason}"):
            environments.step({"action": np.zeros((2, 1), np.int64)})


def test_only_one_environment_is_reset_to_learn_whether_there_are_masks(monkeypatch: pytest.MonkeyPatch) -> None:
    resets = []
    monkeypatch.setattr(
        Drifting, "reset", lambda self, **_: (resets.append(self), ({"a": np.zeros(2, np.uint8)}, {}))[1]
    )
    monkeypatch.setitem(gymnasium.registry, "Drifting-v0", EnvSpec("Drifting-v0", lambda **_: Drifting(None)))
    environments = created(EnvironmentSpec(id="Drifting-v0"), 3)
    assert len(resets) == 1
    environments.reset(1)
    assert len(resets) == 4


def test_error_of_the_environment_itself_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    failing = EnvSpec("Drifting-v0", lambda **_: Drifting(KeyError("gripper")))
    monkeypatch.setitem(gymnasium.registry, "Drifting-v0", failing)
    environments = created(EnvironmentSpec(id="Drifting-v0"), 2)
    environments.reset(1)
    environments.step({"action": np.zeros((2, 1), np.int64)})
    with pytest.raises(EnvironmentSetupError, match="Drifting-v0: step raises KeyError: 'gripper'"):
        environments.step({"action": np.zeros((2, 1), np.int64)})


def test_component_that_is_left_out_does_not_hide_an_error() -> None:
    kwargs: dict[str, Any] = {"text_space": True, "disconnects": True}
    environments = created(
        EnvironmentSpec(id="mission_environment:Mission-v0", leave_out=("mission",), kwargs=kwargs), 2
    )
    environments.reset(1)
    environments.step({"action": np.zeros((2, 1), np.int64)})
    with pytest.raises(EnvironmentSetupError, match="step raises ValueError: motor 3 is disconnected"):
        environments.step({"action": np.zeros((2, 1), np.int64)})


# ------------------------------------------------------------------------------------------------ failures in play


def _play(processes: bool, steps: int = 12, **settings: Any) -> dict[str, list[float]]:
    """Play two faulty environments, and return the scalars of their infos."""
    spec = EnvironmentSpec(id="faulty_environments:Faulty-v0", processes=processes, **settings)
    with closing(make.make_environments(spec, 2, modules=FAULTY)) as environments:
        environments.reset(1)
        for _ in range(steps):
            environments.step({"action": np.zeros((2, 1), np.int64)})
        return {name: values.tolist() for name, values in environments.take_episode_info().items()}


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"kwargs": {"fault": "error"}}, "step raises KeyError: 'missing'"),
        ({"kwargs": {"fault": "second episode"}}, "reset raises ValueError: map 2 is missing"),
        ({"kwargs": {"fault": "exit"}}, "step raises SystemExit: 0"),
        ({"kwargs": {"fault": "error of a class of its own"}}, r"step raises _SimulatorError: no contact \(code 3\)"),
        ({"wrap": "faulty_environments:with_failing_step"}, "step raises RuntimeError: the wrapper fails"),
    ],
)
def test_exception_of_an_environment_is_reported_with_its_place(
    processes: bool, settings: dict[str, Any], reason: str
) -> None:
    place = r" \(.*faulty_environments.py, line \d+\)$"
    with pytest.raises(EnvironmentSetupError, match=f"^environment faulty_environments:Faulty-v0: {reason}{place}"):
        _play(processes, **settings)


@pytest.mark.parametrize("processes", [False, True])
def test_reward_that_is_no_number_is_refused(processes: bool) -> None:
    with pytest.raises(EnvironmentSetupError, match=r"Faulty-v0: step returns the reward \[1.0\]: it must be a number"):
        _play(processes, kwargs={"fault": "reward in a list"})


@pytest.mark.parametrize("processes", [False, True])
def test_end_that_is_no_bool_is_refused(processes: bool) -> None:
    reason = "Faulty-v0: step returns terminated=.?False.?, of type str: it must be a bool"
    with pytest.raises(EnvironmentSetupError, match=reason):
        _play(processes, kwargs={"fault": "flag as text"})
    _play(processes, kwargs={"fault": "flag"})  # 0 and 1


def test_traceback_of_the_users_code_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(EnvironmentSetupError):
        _play(False, kwargs={"fault": "error in a function"})
    printed = capfd.readouterr().err
    assert printed.startswith("Traceback (most recent call last):\n")
    assert [line.split(" in ")[1] for line in printed.splitlines() if " in " in line] == ["step", "_connect"]


def test_process_that_an_environment_ends_is_reported_with_its_status() -> None:
    with pytest.raises(EnvironmentSetupError, match=r"Faulty-v0: the process of .* has died \(status 7\)"):
        _play(True, kwargs={"fault": "crash"})


@pytest.mark.parametrize("processes", [False, True])
def test_entries_of_info_that_are_no_scalars_are_left_out(processes: bool) -> None:
    found = _play(processes, kwargs={"fault": "info"})
    assert found == {"length": [10.0, 10.0], "hash": [float(2**63)] * 2}


# ----------------------------------------------------------------------------------------------- missing packages


@pytest.mark.parametrize("extra", ["Box2D", "MuJoCo"])
def test_missing_package_is_reported_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch, extra: str) -> None:
    def fails(**_kwargs) -> gymnasium.Env:
        raise gymnasium.error.DependencyNotInstalled(f"{extra} is not installed, run `pip install ...`")

    monkeypatch.setitem(gymnasium.registry, "Fails-v0", EnvSpec("Fails-v0", fails))
    with pytest.raises(EnvironmentSetupError, match=rf'pip install "daedalus-rl\[{extra.lower()}\]"$'):
        make_environments(EnvironmentSpec(id="Fails-v0"), 1)


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [
        ("ALE/Pong-v5", "ale_py", "atari"),
        ("MiniGrid-DoorKey-5x5-v0", "minigrid", "minigrid"),
        ("BabyAI-GoToLocal-v0", "minigrid", "minigrid"),
    ],
)
def test_missing_package_that_registers_environments_is_reported_with_its_extra(
    monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(EnvironmentSetupError, match=rf'{name} needs .*pip install "daedalus-rl\[{extra}\]"$'):
        make_environments(EnvironmentSpec(id=name), 1)


def test_minigrid_is_registered_by_its_names() -> None:
    pytest.importorskip("minigrid")
    spec = EnvironmentSpec(id="MiniGrid-DoorKey-5x5-v0", leave_out=("mission",))
    environments = created(spec, 2)
    frames = environments.reset(1).frames
    assert {part: values.shape for part, values in frames.items()} == {"direction": (2, 1), "image": (2, 7, 7, 3)}
    environments.close()


@pytest.mark.parametrize("kwargs", [{}, {"text_space": True}], ids=["space of its own", "text with blanks"])
def test_text_can_be_left_out_in_processes(kwargs: dict[str, Any]) -> None:
    spec = EnvironmentSpec(id="mission_environment:Mission-v0", leave_out=("mission",), processes=True, kwargs=kwargs)
    with closing(created(spec, 2)) as environments:
        assert environments.reset(1).frames["step"].tolist() == [[0.0], [0.0]]
        assert environments.step({"action": np.array([[0], [1]])})[1].tolist() == [0.0, 1.0]


def test_atari_games_of_gymnasium_have_their_own_frames() -> None:
    pytest.importorskip("ale_py")
    spec = EnvironmentSpec(id="ALE/Pong-v5", kwargs={"frameskip": 1}, action_repeat=4, grey=True, resize=(84, 84))
    environments = make_environments(spec, 2)
    assert environments.reset(1).shape == (2, 84, 84)
    assert environments.step(np.zeros(2, np.int64))[0].shape == (2, 84, 84)
    assert choices(environments.spaces) == 6
    environments.close()
    plain = make_environments(EnvironmentSpec(id="ALE/Pong-v5"), 1)
    assert plain.spaces.observations["observation"].shape == (210, 160, 3)
    plain.close()


def test_an_atari_game_of_another_backend_is_the_same_game_on_gymnasium() -> None:
    pytest.importorskip("ale_py")
    kwargs = {"repeat_action_probability": 0.25, "full_action_space": True, "noop_max": 1, "episodic_life": False}
    spec = as_on_gymnasium(EnvironmentSpec(id="Pong-v5", backend="envpool", kwargs=kwargs, action_repeat=4))
    of_backend = {"frameskip": 1, "use_fire_reset": True, "maxpool": True}
    assert spec.kwargs == {**of_backend, "repeat_action_probability": 0.25, "full_action_space": True, "noop_max": 1}
    environments = make_environments(spec, 1)
    assert choices(environments.spaces) == 18
    environments.close()


@pytest.mark.parametrize("name", ["PongNoFrameskip-v4", "Pong-v0"])
def test_atari_games_are_found_by_their_old_names(name: str) -> None:
    """In a process of its own, where nothing has registered them yet."""
    pytest.importorskip("ale_py")
    program = (
        "from daedalus.actor.environments.make import make_environments\n"
        "from daedalus.protocol.spec import EnvironmentSpec\n"
        f"print(make_environments(EnvironmentSpec(id={name!r}), 1).spaces.observations['observation'].shape)"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert finished.stdout == "(210, 160, 3)\n", finished.stderr
