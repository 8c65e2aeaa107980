"""Plays a run on this machine: starts all processes, shows their state, stops them, reports."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from textwrap import wrap
from typing import Final

from rich.console import Console

from deploy.exit_status import exit_status
from deploy.processes import VMDNN, Program, programs
from deploy.supervision import Supervisor, Watchdog
from learner.pretrained import PREFIX, pretrained_names
from proto.bus import Bus, NoHubError, open_bus
from proto.config import Config, load_config
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.machine import usable_cores
from proto.membership import METRICS_PERIOD_S
from proto.metrics import EvaluatorMetrics, LearnerMetrics, PolicyScore, SuiteScore
from proto.outbox import messages_of_run
from proto.permissions import Holder
from proto.run_locks import owned_run
from proto.security import certificate_for
from services.arguments.common import built_in_names, config_argument, integer
from services.arguments.process import PRIVATE
from services.board import Board, RunView
from services.dashboard.ports import listening_socket, page_address
from services.machine.ports import port_trouble
from services.terminal.display import Show, display
from services.terminal.run_progress import ProgressMeter
from services.terminal.run_words import duration_words, success_words

DEFAULT_CONFIG: Final = Path(__file__).parent / "config" / "experiment1.yaml"
RECEIPTS_WITHIN_S: Final = 60.0
"""A run that is done waits so long for messages in outboxes; a killed actor is back before."""
DRAIN_S: Final = 10
"""An actor that is to stop waits so long for receipts; the receivers are stopped after it."""
_NARROW: Final = 79
FEW_CASES: Final = 10
"""With so few tutored cases a run teaches nothing, and says so at its end."""


def main(argv: Sequence[str] | None = None) -> int:
    """Play a run until it is done or is to stop.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status.
    """
    arguments = _parser().parse_args(argv)
    return exit_status(
        "run_local", lambda: _main(arguments), again="the same command continues the run"
    )


def _main(arguments: argparse.Namespace) -> None:
    overrides = list(arguments.overrides)
    if arguments.backend is not None:
        overrides.append(f"simulator.backend={arguments.backend}")
    config = load_config(arguments.config, overrides)
    actors = actors_of(arguments.actors, config)
    check_actors(actors, config)
    check_can_be_done(config)
    certificate_for(config.hub, Holder.HUB)
    if trouble := port_trouble(config.hub.endpoint):
        raise UserError(trouble)
    run(config, actors, RunConsole())


class RunConsole(Console):
    """A console whose reader may end: the run goes on."""

    def on_broken_pipe(self) -> None:
        """Print nothing more."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def actors_of(given: Mapping[str, int] | int | None, config: Config) -> Mapping[str, int]:
    """Return the number of actors by simulator.

    Args:
        given: numbers by simulator; a number of actors with `simulator.backend`; or None for one
            actor for each core, which uses the processor time that the learner leaves.
        config: the configuration.
    """
    if isinstance(given, Mapping):
        return given
    number = usable_cores() if given is None else given
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
        UserError: the run's folder cannot be used, or the run is being played already.
        ProcessFailedError: a process can never work.
        SupervisorEndedError: supervisord was killed.
    """
    dashboard = dashboard_place(config)
    with owned_run(config.run_folder):  # nothing of the run is touched before
        _run(config, actors, dashboard, console)


def _run(
    config: Config,
    actors: Mapping[str, int],
    dashboard: tuple[str, int] | None,
    console: Console,
) -> None:
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
        soft_wrap=True,
    )
    if dashboard is not None:
        console.print(f"watch it at {page_address(*dashboard)}", highlight=False, soft_wrap=True)
    started = [_drained(program) for program in programs(config, file, actors)]
    if dashboard is not None:
        started.append(dashboard_program(file, *dashboard))

    def tell(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    with Supervisor(started, logs) as supervisor:
        watchdog = Watchdog(supervisor, tell)
        supervisor.start("hub")
        view = None
        with _connect(config, watchdog, lifecycle) or nullcontext() as bus:
            if bus is not None:
                for program in supervisor.programs[1:]:
                    supervisor.start(program.name)
                meter = ProgressMeter(started_s=started_s)
                with display(console, meter, _expected(actors)) as show:
                    follower = _Follower(Board(bus), watchdog, lifecycle, show)
                    view = follower.follow_until_done()
                    follower.wait_for_receipts(config.run_folder, tell)
        tell("stopping")
    if left := messages_of_run(config.run_folder):
        outbox = config.run_folder / "outbox"
        words = _message_words(len(left))
        tell(f"without a receipt stay {words} in {outbox}; the same command sends what is there")
    if view is not None:
        tell(summary(view, config, time.monotonic() - started_s))


def dashboard_place(config: Config) -> tuple[str, int] | None:
    """Return address and port of the page that shows the run; None if it is switched off.

    Raises:
        UserError: it cannot be opened at the address of the configuration.
    """
    if not config.dashboard.enabled:
        return None
    host = config.dashboard.host
    with listening_socket(host, config.dashboard.port, or_another=True) as probe:
        return host, int(probe.getsockname()[1])


def dashboard_program(file: Path, host: str, port: int) -> Program:
    """Return the program that serves the page of a run.

    Args:
        file: the configuration of the run.
        host: address at which the page can be opened.
        port: its port.
    """
    place = ("--host", host, "--port", str(port))
    command = (VMDNN, "dashboard", "--config", str(file), *place)
    return Program("dashboard", command)


def is_done(view: RunView) -> bool:
    """Return whether learner and evaluator report that the run is done."""
    learners = view.living(LearnerMetrics)
    evaluators = view.living(EvaluatorMetrics)
    if not learners or not evaluators:
        return False
    return all(m.done for m in learners) and all(m.done for m in evaluators)


def check_can_be_done(config: Config) -> None:
    """Check that the condition `done` of a configuration can be reached.

    Raises:
        UserError: it asks for more policy versions than there will be.
    """
    wanted, possible = config.done.policy_versions, config.policy_versions
    if wanted is not None and wanted > possible:
        raise UserError(
            f"done.policy_versions: {wanted} can never be reached, because this configuration "
            f"gives {possible} policy versions (learner.epochs, learner.publish_every_epochs, "
            "learner.corrections.rounds): set it to at most this number"
        )


def summary(view: RunView, config: Config, wall_s: float) -> str:
    """Return the result of a run in a few lines."""
    lines = [
        f"run {config.run.name}: {view.policy_version} policy versions in {duration_words(wall_s)}",
        *_suite_lines(view.suites),
        *_untried_lines(view, config),
        *_expectation_lines(config),
        f"files: {config.run_folder}/ with config.yaml, tutoring, checkpoints, policies, "
        "rollouts, evaluation, logs",
    ]
    return "\n".join(part for line in lines for part in _wrapped(line))


def _wrapped(line: str) -> list[str]:
    """Break a line between words where a narrow terminal would break it anywhere.

    Indented lines stay whole, because they are commands to be copied.
    """
    if line.startswith(" "):
        return [line]
    return wrap(line, _NARROW, break_long_words=False, break_on_hyphens=False)


def _untried_lines(view: RunView, config: Config) -> list[str]:
    """Say which policy versions before the newest one have fewer trials, and why."""
    if not view.suites or not view.policy_version:
        return []
    suite = view.suites[0]
    counted = {score.version: score.trials for score in suite.policies}
    fewer = [
        version
        for version in range(1, view.policy_version)
        if counted.get(version, 0) < suite.trials
    ]
    if not fewer:
        return []
    words = f"version {fewer[0]}" if len(fewer) == 1 else f"{len(fewer)} earlier versions"
    verb = "has" if len(fewer) == 1 else "have"
    return [
        f"{words} {verb} fewer than {suite.trials} trials, because a newer version came first;"
        " to play the rest:",
        f"  vmdnn evaluate --run {config.run_folder} --policy-version all",
    ]


def _expectation_lines(config: Config) -> list[str]:
    """Say that little success is to be expected of a run with few tutored cases; and what next."""
    cases = config.learner.cases
    if cases is None or len(cases) > FEW_CASES:
        return []
    return [
        f"no success is expected here: {len(cases)} tutored cases and {config.learner.epochs}"
        " epochs show that everything works, they do not teach the task",
        *_next_steps(config.task.name),
    ]


def _next_steps(task: str) -> list[str]:
    """Return commands that show success in a task."""
    trained = f"{PREFIX}{task}"
    steps = []
    if trained in pretrained_names():
        steps += [
            "to see a trained policy now:",
            f"  vmdnn evaluate --policy {trained} --task {task} --trials 3 --video trials.mp4",
        ]
    if task in built_in_names():
        steps += [
            "to train a good policy, tutor all cases:",
            f"  deploy/run_local.sh --config {task}",
        ]
    return steps


def _expected(actors: Mapping[str, int]) -> Mapping[Role, int]:
    """Return the number of processes by role that are started, besides the hub."""
    others = dict.fromkeys((Role.LEARNER, Role.EVALUATOR, Role.RECORDER), 1)
    return {**others, Role.ACTOR: sum(actors.values())}


class _Follower:
    """Looks after a run and shows its state."""

    def __init__(self, board: Board, watchdog: Watchdog, lifecycle: Lifecycle, show: Show) -> None:
        self._board = board
        self._watchdog = watchdog
        self._lifecycle = lifecycle
        self._show = show

    def follow_until_done(self) -> RunView:
        """Go on until the run is done or is to stop; return the last state."""
        while True:
            view = self._look()
            if self._lifecycle.stopping or is_done(view):
                return view
            self._lifecycle.wait(METRICS_PERIOD_S)

    def wait_for_receipts(self, run_folder: Path, tell: Callable[[str], None]) -> None:
        """Wait until what is in outboxes now has been received, or the time is up.

        What actors play meanwhile is not waited for here: they send it before they end.
        """
        waiting = messages_of_run(run_folder)
        if not waiting or self._lifecycle.stopping:
            return
        tell(f"done; waiting for the receipts of {_message_words(len(waiting))} in outboxes")
        over_s = time.monotonic() + RECEIPTS_WITHIN_S
        while waiting and not self._lifecycle.stopping and time.monotonic() < over_s:
            self._lifecycle.wait(METRICS_PERIOD_S)
            self._look()
            waiting &= messages_of_run(run_folder)

    def _look(self) -> RunView:
        view = self._board.view()
        self._show(view)
        self._watchdog.look_unless_stopping(self._lifecycle)
        return view


def _message_words(number: int) -> str:
    return "one message" if number == 1 else f"{number} messages"


def _drained(program: Program) -> Program:
    """The program, such that an actor that is to stop waits for its receipts first."""
    if program.role is not Role.ACTOR:
        return program
    command = (*program.command, "--drain", str(DRAIN_S))
    return replace(program, command=command, stop_within_s=program.stop_within_s + DRAIN_S)


def _connect(config: Config, watchdog: Watchdog, lifecycle: Lifecycle) -> Bus | None:
    """Connect to the hub, which has been started; None if this process was asked to stop."""
    while not lifecycle.stopping:
        watchdog.look_unless_stopping(lifecycle)
        try:
            return open_bus(config.hub, config.run.name, Role.WATCH, f"run-local-{os.getpid()}")
        except NoHubError:
            lifecycle.wait(METRICS_PERIOD_S)
    return None


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
    if not score.lenient.successes:
        return [f"policy {score.version}, {counted}: no success"]
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


def parse_actors(text: str) -> Mapping[str, int] | int:
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
    parser.add_argument("--actors", type=parse_actors)
    parser.add_argument("--backend")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    return parser


if __name__ == "__main__":
    os.umask(PRIVATE)
    sys.exit(main())
