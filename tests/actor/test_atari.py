"""Games of ALE: its own backend, and the same games on gymnasium."""

import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from plain import PlainEnvironments, choices
from saved_runs import save

from daedalus.actor.checking.play import check_environment
from daedalus.actor.environments.atari import PooledFrames, RandomStart
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.dataset_recorder import PolicyPlayer, recorded_environment
from daedalus.actor.evaluation.episodes import RunningEpisodes
from daedalus.actor.evaluation.export_check import play_exported
from daedalus.actor.evaluation.exported_policy import ExportOptions
from daedalus.actor.evaluation.loaded_policy import exported_bytes, load_policy
from daedalus.policy.acting.noise import neutral_noise
from daedalus.policy.user_modules import NO_MODULES
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


@pytest.mark.parametrize(
    ("fields", "warns"),
    [({"action_repeat": 4}, True), ({"action_repeat": 4, "kwargs": {"frameskip": 1}}, False)],
)
def test_actions_that_run_and_game_both_repeat_are_a_warning(fields: dict[str, Any], warns: bool) -> None:
    spec = EnvironmentSpec(id="ALE/Pong-v5", **fields)
    warnings = check_environment(spec, NO_MODULES, seconds=0.0, env_steps=0).warnings
    assert ["shows it for 4 frames each time itself" in each for each in warnings] == [True] * warns


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


def test_recorded_and_exported_policies_see_what_evaluations_show(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = SPEC.model_copy(update={"resize": (20, 20)})
    policy = load_policy(save(tmp_path / "run", small, 1, policy={"encoder": "mlp"}))
    seen = list[np.ndarray]()
    observe = RunningEpisodes.observe

    def observe_noted(self: RunningEpisodes, observed: Any) -> None:
        seen.append(observed.frames["observation"][0].copy())
        observe(self, observed)

    monkeypatch.setattr(RunningEpisodes, "observe", observe_noted)
    steps, frames = 8, 8 * small.action_repeat
    environments = make_environments(as_on_gymnasium(small), 1, one_episode=True)
    episode = RunningEpisodes(environments.spaces, policy._runtime, 1)
    observed = environments.reset(3)
    for _ in range(steps):
        episode.observe(observed)
        observed = environments.step(episode.act(neutral_noise(policy._runtime.noise_size, 1)).actions)[0]
    environments.close()
    shown, seen[:] = list(seen), []
    play_exported(policy, exported_bytes(policy, ExportOptions()), sampled=False, seed=3, steps=frames)
    np.testing.assert_array_equal(seen, shown)
    seen.clear()
    player, environment = PolicyPlayer(policy, sampled=False), recorded_environment(small, NO_MODULES, for_person=False)
    player.reset(3)
    observation, _ = environment.reset(seed=3)
    for _ in range(frames):
        observation, *_ = environment.step(player.act(observation, None))
    environment.close()
    np.testing.assert_array_equal(seen, shown)


pytest.importorskip("ale_py.vector_env")


def _spec(name: str, **fields) -> EnvironmentSpec:
    return EnvironmentSpec(id=name, backend="ale", **fields)


@pytest.mark.parametrize("name", ["Pong", "Pong-v5", "ALE/Pong-v5", "pong"])
def test_game_is_found_by_its_usual_names(name: str) -> None:
    environments = make_environments(_spec(name, grey=True, resize=(84, 84), frame_stack=4), 2)
    assert environments.spaces.observations["observation"].stacked_shape == (4, 84, 84)
    assert choices(environments.spaces) == 6
    environments.close()


def test_game_with_a_name_of_several_words_is_found() -> None:
    environments = make_environments(_spec("ALE/MsPacman-v5"), 1)
    assert choices(environments.spaces) == 9  # eight directions and no move; Pong has 6
    environments.close()


@pytest.mark.parametrize(
    ("fields", "shape"),
    [({}, (210, 160, 3)), ({"grey": True}, (210, 160)), ({"resize": (50, 40)}, (50, 40, 3))],
)
def test_frames_are_single_and_have_the_specified_shape(fields: dict, shape: tuple[int, ...]) -> None:
    environments = PlainEnvironments(make_environments(_spec("Pong", action_repeat=4, **fields), 2))
    first = environments.reset(2**32 - 1)
    before = first.copy()
    frames = environments.step(np.zeros(2, np.int64))[0]
    assert environments.spaces.observations["observation"].shape == shape
    assert (first.shape, frames.shape, frames.dtype) == ((2, *shape), (2, *shape), np.uint8)
    for _ in range(30):
        environments.step(np.full(2, 2))
    np.testing.assert_array_equal(first, before)
    environments.close()


def test_episode_limit_counts_frames_and_the_next_step_resets() -> None:
    environments = PlainEnvironments(
        make_environments(_spec("Pong", action_repeat=4, max_episode_steps=10, grey=True), 2)
    )
    environments.reset(1)
    rows = [environments.step(np.full(2, row % 6)) for row in range(8)]
    assert [truncated.tolist() for _, _, _, truncated in rows] == [[row % 4 == 2] * 2 for row in range(8)]
    assert not any(terminated.any() for _, _, terminated, _ in rows)
    environments.close()


def test_rewards_are_not_clipped() -> None:
    """A target of Space Invaders is worth 5 points or more."""
    environments = PlainEnvironments(
        make_environments(_spec("SpaceInvaders", action_repeat=4, grey=True, resize=(84, 84)), 2)
    )
    environments.reset(1)
    best = max(float(environments.step(np.ones(2, np.int64))[1].max()) for _ in range(300))
    environments.close()
    assert best >= 5.0


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        (_spec("Ponk"), "unknown environment 'Ponk': did you mean Pong"),
        (_spec("Pong", kwargs={"no_such_option": 1}), "cannot be created.*no_such_option"),
        (_spec("Pong", kwargs={"stack_num": 4}), "cannot be created.*stack_num"),
        (
            _spec("Pong", no_reward_limit=3),
            "does not support environment.no_reward_limit: .*--set environment.backend=gymnasium",
        ),
        (_spec("Pong", crop=(1, 1, 1, 1)), "does not support environment.crop"),
        (_spec("Pong", action_table=((1.0,), (2.0,))), "does not support environment.action_table"),
    ],
)
def test_setup_error_is_one_line(spec: EnvironmentSpec, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=reason) as caught:
        make_environments(spec, 2)
    assert "\n" not in str(caught.value)


def test_missing_ale_is_reported_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ale_py.roms", None)
    with pytest.raises(EnvironmentSetupError, match=r'"daedalus-rl\[atari\]".*--set environment.backend=gymnasium'):
        make_environments(_spec("Pong"), 1)
