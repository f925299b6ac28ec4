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


def test_a_missing_module_or_name_is_reported(tmp_path: Path) -> None:
    (tmp_path / "mine_with_a_gap.py").write_text("import not_installed_at_all")
    (tmp_path / "mine_without_it.py").write_text("")
    modules = UserModules(frozenset({"mine_with_a_gap", "mine_without_it"}))
    with pytest.raises(UserModuleError, match=r"wrap=mine_with_a_gap:f: cannot import mine_with_a_gap .*not_installed"):
        modules.attribute("environment.wrap", "mine_with_a_gap:f")
    with pytest.raises(UserModuleError, match=r"mine_without_it.py has no 'f'"):
        modules.attribute("environment.wrap", "mine_without_it:f")
