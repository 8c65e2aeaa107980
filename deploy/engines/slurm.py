"""Slurm: one job for hub, learner, evaluator and recorder, and an array of actors.

The first job runs `deploy.run_local` without actors and the tasks of the array run `deploy.actors`,
so all processes are supervised as on one machine. The first job ends when the run is done.
"""

from __future__ import annotations

import shlex
from typing import Final

from deploy.engines.plan import MADE_BY, Plan
from deploy.processes import STOP_SIGNAL, Program, programs
from proto.keys import Role

WARNING_S: Final = 45
"""Time that a job has left after its processes were stopped."""

# A signal ends `wait` early, so it is called again as long as the process lives.
_WAIT: Final = """\
status=0
while true; do
    wait "$child"
    status=$?
    kill -0 "$child" 2>/dev/null || break
done
"""


def slurm_files(plan: Plan) -> dict[str, str]:
    """Return the files by name. Their paths are relative to the folder from which one submits."""
    all_programs = programs(plan.config, plan.out / "config.yaml", plan.actors, vmdnn=plan.vmdnn)
    services = [program for program in all_programs if program.role is not Role.ACTOR]
    actors = [program for program in all_programs if program.role is Role.ACTOR]
    return {
        "config.yaml": plan.config_text,
        "services.sbatch": _services(plan, services, actors),
        **{f"{actor.name}.sbatch": _actors(plan, actor) for actor in actors},
        "submit.sh": _submit(plan, actors),
    }


def _job_name(plan: Plan, name: str = "") -> str:
    return f"vmdnn-{plan.config.run.name}" + (f"-{name}" if name else "")


def _head(name: str, output: str, *, threads: int, memory_mib: int, stop_within_s: int) -> str:
    return f"""\
#!/bin/bash
# {MADE_BY.format("slurm")}
#SBATCH --job-name={name}
#SBATCH --output={name}-{output}.log
#SBATCH --open-mode=append
#SBATCH --cpus-per-task={threads}
#SBATCH --mem={memory_mib}M
#SBATCH --requeue
#SBATCH --signal=B:USR1@{stop_within_s + WARNING_S}
"""


def _handlers(job: str) -> str:
    """What to do when the time of a job is nearly over, and when it is cancelled."""
    return f"""\
requeue=
stop() {{ [[ -z "${{child:-}}" ]] || kill -s {STOP_SIGNAL} "$child"; }}
trap 'requeue={job}; stop' USR1
trap stop {STOP_SIGNAL}
"""


def _services(plan: Plan, services: list[Program], actors: list[Program]) -> str:
    names = ",".join(_job_name(plan, actor.name) for actor in actors)
    command = shlex.join(
        [
            *(plan.python, "-m", "deploy.run_local", "--config", str(plan.out / "config.yaml")),
            *("--actors", "0", "--set", f"hub.endpoint={plan.everywhere}", *plan.admission),
        ]
    )
    head = _head(
        _job_name(plan),
        "%j",
        threads=sum(program.threads for program in services),
        memory_mib=sum(program.memory_mib for program in services),
        stop_within_s=sum(program.stop_within_s for program in services),
    )
    return f"""\
{head}
# Hub, learner, evaluator and recorder. Before its time is over they are stopped, and save; then
# the job is queued again. When the run is done or this job is cancelled, its actors end too.

actors={names}
{_handlers('"$SLURM_JOB_ID"')}
if ((${{SLURM_RESTART_COUNT:-0}})); then  # perhaps on another host
    squeue --noheader --user="$(id -un)" --name="$actors" --states=RUNNING --format=%A |
        xargs --no-run-if-empty --max-args=1 scontrol requeue
fi
{command} &
child=$!
{_WAIT}
[[ -z "$requeue" ]] || exec scontrol requeue "$requeue"
scancel --user="$(id -un)" --name="$actors"
exit "$status"
"""


def _actors(plan: Plan, actor: Program) -> str:
    backend = actor.command[actor.command.index("--config") + 2 :]
    command = shlex.join(
        [
            *(plan.python, "-m", "deploy.actors", "--config", str(plan.out / "config.yaml")),
            *(*backend, *plan.admission),
        ]
    )
    head = _head(
        _job_name(plan, actor.name),
        "%A-%a",
        threads=actor.threads,
        memory_mib=actor.memory_mib,
        stop_within_s=actor.stop_within_s,
    )
    return f"""\
{head}#SBATCH --array=1-{actor.processes}

# One actor for each task of the array. The first argument is the id of the job of the hub.

{_handlers('"${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"')}
while true; do
    host="$(squeue --noheader --jobs="$1" --format=%B)" && [[ -n "$host" ]] || exit 0
    [[ "$host" == *n/a* ]] || break
    sleep 10 &  # the job of the hub is queued again
    child=$!
    wait "$child"
    [[ -z "$requeue" ]] || exec scontrol requeue "$requeue"
done
{command} --connect "{plan.link}/$host:{plan.port}" --id "{actor.name}-$SLURM_ARRAY_TASK_ID" &
child=$!
{_WAIT}
[[ -z "$requeue" ]] || exec scontrol requeue "$requeue"
exit "$status"
"""


def _submit(plan: Plan, actors: list[Program]) -> str:
    submits = "\n".join(
        'sbatch --dependency="after:$services" "$@"'
        f' {shlex.quote(str(plan.out))}/{actor.name}.sbatch "$services"'
        for actor in actors
    )
    return f"""\
#!/bin/bash
# {MADE_BY.format("slurm")}
# Submits the run {plan.config.run.name}.
# Arguments, such as --partition=NAME --time=12:00:00, go to every sbatch.
set -euo pipefail
services="$(sbatch --parsable "$@" {shlex.quote(str(plan.out))}/services.sbatch)"
services="${{services%%;*}}"
echo "hub, learner, evaluator and recorder: job $services"
{submits}
"""
