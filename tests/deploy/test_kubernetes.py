"""Test of deploy/kubernetes: manifests against the schemas of Kubernetes, commands against our parsers."""

import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from certificates import make_certificates
from commands import check
from processes import LIMIT, until

from daedalus.launch.process_lifecycle import BAD_USAGE, NOT_REACHED, SUPERSEDED
from daedalus.protocol.keys import owner

FOLDER = Path(__file__).parents[2] / "deploy" / "kubernetes"
VERSIONS = ("1.29", "1.33", "1.37")
Manifest = dict[str, Any]


def manifests() -> list[Manifest]:
    """Return all manifests that the kustomizations name."""
    found: list[Manifest] = []
    for folder in (FOLDER, FOLDER / "autoscaling", FOLDER / "monitoring"):
        kustomization = yaml.safe_load((folder / "kustomization.yaml").read_text())
        for name in kustomization["resources"]:
            found += yaml.safe_load_all((folder / name).read_text())
    return found


def validate(manifest: Manifest, version: str) -> None:
    """Check a manifest against the schema of a version, strictly."""
    import kubernetes_validate  # not in each worker of the tests

    kubernetes_validate.validate(manifest, version, strict=True)


def read(path: str) -> Manifest:
    return yaml.safe_load((FOLDER / path).read_text())


def by_name(manifests: Iterable[Manifest]) -> dict[str, Manifest]:
    return {f"{each['kind']}/{each['metadata']['name']}": each for each in manifests}


def of_kubernetes(manifests: dict[str, Manifest]) -> dict[str, Manifest]:
    """Return the manifests whose schema belongs to Kubernetes itself, not to the Prometheus Operator."""
    return {
        name: each for name, each in manifests.items() if not each["apiVersion"].startswith("monitoring.coreos.com")
    }


ALL = by_name(manifests())
OF_KUBERNETES = of_kubernetes(ALL)


def pods() -> list[Manifest]:
    return [each["spec"]["template"] for each in ALL.values() if "template" in each["spec"]]


def containers() -> Iterator[tuple[Manifest, Manifest]]:
    return ((pod, container) for pod in pods() for container in pod["spec"]["containers"])


def test_the_kustomizations_name_every_manifest() -> None:
    patches = {FOLDER / "tls" / patch["path"] for patch in read("tls/kustomization.yaml")["patches"]}
    written = {path for path in FOLDER.rglob("*.yaml") if path.name != "kustomization.yaml"} - patches
    written.remove(FOLDER / "reader.yaml")  # applied by hand
    documents = [each for path in written for each in yaml.safe_load_all(path.read_text())]
    assert len(documents) == len(ALL)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", OF_KUBERNETES)
def test_each_manifest_is_valid_for_each_kubernetes_version(name: str, version: str) -> None:
    validate(ALL[name], version)


def test_the_reader_is_valid_and_mounts_the_runs() -> None:
    reader = read("reader.yaml")
    validate(reader, VERSIONS[-1])
    (volume,) = reader["spec"]["volumes"]
    assert f"PersistentVolumeClaim/{volume['persistentVolumeClaim']['claimName']}" in ALL
    assert reader["spec"]["containers"][0]["image"] in {container["image"] for _, container in containers()}


def test_each_selector_matches_pod_templates() -> None:
    labels = [pod["metadata"]["labels"] for pod in pods()]
    for name, each in OF_KUBERNETES.items():
        if "selector" in each["spec"]:
            selector = each["spec"]["selector"]
            wanted = selector.get("matchLabels", selector)
            assert sum(wanted.items() <= label.items() for label in labels) == 1, name
    target = ALL["HorizontalPodAutoscaler/actor"]["spec"]["scaleTargetRef"]
    assert f"{target['kind']}/{target['name']}" in ALL


def test_network_policies_cover_every_pod_and_open_the_ports_that_are_used() -> None:
    covered, key = set(), "app.kubernetes.io/name"
    policies = [each["spec"] for name, each in ALL.items() if name.startswith("NetworkPolicy/")]
    for policy in policies:
        selector = policy["podSelector"]
        names = (
            selector["matchLabels"].values() if "matchLabels" in selector else selector["matchExpressions"][0]["values"]
        )
        assert set(names) <= {pod["metadata"]["labels"][key] for pod in pods()}
        if "Egress" in policy["policyTypes"]:
            covered.update(names)
    assert covered == {pod["metadata"]["labels"][key] for pod in pods()}
    opened = {port["port"] for policy in policies for rule in policy.get("ingress", []) for port in rule["ports"]}
    assert opened == {port["containerPort"] for _, container in containers() for port in container.get("ports", [])}
    router = ALL["NetworkPolicy/router"]["spec"]
    assert "egress" not in router  # it connects to nothing
    (source,) = router["ingress"][0]["from"]
    assert source["podSelector"] == ALL["NetworkPolicy/clients"]["spec"]["podSelector"]


def words_of(container: Manifest) -> list[str]:
    """Return the arguments of `daedalus` in a container."""
    if "args" in container:
        return [word.replace("$(POD)", "actor-7d9f") for word in container["args"]]
    (line,) = [line for line in container["command"][-1].splitlines() if "daedalus" in line]
    text = line.removesuffix(" &").removeprefix("daedalus ").replace('"$ROUTER"', "$ROUTER")
    for variable in container["env"]:
        text = text.replace(f"${variable['name']}", variable["value"])
    return shlex.split(text)


def test_the_command_of_each_container_is_valid() -> None:
    commands = [check(words_of(container)) for _, container in containers()]
    assert commands == ["router", "learner", "actor", "actor", "exporter"]


def test_the_probes_check_the_run_of_the_learner() -> None:
    (learner,) = (container for _, container in containers() if container["name"] == "learner")
    ready, alive = (learner[probe]["exec"]["command"] for probe in ("readinessProbe", "livenessProbe"))
    words = words_of(learner)
    run_directory = words[words.index("--run-dir") + 1]
    probe = words_of({"command": ready, "env": learner["env"]})
    assert check(probe) == "status"
    assert probe[probe.index("--run") + 1] == Path(run_directory).name
    assert check(alive[1:]) == "status"
    assert alive[2:] == ["--alive", run_directory]


# The learner of the manifest is replaced by a program that ends with the given status, or waits for a signal.
@pytest.mark.parametrize(
    ("learner", "status"), [("exit 0", 0), ("exit 3", 3), ("exit 7", 7), ("kill -9 $$", 137), ("", 143)]
)
def test_the_job_distinguishes_a_run_that_ended_from_one_that_was_stopped(
    tmp_path: Path, learner: str, status: int
) -> None:
    stand_in = tmp_path / "daedalus"
    waiting = f"trap 'echo > {tmp_path}/saved; exit 0' TERM; echo > {tmp_path}/ready; while :; do sleep 0.05; done"
    stand_in.write_text(f"#!/bin/sh\n{learner or waiting}\n")
    stand_in.chmod(0o755)
    (container,) = (container for _, container in containers() if container["name"] == "learner")
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "ROUTER": "tcp/router:7447", "TLS": ""}
    with subprocess.Popen(container["command"], env=environment) as process:
        if not learner:
            until((tmp_path / "ready").exists)
            process.terminate()
        assert process.wait(LIMIT) == status
    assert (tmp_path / "saved").exists() == (not learner)
    rules = ALL["Job/learner"]["spec"]["podFailurePolicy"]["rules"]
    assert rules[0]["onExitCodes"]["values"] == [BAD_USAGE, NOT_REACHED, SUPERSEDED]


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
        assert "memory" in container["resources"]["limits"]
        assert pod["spec"]["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["spec"]["terminationGracePeriodSeconds"] >= 10


def check_volumes(manifests: dict[str, Manifest]) -> None:
    """Fail if a container mounts a volume that its pod does not declare."""
    for each in manifests.values():
        template = each.get("spec", {}).get("template")
        if template is not None:
            volumes = template["spec"].get("volumes", [])
            mounts = (mount for one in template["spec"]["containers"] for mount in one.get("volumeMounts", []))
            assert {mount["name"] for mount in mounts} == {volume["name"] for volume in volumes}
            for volume in volumes:
                assert "emptyDir" not in volume or volume["emptyDir"]["sizeLimit"]
                if "persistentVolumeClaim" in volume:
                    assert f"PersistentVolumeClaim/{volume['persistentVolumeClaim']['claimName']}" in manifests
                if "secret" in volume:
                    assert f"Secret/{volume['secret']['secretName']}" in manifests


def test_each_mounted_volume_is_declared() -> None:
    check_volumes(ALL)


def test_the_monitor_selects_the_exporter_and_its_rules_are_those_of_prometheus() -> None:
    monitor, service = ALL["ServiceMonitor/daedalus"]["spec"], ALL["Service/exporter"]
    assert monitor["selector"]["matchLabels"].items() <= service["metadata"]["labels"].items()
    assert [end["port"] for end in monitor["endpoints"]] == [port["name"] for port in service["spec"]["ports"]]
    labels = read("kustomization.yaml")["labels"][0]["pairs"]
    assert labels[monitor["jobLabel"]] == "daedalus"  # the alerts select up{job="daedalus"}
    alerts = yaml.safe_load((FOLDER.parent / "prometheus" / "alerts.yml").read_text())
    assert ALL["PrometheusRule/daedalus"]["spec"] == alerts


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not installed")
def test_the_components_render_to_valid_manifests_with_tls_everywhere(tmp_path: Path) -> None:
    folder = tmp_path / "kubernetes"
    shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("certs"))
    certificates = make_certificates(folder / "tls" / "certs")
    (certificates / "actor-arm").rename(certificates / "actor")  # another name does not matter here
    kustomization = folder / "kustomization.yaml"
    enabled = re.sub(r"^# (components:|  - \w+)", r"\1", kustomization.read_text(), flags=re.MULTILINE)
    kustomization.write_text(enabled)
    rendered = subprocess.run(["kubectl", "kustomize", str(folder)], stdout=subprocess.PIPE, text=True, check=True)
    found = by_name(yaml.safe_load_all(rendered.stdout))
    secrets = {f"Secret/{role}-tls" for role in ("router", "learner", "actor", "operator")}
    assert found.keys() == ALL.keys() | secrets
    for name, each in of_kubernetes(found).items():
        validate(each, VERSIONS[-1])
        if name in (
            "Deployment/router",
            "Job/learner",
            "Deployment/actor",
            "Deployment/evaluator",
            "Deployment/exporter",
        ):
            words = words_of(each["spec"]["template"]["spec"]["containers"][0])
            check(words)
            assert words[words.index("--tls") + 1] == "/tls"
            assert "--insecure" not in words
            assert not any(word.startswith("tcp/") for word in words)
    check_volumes(found)


def test_the_names_of_actors_fit_their_certificate() -> None:
    for path in ("tls/actor.yaml", "tls/evaluator.yaml"):
        words = words_of(read(path)["spec"]["template"]["spec"]["containers"][0])
        assert owner(words[words.index("--name") + 1]) == "actor"  # docs/deploy.md issues a certificate of this name
        assert ("--evaluator" in words) == ("evaluator" in path)
