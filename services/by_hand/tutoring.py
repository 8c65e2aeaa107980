"""Serves the page on which a person tutors, until Ctrl-C or SIGTERM."""

from __future__ import annotations

import logging
import os
import webbrowser
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Final

from actors.actor import Actor, Assignment
from actors.policies.by_name import make_policy
from actors.simulator import Simulator, make_simulator
from actors.tasks.registry import make_task
from proto.bus import Bus
from proto.config import Config
from proto.episode import Episode, Kind
from proto.lifecycle import Lifecycle
from proto.messages import TutoringCase
from proto.periodic import every
from proto.recordings.episodes import write_episode
from proto.seeds import SEEDS_PER_CASE
from services.by_hand.asked import Asked
from services.by_hand.policy import BY_HAND
from services.by_hand.requests import Choose
from services.by_hand.robot import Robot
from services.by_hand.server import make_app
from services.dashboard.access import Access
from services.dashboard.ports import address_of, listening_socket
from services.dashboard.server import serving
from services.playing.tutoring import Case, save_or_check_config
from services.robot_meshes import robot_meshes

LOG = logging.getLogger(__name__)

HOST: Final = "127.0.0.1"
"""Whoever opens the page moves the robot, so only this machine can open it."""
_TELL_PERIOD_S: Final = 0.5
_DRAIN_S: Final = 10.0
"""What a person has shown is worth waiting for the learner's receipt."""


def tutor_by_hand(
    config: Config, cases: Sequence[Case], folder: Path, port: int | None, policy: str | None
) -> int:
    """Let a person tutor; return how many demonstrations the folder has.

    Args:
        config: the configuration.
        cases: the situations to tutor, in their order.
        folder: where demonstrations are recorded.
        port: port of the page, 0 for any free one; None for `dashboard.port` or the next free one.
        policy: name of the policy that acts and is corrected, see `make_policy`; None if the person
            shows everything.

    Raises:
        UserError: the port is taken, the folder was recorded with other settings, the simulator
            cannot run here, or there is no such policy.
    """
    task = make_task(config.task)
    acting = None if policy is None else make_policy(policy, task)
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    kept = Counter(_cases_in(folder))
    at = next((at for at, case in enumerate(cases) if not kept[case.name]), len(cases) - 1)
    with page(config, port, lifecycle) as robot:
        save_or_check_config(folder, config)
        simulator = make_simulator(config.simulator)
        try:
            while not lifecycle.stopping:
                case = cases[at]
                asked = Asked(
                    case.name,
                    task,
                    case.situation,
                    TutoringCase(task.name, case.number, kept[case.name]).seed,
                    BY_HAND,
                    config.digest(),
                    acting,
                )
                shown = robot.show(simulator, asked, [(c.name, kept[c.name]) for c in cases], at)
                if isinstance(shown, Choose):
                    at = shown.case
                    continue
                if shown is not None:
                    _keep(folder, case, shown)
                    kept[case.name] += 1
                at = (at + 1) % len(cases)
        finally:
            simulator.close()
    return kept.total()


class TutoredActor:
    """The process that takes part in a run as an actor whose tutor is a person."""

    def __init__(
        self,
        config: Config,
        bus: Bus,
        lifecycle: Lifecycle,
        *,
        port: int | None,
        backend: str | None,
    ) -> None:
        """Prepare.

        Args:
            config: the configuration of the run.
            bus: connection to the other processes.
            lifecycle: says when to pause and to stop.
            port: port of the page, as in `tutor_by_hand`.
            backend: name of the simulator; None for `simulator.backend`.
        """
        self._config, self._bus, self._lifecycle = config, bus, lifecycle
        self._port, self._backend = port, backend

    def run(self) -> None:
        """Show what the learner asks for until it should stop.

        Raises:
            UserError: the port is taken, or its configuration does not fit the run.
        """
        with page(self._config, self._port, self._lifecycle) as robot:
            Actor(
                self._config,
                self._bus,
                self._lifecycle,
                backend=self._backend,
                drain_s=_DRAIN_S,
                shower=_ShownByPerson(robot),
            ).run()


class _ShownByPerson:
    """Has a person show what the learner of a run asks for."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._kept = 0

    def show(
        self, simulator: Simulator, assignment: Assignment, actor: str, config_digest: str
    ) -> Episode | None:
        correction = assignment.kind is Kind.CORRECTION
        seed = assignment.seed
        asked = Asked(
            f"correction {seed}" if correction else f"case {seed // SEEDS_PER_CASE}",
            assignment.task,
            assignment.situation,
            seed,
            actor,
            config_digest,
            assignment.policy if correction else None,
            assignment.training,
            assignment.conditions,
        )
        shown = self._robot.show(simulator, asked, [(asked.name, self._kept)], 0)
        if not isinstance(shown, Episode):
            return None
        self._kept += 1
        return shown


@contextmanager
def page(config: Config, port: int | None, lifecycle: Lifecycle) -> Iterator[Robot]:
    """Serve the page of a robot until the context ends.

    Args:
        config: the configuration.
        port: as in `tutor_by_hand`.
        lifecycle: says when to stop, and what is waited for.

    Raises:
        UserError: the port is taken.
    """
    wanted = config.dashboard.port if port is None else port
    listening = listening_socket(HOST, wanted, or_another=port is None)
    robot = Robot(lifecycle)
    with (
        serving(make_app(robot, Access(HOST)), listening),
        every(_TELL_PERIOD_S, robot.tell_waiting),
    ):
        address = address_of(listening)
        print(f"tutor by hand at {address} (Ctrl-C ends)", flush=True)
        if any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))):
            webbrowser.open(address)  # elsewhere it could start a browser in this terminal
        yield robot


def _keep(folder: Path, case: Case, shown: Episode) -> None:
    files = (folder / f"{case.name}_{BY_HAND}{number:02d}.mcap" for number in count())
    write_episode(next(file for file in files if not file.exists()), shown, robot=robot_meshes())
    LOG.info("kept a %s of %s: %s", shown.kind, case.name, shown.outcome.reason)


def _cases_in(folder: Path) -> list[str]:
    """The case of each demonstration in a folder."""
    return [file.name.partition("_")[0] for file in folder.glob(f"*_{BY_HAND}*.mcap")]
