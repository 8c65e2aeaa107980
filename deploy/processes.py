"""The processes of a run, whatever starts them: supervisord, systemd, Slurm, Kubernetes, Compose.

Each engine is told from here what to start, how to stop it, when to start it again and what it
needs, so that they cannot differ. `deploy.supervision` runs the processes on one machine;
`deploy.manifests` writes the files of the other engines.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from proto.config import Config
from proto.keys import Role

VMDNN: Final = str(Path(sys.executable).with_name("vmdnn"))
"""The command of this environment."""

STOP_SIGNAL: Final = "TERM"
"""Signal that asks a process to end cleanly."""
BAD_INPUT: Final = 2
"""Exit status for bad input; a process that ends with it is not started again."""
STUCK_AFTER_S: Final = 60
"""A process without a heartbeat for this time is killed and started again."""
FIRST_BEAT_WITHIN_S: Final = 300
"""A process that starts on a busy machine needs time until its first heartbeat."""


@dataclass(frozen=True)
class Program:
    """Processes that run the same command.

    Attributes:
        name: name of the process; several processes are called `name-1`, `name-2` and so on.
        command: the command with its arguments.
        threads: number of threads with which each process computes. More threads than cores slow
            all processes down.
        processes: number of processes.
        stop_within_s: time from STOP_SIGNAL to SIGKILL.
        role: what it does in a run; None for a program that takes no part in one.
        memory_mib: memory that one process needs at most.
        volume_gib: size of a volume for what must outlive it; 0 if there is nothing.
    """

    name: str
    command: Sequence[str]
    threads: int = 1
    processes: int = 1
    stop_within_s: int = 15
    role: Role | None = None
    memory_mib: int = 1024
    volume_gib: int = 0


def programs(
    config: Config, file: Path, actors: Mapping[str, int], *, vmdnn: str = VMDNN
) -> list[Program]:
    """Return the programs of a run, in the order in which they are started.

    Args:
        config: the configuration of the run.
        file: its file, as the processes find it.
        actors: number of actors by simulator.
        vmdnn: the command `vmdnn`, as the processes find it.
    """

    def program(role: Role, name: str = "", *words: str, **needs: int) -> Program:
        command = (vmdnn, role.value, "--config", str(file), *words)
        return Program(name or role.value, command, role=role, **needs)

    started = [
        program(Role.HUB, memory_mib=512),
        program(
            Role.LEARNER,
            threads=config.learner.threads,
            stop_within_s=30,  # it saves a checkpoint
            memory_mib=4096,
            volume_gib=10,
        ),
        # They are stopped the other way round: what the evaluator has counted is still recorded.
        program(Role.RECORDER, volume_gib=round(config.recorder.keep.gib) + 5),  # trials are kept
        program(Role.EVALUATOR, volume_gib=1),
    ]
    present = {backend: number for backend, number in actors.items() if number}
    for backend, number in present.items():
        chosen = () if backend == config.simulator.backend else ("--backend", backend)
        name = "actor" if len(present) == 1 else f"actor-{re.sub('[^A-Za-z0-9]+', '-', backend)}"
        started.append(program(Role.ACTOR, name, *chosen, processes=number, memory_mib=2048))
    return started
