"""`daedalus record`, in this process: who plays, and what is in the dataset."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pygame
import pytest
from saved_runs import save

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.minari_files import MinariWriter
from daedalus.actor.evaluation import dataset_recorder
from daedalus.actor.evaluation.dataset_recorder import Recorder
from daedalus.cli.commands.export import export
from daedalus.cli.commands.record import record
from daedalus.protocol.spec import EnvironmentSpec

PUMP = """
import gymnasium
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv

class Pump:
    def reset(self, agent, seed):
        self.steps = 0

    def act(self, observation, action_mask):
        self.steps += 1
        return np.array([1.0 if observation[1] >= 0 else -1.0], np.float32) * (0.5 if self.steps % 2 else 1.0)

class Unseen(CartPoleEnv):
    def render(self):
        return None

class Masked(gymnasium.Env):
    flags = gymnasium.spaces.MultiBinary(4)
    observation_space = gymnasium.spaces.Dict({"action_mask": flags, "place": gymnasium.spaces.Discrete(4)})
    action_space = gymnasium.spaces.Discrete(4)

    def observe(self):
        return {"action_mask": np.arange(4) == self.place, "place": self.place}

    def reset(self, seed=None, options=None):
        self.place = 1
        return self.observe(), {}

    def step(self, action):
        assert action == self.place
        self.place = (self.place + 1) % 4
        return self.observe(), 1.0, self.place == 0, False, {}

class Broken(CartPoleEnv):
    def step(self, action):
        raise RuntimeError("the pole is gone")
"""


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "pumping.py").write_text(PUMP)
    return lambda *words: record(["--out", "./shown", *map(str, words)])


def test_a_bot_is_recorded_with_every_observation(recorded: Callable[..., int], tmp_path: Path) -> None:
    assert recorded("--env", "MountainCarContinuous-v0", "--by", "pumping:Pump", "--episodes", 2, "--seed", 7) == 0
    dataset = minari.MinariDataset(tmp_path / "shown/data")
    environment = dataset.recover_environment()
    for number, episode in enumerate(dataset):
        observation, _ = environment.reset(seed=7 + number)
        np.testing.assert_array_equal(episode.observations[0], observation)
        for action, following, reward in zip(episode.actions, episode.observations[1:], episode.rewards, strict=True):
            observation, earned, *_ = environment.step(action)
            np.testing.assert_array_equal(following, observation)
            assert reward == earned
        assert episode.terminations[-1]
    assert dataset.total_episodes == 2


def test_a_random_player_obeys_a_mask_in_the_observation(recorded: Callable[..., int]) -> None:
    assert recorded("--env", "pumping:Masked", "--by", "random", "--episodes", 3) == 0


class OneArray(gymnasium.Env):
    """Counts its steps, in the same array each time; its end may be given."""

    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space = gymnasium.spaces.Discrete(2)
    count = np.zeros(1, np.float32)

    def __init__(self, end: float = 3.0) -> None:
        self.end = end

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count[:] = 0.0
        return self.count, {}

    def step(self, action: Any) -> Any:
        self.count += 1.0
        return self.count, 0.0, bool(self.count[0] == self.end), False, {}


class Always:
    def reset(self, seed: int) -> None:
        pass

    def act(self, observation: Any, action_mask: Any) -> Any:
        return 1


def test_an_environment_may_use_its_array_again(tmp_path: Path) -> None:
    environment = OneArray()
    writer = MinariWriter(str(tmp_path / "shown"), environment.observation_space, environment.action_space)
    Recorder(environment, writer, episodes=1, seed=0).play(Always())
    (episode,) = minari.MinariDataset(tmp_path / "shown/data")
    assert episode.observations.ravel().tolist() == [0.0, 1.0, 2.0, 3.0]


def test_an_end_that_is_no_bool_is_refused(tmp_path: Path) -> None:
    class EndsWithText(OneArray):
        def step(self, action: Any) -> Any:
            observation, reward, ended, *others = super().step(action)
            return observation, reward, str(ended), *others

    environment = EndsWithText()
    writer = MinariWriter(str(tmp_path / "shown"), environment.observation_space, environment.action_space)
    with pytest.raises(EnvironmentSetupError, match="terminated='False', of type str: it must be a bool"):
        Recorder(environment, writer, episodes=1, seed=0).play(Always())


@pytest.mark.parametrize(("longest", "most_bytes"), [(5, 1 << 30), (100, 72)])  # a step has 4 bytes and 8
def test_an_episode_that_never_ends_is_truncated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, longest: int, most_bytes: int
) -> None:
    monkeypatch.setattr(dataset_recorder, "EPISODE_BYTES", most_bytes)
    environment = OneArray(end=-1.0)
    writer = MinariWriter(str(tmp_path / "shown"), environment.observation_space, environment.action_space)
    Recorder(environment, writer, episodes=2, seed=0, longest=longest).play(Always())
    for episode in minari.MinariDataset(tmp_path / "shown/data"):
        assert episode.truncations.tolist() == [False] * 4 + [True]
        assert not episode.terminations.any()
    assert len(caplog.messages) == 1
    assert "has not ended after 5 steps and is recorded as truncated" in caplog.text


def test_a_person_plays_with_keys(recorded: Callable[..., int], tmp_path: Path) -> None:
    keys = ("--key", "a=0", "--key", "d=1", "--idle", "1", "--rate", "500")
    assert recorded("--env", "CartPole-v1", "--by", "keys", *keys, "--episodes", 2) == 0
    dataset = minari.MinariDataset(tmp_path / "shown/data")
    assert dataset.total_episodes == 2
    assert all((episode.actions == 1).all() for episode in dataset)  # nobody pressed a key
    assert recorded("--env", "CartPole-v1", "--by", "keys", *keys) == 2  # the dataset is there


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        (("--env", "CartPole-v1"), 2, "name either a run directory, or --env ID and --by PLAYER"),
        (("--env", "CartPole-v1", "--by", "keys", "--key", "a=7"), 1, "the action 7 of a key"),
        (("--env", "CartPole-v1", "--by", "keys", "--key", "a=0.5"), 1, "the action 0.5 of a key"),
        (("--env", "CartPole-v1", "--by", "keys", "--key", 'a=["x"]'), 1, "the action ['x'] of a key"),
        (("--env", "CartPole-v1", "--by", "keys", "--key", "a"), 2, "write K=ACTION"),
        (("--env", "CartPole-v1", "--by", "random", "--key", "a=1"), 2, "--key is for --by keys or gamepad"),
        (("--env", "CartPole-v1", "--by", "random", "--sampled"), 2, "--sampled is for a RUN_DIR"),
        (("--env", "CartPole-v1", "--by", "keys", "--axis", "leftx=0"), 2, "--axis is for --by gamepad"),
        (("--env", "CartPole-v1", "--by", "random", "--episodes", "0"), 2, "--episodes 0 must be at least 1"),
        (("--env", "CartPole-v1", "--by", "random", "--seed", "-3"), 2, "--seed -3 must be at least 0"),
        (("--env", "CartPole-v1", "--by", "keys"), 1, "name keys with --key"),
        (("--env", "CartPole-v1", "--by", "gamepad", "--key", "a=1"), 1, "no gamepad is connected"),
        (("--env", "CartPole-v1", "--by", "gamepad", "--axis", "leftx"), 2, "write AXIS=N"),
        (("--env", "pumping:Unseen", "--by", "keys", "--key", "a=1"), 1, "render() must return an array"),
        (("--env", "CartPole-v1", "--by", "pumping:Nobody"), 1, "Nobody"),
        (("--env", "CartPole-v1", "--by", "Pump"), 2, "--by Pump is no player: write module:Bot, random, keys or "),
        (("--env", "CartPole-v1", "--by", "random", "--out", "shown"), 2, "dataset shown has no id of Minari"),
        (("--env", "pumping:Broken", "--by", "random"), 1, "Broken: step raises RuntimeError: the pole is gone"),
        (("--env", "pettingzoo.classic.connect_four_v3", "--by", "random"), 1, "datasets are of one agent"),
    ],
)
def test_what_cannot_be_recorded_leaves_nothing(
    recorded: Callable[..., int],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    status: int,
    reason: str,
) -> None:
    assert recorded(*words) == status
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert reason in line
    assert not (tmp_path / "shown").exists()


def test_a_person_without_a_display_is_told_so(
    recorded: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """SDL would open a window that nobody sees, and record an episode of nobody's actions."""
    pygame.quit()
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert recorded("--env", "CartPole-v1", "--by", "keys", "--key", "a=1", "--episodes", 1) == 1
    assert "there is no display for the window" in capsys.readouterr().err


def test_an_observation_that_no_policy_can_act_on_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    environment = EnvironmentSpec(id="faulty_environments:Faulty-v0", kwargs={"fault": "nan"})
    run, allowed = save(tmp_path / "run", environment, 1), ("--allow-module", "faulty_environments")
    assert record([str(run), "--out", str(tmp_path / "shown"), *allowed]) == 1
    assert export([str(run), str(tmp_path / "policy.onnx"), "--check", *allowed]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first.removeprefix("daedalus record: ") == second.removeprefix("daedalus export: ")
    assert "Faulty-v0: the observation has a value that is not finite (nan)" in first
