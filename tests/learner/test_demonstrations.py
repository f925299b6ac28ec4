"""Minari datasets as demonstrations: every transition against the recorded episodes, and hostile datasets."""

import io
import json
import logging
import pickle
import shutil
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from mission_environment import MissionSpace
from PIL import Image

from daedalus.actor.checking.check_report import EnvironmentReport
from daedalus.actor.environments.minari_files import DatasetError, Episode, MinariReader, MinariWriter
from daedalus.actor.environments.transforms import Transforms
from daedalus.launch import dataset_import
from daedalus.launch.dataset_import import write_demonstrations
from daedalus.learner.run import demonstration_files
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.demonstrations import read_demonstrations
from daedalus.learner.training.learner import Learner
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

OBSERVATIONS = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTIONS = gymnasium.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32))


def spec_of(frames: int = 1, **training: Any) -> RunSpec:
    return RunSpec.model_validate(
        {
            "environment": {"id": "Arm-v0", "frame_stack": frames, "reward_scale": 0.5},
            "policy": {"hidden": (6,), "distribution": "squashed_gaussian", "state_dependent_std": True},
            "training": {"algorithm": "sac", "replay_begin": 8, "minibatch_rows": 10, **training},
        }
    )


def spaces_of(frames: int = 1) -> Spaces:
    return Spaces(
        observations={"observation": ArraySpace(shape=(2,), dtype="float32", frames=frames)},
        actions={"action": ContinuousSpace(low=(-2.0, 0.0), high=(2.0, 1.0))},
    )


def episode(number: int, steps: int, *, terminated: bool, truncated: bool = False) -> Episode:
    """Return an episode whose observations and rewards name their place."""
    random = np.random.default_rng(number)
    return Episode(
        observations=np.array([[number, step] for step in range(steps + 1)], np.float64),
        actions=random.uniform([-2.0, 0.0], [2.0, 1.0], (steps, 2)).astype(np.float32),
        rewards=10.0 * number + np.arange(steps),
        terminated=terminated,
        truncated=truncated,
    )


EPISODES = [
    episode(0, 5, terminated=True),
    episode(1, 1, terminated=False, truncated=True),
    episode(2, 9, terminated=False),  # the recording broke off
    episode(3, 4, terminated=True, truncated=True),
]


@pytest.fixture
def dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a dataset with Minari's own library, and return its folder."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    buffers = [
        EpisodeBuffer(
            observations=each.observations,  # pyright: ignore[reportArgumentType]
            actions=each.actions,  # pyright: ignore[reportArgumentType]
            rewards=[*each.rewards],
            terminations=[False] * (len(each.rewards) - 1) + [each.terminated],
            truncations=[False] * (len(each.rewards) - 1) + [each.truncated],
        )
        for each in EPISODES
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it asks for authors and links
        minari.create_dataset_from_buffers(
            "arm/shown-v0", buffers, observation_space=OBSERVATIONS, action_space=ACTIONS
        )
    return tmp_path / "minari/arm/shown-v0"


def expected(frames: int) -> list[tuple[list[float], list[float], list[float], float, float]]:
    """Return each transition of the episodes: observation, action from -1 to 1, next observation, reward, discount."""
    found = []
    for each in EPISODES:
        stacks = [
            np.stack([each.observations[max(step - back, 0)] for back in range(frames - 1, -1, -1)]).ravel().tolist()
            for step in range(len(each.observations))
        ]
        for step, reward in enumerate(each.rewards):
            ends = step == len(each.rewards) - 1 and each.terminated
            action = (each.actions[step] - [-2.0, 0.0]) / [4.0, 1.0] * 2.0 - 1.0
            values = np.round(action, 4).tolist()
            found.append((stacks[step], values, stacks[step + 1], 0.5 * reward, 0.0 if ends else 0.9))
    return sorted(found)


def test_terminations_at_a_time_limit_are_bootstrapped_as_those_of_actors(dataset: Path, tmp_path: Path) -> None:
    spec, changes = spec_of(), {"bootstrap_terminations": True, "no_reward_limit": 5}
    spec = spec.model_copy(update={"environment": spec.environment.model_copy(update=changes)})
    write_demonstrations(str(dataset), spec, spaces_of(), tmp_path)
    buffer = read_demonstrations(tmp_path, spec, spaces_of(), 0)
    assert buffer is not None
    assert buffer.transitions(buffer.learned_rows, 1, 0.9).discounts.tolist() == pytest.approx([0.9] * 19)


@pytest.mark.parametrize("part_bytes", [1, 300, 16 << 20])
@pytest.mark.parametrize("frames", [1, 3])
def test_transitions_are_those_of_the_recorded_episodes(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frames: int, part_bytes: int
) -> None:
    for module in (dataset_import, demonstration_files):
        monkeypatch.setattr(module, "PART_BYTES", part_bytes)  # also the length of rollouts
    monkeypatch.setattr(demonstration_files, "MOST_ROWS", 4)
    write_demonstrations("arm/shown-v0", spec_of(frames), spaces_of(frames), tmp_path)
    buffer = read_demonstrations(tmp_path, spec_of(frames), spaces_of(frames), 0)
    assert buffer is not None
    found = buffer.transitions(buffer.learned_rows, 1, 0.9)
    observations, following = (
        values["observation"].flatten(1).tolist() for values in (found.observations, found.next_observations)
    )
    actions = np.round(found.actions.double().numpy(), 4).tolist()
    rows = zip(observations, actions, following, found.rewards.tolist(), found.discounts.tolist(), strict=True)
    for (*exact, discount), (*oracle, wanted) in zip(sorted(rows), expected(frames), strict=True):
        assert exact == oracle
        assert discount == pytest.approx(wanted)


def test_minari_reads_what_is_recorded(tmp_path: Path) -> None:
    environment = gymnasium.make("Pendulum-v1")
    name = str(tmp_path / "pendulum/mine-v0")
    writer = MinariWriter(name, environment.observation_space, environment.action_space, environment.spec)
    first, _ = environment.reset(seed=1)
    following, reward, *_ = environment.step(np.array([1.5], np.float32))
    recorded = Episode(np.stack([first, following]), np.array([[1.5]], np.float32), np.array([reward]), False, True)
    writer.add(recorded, seed=1)
    theirs = minari.MinariDataset(Path(name) / "data")
    assert (theirs.total_episodes, theirs.total_steps) == (1, 1)
    assert theirs.recover_environment().spec == environment.spec
    with MinariReader(name) as ours:
        for found in (theirs[0], next(iter(ours))):
            np.testing.assert_array_equal(found.observations, recorded.observations)
            np.testing.assert_array_equal(found.actions, recorded.actions)
            np.testing.assert_array_equal(found.rewards, recorded.rewards)


def test_texts_and_keys_with_slashes_are_recorded(tmp_path: Path) -> None:
    arm = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    space = gymnasium.spaces.Dict({"arm/angle": arm, "mission": MissionSpace()})  # as dm_control's and MiniGrid's
    writer = MinariWriter(str(tmp_path / "shown"), space, gymnasium.spaces.Dict({"arm/turn": arm}))
    seen, done = np.array([[0.5], [0.75]], np.float32), {"arm/turn": np.array([[0.25]], np.float32)}
    writer.add(Episode({"arm/angle": seen, "mission": np.array(["go on", "on"])}, done, np.ones(1), True, False))
    with MinariReader(str(tmp_path / "shown"), ["mission"]) as dataset:
        (episode,) = dataset
        found, wanted = (
            Transforms(spec_of().environment, each, ACTIONS).spaces
            for each in (dataset.observation_space, gymnasium.spaces.Dict({"arm/angle": arm}))
        )
    assert found == wanted
    np.testing.assert_array_equal(episode.observations["arm_angle"], seen)
    np.testing.assert_array_equal(episode.actions["arm_turn"], done["arm/turn"])
    theirs = minari.MinariDataset(tmp_path / "shown/data")
    assert [*theirs[0].observations["mission"]] == ["go on", "on"]


@pytest.mark.parametrize("keys", [("arm/z", "arm_z"), ("arm/z", "arm:z")])
def test_keys_whose_components_would_change_places_are_not_recorded(tmp_path: Path, keys: tuple[str, str]) -> None:
    space = gymnasium.spaces.Dict(dict.fromkeys(keys, OBSERVATIONS))
    with pytest.raises(DatasetError, match="two keys differ only by a slash, or by"):
        MinariWriter(str(tmp_path / "shown"), space, ACTIONS)


@pytest.mark.parametrize(
    ("space", "observations", "reward", "reason"),
    [
        (OBSERVATIONS, np.zeros((2, 2)), np.nan, "a reward that is not finite"),
        (OBSERVATIONS, np.full((2, 2), np.nan), 0.0, "its observation has a value that is not finite"),
        (OBSERVATIONS, np.zeros((2, 2, 1)), 0.0, "its observation has the shape"),
        (gymnasium.spaces.Discrete(3), np.array([0.5, 1.0]), 0.0, "its observation has the value 0.5"),
        (gymnasium.spaces.Sequence(ACTIONS), None, 0.0, "No serialization method available"),
    ],
)
def test_what_nothing_could_learn_from_is_not_recorded(
    tmp_path: Path, space: gymnasium.Space, observations: Any, reward: float, reason: str
) -> None:
    def write() -> None:
        writer = MinariWriter(str(tmp_path / "shown"), space, ACTIONS)
        writer.add(Episode(observations, np.zeros((1, 2), np.float32), np.array([reward]), True, False))

    with pytest.raises(DatasetError, match=reason):
        write()
    assert not (tmp_path / "shown").exists()


def test_what_is_recorded_survives_a_kill_and_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    environment, name = gymnasium.make("Pendulum-v1"), str(tmp_path / "shown")
    writer = MinariWriter(name, environment.observation_space, environment.action_space)
    episode = Episode(np.zeros((2, 3), np.float32), np.zeros((1, 1), np.float32), np.zeros(1), True, False)
    writer.add(episode)
    metadata, data = tmp_path / "shown/data/metadata.json", tmp_path / "shown/data/main_data.hdf5"
    before = metadata.read_text()
    with metadata.open() as seen:
        writer.add(episode)
        assert seen.read() == before, "a reader, or whoever comes after a kill, finds the old metadata or the new ones"
    metadata.write_text(before)  # as if killed before the second episode was stated
    with MinariReader(name) as dataset:
        assert (dataset.episodes, len(list(dataset))) == (1, 1)
    writer.add(episode)
    size = data.stat().st_size
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1 << 20))
        with pytest.raises(DatasetError, match="less than 16 MiB left"):
            writer.add(episode)
    assert data.stat().st_size == size
    with monkeypatch.context() as patch:
        patch.setattr(h5py.File, "__exit__", failing)
        with pytest.raises(DatasetError, match="cannot be written: no space"):
            writer.add(episode)
    with pytest.raises(DatasetError, match="cannot be written: no space"):  # HDF5 may crash if it goes on
        writer.add(episode)


def failing(file: h5py.File, *_: object) -> None:
    file.close()
    raise RuntimeError("no\nspace")  # as h5py reports a full disk


def change(dataset: Path, kind: str) -> None:
    """Damage a dataset."""
    data, metadata = dataset / "data/main_data.hdf5", dataset / "data/metadata.json"
    content = json.loads(metadata.read_text())
    if kind == "truncated":
        data.write_bytes(data.read_bytes()[:-2000])
        return
    if kind == "pickled":
        data.write_bytes(pickle.dumps({"episodes": [1]}))
        return
    if kind == "pickled metadata":
        metadata.write_bytes(pickle.dumps(content))
        return
    if kind == "no spaces":  # Minari's reader would make this environment, and import its module
        del content["observation_space"]
        content["env_spec"] = json.dumps({"id": "x:Evil-v0", "entry_point": "antigravity:Evil"})
    if kind == "objects in a space":
        content["action_space"] = json.dumps(json.loads(content["action_space"]) | {"dtype": "O"})
    if kind == "episodes missing":
        content["total_episodes"] += 1
    metadata.write_text(json.dumps(content))
    with h5py.File(data, "a") as file:
        group: Any = file["episode_2"]
        if kind == "outside":
            group["actions"][3, 0] = 2.5
        if kind == "nan":
            group["observations"][1, 0] = np.nan
        if kind == "lengths":
            group["observations"].resize((7, 2))
        if kind == "ends early":
            group["terminations"][1] = True
        if kind in ("objects", "link", "virtual", "huge"):
            del group["rewards"]
        if kind == "objects":
            group.create_dataset("rewards", data=["a"] * 9, dtype=h5py.string_dtype())
        if kind == "link":
            group["rewards"] = h5py.ExternalLink("/etc/passwd", "/x")
        if kind == "virtual":
            layout = h5py.VirtualLayout((9,), "f8")
            layout[:] = h5py.VirtualSource("/etc/passwd", "x", (9,))
            group.create_virtual_dataset("rewards", layout)
        if kind == "huge":
            group.create_dataset("rewards", (1 << 40,), "f8", chunks=(1024,))


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("truncated", "damaged or no HDF5 file"),
        ("pickled", "damaged or no HDF5 file"),
        ("pickled metadata", "metadata cannot be read"),
        ("no spaces", "metadata have no observation_space"),
        ("objects in a space", "dtype O"),
        ("episodes missing", "state 5 episodes, and it has 4"),
        ("outside", "episode 2: the action 2.5 is outside its bounds -2 to 2"),
        ("nan", "episode 2: .* not finite"),
        ("lengths", r"has the shape \(7, 2\), not \(10, 2\)"),
        ("ends early", "episode 2 goes on after a step that ends it"),
        ("objects", "holds object, and only numbers are read"),
        ("link", "/episode_2 has no rewards of its own"),
        ("virtual", "in another file"),
        ("huge", "bytes: an episode may have"),
    ],
)
def test_a_hostile_dataset_is_refused_in_one_line_and_nothing_is_left(
    dataset: Path, tmp_path: Path, kind: str, reason: str
) -> None:
    change(dataset, kind)
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(SettingsError, match=reason) as refusal:
        write_demonstrations(str(dataset), spec_of(), spaces_of(), run)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 600
    assert not [*run.iterdir()]


def test_a_dataset_that_does_not_fit_the_run_or_the_memory_is_refused(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(SettingsError, match=r"float32 array of shape \(2,\) there, and .*3 stacked here"):
        write_demonstrations("arm/shown-v0", spec_of(), spaces_of(3), tmp_path)
    with pytest.raises(SettingsError, match="impala does not learn from demonstrations"):
        write_demonstrations("arm/shown-v0", RunSpec.model_validate({"environment": {"id": "A-v0"}}), None, tmp_path)
    of_sac: dict[str, Any] = {"demonstration_share": 0.04}  # of 10 rows, none
    for unlearned in (of_sac, {"algorithm": "appo", "cloning_updates": 0, "cloning_weight": 0.0}):
        with pytest.raises(SettingsError, match="leave --demonstrations out"):
            write_demonstrations("arm/shown-v0", spec_of(**unlearned), None, tmp_path)
    with pytest.raises(SettingsError, match="nowhere is no Minari dataset"):
        write_demonstrations("nowhere", spec_of(), None, tmp_path)
    with caplog.at_level(logging.WARNING):
        write_demonstrations("arm/shown-v0", spec_of(), None, tmp_path)
    others = spaces_of().model_copy(update={"actions": {"action": ContinuousSpace(low=(-1.0, 0.0), high=(1.0, 1.0))}})
    with pytest.raises(SettingsError, match=r"\(low -2 0, .*\) there, and .*\(low -1 0, .*\) here"):
        read_demonstrations(tmp_path, spec_of(), others, 0)
    monkeypatch.setattr(demonstration_files, "available_memory", lambda: 3200)
    with pytest.raises(SettingsError, match=r"19 steps take .* MiB .*: \d+ steps fit"):
        read_demonstrations(tmp_path, spec_of(), spaces_of(), 0)
    shutil.rmtree(tmp_path / "demonstrations/00000000")
    with pytest.raises(Exception, match="a part is missing"):
        read_demonstrations(tmp_path, spec_of(), spaces_of(), 0)


NESTED = gymnasium.spaces.Dict(
    {
        "arm": gymnasium.spaces.Box(-1.0, np.inf, (2, 1), np.float32),
        "grip": gymnasium.spaces.Discrete(3, start=5),
        "rest": gymnasium.spaces.Tuple([gymnasium.spaces.MultiBinary(2), gymnasium.spaces.MultiDiscrete([2, 300])]),
    }
)
TABLE = {"action_table": [[-1.0, 0.2], [1.0, 0.3]], "action_table_columns": [2, 0]}
STEERED = gymnasium.spaces.Box(np.array([0.0, -3.0, -1.0]), np.array([1.0, 5.0, 1.0]), dtype=np.float64)


@pytest.mark.parametrize(
    ("space", "settings", "outside"),
    [
        (NESTED, {}, {"arm": np.zeros((2, 1)), "grip": 4, "rest": (np.zeros(2), np.zeros(2))}),
        (STEERED, TABLE, np.array([0.2, 0.0, 1.0])),  # no row of the table
        (STEERED, TABLE, np.array([0.2, 5.1, -1.0])),
    ],
)
def test_recorded_actions_are_what_the_policy_would_have_chosen(
    space: gymnasium.Space, settings: dict[str, Any], outside: Any
) -> None:
    environment = EnvironmentSpec.model_validate({"id": "Any-v0", **settings})
    transforms = Transforms(environment, OBSERVATIONS, space)
    random = np.random.default_rng(3)
    chosen: dict[str, np.ndarray] = {}
    for name, component in transforms.spaces.actions.items():
        if isinstance(component, DiscreteSpace):
            chosen[name] = random.integers(0, component.counts, (20, component.size)).astype(component.dtype)
        else:
            chosen[name] = random.uniform(-1.0, 1.0, (20, component.size)).astype(np.float32)
    found = transforms.policy_actions(transforms.env_actions(chosen))
    assert found.keys() == chosen.keys()
    for name, values in chosen.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_allclose(found[name], values, atol=1e-6)
    with pytest.raises(ValueError, match="action"):
        transforms.policy_action(outside)


def seen(folder: Path, images: np.ndarray) -> Path:
    """Write a dataset of one episode as Minari does by default, with images as JPEG."""
    space = gymnasium.spaces.Dict(
        {"camera": gymnasium.spaces.Box(0, 255, images.shape[1:], np.uint8), "arm": OBSERVATIONS}
    )
    steps = len(images) - 1
    folder.mkdir()
    storage = MinariStorage.new(folder / "data", space, gymnasium.spaces.Discrete(2))
    episode = EpisodeBuffer(
        observations={"camera": images, "arm": np.zeros((steps + 1, 2))},  # pyright: ignore[reportArgumentType]
        actions=[0] * steps,
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
    )
    storage.update_episodes([episode])
    storage.update_metadata({"dataset_id": "seen-v0", "minari_version": minari.__version__})
    return folder


@pytest.mark.parametrize(("shape", "plain"), [((32, 40, 3), False), ((32, 40, 3), True), ((33, 32), False)])
def test_images_as_jpeg_are_those_that_minari_reads(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, shape: tuple[int, ...], plain: bool
) -> None:
    random = np.random.default_rng(1)
    images = random.integers(0, 255, (4, *shape)).astype(np.uint8)
    if plain:
        images[:] = images[:, :1, :1]  # files of one length
    folder = seen(tmp_path / "seen", images)
    theirs = minari.MinariDataset(folder / "data")[0].observations["camera"]
    with MinariReader(str(folder)) as dataset:
        (episode,) = dataset
    np.testing.assert_array_equal(episode.observations["camera"], theirs)
    spec = RunSpec.model_validate({"environment": {"id": "A-v0"}, "training": {"algorithm": "appo"}})
    with caplog.at_level(logging.WARNING):
        write_demonstrations(str(folder), spec, None, tmp_path)
    assert "images as JPEG, which are not quite those" in caplog.text


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda image: image[:200], "[Tt]runcated"),
        (lambda image: jpeg((64, 40)), "it is RGB 64 x 40, not of shape"),
        (lambda image: jpeg((40, 32), "L"), "it is L 40 x 32, not of shape"),
        (lambda image: jpeg((40, 32), form="png"), "cannot identify"),
    ],
)
def test_a_hostile_image_is_refused(tmp_path: Path, change: Any, reason: str) -> None:
    images = np.random.default_rng(1).integers(0, 255, (4, 32, 40, 3)).astype(np.uint8)
    folder = seen(tmp_path / "seen", images)
    with h5py.File(folder / "data/main_data.hdf5", "a") as file:
        group: Any = file["episode_0/observations"]
        group["camera"][2] = np.frombuffer(change(group["camera"][2].tobytes()), np.uint8)
    with (
        MinariReader(str(folder)) as dataset,
        pytest.raises(DatasetError, match=f"image 2 .* cannot be read: .*{reason}"),
    ):
        list(dataset)


def test_a_dataset_without_the_arguments_of_the_environment_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made_from = EnvSpec("Arm-v0", "arm:Arm", kwargs={"speed": 2, "sparse": False})
    MinariWriter(str(tmp_path / "shown"), OBSERVATIONS, ACTIONS, made_from).add(EPISODES[0])
    for number, changed in enumerate(
        ({"kwargs": {"speed": 2.0}}, {"kwargs": {"speed": 2}, "training_kwargs": {"sparse": True, "size": [1, 2]}})
    ):
        environment = {"id": "arm:Arm-v0", **changed}
        directory = tmp_path / str(number)
        directory.mkdir()
        write_demonstrations(
            str(tmp_path / "shown"),
            spec_of().model_copy(update={"environment": EnvironmentSpec.model_validate(environment)}),
            None,
            directory,
        )
    (warning,) = [text for text in caplog.messages if "was recorded" in text]
    assert "recorded without the arguments sparse=True, size=[1, 2], which the environment of the run has" in warning


def jpeg(size: tuple[int, int], mode: str = "RGB", form: str = "jpeg") -> bytes:
    Image.new(mode, size).save(data := io.BytesIO(), form)
    return data.getvalue()


def report_of(spaces: Spaces, action_space: gymnasium.Space, spec: RunSpec) -> EnvironmentReport:
    """Return what the check of an environment finds."""
    first = Transforms(spec.environment, OBSERVATIONS, action_space).first_choices
    return EnvironmentReport(spaces=spaces, first_choices=first)


@pytest.mark.parametrize(
    ("there", "here", "reason"),
    [
        (gymnasium.spaces.Discrete(3), gymnasium.spaces.Discrete(3, start=5), "begin with 0 there, and with 5 here"),
        (gymnasium.spaces.Discrete(3, start=-1), gymnasium.spaces.Discrete(3), "begin with -1 there, and with 0 here"),
        (
            gymnasium.spaces.MultiDiscrete([3, 2], start=[1, 7]),
            gymnasium.spaces.MultiDiscrete([3, 2], start=[1, 2]),
            "begin with 1, 7 there, and with 1, 2 here",
        ),
        (gymnasium.spaces.Discrete(3), gymnasium.spaces.MultiDiscrete([3]), ""),  # with the same values
    ],
)
def test_choices_that_begin_otherwise_than_those_of_the_environment_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: Any, here: gymnasium.Space, reason: str
) -> None:
    actions = np.zeros((5, *there.shape), np.int64) + there.start
    MinariWriter(str(tmp_path / "shown"), OBSERVATIONS, there).add(
        episode(0, 5, terminated=True)._replace(actions=actions)
    )
    spec = RunSpec.model_validate({"environment": {"id": "Arm-v0"}, "training": {"algorithm": "appo"}})
    spaces = Transforms(spec.environment, OBSERVATIONS, here).spaces
    monkeypatch.setattr(dataset_import, "quick_check", lambda *_, play: report_of(spaces, here, spec))
    if reason:
        with pytest.raises(SettingsError, match=f"has other spaces than the run .*: the choices of action .* {reason}"):
            write_demonstrations(str(tmp_path / "shown"), spec, spaces, tmp_path)
    else:
        write_demonstrations(str(tmp_path / "shown"), spec, spaces, tmp_path)


def test_choices_with_masks_are_learned_from_without_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dataset has no masks of the environment's info: what was played was legal."""
    space = gymnasium.spaces.Discrete(3)
    writer = MinariWriter(str(tmp_path / "shown"), OBSERVATIONS, space)
    writer.add(episode(0, 5, terminated=True)._replace(actions=np.array([0, 2, 1, 1, 0])))
    masked = Spaces(observations=spaces_of().observations, actions={"action": DiscreteSpace(counts=(3,), masked=True)})
    spec = RunSpec.model_validate({"environment": {"id": "Arm-v0"}, "training": {"algorithm": "appo"}})
    monkeypatch.setattr(dataset_import, "quick_check", lambda *_, play: report_of(masked, space, spec))
    write_demonstrations(str(tmp_path / "shown"), spec, masked, tmp_path)
    buffer = read_demonstrations(tmp_path, spec, masked, 0)
    assert buffer is not None
    learner = Learner(spec.training.model_copy(update={"cloning_updates": 2}), spec.policy, masked)
    learner.learn_from(buffer)
    assert "too few steps to hold any out" in learner.clone()


@pytest.mark.parametrize("algorithm", ["sac", "appo"])
def test_steps_with_one_action_are_a_row_of_a_run_that_repeats_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, algorithm: str
) -> None:
    held = episode(0, 7, terminated=True)
    held = held._replace(actions=np.repeat(held.actions[:3], 3, axis=0)[:7])
    spec = spec_of(algorithm=algorithm)
    spec = spec.model_copy(update={"environment": spec.environment.model_copy(update={"action_repeat": 3})})

    def imported(name: str, *episodes: Episode) -> list[list[float]]:
        writer = MinariWriter(str(tmp_path / name), OBSERVATIONS, ACTIONS)
        for each in episodes:
            writer.add(each)
        write_demonstrations(str(tmp_path / name), spec, spaces_of(), tmp_path / f"run-{name}")
        buffer = read_demonstrations(tmp_path / f"run-{name}", spec, spaces_of(), 0)
        assert buffer is not None
        found = buffer.transitions(buffer.learned_rows, 1, 0.9)
        seen = (values["observation"][:, 1].tolist() for values in (found.observations, found.next_observations))
        return [*seen, found.rewards.tolist(), found.discounts.tolist()]

    rows = imported("held", held)
    assert rows == [[0.0, 3.0, 6.0], [3.0, 6.0, 7.0], [1.5, 6.0, 3.0], [pytest.approx(0.9), pytest.approx(0.9), 0.0]]
    assert "differ" not in caplog.text
    if algorithm == "sac":
        with pytest.raises(SettingsError, match=r"episode 1: the run repeats each action 3 times .* and 1 times the"):
            imported("moved", held, episode(0, 4, terminated=True))
    else:
        assert imported("moved", held, episode(0, 4, terminated=True))[0] == [0.0, 3.0, 6.0, 0.0, 3.0]
        assert "in 1 of 5 rows of dataset" in caplog.text
