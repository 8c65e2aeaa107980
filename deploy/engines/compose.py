"""Compose: all processes of a run as containers on one machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from deploy.engines.kubernetes import CONFIG, DATA, FRESH, HEARTBEAT, IMAGE
from deploy.engines.plan import Plan, yaml_text
from deploy.processes import FIRST_BEAT_WITHIN_S, STOP_SIGNAL, Program, programs
from proto.keys import Role
from services.arguments.process import HEARTBEAT_FILE

FILE: Final = "compose.yaml"
CONFIG_FILE: Final = "compose-config.yaml"
"""The configuration, beside it: Podman's Compose does not know `configs`."""


def compose_files(plan: Plan) -> dict[str, str]:
    """Return the files by name."""
    started = programs(plan.config, Path(CONFIG), plan.actors, vmdnn="vmdnn")
    composed = {
        "name": f"vmdnn-{plan.config.run.name.lower()}",
        "services": {program.name: _service(program, plan) for program in started},
        "volumes": {_volume(program): {} for program in started if _volume(program)},
    }
    return {FILE: yaml_text("compose", [composed]), CONFIG_FILE: plan.config_text}


def _volume(program: Program) -> str:
    """The volume of a program; all actors share one, so that each can send what others left."""
    return "" if program.role is Role.HUB else f"{program.role}-data"


def _service(program: Program, plan: Plan) -> dict[str, Any]:
    hub = program.role is Role.HUB
    endpoint = plan.everywhere if hub else f"{plan.link}/hub:{plan.port}"
    service: dict[str, Any] = {
        "image": IMAGE,
        "command": [
            *program.command,
            "--connect",
            endpoint,
            "--set",
            f"run.folder={DATA}",
            *plan.admission,
        ],
        "environment": {"OMP_NUM_THREADS": str(program.threads), HEARTBEAT_FILE: HEARTBEAT},
        "volumes": [f"./{CONFIG_FILE}:{CONFIG}:ro"],
        "read_only": True,
        "tmpfs": ["/tmp:mode=1777"],
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        "mem_limit": f"{program.memory_mib}m",
        "restart": "unless-stopped",
        "stop_signal": f"SIG{STOP_SIGNAL}",
        "stop_grace_period": f"{program.stop_within_s}s",
        "healthcheck": {
            "test": ["CMD-SHELL", FRESH.replace("$", "$$")],
            "interval": "20s",
            "start_period": f"{FIRST_BEAT_WITHIN_S}s",
        },
    }
    if volume := _volume(program):
        service["volumes"] += [f"{volume}:{DATA}"]
        service["depends_on"] = ["hub"]
    else:
        service["build"] = {"context": "..", "dockerfile": "deploy/container/Dockerfile"}
    if program.processes > 1:
        # Podman's Compose starts one only, unless it is told the mode, too.
        service["deploy"] = {"mode": "replicated", "replicas": program.processes}
    return service
