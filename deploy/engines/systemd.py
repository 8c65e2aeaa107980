"""systemd: a unit for each process, and a target that starts and stops all of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from deploy.engines.plan import MADE_BY, Plan
from deploy.processes import (
    BAD_INPUT,
    FIRST_BEAT_WITHIN_S,
    STOP_SIGNAL,
    STUCK_AFTER_S,
    Program,
    programs,
)
from proto.keys import Role


def systemd_files(plan: Plan) -> dict[str, str]:
    """Return the files by name. The units are for this machine: their paths are absolute."""
    prefix = f"vmdnn-{plan.config.run.name}"
    files = {"config.yaml": plan.config_text, f"{prefix}.target": _target(plan, prefix)}
    config = plan.out.absolute() / "config.yaml"
    for program in programs(plan.config, config, plan.actors, vmdnn=_absolute(plan.vmdnn)):
        template = "@" if program.role is Role.ACTOR else ""
        files[f"{prefix}-{program.name}{template}.service"] = _unit(program, prefix)
    return files


def _absolute(command: str) -> str:
    return str(Path(command).absolute())


def _target(plan: Plan, prefix: str) -> str:
    wanted = []
    for program in programs(plan.config, plan.out, plan.actors):
        if program.role is Role.ACTOR:
            numbers = range(1, program.processes + 1)
            wanted += [f"{prefix}-{program.name}@{number}.service" for number in numbers]
        else:
            wanted.append(f"{prefix}-{program.name}.service")
    return f"""\
# {MADE_BY.format("systemd")}
[Unit]
Description=vmdnn, run {plan.config.run.name}
Wants={" ".join(wanted)}

[Install]
WantedBy=default.target
"""


def _unit(program: Program, prefix: str) -> str:
    actor = program.role is Role.ACTOR
    hub = "" if program.role is Role.HUB else f"\nAfter={prefix}-hub.service"
    words = [*program.command, *(("--id", f"{program.name}-") if actor else ())]
    return f"""\
# {MADE_BY.format("systemd")}
[Unit]
Description={prefix}: {program.name}{" %i" if actor else ""}
PartOf={prefix}.target{hub}
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={_command(words)}{"%i" if actor else ""}
WorkingDirectory={_plain(str(Path.cwd()))}
Environment=OMP_NUM_THREADS={program.threads}
Restart=always
RestartSec=2
RestartPreventExitStatus={BAD_INPUT}
KillSignal=SIG{STOP_SIGNAL}
TimeoutStartSec={FIRST_BEAT_WITHIN_S}
WatchdogSec={STUCK_AFTER_S}
TimeoutStopSec={program.stop_within_s}
MemoryMax={program.memory_mib}M
"""


def _command(words: Sequence[str]) -> str:
    return " ".join(map(_word, words))


def _word(word: str) -> str:
    plain = _plain(word).replace("$", "$$")
    if re.fullmatch(r"[\w./:=@%$,+-]+", plain):
        return plain
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain(text: str) -> str:
    """Keep systemd from reading `%` as the beginning of a specifier."""
    return text.replace("%", "%%")
