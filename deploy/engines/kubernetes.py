"""Kubernetes: a kustomize base with a StatefulSet for each service and a Deployment of actors.

What a cluster adds, such as certificates or another configuration, is an overlay.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from deploy.engines.plan import DRAIN_S, Plan, yaml_text
from deploy.processes import FIRST_BEAT_WITHIN_S, STUCK_AFTER_S, Program, programs
from proto.keys import Role
from services.arguments.process import HEARTBEAT_FILE

IMAGE: Final = "vmdnn"
HUB: Final = "vmdnn-hub"
CONFIG: Final = "/etc/vmdnn/config.yaml"
DATA: Final = "/data"
CERTIFICATES: Final = "/certificates"
HEARTBEAT: Final = "/tmp/heartbeat"
GROUP: Final = 65532
"""Group of the volumes; the image's user is in it."""
FRESH: Final = f"test -n \"$(find {HEARTBEAT} -newermt '-{STUCK_AFTER_S} seconds')\""
"""Shell command that succeeds if the process has had a heartbeat lately."""

Manifest = Mapping[str, Any]


def kubernetes_files(plan: Plan) -> dict[str, str]:
    """Return the files of the base by name."""
    files = {"config.yaml": plan.config_text}
    for program in programs(plan.config, Path(CONFIG), plan.actors, vmdnn="vmdnn"):
        documents = [_workload(program, plan)]
        if program.role is Role.HUB:
            documents.append(_service(plan))
        files[f"{program.name}.yaml"] = yaml_text("kubernetes", documents)
    files["network-policy.yaml"] = yaml_text("kubernetes", _network_policies(plan))
    resources = sorted(name for name in files if name != "config.yaml")
    files["kustomization.yaml"] = yaml_text("kubernetes", [_kustomization(resources)])
    return files


def _kustomization(resources: list[str]) -> Manifest:
    return {
        "apiVersion": "kustomize.config.k8s.io/v1beta1",
        "kind": "Kustomization",
        "resources": resources,
        "configMapGenerator": [{"name": "vmdnn-config", "files": ["config.yaml"]}],
        "images": [{"name": IMAGE, "newTag": "latest"}],
    }


def _labels(program: Program) -> dict[str, str]:
    return {"app.kubernetes.io/name": "vmdnn", "app.kubernetes.io/component": program.name}


def _workload(program: Program, plan: Plan) -> Manifest:
    actor = program.role is Role.ACTOR
    labels = _labels(program)
    spec: dict[str, Any] = {
        "replicas": program.processes,
        "selector": {"matchLabels": labels},
        "template": {"metadata": {"labels": labels}, "spec": _pod(program, plan)},
    }
    if not actor:
        spec["serviceName"] = HUB
    if program.volume_gib:
        claim = {
            "accessModes": ["ReadWriteOnce"],
            "resources": {"requests": {"storage": f"{program.volume_gib}Gi"}},
        }
        spec["volumeClaimTemplates"] = [{"metadata": {"name": "data"}, "spec": claim}]
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment" if actor else "StatefulSet",
        "metadata": {"name": f"vmdnn-{program.name}", "labels": labels},
        "spec": spec,
    }


def _pod(program: Program, plan: Plan) -> Manifest:
    volumes: list[Manifest] = [
        {"name": "config", "configMap": {"name": "vmdnn-config"}},
        {"name": "tmp", "emptyDir": {}},
        {
            "name": "certificates",
            "secret": {
                "secretName": f"vmdnn-{program.role}-certificates",
                "optional": True,
                "defaultMode": 0o440,
            },
        },
    ]
    if not program.volume_gib:
        volumes.append({"name": "data", "emptyDir": {}})
    drain_s = DRAIN_S if program.role is Role.ACTOR else 0
    return {
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": drain_s + program.stop_within_s,
        "securityContext": {
            "runAsNonRoot": True,
            "fsGroup": GROUP,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [_container(program, plan)],
        "volumes": volumes,
    }


def _container(program: Program, plan: Plan) -> Manifest:
    hub = program.role is Role.HUB
    endpoint = plan.everywhere if hub else f"{plan.link}/{HUB}:{plan.port}"
    words = ["--connect", "$(HUB)", "--set", f"run.folder={DATA}"]
    words += ["--set", f"hub.certificates={CERTIFICATES}", "--set", "hub.insecure=$(INSECURE)"]
    environment: list[Manifest] = [
        {"name": "HUB", "value": endpoint},
        {"name": "INSECURE", "value": str(plan.insecure).lower()},
        {"name": "OMP_NUM_THREADS", "value": str(program.threads)},
        {"name": HEARTBEAT_FILE, "value": HEARTBEAT},
    ]
    if program.role is Role.ACTOR:
        words += ["--id", "$(POD)", "--drain", str(DRAIN_S)]
        pod = {"fieldRef": {"fieldPath": "metadata.name"}}
        environment.insert(0, {"name": "POD", "valueFrom": pod})
    alive = {"exec": {"command": ["sh", "-c", FRESH]}, "timeoutSeconds": 10}
    container: dict[str, Any] = {
        "name": program.name,
        "image": IMAGE,
        "command": [*program.command, *words],
        "env": environment,
        "resources": {
            "requests": {"cpu": str(program.threads), "memory": f"{program.memory_mib}Mi"},
            "limits": {"cpu": str(program.threads + 1), "memory": f"{program.memory_mib}Mi"},
        },
        "startupProbe": {**alive, "periodSeconds": 5, "failureThreshold": FIRST_BEAT_WITHIN_S // 5},
        "livenessProbe": {**alive, "periodSeconds": 20, "failureThreshold": 2},
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "volumeMounts": [
            {"name": "config", "mountPath": str(Path(CONFIG).parent), "readOnly": True},
            {"name": "certificates", "mountPath": CERTIFICATES, "readOnly": True},
            {"name": "tmp", "mountPath": "/tmp"},
            {"name": "data", "mountPath": DATA},
        ],
    }
    if hub:
        container["ports"] = [{"name": "zenoh", "containerPort": plan.port}]
        container["readinessProbe"] = {"tcpSocket": {"port": "zenoh"}, "periodSeconds": 5}
    return container


def _service(plan: Plan) -> Manifest:
    labels = {"app.kubernetes.io/name": "vmdnn", "app.kubernetes.io/component": "hub"}
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {"name": HUB, "labels": labels},
        "spec": {
            "selector": labels,
            "ports": [{"name": "zenoh", "port": plan.port, "targetPort": "zenoh"}],
        },
    }


def _network_policies(plan: Plan) -> list[Manifest]:
    """Pods of vmdnn reach only the hub and the names of services; only they reach the hub."""
    ours = {"matchLabels": {"app.kubernetes.io/name": "vmdnn"}}
    hub = {"matchLabels": {**ours["matchLabels"], "app.kubernetes.io/component": "hub"}}
    hub_port = [{"protocol": "TCP", "port": plan.port}]
    dns = [{"protocol": protocol, "port": 53} for protocol in ("UDP", "TCP")]

    def policy(name: str, spec: Manifest) -> Manifest:
        return {
            "apiVersion": "networking.k8s.io/v1",
            "kind": "NetworkPolicy",
            "metadata": {"name": name},
            "spec": spec,
        }

    return [
        policy(
            "vmdnn",
            {
                "podSelector": ours,
                "policyTypes": ["Ingress", "Egress"],
                "egress": [{"to": [{"podSelector": hub}], "ports": hub_port}, {"ports": dns}],
            },
        ),
        policy(
            HUB,
            {
                "podSelector": hub,
                "policyTypes": ["Ingress"],
                "ingress": [{"from": [{"podSelector": ours}], "ports": hub_port}],
            },
        ),
    ]
