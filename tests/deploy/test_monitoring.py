"""The alerts and the dashboard use metrics that the exporter has."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from daedalus.launch.prometheus_exporter import StatusCollector

FOLDER = Path(__file__).parents[2] / "deploy" / "prometheus"
RULES = [rule for group in yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"] for rule in group["rules"]]


def exported() -> set[str]:
    return {family.name + ("_total" if family.type == "counter" else "") for family in StatusCollector().collect()}


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
    metric, *_ = re.findall(r"\bup\b|daedalus_\w+", rule["expr"])  # the one whose value is shown
    labels = {"up": ["instance"], "daedalus_up": ["instance"]}
    labels |= {
        family.name: family._labelnames  # pyright: ignore[reportAttributeAccessIssue]
        for family in StatusCollector().collect()
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


GRAFANA = Path(__file__).parents[2] / "deploy" / "grafana"
DASHBOARD = json.loads((GRAFANA / "dashboards" / "daedalus.json").read_text())


def test_each_metric_of_the_dashboard_is_exported() -> None:
    expressions = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    expressions += [variable["query"]["query"] for variable in DASHBOARD["templating"]["list"]]
    drawn = {name for expression in expressions for name in re.findall(r"daedalus_\w+", expression)}
    assert len(drawn) > 10
    assert drawn <= exported()


def test_panels_do_not_overlap() -> None:
    cells = [
        (panel["gridPos"]["x"] + column, panel["gridPos"]["y"] + row)
        for panel in DASHBOARD["panels"]
        for column in range(panel["gridPos"]["w"])
        for row in range(panel["gridPos"]["h"])
    ]
    assert len(cells) == len(set(cells))
    assert all(column < 24 for column, _ in cells)
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


def test_the_data_source_of_the_dashboard_is_provisioned() -> None:
    provisioned = yaml.safe_load((GRAFANA / "provisioning" / "datasources" / "prometheus.yml").read_text())
    asked = {panel["datasource"]["uid"] for panel in DASHBOARD["panels"]}
    asked |= {variable["datasource"]["uid"] for variable in DASHBOARD["templating"]["list"]}
    assert asked == {source["uid"] for source in provisioned["datasources"]}


def test_the_provider_reads_the_folder_that_compose_mounts() -> None:
    provider = yaml.safe_load((GRAFANA / "provisioning" / "dashboards" / "daedalus.yml").read_text())
    compose = yaml.safe_load((GRAFANA.parents[1] / "docker-compose.yml").read_text())
    (path,) = (each["options"]["path"] for each in provider["providers"])
    assert f"./deploy/grafana/dashboards:{path}:ro" in compose["services"]["grafana"]["volumes"]
