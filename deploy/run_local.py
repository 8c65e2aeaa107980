"""Plays a run on this machine: starts all processes, shows their state, stops them, reports."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

from deploy.supervision import BAD_INPUT, ProcessState, Program, Supervisor
from proto.bus import Bus, open_bus
from proto.config import Config, load_config
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import METRICS_PERIOD_S
from proto.metrics import EvaluatorMetrics, LearnerMetrics, PolicyScore, SuiteScore
from services.arguments.common import config_argument, integer
from services.board import Board, RunView
from services.machine.ports import port_trouble
from services.terminal.display import display
from services.terminal.run_words import success_words

DEFAULT_CONFIG: Final = Path(__file__).parent / "config" / "experiment1.yaml"
VMDNN: Final = str(Path(sys.executable).with_name("vmdnn"))

HUB_WITHIN_S: Final = 30.0
TOO_MANY_CRASHES: Final = 5
TOO_SHORT_S: Final = 60.0
"""A process that crashes TOO_MANY_CRASHES times within this time ends the run."""


class ProcessFailedError(Exception):
    """A process has ended for good or crashes repeatedly; the message has the end of its log."""

    def __init__(self, process: ProcessState, problem: str) -> None:
        lines = process.log.read_text(errors="replace").splitlines() if process.log.exists() else []
        last = "\n".join(f"    {line}" for line in lines[-12:])
        super().__init__(f"{process.name} {problem}; the end of {process.log}:\n{last}")
        self.exit_status = BAD_INPUT if process.exit_status == BAD_INPUT else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Play a run until it is done or is to stop.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status.
    """
    arguments = _parser().parse_args(argv)
    try:
        overrides = list(arguments.overrides)
        if arguments.backend is not None:
            overrides.append(f"simulator.backend={arguments.backend}")
        config = load_config(arguments.config, overrides)
        actors = actors_of(arguments.actors, config)
        check_actors(actors, config)
        if trouble := port_trouble(config.hub.endpoint):
            raise UserError(trouble)
        run(config, actors, Console())
    except UserError as error:
        print(f"run_local: {error}", file=sys.stderr)
        return BAD_INPUT
    except ProcessFailedError as error:
        print(f"run_local: {error}", file=sys.stderr)
        return error.exit_status
    return 0


def actors_of(given: Mapping[str, int] | int | None, config: Config) -> Mapping[str, int]:
    """Return the number of actors by simulator.

    Args:
        given: numbers by simulator; a number of actors with `simulator.backend`; or None for one
            actor for each core, which uses the processor time that the learner leaves.
        config: the configuration.
    """
    if isinstance(given, Mapping):
        return given
    number = len(os.sched_getaffinity(0)) if given is None else given
    return {config.simulator.backend: number}


def check_actors(actors: Mapping[str, int], config: Config) -> None:
    """Check that there is an actor for every suite and for the tutor.

    Without any actor here, all are expected to join from elsewhere; `NAME=0` says so of one
    simulator.

    Raises:
        UserError: no actor has a simulator that the configuration names.
    """
    if not any(actors.values()):
        return
    wanted = [f"{backend}=1" for backend in _backends_of(config)]
    advice = (
        f"start one with --actors {','.join(wanted)}, or write 0 in place of 1 if such actors join"
        " from elsewhere"
    )
    for suite in (*config.suites, *config.practised_suites()):
        if suite.backend not in actors:
            raise UserError(
                f"no actor has the simulator {suite.backend} of the suite {suite.name}; {advice}"
            )
    if not set(config.tutoring_backends) & set(actors):
        names = " or ".join(config.tutoring_backends)
        raise UserError(f"no actor has the simulator {names} of tutor.backends; {advice}")


def _backends_of(config: Config) -> list[str]:
    """Return the names of all simulators that a run needs."""
    suites = (suite.backend for suite in config.suites)
    return list(dict.fromkeys([config.simulator.backend, *config.tutoring_backends, *suites]))


def run(config: Config, actors: Mapping[str, int], console: Console) -> None:
    """Play a run until it is done or this process is to stop.

    Args:
        config: the configuration of the run.
        actors: number of actors by simulator.
        console: shows the state of the run.

    Raises:
        UserError: the run's folder cannot be used.
        ProcessFailedError: a process has ended for good or crashes repeatedly.
    """
    started_s = time.monotonic()
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    exists = (config.run_folder / "config.yaml").exists()
    logs = config.run_folder / "logs"
    # The learner writes config.yaml of the run, after it has checked that the run can continue.
    file = logs / "config.yaml"
    config.save(file)
    number = sum(actors.values())
    console.print(
        f"{'continuing' if exists else 'starting'} run {config.run.name} with {number} "
        f"{'actor' if number == 1 else 'actors'} in {config.run_folder}",
        highlight=False,
    )
    with Supervisor(programs(config, file, actors), logs) as supervisor:
        supervisor.start("hub")
        with _connect(config, supervisor, lifecycle) as bus:
            for program in supervisor.programs[1:]:
                supervisor.start(program.name)
            view = _follow(Board(bus), supervisor, lifecycle, console)
        console.print("stopping", highlight=False)
    text = summary(view, config, time.monotonic() - started_s)
    console.print(text, highlight=False, soft_wrap=True)


def programs(config: Config, file: Path, actors: Mapping[str, int]) -> list[Program]:
    """Return the programs of a run, in the order in which they are started.

    Args:
        config: the configuration of the run.
        file: its file.
        actors: number of actors by simulator.
    """

    def vmdnn(role: Role) -> tuple[str, ...]:
        return (VMDNN, role.value, "--config", str(file))

    started = [
        Program("hub", vmdnn(Role.HUB)),
        Program(
            "learner",
            vmdnn(Role.LEARNER),
            threads=config.learner.threads,
            stop_within_s=30,  # it saves a checkpoint
        ),
        Program("evaluator", vmdnn(Role.EVALUATOR)),
        Program("recorder", vmdnn(Role.RECORDER)),
    ]
    present = {backend: number for backend, number in actors.items() if number}
    for backend, number in present.items():
        chosen = () if backend == config.simulator.backend else ("--backend", backend)
        name = "actor" if len(present) == 1 else f"actor-{re.sub('[^A-Za-z0-9]+', '-', backend)}"
        started.append(Program(name, (*vmdnn(Role.ACTOR), *chosen), processes=number))
    return started


def is_done(view: RunView) -> bool:
    """Return whether learner and evaluator report that the run is done."""
    learners = view.living(LearnerMetrics)
    evaluators = view.living(EvaluatorMetrics)
    if not learners or not evaluators:
        return False
    return all(m.done for m in learners) and all(m.done for m in evaluators)


class Crashes:
    """Detects crashes of processes, which supervisord starts again."""

    def __init__(self) -> None:
        """Start with no crashes."""
        self._started_s: dict[str, int] = {}
        self._crashes_s: defaultdict[str, deque[int]] = defaultdict(
            lambda: deque(maxlen=TOO_MANY_CRASHES)
        )

    def update(self, processes: Iterable[ProcessState]) -> list[ProcessState]:
        """Return the processes that were started again since the last call.

        Raises:
            ProcessFailedError: a process has ended for good or crashes repeatedly.
        """
        restarted = []
        for process in processes:
            if process.gave_up:
                raise ProcessFailedError(process, "has ended and is not started again")
            before_s = self._started_s.get(process.name, 0)
            self._started_s[process.name] = process.started_s
            if before_s and process.started_s != before_s:
                restarted.append(process)
                crashes_s = self._crashes_s[process.name]
                crashes_s.append(process.started_s)
                if len(crashes_s) == TOO_MANY_CRASHES and _span(crashes_s) < TOO_SHORT_S:
                    raise ProcessFailedError(process, "crashes repeatedly")
        return restarted


def summary(view: RunView, config: Config, wall_s: float) -> str:
    """Return the result of a run in a few lines."""
    minutes, seconds = divmod(round(wall_s), 60)
    lines = [
        f"run {config.run.name}: {view.policy_version} policy versions"
        f" in {minutes} min {seconds} s",
        *_suite_lines(view.suites),
        f"files: {config.run_folder}/ with config.yaml, tutoring, checkpoints, policies, "
        "rollouts, evaluation, logs",
    ]
    return "\n".join(lines)


def _follow(
    board: Board, supervisor: Supervisor, lifecycle: Lifecycle, console: Console
) -> RunView:
    """Show the state of the run until it is done or is to stop; return the last state."""
    crashes = Crashes()
    with display(console) as show:
        while True:
            view = board.view()
            show(view)
            for process in crashes.update(supervisor.processes()):
                console.print(f"{process.name} crashed and was started again; see {process.log}")
            if lifecycle.stopping or is_done(view):
                return view
            lifecycle.wait(METRICS_PERIOD_S)


def _connect(config: Config, supervisor: Supervisor, lifecycle: Lifecycle) -> Bus:
    deadline = time.monotonic() + HUB_WITHIN_S
    crashes = Crashes()
    while True:
        try:
            return open_bus(config.hub, config.run.name, Role.WATCH, f"run-local-{os.getpid()}")
        except UserError:
            crashes.update(supervisor.processes())
            if lifecycle.stopping or time.monotonic() > deadline:
                raise


def _suite_lines(suites: Sequence[SuiteScore]) -> list[str]:
    """Return the result of each suite in a few lines; with one suite, without its name."""
    named = len(suites) > 1
    lines = [
        f"{suite.name}, {line}" if named and not line.startswith(" ") else line
        for suite in suites
        for line in _score_lines(suite)
    ]
    return lines or ["no trial was counted"]


def _newest_counted(suite: SuiteScore) -> PolicyScore | None:
    """Return the score of the newest policy with all trials counted, or else with any counted."""
    scores = suite.policies
    complete = [score for score in scores if score.trials >= suite.trials]
    return max(complete or scores, key=lambda score: score.version, default=None)


def _score_lines(suite: SuiteScore) -> list[str]:
    score = _newest_counted(suite)
    if score is None:
        return ["no trial was counted" + (f": {suite.unplayable}" if suite.unplayable else "")]
    counted = f"{score.trials} of {suite.trials} trials counted"
    return [
        f"policy {score.version}, {counted}; successes, rate and its 95 % interval:",
        *(
            f"  {name:8} {success_words(success, score.trials)}"
            for name, success in (
                ("lenient", score.lenient),
                ("strict", score.strict),
                ("precise", score.precise),
            )
        ),
    ]


def _span(times_s: Sequence[int]) -> int:
    return times_s[-1] - times_s[0]


def _actors(text: str) -> Mapping[str, int] | int:
    """Parse a number of actors, or numbers by simulator such as `sapien=1,mujoco=1`."""
    number = integer(0)
    if "=" not in text:
        return int(number(text))
    actors: dict[str, int] = {}
    for part in text.split(","):
        backend, equals, count = part.strip().rpartition("=")
        if not equals or not backend or backend in actors:
            raise argparse.ArgumentTypeError(
                f"{text!r}: write a number, or one for each simulator such as sapien=1,mujoco=1"
            )
        actors[backend] = number(count)
    return actors


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="run_local", add_help=False)  # run_local.sh prints it
    parser.add_argument("--config", type=config_argument, default=DEFAULT_CONFIG)
    parser.add_argument("--actors", type=_actors)
    parser.add_argument("--backend")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    return parser


if __name__ == "__main__":
    sys.exit(main())
