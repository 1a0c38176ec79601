"""Dashboard, rules and scrape configuration: well formed, and about metrics that are documented."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import yaml

REPOSITORY = Path(__file__).parents[2]
DOCKER = REPOSITORY / "docker"
DASHBOARD: dict[str, Any] = json.loads((DOCKER / "grafana/dashboards/smsr.json").read_text())
RULES: dict[str, Any] = yaml.safe_load((DOCKER / "prometheus" / "rules.yml").read_text())


def documented() -> dict[str, set[str]]:
    """Metrics of the table in docs/deployment.md, each with its labels."""
    text = (REPOSITORY / "docs" / "deployment.md").read_text()
    rows = re.findall(r"^\| `(smsr_\w+)` \| (\w+) \|([^|]*)\|", text, re.MULTILINE)
    metrics: dict[str, set[str]] = {}
    for name, kind, labels in rows:
        names = {"histogram": ("_bucket", "_sum", "_count")}.get(kind, ("",))
        for suffix in names:
            extra = {"le"} if suffix == "_bucket" else set()
            metrics[name + suffix] = set(re.findall(r"`(\w+)`", labels)) | extra
    return metrics


def expressions() -> list[str]:
    """Every PromQL expression in the repository."""
    panels = [t["expr"] for p in DASHBOARD["panels"] for t in p.get("targets", [])]
    return panels + [rule["expr"] for group in RULES["groups"] for rule in group["rules"]]


def test_expressions_use_documented_metrics_and_labels() -> None:
    known = documented()
    for expression in expressions():
        names = re.findall(r"\bsmsr_\w+", expression)
        assert names or "up{" in expression
        assert set(names) <= known.keys(), expression
        grouped = re.findall(r"\bby \(([^)]*)\)", expression)
        matched = re.findall(r"\{([^}]*)\}", expression)
        labels = {label for group in grouped for label in re.findall(r"\w+", group)}
        labels |= {label for match in matched for label in re.findall(r"(\w+)\s*[=!]", match)}
        if names:
            assert labels <= set().union(*(known[name] for name in names)), expression


def test_every_documented_metric_is_on_the_dashboard() -> None:
    text = json.dumps(DASHBOARD)
    families = {re.sub(r"_(bucket|sum|count)$", "", name) for name in documented()}
    assert len(families) >= 12
    assert {name for name in families if name not in text} == set()


def test_panels_do_not_overlap_and_name_the_data_source() -> None:
    provided = yaml.safe_load(
        (DOCKER / "grafana" / "provisioning" / "datasources" / "prometheus.yaml").read_text()
    )["datasources"][0]["uid"]
    taken: set[tuple[int, int]] = set()
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(ids) == len(set(ids))
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells
        if panel["type"] != "row":
            assert panel["datasource"]["uid"] == provided


def test_mounted_files_are_there() -> None:
    compose = yaml.safe_load((DOCKER / "compose.s3.yaml").read_text())
    for service in compose["services"].values():
        for volume in service.get("volumes", []):
            if volume.startswith("./"):
                assert (DOCKER / volume.split(":")[0]).exists(), volume
