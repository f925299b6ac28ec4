"""The learner with a replay buffer: how many updates, resume, and the buffer on the disk."""

import errno
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from building import identity, make_rollout

from daedalus.algorithms.replay_buffer import ReplayBuffer, Transitions
from daedalus.algorithms.sac import Sac
from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training import replay_files
from daedalus.learner.training.replay_files import FOLDER, ReplayFiles
from daedalus.learner.training.replay_learner import ReplayLearner, build_replay_buffer
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout

SPACES = Spaces(
    observations={"observation": ArraySpace(shape=(3,), dtype="float32")},
    actions={"action": ContinuousSpace(low=(-1.0,), high=(1.0,))},
)
POLICY = {"hidden": (6,), "distribution": "squashed_gaussian", "state_dependent_std": True}
ROWS, ENVIRONMENTS = 4, 2


def spec_of(sections: dict[str, Any] | None = None, **training: Any) -> RunSpec:
    content: dict[str, Any] = {
        "environment": {"id": "Any-v0"},
        "policy": POLICY,
        "collection": {"rollout_length": ROWS, "actors": 1, "envs_per_actor": ENVIRONMENTS},
        "training": {"algorithm": "sac", "replay_begin": 16, "minibatch_rows": 8, **training},
    }
    for section, values in (sections or {}).items():
        content[section] = content[section] | values
    return RunSpec.model_validate(content)


def rollout(seed: int, rows: int = ROWS) -> Rollout:
    """Return a rollout in which all rows are learned from."""
    random, cells = np.random.default_rng(seed), (rows, ENVIRONMENTS)
    none = np.zeros(cells, np.bool_)
    actions = {"action": random.uniform(-1.0, 1.0, (*cells, 1)).astype(np.float32)}
    flags: dict[str, Any] = {"terminated": none, "truncated": none.copy(), "valid": ~none, "actions": actions}
    empty = {"episode_returns": np.zeros(0, np.float32), "episode_lengths": np.zeros(0, np.int32)}
    return make_rollout(identity(sequence=seed), rows=rows, environments=ENVIRONMENTS, seed=seed, **flags, **empty)


def trained(learner: ReplayLearner, *seeds: int) -> ReplayLearner:
    for seed in seeds:
        learner.step([rollout(seed)], 0.0)
        while learner.updates_due:
            learner.step([], 0.0)
    return learner


def test_too_little_memory_is_reported_with_the_number_of_rows_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    compute = Sac.gradients

    def limited(self: Sac, transitions: Transitions, **options: bool) -> Any:
        if len(transitions.rewards) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return compute(self, transitions, **options)

    monkeypatch.setattr(Sac, "gradients", limited)
    with pytest.raises(SettingsError, match=r"batch of 8 rows do not fit .*; 2 rows fit: set training.minibatch_rows"):
        trained(ReplayLearner(spec_of(), SPACES), 0, 1)


def test_each_row_earns_its_updates_after_the_beginning() -> None:
    learner = ReplayLearner(spec_of(updates_per_env_step=0.3125), SPACES)
    versions, planned = [], []
    for seed in range(6):
        planned.append(learner.updates_of([rollout(seed)]))
        versions.append(trained(learner, seed).policy_version)
    # 8 rows a rollout: none for the first 8; then 2.5 for each rollout, of which whole ones are made.
    assert versions == [0, 2, 5, 7, 10, 12]
    assert planned == np.diff([0, *versions]).tolist()


def test_buffer_has_room_for_all_env_steps_of_a_run_beside_its_reset_rows_or_as_many_of_people() -> None:
    learners = [ReplayLearner(spec_of(env_steps=32, replay_begin=32), SPACES) for _ in range(2)]
    for seed in range(8):
        ends = np.tile([[True], [False]] * (ROWS // 2), ENVIRONMENTS)  # episodes of one step
        learners[0].replay.add(replace(rollout(seed), terminated=ends, valid=ends))
        by_people = rollout(seed).valid if seed < 4 else None
        learners[1].replay.add(replace(rollout(seed), overridden=by_people, taught=by_people))
    assert [(len(each.replay), each.replay.taught) for each in learners] == [(32, 0), (32, 32)]
    assert [each.updates_of([rollout(9)]) for each in learners] == [8, 8]  # half of the budget is enough to begin


def test_a_rollout_that_is_left_out_earns_no_updates() -> None:
    ours, theirs = (ReplayLearner(spec_of(updates_per_env_step=0.125), SPACES) for _ in range(2))

    def learn(learner: ReplayLearner, rollouts: list[Rollout]) -> int:
        learner.step(rollouts, 0.0)
        while learner.updates_due:
            learner.step([], 0.0)
        return learner.policy_version

    def of_actors(batch: int) -> list[Rollout]:
        return [replace(rollout(batch), identity=identity(name, batch)) for name in "abz"]

    for batch in range(3):
        assert learn(ours, of_actors(batch)) == learn(theirs, of_actors(batch))
    first, second, third = of_actors(3)
    bad = replace(third, rewards=np.full_like(third.rewards, 1e9))
    assert learn(ours, [first, second, bad]) == learn(theirs, [first, second])
    assert len(ours.replay) == len(theirs.replay)


def test_updates_change_policy_critics_and_temperature() -> None:
    learner = trained(ReplayLearner(spec_of(), SPACES), 0)
    before = {name: values.copy() for name, values in learner.weights().items()}
    state = {name: values.clone() for name, values in learner.state().items()}
    trained(learner, 1, 2)
    assert learner.policy_version == 16
    assert any((learner.weights()[name] != values).any() for name, values in before.items())
    for name in ("critics", "moments", "log_temperature"):
        assert (learner.state()[f"algorithm/{name}"] != state[f"algorithm/{name}"]).any(), name
    assert learner.entropy_bonus(0.0) != 1.0
    assert learner.metrics.take_means()["gradient_norm"] > 0.0


def test_policy_is_updated_with_each_third_update_of_the_critics_also_after_a_resume() -> None:
    learner = trained(ReplayLearner(spec_of(updates_per_env_step=0.125), SPACES), 0)
    changed = []
    for seed in range(1, 10):
        before = {name: values.copy() for name, values in learner.weights().items()}
        trained(learner, seed)
        changed.append(any((learner.weights()[name] != values).any() for name, values in before.items()))
        other = ReplayLearner(spec_of(updates_per_env_step=0.125), SPACES)
        state = {name: values.clone() for name, values in learner.state().items()}
        other.restore(learner.policy_version, learner.weights(), state)
        other.replay = learner.replay
        learner = other
    assert changed == [True, False, False] * 3


def sampled_rewards(monkeypatch: pytest.MonkeyPatch) -> list[torch.Tensor]:
    """Return the rewards of each minibatch, as they come."""
    sampled: list[torch.Tensor] = []
    gradients = Sac.gradients

    def observed(self: Sac, transitions: Transitions, **options: bool) -> Any:
        sampled.append(transitions.rewards)
        return gradients(self, transitions, **options)

    monkeypatch.setattr(Sac, "gradients", observed)
    return sampled


def test_half_of_each_minibatch_is_demonstrations(monkeypatch: pytest.MonkeyPatch) -> None:
    sampled = sampled_rewards(monkeypatch)
    learner = ReplayLearner(spec_of(), SPACES)
    learner.demonstrations = ReplayBuffer(SPACES, 2 * ROWS, 32)  # whose rollouts may have another length
    shown = rollout(1, 2 * ROWS)
    shown.rewards[:] = 77.0
    learner.demonstrations.add(shown)
    trained(learner, 2, 3, 4)
    assert len(sampled) == 16
    assert all(len(rewards) == 8 and (rewards == 77.0).sum() == 4 for rewards in sampled)


def test_a_choice_is_learned_from_rollouts_people_and_demonstrations() -> None:
    """The policy has played 0, people 1, and demonstrations show 2, which earns most. A resumed run knows it, too."""
    spaces = SPACES.model_copy(update={"actions": {"action": DiscreteSpace(counts=(3,))}})
    spec = spec_of(discount_factor=0.0, learning_rate=0.02, max_gradient_norm=100.0)

    def playing(action: int, seed: int) -> Rollout:
        played = np.full((ROWS, ENVIRONMENTS, 1), action, np.uint8)
        return replace(rollout(seed), actions={"action": played}, rewards=played[..., 0].astype(np.float32))

    learner = ReplayLearner(spec, spaces)
    shown = ReplayBuffer(spaces, ROWS, 32)
    for seed in range(4):
        shown.add(playing(2, seed))
    learner.learn_from(shown)
    for seed in range(12):
        by_people = playing(1, 100 + seed)
        for each in (replace(by_people, overridden=by_people.valid, taught=by_people.valid), playing(0, 200 + seed)):
            learner.step([each], 0.0)
            while learner.updates_due:
                learner.step([], 0.0)
    other = ReplayLearner(spec, spaces)
    other.restore(learner.policy_version, learner.weights(), {k: v.clone() for k, v in learner.state().items()})
    network = ActorCritic(spec.policy, spaces, training=spec.training)
    network.load_state_dict({name: torch.from_numpy(values) for name, values in other.weights().items()})
    logits, _ = network.step({"observation": torch.randn(20, 3)}, torch.zeros(20, 0))
    assert (logits[:, 0] < logits[:, 1]).all()
    assert (logits[:, 1] < logits[:, 2]).all()
    assert other.entropy_bonus(0.0) == learner.entropy_bonus(0.0) != 1.0


def test_people_teach_also_in_rollouts_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    sampled = sampled_rewards(monkeypatch)
    learner = trained(ReplayLearner(spec_of(), SPACES), 1)
    own = rollout(2)
    own.rewards[:] = 77.0
    learner.step([replace(own, overridden=own.valid, taught=own.valid)], 0.0)
    assert (learner.updates_due, learner.replay.taught) == (0, 8)  # a person's rows earn no updates
    trained(learner, 3, 4)
    assert len(sampled) == 16
    assert all((rewards == 77.0).sum() == 4 for rewards in sampled)
    assert all(np.isfinite(values).all() for values in learner.weights().values())


def test_a_rollout_that_is_not_finite_for_the_critics_is_survived() -> None:
    learner = trained(ReplayLearner(spec_of(max_gradient_norm=0.5), SPACES), 0, 1)
    wild = rollout(2)
    wild.rewards[:] = 1e9  # the largest that the judge lets through
    learner.step([wild], 0.0)
    trained(learner, 3, 4, 5)
    assert all(np.isfinite(values).all() for values in learner.weights().values())
    assert all(torch.isfinite(values.float()).all() for values in learner.state().values())


def saved(learner: ReplayLearner, directory: Path, files: ReplayFiles | None = None) -> ReplayFiles:
    files = files or ReplayFiles(directory, learner)
    files.begin()()
    return files


def resumed(learner: ReplayLearner, directory: Path, spec: RunSpec) -> tuple[ReplayLearner, ReplayFiles]:
    other = ReplayLearner(spec, SPACES)
    other.restore(learner.policy_version, learner.weights(), {k: v.clone() for k, v in learner.state().items()})
    files = ReplayFiles(directory, other)
    files.load()
    return other, files


def contents(learner: ReplayLearner) -> list[list[float]]:
    found = learner.replay.transitions(learner.replay.learned_rows, 1, 0.9)
    return [each.tolist() for each in (found.rewards, found.actions, found.next_observations["observation"])]


def test_resumed_learner_continues_exactly(tmp_path: Path) -> None:
    spec = spec_of(replay_transitions=40)
    learner = trained(ReplayLearner(spec, SPACES), *range(3))
    files = saved(learner, tmp_path)
    trained(learner, *range(3, 8))  # the buffer has dropped the first ones
    saved(learner, tmp_path, files)
    other, _ = resumed(learner, tmp_path, spec)
    assert contents(other) == contents(learner)
    torch.manual_seed(9)
    trained(learner, 20, 21)
    torch.manual_seed(9)
    trained(other, 20, 21)
    assert other.policy_version == learner.policy_version
    # The columns have other places in the memory of the buffer, but the same order.
    for name, values in learner.weights().items():
        np.testing.assert_array_equal(other.weights()[name], values)


def test_a_run_of_an_earlier_version_whose_critics_are_others_is_refused() -> None:
    learner = trained(ReplayLearner(spec_of(), SPACES), 0, 1)
    state = learner.state()
    ReplayLearner(spec_of(), SPACES).restore(7, learner.weights(), state)
    state["algorithm/critics"] = state["algorithm/critics"][:-1]
    with pytest.raises(CheckpointMismatchError, match="critics of the run are those of an earlier version"):
        ReplayLearner(spec_of(), SPACES).restore(7, learner.weights(), state)


def test_saved_parts_are_no_more_than_the_buffer_and_one(tmp_path: Path) -> None:
    spec = spec_of(replay_transitions=40)  # 10 columns, of which a rollout adds 2
    learner = ReplayLearner(spec, SPACES)
    files = ReplayFiles(tmp_path, learner)
    for seed in range(20):
        learner.step([rollout(seed)], 0.0)
        saved(learner, tmp_path, files)
    names = sorted(path.name for path in (tmp_path / FOLDER).iterdir())
    assert names[0].startswith("000000000030-")
    assert len(names) == 5
    other, files = resumed(learner, tmp_path, spec)
    assert contents(other) == contents(learner)
    other.step([rollout(30)], 0.0)
    saved(other, tmp_path, files)  # goes on after the newest
    assert max(path.name for path in (tmp_path / FOLDER).iterdir()) == "000000000040-000000000042"


def test_a_save_that_begins_while_another_writes_doubles_nothing(tmp_path: Path) -> None:
    learner = trained(ReplayLearner(spec_of(), SPACES), 0)
    files = ReplayFiles(tmp_path, learner)
    first = files.begin()
    second = files.begin()
    trained(learner, 1)
    third = files.begin()
    for write in (first, second, third):
        write()
    other, _ = resumed(learner, tmp_path, spec_of())
    assert contents(other) == contents(learner)


def test_a_failed_save_is_made_up_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = trained(ReplayLearner(spec_of(), SPACES), 0)
    files = ReplayFiles(tmp_path, learner)
    first = files.begin()
    trained(learner, 1)
    second = files.begin()
    with monkeypatch.context() as failing:
        failing.setattr(replay_files, "write_sealed", full)
        for write in (first, second):
            with pytest.raises(OSError, match=r"space|not saved"):
                write()
    files.begin()()
    other, _ = resumed(learner, tmp_path, spec_of())
    assert contents(other) == contents(learner)


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_rare_rewards_are_stored_as_they_came() -> None:
    learner = ReplayLearner(spec_of(), SPACES)
    for seed in range(40):
        one = rollout(seed)
        one.rewards[:] = 0.0
        one.rewards[1, 0] = 100.0 if seed % 20 == 0 else 0.0
        learner.step([one], 0.0)
    stored = learner.replay.transitions(learner.replay.learned_rows, 1, 0.9).rewards
    assert sorted(stored.tolist())[-3:] == [0.0, 100.0, 100.0]


def test_critics_read_codes_as_the_policy_does() -> None:
    spaces = SPACES.model_copy(update={"observations": {"map": ArraySpace(shape=(5, 5, 2), dtype="uint8")}})
    spec = spec_of({"policy": {"codes": {"map": (3, 4)}}, "collection": {"rollout_length": 16}})
    one = replace(rollout(0, rows=16), frames={"map": np.ones((17, ENVIRONMENTS, 5, 5, 2), np.uint8)})
    learner = ReplayLearner(spec, spaces)
    learner.step([one], 0.0)
    assert learner.policy_version > 0


def test_a_damaged_part_is_left_out_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    spec = spec_of()
    learner = trained(ReplayLearner(spec, SPACES), 0)
    files = saved(learner, tmp_path)
    trained(learner, 1)
    saved(learner, tmp_path, files)
    first, _ = sorted((tmp_path / FOLDER).iterdir())
    data = bytearray((first / "columns.safetensors").read_bytes())
    data[-1] ^= 1
    (first / "columns.safetensors").write_bytes(data)
    other, _ = resumed(learner, tmp_path, spec)
    assert len(other.replay) == 8
    assert "a part of the replay buffer is left out" in caplog.text


def test_the_buffer_of_another_run_or_of_other_rollouts_is_refused(tmp_path: Path) -> None:
    spec = spec_of()
    learner, other = (trained(ReplayLearner(spec, SPACES), 0) for _ in range(2))
    saved(other, tmp_path)
    with pytest.raises(CheckpointMismatchError, match=r"of another run: remove the folder .*replay"):
        resumed(learner, tmp_path, spec)
    shutil.rmtree(tmp_path / FOLDER)
    saved(learner, tmp_path)
    longer = spec_of({"collection": {"rollout_length": 8}})
    with pytest.raises(CheckpointMismatchError, match=r"restore collection\.rollout_length=4,"):
        resumed(learner, tmp_path, longer)


def test_a_buffer_that_does_not_fit_is_refused_with_what_would() -> None:
    with pytest.raises(
        SettingsError, match=r"1,000,000 transitions takes .* MiB, .*: ([\d,]+) transitions fit"
    ) as refusal:
        ReplayLearner(spec_of(replay_megabytes=4.0), SPACES)
    assert str(refusal.value).endswith(" or fewer, or raise training.replay_megabytes")
    fitting = int(str(refusal.value).split("replay_transitions=")[1].split()[0])
    ReplayLearner(spec_of(replay_megabytes=4.0, replay_transitions=fitting), SPACES)
    with pytest.raises(SettingsError, match=r"takes \d+\.\d+ MiB, and .* allows 0\.0\d+ MiB: 0 transitions fit"):
        ReplayLearner(spec_of(replay_megabytes=0.0001, replay_transitions=20), SPACES)
    with pytest.raises(SettingsError, match="fit"):
        ReplayLearner(spec_of(replay_megabytes=4.0, replay_transitions=fitting + ROWS), SPACES)


def test_frames_that_take_more_than_half_of_a_gpu_stay_in_main_memory(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    spec = spec_of(replay_transitions=64).training
    on_cpu = build_replay_buffer(spec, SPACES, ROWS)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (2 * on_cpu.columns * SPACES.frame_bytes(ROWS) - 1, 0))
    beside_gpu = build_replay_buffer(spec.model_copy(update={"device": "cuda"}), SPACES, ROWS)
    assert beside_gpu.nbytes == on_cpu.nbytes
    assert "its frames are in main memory" in caplog.text


@pytest.mark.parametrize(
    ("sections", "training", "remedy"),
    [
        ({"collection": {"upload": "gradients"}}, {}, "set collection.upload=rollouts"),
        ({"policy": {"memory": "gru"}}, {}, "set policy.memory=none"),
        ({"policy": {"distribution": "gaussian"}}, {}, "policy.distribution=squashed_gaussian"),
        ({}, {"normalize_rewards": True}, "environment.reward_scale"),
        ({}, {"curiosity": 0.5}, "training.curiosity=0"),
        ({}, {"n_step": ROWS + 1}, f"collection.rollout_length is {ROWS}: set n_step lower"),
    ],
)
def test_settings_that_replay_cannot_keep_are_refused(
    sections: dict[str, Any], training: dict[str, Any], remedy: str
) -> None:
    with pytest.raises(ValueError, match="sac") as refusal:
        spec_of(sections, **training)
    assert remedy in str(refusal.value)
