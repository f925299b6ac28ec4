"""Test that the CI workflows, the classifiers and the citation agree with pyproject.toml."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CLASSIFIERS = PROJECT["classifiers"]


def read(name: str) -> dict[Any, Any]:
    return yaml.safe_load((ROOT / ".github" / "workflows" / name).read_text())


def steps(workflow: dict[str, Any]) -> list[dict[str, Any]]:
    return [step for job in workflow["jobs"].values() for step in job["steps"]]


def supported() -> list[str]:
    """Return the Python versions of the classifiers."""
    found = [re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", text) for text in CLASSIFIERS]
    return [match[1] for match in found if match]


def test_the_classifiers_begin_with_the_oldest_python_that_is_required() -> None:
    assert PROJECT["requires-python"] == f">={supported()[0]}"
    assert supported() == [f"3.{minor}" for minor in range(11, 11 + len(supported()))]
    assert not [text for text in CLASSIFIERS if text.startswith("License ::")]  # the licence is an SPDX expression


@pytest.mark.parametrize("job", ["test", "actor"])
def test_each_supported_python_is_tested(job: str) -> None:
    assert read("ci.yml")["jobs"][job]["strategy"]["matrix"]["python"] == supported()


def test_the_suite_is_tested_on_linux_and_the_actor_on_windows_and_macos() -> None:
    jobs = read("ci.yml")["jobs"]
    assert jobs["test"]["runs-on"].startswith("ubuntu")
    assert {"run": "make test"} in jobs["test"]["steps"]
    systems = [system.partition("-")[0] for system in jobs["actor"]["strategy"]["matrix"]["system"]]
    assert systems == ["windows", "macos"]
    (tested,) = [step["run"] for step in jobs["actor"]["steps"] if "pytest" in step.get("run", "")]
    for folder in re.findall(r"tests/\w+", tested):
        assert (ROOT / folder).is_dir()


def test_extras_that_a_workflow_installs_exist() -> None:
    (named,) = re.findall(r"\.whl\)\[([\w,]+)\]", str(read("ci.yml")))
    assert set(named.split(",")) <= PROJECT["optional-dependencies"].keys()


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_pins_its_actions_limits_its_jobs_and_needs_no_secret(path: Path) -> None:
    workflow = read(path.name)
    for step in steps(workflow):
        if "uses" in step:
            assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step["uses"])  # a tag can be moved
    assert all("timeout-minutes" in job for job in workflow["jobs"].values())
    assert workflow["permissions"] == {"contents": "read"}
    assert "secrets." not in path.read_text()
    assert "password" not in str(workflow)


def test_only_the_job_that_publishes_has_an_identity_and_only_tags_start_it() -> None:
    release = read("release.yml")
    assert release[True] == {"push": {"tags": ["v*"]}}  # YAML 1.1 reads the key `on` as true
    permissions = {name: job.get("permissions", {}) for name, job in release["jobs"].items()}
    assert permissions == {"build": {}, "publish": {"id-token": "write"}}
    assert release["jobs"]["publish"]["needs"] == "build"
    assert {"run": "python -m build --no-isolation"} in release["jobs"]["build"]["steps"]


def test_the_citation_names_the_version_and_the_licence_of_the_project() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"] == "Apache-2.0"
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License\n                           Version 2.0, January 2004" in text
    assert "END OF TERMS AND CONDITIONS" in text
