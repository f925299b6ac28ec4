"""Test of deploy/prometheus: alerts use only metrics and labels that exist. promtool checks them if it is installed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from daedalus.launch.prometheus_exporter import metrics

FOLDER = Path(__file__).parents[2] / "deploy" / "prometheus"
RULES = [rule for group in yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"] for rule in group["rules"]]


def exported() -> set[str]:
    return {family.name + ("_total" if family.type == "counter" else "") for family in metrics([])}


def test_the_alerts_that_operators_need_exist() -> None:
    causes = {rule["alert"].removeprefix("Daedalus") for rule in RULES}
    assert causes >= {"LearnerDown", "UpdatesStalled", "ActorSilent", "NoActors", "ReturnCollapsed", "CheckpointOld"}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_each_alert_uses_metrics_that_are_exported(rule: dict) -> None:
    names = set(re.findall(r"daedalus_\w+", rule["expr"]))
    assert names <= exported()
    assert names or rule["expr"].startswith('up{job="daedalus"}')
    assert rule["labels"]["severity"] in ("warning", "critical")


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_the_text_of_each_alert_uses_labels_of_its_metric(rule: dict) -> None:
    (metric,) = set(re.findall(r"\bup\b|daedalus_\w+", rule["expr"]))
    labels = {"up": ["instance"], "daedalus_up": ["instance"]}
    labels |= {
        family.name: family._labelnames  # pyright: ignore[reportAttributeAccessIssue]
        for family in metrics([])
        if family.name not in labels
    }
    assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= set(labels[metric])


def test_prometheus_loads_the_alerts_that_compose_mounts() -> None:
    configuration = yaml.safe_load((FOLDER / "prometheus.yml").read_text())
    compose = yaml.safe_load((FOLDER.parents[1] / "docker-compose.yml").read_text())
    assert configuration["rule_files"] == ["alerts.yml"]  # relative to the configuration file
    assert {"prometheus.yml", "alerts.yml"} == {
        Path(mount.split(":")[1]).name
        for mount in compose["services"]["prometheus"]["volumes"]
        if mount.startswith("./deploy/prometheus/")
    }
    assert configuration["scrape_configs"][0]["job_name"] == "daedalus"


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed")
def test_promtool_accepts_the_configuration() -> None:
    subprocess.run(["promtool", "check", "config", str(FOLDER / "prometheus.yml")], check=True)
    subprocess.run(["promtool", "test", "rules", "alerts.test.yml"], cwd=Path(__file__).parent, check=True)
