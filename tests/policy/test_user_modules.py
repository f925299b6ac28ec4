"""Test of policy/user_modules.py: a module is imported only if it is allowed."""

import sys
from pathlib import Path

import pytest

from daedalus.policy.user_modules import ModuleNotAllowedError, UserModuleError, UserModules
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, RunSpec


@pytest.fixture(autouse=True)
def _restored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "modules", {**sys.modules})
    monkeypatch.setattr(sys, "dont_write_bytecode", True)


def test_an_allowed_module_is_imported_from_the_working_directory(tmp_path: Path) -> None:
    (tmp_path / "mine_to_import.py").write_text("value = 7")
    assert UserModules(frozenset({"mine_to_import"})).attribute("environment.wrap", "mine_to_import:value") == 7


@pytest.mark.parametrize("allowed", ["", "mine_not_to_import.part", "mine_not_to"])
def test_no_other_module_is_imported_even_if_it_was_before(tmp_path: Path, allowed: str) -> None:
    (tmp_path / "mine_not_to_import.py").write_text("raise SystemError")
    modules = UserModules(frozenset({allowed}), "the learner")
    with pytest.raises(ModuleNotAllowedError) as refused:
        modules.load("environment.id", "mine_not_to_import:Id")
    assert str(refused.value) == (
        "the learner asks for environment.id=mine_not_to_import:Id, but the module mine_not_to_import may not be "
        "imported here; if you trust that code, add --allow-module mine_not_to_import"
    )
    with pytest.raises(ModuleNotAllowedError):
        modules.attribute("environment.wrap", "os:system")


def test_all_missing_modules_are_named_once() -> None:
    environment = EnvironmentSpec(id="corridor:A-v0", wrap="corridor:wrap")
    spec = RunSpec(environment=environment, policy=PolicySpec(encoder="nets.deep:Net"))
    with pytest.raises(
        ModuleNotAllowedError, match=r"corridor and nets.deep .* --allow-module corridor --allow-m"
    ) as one:
        UserModules().check(spec.user_modules)
    assert one.value.modules == ("corridor", "nets.deep")
    UserModules(frozenset(one.value.modules)).check(spec.user_modules)
    UserModules().check(RunSpec(environment=EnvironmentSpec(id="ALE/Pong-v5")).user_modules)


def failure(value: str) -> str:
    """Return the error of a module that is allowed."""
    with pytest.raises(UserModuleError) as error:
        UserModules(frozenset({value.rpartition(":")[0]})).attribute("environment.wrap", value)
    return str(error.value).removeprefix(f"environment.wrap={value}: ")


def test_a_missing_module_or_name_is_reported(tmp_path: Path) -> None:
    (tmp_path / "mine_without_it.py").write_text("")
    assert failure("__main__:f") == "name the module of the file, without .py, in place of __main__"
    (tmp_path / "mine_that_ends.py").write_text("import argparse; argparse.ArgumentParser().parse_args(['--wrong'])")
    assert failure("mine_that_ends:f").startswith("mine_that_ends ends the process when it is imported: begin what it")
    assert failure("mine_that_is_absent:f").endswith("install it, or start in the folder of mine_that_is_absent.py")
    assert "cannot import mine_absent.part (No module" in failure("mine_absent.part:f")
    assert failure("mine_without_it:f") == "mine_without_it.py has no 'f'"


def test_a_module_that_imports_a_missing_one_is_not_said_to_be_missing(tmp_path: Path) -> None:
    (tmp_path / "mine_with_a_gap.py").write_text("import not_installed_at_all.part")
    (tmp_path / "mine_above_it.py").write_text("import mine_with_a_gap")
    (tmp_path / "mine_with_an_old_name.py").write_text("\nfrom os import absent")
    imports = "mine_with_a_gap.py imports not_installed_at_all, which is not installed"
    assert failure("mine_with_a_gap:f") == failure("mine_above_it:f") == imports
    reason = failure("mine_with_an_old_name:f")
    assert reason.startswith(
        "cannot import mine_with_an_old_name (mine_with_an_old_name.py, line 2: cannot import name"
    )


def test_the_path_of_a_file_in_place_of_a_module_is_reported() -> None:
    write = "name the module, not its file: write "
    assert failure("mine.py:f") == f"{write}mine:f"
    assert failure("envs/mine.py:f") == f"{write}envs.mine:f"
    assert failure("/srv/mine.py:f") == "name the module, not its file: start in /srv and write mine:f"


@pytest.mark.parametrize("name", ["colorsys", "time"])  # the second has no file
def test_a_file_with_the_name_of_a_module_of_python_is_reported(name: str, tmp_path: Path) -> None:
    assert "this folder" not in failure(f"{name}:absent")
    (tmp_path / f"{name}.py").write_text("absent = 1")
    assert failure(f"{name}:absent").endswith(
        f"; it was imported in place of {name}.py of this folder: rename your file"
    )
