"""The dashboard and the alert rules load, and every metric and label that they name is in a scrape of a server."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections import defaultdict

import httpx
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from protocol.messages import Composite
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.docker.dockerfile import ROOT
from tests.docker.promql import Named, named
from tests.service.fakes import FAKE_DEVICE, Lab, fake_mesh, frame_message
from tests.service.wire import Wire

FOLDER = ROOT / "docker/monitoring"
ALERTS = yaml.safe_load((FOLDER / "alerts.yaml").read_text())
BOARD = json.loads((FOLDER / "dashboard.json").read_text())
PROMETHEUS_OWN = {"up"}
OF_THE_TARGET = {"job", "instance"}
"""Labels that Prometheus adds to what it scrapes."""

Scrape = dict[str, dict[str, set[str]]]
"""Values of each label by the name of the sample."""


@pytest.fixture(scope="module")
def scrape(tmp_path_factory) -> Scrape:
    """What a server says after a frame."""
    service = Service(
        FAKE_DEVICE,
        pipeline_factory=Lab().build,
        mesh_loader=fake_mesh,
        data=tmp_path_factory.mktemp("rooms"),
    )
    with BackgroundServer(service) as server:
        wire = Wire(server.url)
        wire.greet()
        wire.say(frame_message(0))
        wire.hear_until(Composite)
        text = httpx.get(f"{server.url}/metrics", trust_env=False).text
        wire.hang_up()
    found: Scrape = defaultdict(lambda: defaultdict(set))
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            for label, value in ({"": ""} | sample.labels).items():
                found[sample.name][label].add(value)
    return found


def expressions() -> list[str]:
    rules = [rule["expr"] for group in ALERTS["groups"] for rule in group["rules"]]
    return rules + [target["expr"] for panel in BOARD["panels"] for target in panel["targets"]]


@pytest.mark.parametrize("expression", expressions())
def test_what_is_named_is_in_a_scrape(expression: str, scrape: Scrape) -> None:
    metrics, groups = named(expression)
    assert metrics
    of_all = set(OF_THE_TARGET)
    for metric in metrics:
        if metric.metric in PROMETHEUS_OWN:
            continue
        assert metric.metric in scrape
        labels = scrape[metric.metric]
        of_all |= set(labels)
        for label, values in metric.labels.items():
            assert label in OF_THE_TARGET or set(values) <= labels[label], (label, values)
    assert groups <= of_all


def test_every_metric_of_the_server_is_shown_or_watched(scrape: Scrape) -> None:
    used = {metric.metric for expression in expressions() for metric in named(expression)[0]}
    for name in scrape:
        family = re.sub(r"_(bucket|sum|count)$", "", name)
        if name.startswith("probeless_"):
            assert {name, f"{family}_bucket", f"{family}_sum"} & used, name


def test_rules_have_what_prometheus_asks_for_and_people_need() -> None:
    rules = [rule for group in ALERTS["groups"] for rule in group["rules"]]
    assert len({rule["alert"] for rule in rules}) == len(rules)
    for rule in rules:
        assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
        assert re.fullmatch(r"\d+[smh]", rule.get("for", "1m"))
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert set(rule["annotations"]) == {"summary", "description"}


def test_every_alert_fires_in_prometheus_own_test() -> None:
    unit = ROOT / "tests/docker/alerts_unit.yaml"
    expected = yaml.safe_load(unit.read_text())["tests"][0]["promql_expr_test"][0]["exp_samples"]
    alerts = [rule["alert"] for group in ALERTS["groups"] for rule in group["rules"]]
    assert [sample["labels"] for sample in expected] == [f'{{alertname="{alert}"}}' for alert in alerts]
    if shutil.which("promtool"):
        subprocess.run(["promtool", "check", "rules", FOLDER / "alerts.yaml"], check=True)
        subprocess.run(["promtool", "test", "rules", unit], check=True)


def test_the_dashboard_is_one_that_grafana_takes() -> None:
    assert BOARD["schemaVersion"] >= 36
    variables = {variable["name"] for variable in BOARD["templating"]["list"]}
    ids = [panel["id"] for panel in BOARD["panels"]]
    assert len(set(ids)) == len(ids)
    taken: set[tuple[int, int]] = set()
    for panel in BOARD["panels"]:
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert not cells & taken, panel["title"]
        assert at["x"] + at["w"] <= 24  # columns
        taken |= cells
        assert panel["datasource"]["uid"] == "${source}"
        for target in panel["targets"]:
            used = set(re.findall(r"\$(\w+)", target["expr"]))
            assert used <= variables | {"__rate_interval"}


@pytest.mark.parametrize(
    ("expression", "metrics", "groups"),
    [
        ("up == 0", [Named("up", {})], set()),
        ('sum by (a, b) (rate(c{d=~"x|$y", e!="z"}[5m]))', [Named("c", {"d": ("x",), "e": ("z",)})], {"a", "b"}),
        ("a / b and c", [Named("a", {}), Named("b", {}), Named("c", {})], set()),
        ("histogram_quantile(0.9, a_bucket)", [Named("a_bucket", {})], set()),
    ],
)
def test_names_are_found(expression: str, metrics: list[Named], groups: set[str]) -> None:
    assert named(expression) == (metrics, groups)


def test_documentation_names_both_files() -> None:
    said = (ROOT / "docs/operating.md").read_text()
    for path in FOLDER.iterdir():
        assert f"docker/monitoring/{path.name}" in said
