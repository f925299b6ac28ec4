"""Test of deploy/kubernetes: manifests against the schemas of Kubernetes, commands against our parsers."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from commands import check

FOLDER = Path(__file__).parents[2] / "deploy" / "kubernetes"
VERSIONS = ("1.29", "1.33", "1.37")
Manifest = dict[str, Any]


def manifests() -> list[Manifest]:
    """Return all manifests that the kustomizations name."""
    found: list[Manifest] = []
    for folder in (FOLDER, FOLDER / "autoscaling"):
        kustomization = yaml.safe_load((folder / "kustomization.yaml").read_text())
        for name in kustomization["resources"]:
            found += yaml.safe_load_all((folder / name).read_text())
    return found


ALL = {f"{each['kind']}/{each['metadata']['name']}": each for each in manifests()}


def pods() -> list[Manifest]:
    return [each["spec"]["template"] for each in ALL.values() if "template" in each["spec"]]


def containers() -> Iterator[tuple[Manifest, Manifest]]:
    return ((pod, container) for pod in pods() for container in pod["spec"]["containers"])


def test_the_kustomizations_name_every_manifest() -> None:
    written = {path for path in FOLDER.rglob("*.yaml") if path.name != "kustomization.yaml"}
    documents = [each for path in written for each in yaml.safe_load_all(path.read_text())]
    assert len(documents) == len(ALL)
    assert set(ALL) == {
        "Service/router",
        "Deployment/router",
        "StatefulSet/learner",
        "Deployment/actor",
        "HorizontalPodAutoscaler/actor",
    }


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", ALL)
def test_each_manifest_is_valid_for_each_kubernetes_version(name: str, version: str) -> None:
    kubernetes_validate.validate(ALL[name], version, strict=True)


@pytest.mark.parametrize("broken", ["unknown field", "wrong type", "missing field"])
def test_a_broken_manifest_is_invalid(broken: str) -> None:
    manifest = copy.deepcopy(ALL["Deployment/actor"])
    container = manifest["spec"]["template"]["spec"]["containers"][0]
    if broken == "unknown field":
        container["argz"] = container.pop("args")
    elif broken == "wrong type":
        manifest["spec"]["replicas"] = "two"
    else:
        del manifest["spec"]["selector"]
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(manifest, VERSIONS[-1], strict=True)


def test_each_selector_matches_one_pod_template() -> None:
    labels = [pod["metadata"]["labels"] for pod in pods()]
    for each in ALL.values():
        if "selector" in each["spec"]:
            selector = each["spec"]["selector"]
            wanted = selector.get("matchLabels", selector)
            assert sum(wanted.items() <= label.items() for label in labels) == 1
    target = ALL["HorizontalPodAutoscaler/actor"]["spec"]["scaleTargetRef"]
    assert f"{target['kind']}/{target['name']}" in ALL


def test_the_command_of_each_container_is_valid() -> None:
    assert [check(container["args"]) for _, container in containers()] == ["router", "learner", "actor"]


def test_the_probes_check_the_run_of_the_learner() -> None:
    (learner,) = (container for _, container in containers() if container["name"] == "learner")
    ready, alive = (learner[probe]["exec"]["command"] for probe in ("readinessProbe", "livenessProbe"))
    run = Path(learner["args"][learner["args"].index("--run-dir") + 1]).name
    assert ready[:2] == ["daedalus", "status"]
    assert check(ready[1:]) == "status"
    assert ready[ready.index("--run") + 1] == run
    assert check(alive[1:]) == "status"
    assert alive[2:] == ["--alive", learner["args"][learner["args"].index("--run-dir") + 1]]


def test_images_are_named_by_the_kustomization_and_built_by_the_dockerfile() -> None:
    kustomization = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())
    named = {image["name"] for image in kustomization["images"]}
    assert named == {container["image"] for _, container in containers()}
    dockerfile = (FOLDER.parents[1] / "Dockerfile").read_text()
    assert all(f"FROM run AS {name.removeprefix('daedalus-')}\n" in dockerfile for name in named)


def test_containers_run_without_root_and_with_a_read_only_file_system() -> None:
    for pod, container in containers():
        assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
        assert pod["spec"]["automountServiceAccountToken"] is False
        limits = container["securityContext"]
        assert (limits["allowPrivilegeEscalation"], limits["readOnlyRootFilesystem"]) == (False, True)
        assert limits["capabilities"] == {"drop": ["ALL"]}
        assert {"cpu", "memory"} <= container["resources"]["requests"].keys()


def test_each_mounted_volume_is_declared() -> None:
    for each in ALL.values():
        template = each["spec"].get("template")
        if template is not None:
            volumes = {volume["name"] for volume in template["spec"].get("volumes", [])}
            volumes |= {claim["metadata"]["name"] for claim in each["spec"].get("volumeClaimTemplates", [])}
            mounts = (mount for one in template["spec"]["containers"] for mount in one.get("volumeMounts", []))
            assert {mount["name"] for mount in mounts} <= volumes
