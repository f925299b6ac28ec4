"""Test of docker-compose.yml and the files that it mounts. `make test-compose` starts the containers."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import check

ROOT = Path(__file__).parents[2]
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]


def test_the_build_context_holds_every_package() -> None:
    packages = {"daedalus", *(link.name for link in (ROOT / "daedalus").iterdir() if link.is_symlink())}
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    files = {"pyproject.toml", "constraints.txt", "deploy/requirements", "README.md", "LICENSE", "MANIFEST.in"}
    assert packages | files == kept


def test_the_default_services_are_router_learner_actor_and_evaluator() -> None:
    default = {name for name, service in SERVICES.items() if "profiles" not in service}
    assert default == {"router", "learner", "actor", "evaluator"}
    assert "--evaluator" in SERVICES["evaluator"]["command"]
    monitoring = {name for name, service in SERVICES.items() if service.get("profiles") == ["monitoring"]}
    assert monitoring == {"exporter", "tensorboard", "prometheus", "grafana"}


@pytest.mark.parametrize("name", ["router", "learner", "actor", "exporter"])
def test_the_command_of_each_service_is_valid(name: str) -> None:
    assert check(SERVICES[name]["command"]) == name


def test_the_health_check_is_a_valid_command() -> None:
    kind, program, *arguments = SERVICES["learner"]["healthcheck"]["test"]
    assert (kind, program) == ("CMD", "daedalus")
    assert check(arguments) == "status"


def test_images_are_targets_of_the_dockerfile() -> None:
    targets = set(re.findall(r"^FROM run AS (\w+)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE))
    built = {service["image"]: service["build"]["target"] for service in SERVICES.values() if "build" in service}
    assert built == {f"daedalus-{target}": target for target in targets - {"gateway"}}
    ours = {service["image"] for service in SERVICES.values() if service["image"].startswith("daedalus")}
    assert ours == set(built)


def test_ports_are_open_on_the_loopback_address_only() -> None:
    ports = [port for service in SERVICES.values() for port in service.get("ports", [])]
    assert len(ports) == 4
    assert all(port.startswith("127.0.0.1:") for port in ports)


def test_each_mounted_file_exists() -> None:
    mounts = [mount for service in SERVICES.values() for mount in service.get("volumes", []) if mount.startswith("./")]
    assert len(mounts) == 4
    assert all((ROOT / mount.split(":")[0]).exists() for mount in mounts)


def test_host_names_in_addresses_are_services() -> None:
    text = (ROOT / "docker-compose.yml").read_text()
    text += (ROOT / "deploy" / "prometheus" / "prometheus.yml").read_text()
    text += (ROOT / "deploy" / "grafana" / "provisioning" / "datasources" / "prometheus.yml").read_text()
    hosts = set(re.findall(r"(?:tcp/|http://|targets: \[\")([a-z]+):\d+", text))
    assert hosts == {"router", "exporter", "prometheus"}
    assert hosts <= SERVICES.keys()


def test_each_container_is_limited() -> None:
    for name, service in SERVICES.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["mem_limit"], name
        assert service["pids_limit"] > 0, name
        assert service["logging"]["options"].keys() == {"max-size", "max-file"}, name
        assert any(mount.startswith("/tmp:") for mount in service["tmpfs"]), name


def test_images_of_others_are_pinned_by_digest() -> None:
    (base,) = re.findall(r"^ARG BASE=(\S+)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    for image in [base, *(service["image"] for service in SERVICES.values())]:
        if not image.startswith("daedalus-"):
            assert re.search(r":[\w.-]+@sha256:[0-9a-f]{64}$", image), image


@pytest.mark.parametrize("name", ["actor", "gateway", "learner", "build", "release"])
def test_packages_of_images_have_hashes_and_the_versions_of_the_constraints(name: str) -> None:
    text = (ROOT / "deploy" / "requirements" / f"{name}.txt").read_text()
    locked = dict(re.findall(r"^([\w.-]+)==([^ ;\\]+)", text, re.MULTILINE))
    constraints = (ROOT / "constraints.txt").read_text().lower().replace("_", "-")
    for package, version in locked.items():
        assert f"{package}=={version}\n" in constraints
    blocks = text.split("\n", 2)[2].replace(" \\\n    --hash", " --hash").splitlines()
    assert len(blocks) == len(locked)
    assert all(re.search(r" --hash=sha256:[0-9a-f]{64}", block) for block in blocks)
    user = ROOT / (".github/workflows/release.yml" if name == "release" else "Dockerfile")
    assert f"-r deploy/requirements/{name}.txt" in user.read_text()


@pytest.mark.parametrize(("name", "extra"), [("actor", "monitoring"), ("gateway", "gateway"), ("learner", "learner")])
def test_packages_of_images_are_all_that_the_project_requires(name: str, extra: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = {
        re.split(r"[<>=\[]", each)[0] for each in [*project["dependencies"], *project["optional-dependencies"][extra]]
    }
    text = (ROOT / "deploy" / "requirements" / f"{name}.txt").read_text()
    assert required - {"torch"} <= set(re.findall(r"^([\w.-]+)==", text, re.MULTILINE))
