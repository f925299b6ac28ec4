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
EXTRAS = PROJECT["optional-dependencies"]


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


def test_each_supported_python_is_tested_and_the_oldest_with_the_oldest_packages() -> None:
    jobs = read("ci.yml")["jobs"]
    core = jobs["core"]["strategy"]["matrix"]["include"]
    assert {*jobs["test"]["strategy"]["matrix"]["python"], *(each["python"] for each in core)} == {*supported()}
    assert jobs["actor"]["strategy"]["matrix"]["python"] == jobs["test"]["strategy"]["matrix"]["python"]
    (lowest,) = [each for each in core if "CONSTRAINTS=constraints-lowest.txt" in each["with"]]
    assert lowest["python"] == supported()[0]
    assert f"TORCH={_lowest(PROJECT['optional-dependencies']['learner'])['torch']}" in lowest["with"]


def _lowest(requirements: list[str]) -> dict[str, str]:
    """Return the oldest release that each requirement allows, such as `torch==2.9`, by name."""
    found = [re.match(r"([\w-]+)>=([\d.]+)", each) for each in requirements]
    return {match[1]: f"{match[1]}=={match[2]}" for match in found if match}


def test_the_second_constraints_are_the_oldest_releases_that_are_allowed() -> None:
    extras = re.search(r"^CORE_EXTRAS = (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert extras
    required = [*PROJECT["dependencies"], *(each for name in extras[1].split() for each in EXTRAS[name])]
    text = (ROOT / "constraints-lowest.txt").read_text()
    for name, pinned in _lowest(required).items():
        if name != "torch":  # its index has other builds of a release
            assert re.search(rf"^{re.escape(pinned)}(\.\d+)*$", text, re.MULTILINE), pinned


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
    passwords = re.findall(r"password: (.+)", path.read_text())
    assert {*passwords} <= {"${{ github.token }}"}  # it ends with the run
    assert not re.search(r"(image=|generator=)(?!\S+@sha256:[0-9a-f]{64})", path.read_text())


def test_each_job_of_a_release_has_the_permissions_that_it_needs_and_only_tags_start_it() -> None:
    release = read("release.yml")
    assert release[True] == {"push": {"tags": ["v*"]}}  # YAML 1.1 reads the key `on` as true
    permissions = {name: job.get("permissions", {}) for name, job in release["jobs"].items()}
    signs = {"id-token": "write", "attestations": "write"}
    assert permissions == {
        "build": {},
        "attest": signs,
        "images": {"contents": "read", "packages": "write", **signs},
        "publish": {"id-token": "write"},
    }
    assert release["jobs"]["publish"]["needs"] == ["attest", "images"]
    assert {"run": "python -m build --no-isolation"} in release["jobs"]["build"]["steps"]
    for name in ("attest", "publish"):  # whoever can sign runs no code of the project
        assert all("run" not in step for step in release["jobs"][name]["steps"])


def test_a_release_pushes_every_image_with_its_contents_and_provenance() -> None:
    images = read("release.yml")["jobs"]["images"]
    targets = re.findall(r"^FROM run AS (\w+)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert sorted(images["strategy"]["matrix"]["target"]) == sorted(targets)
    (push,) = [step["with"] for step in images["steps"] if step.get("id") == "push"]
    assert (push["push"], push["provenance"], push["sbom"].partition("=")[0]) == (True, "mode=max", "generator")


def test_the_citation_names_the_version_and_the_licence_of_the_project() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"] == "Apache-2.0"
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License\n                           Version 2.0, January 2004" in text
    assert "END OF TERMS AND CONDITIONS" in text
