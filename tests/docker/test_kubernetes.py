"""The manifests as kustomize renders them: valid by schema, closed by policy, true to the code."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import yaml

from worker.records import PREFIX
from worker.settings import Settings

REPOSITORY = Path(__file__).parents[2]
MANIFESTS = REPOSITORY / "docker" / "kubernetes"
KEDA = json.loads((Path(__file__).parent / "schemas" / "keda.json").read_text())
OVERLAYS = ("cluster", "external-redis")
KUBERNETES = ("1.30", "1.37")  # the oldest and the newest that are promised

Manifest = dict[str, Any]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Manifest]]:
    """Each overlay, built as `kubectl apply -k` would, with the example's secrets."""
    folder = tmp_path_factory.mktemp("kubernetes") / "kubernetes"
    shutil.copytree(MANIFESTS, folder)
    kubectl = shutil.which("kubectl", path=str(Path(sys.executable).parent)) or "kubectl"
    overlays = {}
    for name in OVERLAYS:
        shutil.copy(folder / name / "secret.env.example", folder / name / "secret.env")
        built = subprocess.run(
            [kubectl, "kustomize", folder / name], capture_output=True, text=True, check=True
        )
        overlays[name] = [*yaml.safe_load_all(built.stdout)]
    return overlays


def check(manifest: Manifest, version: str = KUBERNETES[-1]) -> None:
    """Raise an error of jsonschema where a manifest is not of its kind's shape."""
    if manifest["apiVersion"].startswith("keda.sh/"):
        jsonschema.Draft202012Validator(KEDA).validate(manifest)
    else:
        kubernetes_validate.validate(manifest, version, strict=True)


def pick(manifests: list[Manifest], kind: str, name: str) -> Manifest:
    (found,) = (m for m in manifests if m["kind"] == kind and m["metadata"]["name"] == name)
    return copy.deepcopy(found)


def workloads(manifests: list[Manifest]) -> list[Manifest]:
    return [m for m in manifests if m["kind"] in ("Deployment", "StatefulSet")]


@pytest.mark.parametrize("version", KUBERNETES)
@pytest.mark.parametrize("overlay", OVERLAYS)
def test_manifests_fit_their_schemas(
    rendered: dict[str, list[Manifest]], overlay: str, version: str
) -> None:
    for manifest in rendered[overlay]:
        check(manifest, version)
        assert manifest["kind"] == "Namespace" or manifest["metadata"]["namespace"] == "smsr"


def test_each_overlay_is_whole(rendered: dict[str, list[Manifest]]) -> None:
    common = {
        ("Deployment", "api"),
        ("Service", "api"),
        ("Ingress", "api"),
        ("PodDisruptionBudget", "api"),
        ("Deployment", "worker"),
        ("PodDisruptionBudget", "worker"),
        ("ScaledObject", "worker"),
        ("Secret", "smsr"),
        ("NetworkPolicy", "deny"),
    }
    redis = {("StatefulSet", "redis"), ("Service", "redis"), ("NetworkPolicy", "redis")}
    names = {
        overlay: {(m["kind"], m["metadata"]["name"]) for m in manifests}
        for overlay, manifests in rendered.items()
    }
    assert common | redis <= names["cluster"]
    assert common <= names["external-redis"]
    assert not redis & names["external-redis"]


def test_the_check_refuses_what_is_wrong(rendered: dict[str, list[Manifest]]) -> None:
    """A check that lets a misspelt field pass would say nothing about the rest."""
    manifests = rendered["cluster"]
    worker = pick(manifests, "Deployment", "worker")
    worker["spec"]["template"]["spec"]["containers"][0]["readinesProbe"] = {}
    with pytest.raises(Exception, match="readinesProbe"):
        check(worker)
    service = pick(manifests, "Service", "api")
    service["spec"]["ports"][0]["port"] = "http"
    with pytest.raises(Exception, match="integer"):
        check(service)
    scaler = pick(manifests, "ScaledObject", "worker")
    scaler["spec"]["maxReplicas"] = 3
    with pytest.raises(jsonschema.ValidationError):
        check(scaler)


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_containers_are_closed_and_limited(
    rendered: dict[str, list[Manifest]], overlay: str
) -> None:
    for workload in workloads(rendered[overlay]):
        pod = workload["spec"]["template"]["spec"]
        assert pod["automountServiceAccountToken"] is False
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        for container in pod["containers"]:
            security = container["securityContext"]
            assert security["readOnlyRootFilesystem"] is True
            assert security["allowPrivilegeEscalation"] is False
            assert security["capabilities"] == {"drop": ["ALL"]}
            assert {"cpu", "memory"} <= container["resources"]["limits"].keys()
            assert "livenessProbe" in container


def test_uid_is_that_of_the_image(rendered: dict[str, list[Manifest]]) -> None:
    dockerfile = (REPOSITORY / "docker" / "Dockerfile").read_text()
    user = re.search(r"^USER (\d+):(\d+)$", dockerfile, re.MULTILINE)
    assert user is not None
    for name in ("api", "worker"):
        pod = pick(rendered["cluster"], "Deployment", name)["spec"]["template"]["spec"]
        assert pod["securityContext"]["runAsUser"] == int(user[1])
        assert pod["securityContext"]["runAsGroup"] == int(user[2])


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_settings_are_ones_that_the_code_reads(
    rendered: dict[str, list[Manifest]], overlay: str
) -> None:
    known = {f"SMSR_{name.upper()}" for name in Settings.model_fields}
    (settings,) = (m["data"] for m in rendered[overlay] if m["kind"] == "ConfigMap")
    ours = {name for name in settings if name.startswith("SMSR_")}
    assert ours <= known
    Settings.model_validate({n.removeprefix("SMSR_").lower(): settings[n] for n in ours})


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_a_service_with_an_ingress_needs_keys(
    rendered: dict[str, list[Manifest]], overlay: str
) -> None:
    assert any(m["kind"] == "Ingress" for m in rendered[overlay])
    (settings,) = (m["data"] for m in rendered[overlay] if m["kind"] == "ConfigMap")
    assert settings["SMSR_ACCESS"] == "keys"


def test_a_worker_has_time_to_hand_its_job_back(rendered: dict[str, list[Manifest]]) -> None:
    (settings,) = (m["data"] for m in rendered["cluster"] if m["kind"] == "ConfigMap")
    pod = pick(rendered["cluster"], "Deployment", "worker")["spec"]["template"]["spec"]
    grace = float(settings["SMSR_SHUTDOWN_GRACE_SECONDS"])
    assert pod["terminationGracePeriodSeconds"] >= grace + 30


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_autoscaler_counts_the_keys_of_the_queue(
    rendered: dict[str, list[Manifest]], overlay: str
) -> None:
    scaler = pick(rendered[overlay], "ScaledObject", "worker")["spec"]
    counted = {t["name"]: t["metadata"]["listName"] for t in scaler["triggers"]}
    assert counted == {"waiting": f"{PREFIX}:jobs:queued", "running": f"{PREFIX}:jobs:running"}
    assert set(re.findall(r"[a-z]+", scaler["advanced"]["scalingModifiers"]["formula"])) == set(
        counted
    )
    worker = pick(rendered[overlay], "Deployment", scaler["scaleTargetRef"]["name"])
    container = worker["spec"]["template"]["spec"]["containers"][0]
    (settings,) = (m for m in rendered[overlay] if m["kind"] == "ConfigMap")
    assert {"configMapRef": {"name": settings["metadata"]["name"]}} in container["envFrom"]
    for trigger in scaler["triggers"]:
        assert trigger["metadata"]["addressFromEnv"] in settings["data"]
        tls = settings["data"]["REDIS_SCHEME"] == "rediss"
        assert trigger["metadata"]["enableTLS"] == str(tls).lower()


def test_network_is_closed_but_for_named_ways(rendered: dict[str, list[Manifest]]) -> None:
    manifests = rendered["cluster"]
    deny = pick(manifests, "NetworkPolicy", "deny")["spec"]
    assert deny == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    redis = pick(manifests, "NetworkPolicy", "redis")["spec"]
    assert [rule["ports"] for rule in redis["ingress"]] == [[{"port": 6379, "protocol": "TCP"}]]
    external = pick(rendered["external-redis"], "NetworkPolicy", "application")["spec"]
    (settings,) = (m["data"] for m in rendered["external-redis"] if m["kind"] == "ConfigMap")
    port = int(settings["REDIS_ADDRESS"].rpartition(":")[2])
    assert {"ports": [{"port": port, "protocol": "TCP"}]} in external["egress"]
