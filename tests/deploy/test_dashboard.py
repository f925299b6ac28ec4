"""Test of deploy/grafana: the dashboard draws only metrics that the exporter exports."""

import json
import re
from pathlib import Path

import yaml

from daedalus.launch.prometheus_exporter import metrics

GRAFANA = Path(__file__).parents[2] / "deploy" / "grafana"
DASHBOARD = json.loads((GRAFANA / "dashboards" / "daedalus.json").read_text())


def exported() -> set[str]:
    return {family.name + ("_total" if family.type == "counter" else "") for family in metrics([])}


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
