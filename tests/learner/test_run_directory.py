"""learner/run/run_directory.py: files of the run directory, and config.toml that reproduces the run."""

import errno
import json
import sys
from pathlib import Path
from typing import Any

import pytest
from building import run_spec
from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError, read_preset
from daedalus.learner.run.settings import run_spec as run_spec_of
from daedalus.protocol.spec import RunSpec

FINITE = st.floats(allow_nan=False, allow_infinity=False)
ABOVE_0 = st.floats(0.0, 1e9, exclude_min=True)
UNIT = st.floats(0.0, 1.0)
JSON = st.recursive(
    st.booleans() | st.integers(-(2**60), 2**60) | FINITE | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@st.composite
def specs(draw: st.DrawFn) -> RunSpec:
    def some(**strategies: st.SearchStrategy[Any]) -> dict[str, Any]:
        """Draw any subset of the settings; the others have their defaults."""
        return draw(st.fixed_dictionaries({}, optional=strategies))

    return RunSpec.model_validate(
        {
            "environment": {
                "id": draw(st.from_regex(r"[^\W:]{1,9}|[^\W\d]{1,5}:[\w' -]{1,5}", fullmatch=True)),
                **some(
                    kwargs=st.dictionaries(st.text(max_size=5), JSON, max_size=3),
                    max_episode_steps=st.integers(1, 10**9),
                    reward_scale=ABOVE_0,
                ),
            },
            "policy": some(hidden=st.lists(st.integers(1, 999), min_size=1, max_size=8)),
            "collection": some(actors=st.integers(1, 99), window=st.integers(1, 64)),
            "training": some(
                algorithm=st.sampled_from(["a2c", "a3c", "impala"]),
                target_return=FINITE,
                learning_rate=st.floats(0.0, 1.0, exclude_min=True),
                learning_rate_final=UNIT,
                entropy_bonus_final=UNIT,
                optimizer_epsilon=ABOVE_0,
                stop_when_solved=st.booleans(),
            ),
            "service": some(log_seconds=ABOVE_0),
        }
    )


@given(specs())
def test_config_toml_reads_back_as_the_same_run(tmp_path_factory: pytest.TempPathFactory, spec: RunSpec) -> None:
    directory = tmp_path_factory.mktemp("run")
    run_directory.write_config(directory, spec)
    assert run_directory.read_config(directory) == spec


def test_config_toml_contains_defaults(tmp_path: Path) -> None:
    run_directory.write_config(tmp_path, run_spec())
    text = (tmp_path / run_directory.CONFIG).read_text()
    assert "discount_factor = 0.99" in text
    assert "checkpoint_seconds = 60.0" in text


def test_config_toml_can_be_used_as_a_preset(tmp_path: Path) -> None:
    run_directory.create(tmp_path, run_spec(algorithm="a3c", seed=9))
    again = run_spec_of(read_preset(str(tmp_path / run_directory.CONFIG)))
    assert again == run_spec(algorithm="a3c", seed=9)


def test_new_run_directory_contains_config_and_versions(tmp_path: Path) -> None:
    run_directory.create(tmp_path / "runs" / "new", run_spec())
    assert sorted(entry.name for entry in (tmp_path / "runs" / "new").iterdir()) == [
        *("config.toml", "learner.lock", "versions.json")
    ]
    versions = run_directory.read_json(tmp_path / "runs" / "new" / run_directory.VERSIONS)
    assert {"python", "torch", "numpy", "eclipse-zenoh"} <= versions.keys()


@pytest.mark.skipif(sys.platform == "win32", reason="no permissions")
def test_only_its_owner_may_enter_a_new_run_directory(tmp_path: Path) -> None:
    for numbered in (False, True):
        run_directory.create_locked(tmp_path / "runs" / str(numbered), run_spec(), numbered=numbered).close()
        assert (tmp_path / "runs" / str(numbered)).stat().st_mode & 0o777 == 0o700
    with run_directory.made(tmp_path / "runs" / "made"):
        assert (tmp_path / "runs" / "made").stat().st_mode & 0o777 == 0o700
    (tmp_path / "mine").mkdir(0o755)
    run_directory.create_locked(tmp_path / "mine", run_spec()).close()
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o755  # a directory of the user's stays as it is


def test_existing_run_directory_is_refused_and_unchanged(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    run_directory.create(directory, run_spec(seed=1))
    with pytest.raises(SettingsError, match=r"exists: continue the run with `daedalus resume .*run`"):
        run_directory.create(directory, run_spec(seed=2))
    assert run_directory.read_config(directory).training.seed == 1


def test_empty_directory_is_accepted_and_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    run_directory.create(tmp_path / "empty", run_spec())
    (tmp_path / "file").touch()
    with pytest.raises(SettingsError, match=r"file is a file: choose a directory with --run-dir"):
        run_directory.create(tmp_path / "file", run_spec())
    with pytest.raises(SettingsError, match=r"is not empty, and has no config\.toml: choose another directory"):
        run_directory.create(tmp_path, run_spec())
    with pytest.raises(SettingsError, match="Not a directory"):
        run_directory.create(tmp_path / "file" / "run", run_spec())


def test_read_config_refuses_a_directory_without_config_toml(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"is not a run directory: it has no config\.toml"):
        run_directory.read_config(tmp_path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "setting environment is missing"),
        ("[environment]\nid = 3", "setting environment.id"),
        ("a = " + "[" * 50_000, "is not valid: its values are nested too deeply"),
        ("a." * 8000 + "a = 1", "is not valid: its values are nested too deeply"),
        ("a = " + "9" * 5000, "is not valid TOML"),
        ("#" * ((1 << 20) + 1), "is larger than 1 MiB"),
    ],
)
def test_damaged_config_toml_is_named(tmp_path: Path, text: str, reason: str) -> None:
    """A sweep has many of them."""
    path = tmp_path / run_directory.CONFIG
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        run_directory.read_config(tmp_path)
    assert str(error.value).startswith(str(path))
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_json_reads_back_and_damage_raises(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    run_directory.write_json(path, {"solved": True, "seconds": 1.5})
    assert run_directory.read_json(path) == {"solved": True, "seconds": 1.5}
    for damaged in (path.read_text()[:9], "", "[]", "[" * 200_000, '{"a": ' + "9" * 5000 + "}"):
        path.write_text(damaged)
        with pytest.raises(SettingsError, match="is damaged"):
            run_directory.read_json(path)
    with pytest.raises(SettingsError, match="does not exist"):
        run_directory.read_json(tmp_path / "none.json")


def test_json_file_is_unchanged_when_its_replacement_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "summary.json"
    run_directory.write_json(path, {"run": 1})

    def refuse(*_: object) -> None:
        raise OSError("the power failed")

    monkeypatch.setattr("daedalus.learner.run.run_directory.os.replace", refuse)
    with pytest.raises(OSError, match="power"):
        run_directory.write_json(path, {"run": 2})
    assert json.loads(path.read_text()) == {"run": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_settings_that_cannot_be_written_are_named_and_leave_the_former_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_directory.write_config(tmp_path, run_spec(seed=1))

    def disk_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")  # without a file name, as of a write

    monkeypatch.setattr(Path, "write_text", disk_full)
    with pytest.raises(SettingsError, match=r"^.*/config\.toml cannot be written: No space left on device$"):
        run_directory.write_config(tmp_path, run_spec(seed=2))
    assert run_directory.read_config(tmp_path) == run_spec(seed=1)
    assert [file.name for file in tmp_path.iterdir()] == [run_directory.CONFIG]


def test_name_of_a_run_is_that_of_its_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = tmp_path / "try-1"
    directory.mkdir()
    monkeypatch.chdir(directory)
    assert {
        run_directory.run_name(path) for path in (directory, Path(), Path("../try-1"), directory / "checkpoints" / "..")
    } == {"try-1"}
    (tmp_path / "current").symlink_to(directory)
    assert run_directory.run_name(tmp_path / "current") == "current"
    assert run_directory.run_name(tmp_path / "try#1") != run_directory.run_name(tmp_path / "try 1")


def test_default_directory_is_named_after_the_run() -> None:
    directory = run_directory.default_directory("ALE/Pong-v5", run_spec(algorithm="a3c", seed=4))
    assert directory.parent == Path("runs")
    assert directory.name.startswith("ALE-Pong-v5-a3c-s4-")
