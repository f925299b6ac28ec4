"""actor/environments/atari.py: games of ALE look and begin on gymnasium as on ALE's own backend."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from plain import PlainEnvironments
from saved_runs import save

from daedalus.actor.environments.atari import PooledFrames, RandomStart
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.loaded_policy import load_policy
from daedalus.protocol.spec import EnvironmentSpec

pytest.importorskip("ale_py.vector_env")

SPEC = EnvironmentSpec(id="Asteroids-v5", backend="ale", action_repeat=4, grey=True, resize=(84, 84))
BRIGHT = 40


def bright_pixels(spec: EnvironmentSpec) -> np.ndarray:
    """Return how many pixels are bright in each of 16 observations."""
    environments = PlainEnvironments(make_environments(spec, 1))
    environments.reset(0)
    counts = [int((environments.step(np.zeros(1, np.int64))[0] > BRIGHT).sum()) for _ in range(16)]
    environments.close()
    return np.array(counts)


def test_objects_that_are_drawn_in_every_other_frame_are_seen() -> None:
    on_ale, on_gymnasium = bright_pixels(SPEC), bright_pixels(as_on_gymnasium(SPEC))
    np.testing.assert_allclose(on_gymnasium, on_ale, rtol=0.1)
    without = as_on_gymnasium(SPEC).kwargs | {"maxpool": False}
    assert (bright_pixels(as_on_gymnasium(SPEC).model_copy(update={"kwargs": without})) < on_ale / 4).all()


class Blinking(gymnasium.Env[np.ndarray, np.int64]):
    """Two pixels, of which the first is drawn in even frames and the second in odd ones, as bright as the frame."""

    observation_space = gymnasium.spaces.Box(0, 255, (2,), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)

    def __init__(self, meanings: list[str], ends_after: int = 99) -> None:
        self.meanings, self.ends_after, self.frame, self.actions = meanings, ends_after, 0, list[int]()

    def get_action_meanings(self) -> list[str]:
        return self.meanings

    def _drawn(self) -> np.ndarray:
        pixels = np.zeros(2, np.uint8)
        pixels[self.frame % 2] = 10 + self.frame
        return pixels

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.frame, self.actions = 0, []
        return self._drawn(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.frame += 1
        self.actions.append(action)
        return self._drawn(), 0.0, self.frame == self.ends_after, False, {}


def test_frames_are_pooled_by_twos() -> None:
    environment = PooledFrames(Blinking(["NOOP"]))
    assert environment.reset()[0].tolist() == [10, 0]
    assert [environment.step(0)[0].tolist() for _ in range(3)] == [[10, 11], [12, 11], [12, 13]]
    assert environment.reset()[0].tolist() == [10, 0]


@pytest.mark.parametrize("fires", [False, True])
@pytest.mark.parametrize("meanings", [["NOOP", "FIRE", "UP"], ["NOOP", "UP", "FIRE"]])
def test_an_episode_begins_after_a_random_number_of_frames_of_which_the_last_fires(
    meanings: list[str], fires: bool
) -> None:
    game = Blinking(meanings)
    environment = RandomStart(game, 5, fires)
    lengths = set()
    for seed in range(60):
        observation, _ = environment.reset(seed=seed)
        assert observation.tolist() == game._drawn().tolist()
        *others, last = game.actions
        assert not any(others)
        assert last == int(fires and meanings[1] == "FIRE")
        lengths.add(len(game.actions))
        again = len(game.actions)
        environment.reset(seed=seed)
        assert len(game.actions) == again
    assert lengths == {1, 2, 3, 4, 5}


def test_a_game_that_ends_before_the_episode_begins_anew() -> None:
    game = Blinking(["NOOP", "UP"], ends_after=2)
    environment = RandomStart(game, 5, use_fire_reset=False)
    for seed in range(20):
        environment.reset(seed=seed)
        assert game.frame < 2


def test_frames_before_an_episode_do_not_count_against_its_limit() -> None:
    limited = as_on_gymnasium(SPEC.model_copy(update={"max_episode_steps": 40}))
    environments = PlainEnvironments(make_environments(limited, 1))
    for seed in range(3):
        environments.reset(seed)
        ends = [bool(environments.step(np.zeros(1, np.int64))[3][0]) for _ in range(10)]
        assert ends == [False] * 9 + [True]
    environments.close()


def test_a_policy_in_a_loop_of_the_caller_sees_pooled_frames(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = load_policy(save(tmp_path / "run", SPEC, 1))
    seen: list[np.ndarray] = []
    observe_one = policy._transforms.observe_one
    monkeypatch.setattr(
        policy._transforms,
        "observe_one",
        lambda observation, mask: seen.append(observation) or observe_one(observation, mask),
    )
    frames = [np.full((210, 160, 3), value, np.uint8) for value in (9, 1, 2, 5, 3, 8)]
    for frame in frames:
        policy.act(frame)
    policy.reset()
    policy.act(frames[1])
    assert [int(each.max()) for each in seen] == [9, 5, 1]
