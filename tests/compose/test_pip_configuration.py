"""Test of pip_configuration.py. It needs no docker."""

from pathlib import Path

import pytest
from pip_configuration import for_image, options_of


def test_a_later_section_replaces_an_earlier_one_and_other_commands_are_ignored() -> None:
    listing = """\
:env:.timeout='60'
download.timeout='5'
global.find-links='\\n/a\\n/b'
global.timeout='15'
install.timeout='30'
"""
    assert options_of(listing) == {"find-links": "\n/a\n/b", "timeout": "60"}


@pytest.mark.parametrize("name", ["constraint", "requirement", "cert", "client-cert", "find-links"])
def test_a_file_that_an_option_names_is_copied(name: str, tmp_path: Path) -> None:
    file = tmp_path / "named.txt"
    file.touch()
    assert for_image({name: str(file)}) == ({name: str(file)}, [file])


@pytest.mark.parametrize("name", ["constraint", "requirement", "cert", "client-cert", "find-links"])
def test_an_option_is_left_out_if_its_file_does_not_exist(name: str, tmp_path: Path) -> None:
    assert for_image({name: str(tmp_path / "missing"), "timeout": "60"}) == ({"timeout": "60"}, [])


def test_each_word_of_a_list_is_handled_separately(tmp_path: Path) -> None:
    wheels, page = tmp_path / "wheels", tmp_path / "page.html"
    wheels.mkdir()
    page.touch()
    options = {"find-links": f"\n{wheels}\n{tmp_path / 'missing'}\nhttps://example.org/wheels/\n{page.as_uri()}"}
    kept = {"find-links": f"{wheels} https://example.org/wheels/ {page.as_uri()}"}
    assert for_image(options) == (kept, [wheels, page])


def test_a_relative_path_becomes_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "constraints.txt").touch()
    file = tmp_path / "constraints.txt"
    assert for_image({"constraint": "constraints.txt"}) == ({"constraint": str(file)}, [file])


def test_a_path_of_a_single_value_may_hold_a_space(tmp_path: Path) -> None:
    file = tmp_path / "our authority.pem"
    file.touch()
    assert for_image({"cert": str(file)}) == ({"cert": str(file)}, [file])


def test_a_folder_named_twice_is_copied_once(tmp_path: Path) -> None:
    both = {"find-links": str(tmp_path), "extra-index-url": tmp_path.as_uri()}
    assert for_image(both) == (both, [tmp_path])


def make_index(folder: Path, link: str) -> Path:
    (folder / "numpy").mkdir(parents=True)
    (folder / "numpy" / "index.html").write_text(f'<a href="{link}">numpy</a>')
    return folder


@pytest.mark.parametrize("name", ["index-url", "extra-index-url"])
def test_an_index_in_a_local_folder_is_copied_if_it_holds_its_files(name: str, tmp_path: Path) -> None:
    whole = make_index(tmp_path / "whole", "numpy-2.4.6-py3-none-any.whl#sha256=0")
    outside = make_index(tmp_path / "outside", "../../files/numpy-2.4.6-py3-none-any.whl")
    assert for_image({name: whole.as_uri()}) == ({name: whole.as_uri()}, [whole])
    assert for_image({name: outside.as_uri()}) == ({}, [])
    assert for_image({name: (tmp_path / "missing").as_uri()}) == ({}, [])


def test_an_index_on_another_host_is_kept() -> None:
    options = {"index-url": "https://example.org/simple", "extra-index-url": "https://a.example https://b.example"}
    assert for_image(options) == (options, [])
