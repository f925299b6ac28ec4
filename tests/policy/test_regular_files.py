"""Files of every kind, opened by a reader who does not know what they are."""

import os
from pathlib import Path

import pytest

from daedalus.policy.saving.regular_files import open_regular, read_regular


def test_beginning_of_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"content")
    assert [read_regular(path, limit) for limit in (0, 3, 7, 2**60)] == [b"", b"con", b"content", b"content"]
    with open_regular(path) as file:
        file.seek(3)
        assert file.read() == b"tent"


def test_missing_file_and_folder_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "missing", 10)
    with pytest.raises(OSError, match=r"directory|[Pp]ermission"):
        read_regular(tmp_path, 10)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs in folders")
def test_other_kinds_of_files_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")  # nobody writes into it
    for path in (tmp_path / "fifo", Path("/dev/zero")):
        descriptors = len(os.listdir("/dev/fd"))
        with pytest.raises(OSError, match="not a regular file") as error:
            read_regular(path, 10)
        assert error.value.filename == str(path)
        assert len(os.listdir("/dev/fd")) == descriptors
