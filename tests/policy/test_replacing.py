"""policy/saving/regular_files.py: files that are replaced in one step."""

import stat
from pathlib import Path

import pytest

from daedalus.policy.saving.regular_files import replace_text, replacing


def test_a_file_keeps_its_content_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    replace_text(path, "old")
    with replacing(path) as beside:
        beside.write_bytes(b"new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_error_keeps_the_old_file_and_leaves_no_other(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "config.toml"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as beside:
            beside.write_text("ne")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("private", [False, True])
def test_others_cannot_read_a_private_file_while_it_is_written_either(tmp_path: Path, *, private: bool) -> None:
    path = tmp_path / "token"
    with replacing(path, private=private) as beside:
        modes = [beside.stat().st_mode]
        beside.write_text("secret")
    modes.append(path.stat().st_mode)
    assert [bool(stat.S_IMODE(mode) & 0o077) for mode in modes] == [not private] * 2


def test_a_missing_folder_is_an_error_that_names_a_file_in_it(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        replace_text(tmp_path / "nowhere" / "text", "text")
