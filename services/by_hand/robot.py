"""The robot that a person tutors: one thread owns the simulator and obeys one request at a time.

It moves only while it obeys. It tells what there is to see through a `Feed`.
"""

from __future__ import annotations

import base64
import logging
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, Final

from actors.attention import crop_of_focus
from actors.hand_control import FamiliarPostures
from actors.player import LiveStep, play
from actors.pointing import OUTSIDE_HEIGHT, OUTSIDE_WIDTH
from actors.simulator import EYE_HEIGHT, EYE_WIDTH, Crop, Simulator, make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from proto.acceptance import misfit
from proto.body import FOCUS, GRASP
from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.messages import TutoringCase
from proto.plain_text import plain
from proto.recordings.episodes import write_episode
from services.by_hand.demonstration import Command, Demonstration
from services.by_hand.policy import BY_HAND, ShownByHand
from services.by_hand.requests import Choose, Pace, Request, Simple, Stop
from services.dashboard.feed import Feed, jpeg, outcome_content, situation_content
from services.playing.tutoring import Case, save_or_check_config
from services.robot_meshes import robot_meshes

LOG = logging.getLogger(__name__)

PICTURE_PERIOD_S: Final = 0.15
"""Least time between two pictures while the robot moves."""
SHOW_AFTER_S: Final = 0.08
"""When nothing is asked for this time, the robot shows what it has come to."""
_END_WITHIN_S: Final = 30.0


class _StoppedError(Exception):
    """The person has stopped the robot."""


class Robot:
    """Obeys requests in its own thread.

    Attributes:
        feed: topics `robot` (what state it is in) and `pictures`.
        failed: what ended the thread; None while it runs.
    """

    def __init__(self, config: Config, cases: Sequence[Case], folder: Path) -> None:
        """Prepare.

        Args:
            config: the configuration.
            cases: the situations to tutor, in their order.
            folder: where demonstrations are recorded.
        """
        self.feed = Feed()
        self.failed: Exception | None = None
        self._config = config
        self._cases = cases
        self._folder = folder
        self._task: Task = make_task(config.task)
        self._pace = 1.0
        self._problem = ""
        self._number = 0
        self._kept = Counter(_cases_in(folder))
        self._case = next(
            (at for at, case in enumerate(cases) if not self._kept[case.name]), len(cases) - 1
        )
        self._played: Episode | None = None
        self._pictures_due_s = 0.0
        self._wanted: tuple[int, Request] | None = None
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._ending = False

    @property
    def kept(self) -> int:
        """Number of demonstrations in the folder."""
        return self._kept.total()

    @contextmanager
    def working(self) -> Iterator[None]:
        """Work in a thread until the context ends.

        Raises:
            UserError: the folder was recorded with another task, simulator or tutor.
        """
        save_or_check_config(self._folder, self._config)
        thread = threading.Thread(target=self._run, name="robot", daemon=True)
        thread.start()
        try:
            yield
        finally:
            with self._changed:
                self._ending = True
                self._changed.notify()
            self._stop.set()
            thread.join(_END_WITHIN_S)

    def ask(self, number: int, request: Request) -> bool:
        """Ask for something; False if the robot is busy with something else.

        Args:
            number: of the request; the state tells the number of the last one that is done.
            request: what is wanted.
        """
        if isinstance(request, Stop):
            self.stop()
            return True
        if isinstance(request, Pace):
            self._pace = request.factor
            return True
        with self._changed:
            if self._wanted is not None:
                return False
            self._stop.clear()
            self._wanted = (number, request)
            self._changed.notify()
        return True

    def stop(self) -> None:
        """Stop moving. What was shown so far stays."""
        self._stop.set()

    def _run(self) -> None:
        try:
            simulator = make_simulator(self._config.simulator)
            try:
                self._work(simulator)
            finally:
                simulator.close()
        except Exception as error:  # the main thread tells it and ends
            self.failed = error

    def _work(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self._familiar = FamiliarPostures.of_tutor(self._task)
        self._begin()
        while True:
            self._tell_state(busy=False)
            # A request that follows at once, as while a key is held, need not wait for pictures.
            if not self._is_asked(within_s=SHOW_AFTER_S):
                self._show()
                self._is_asked()
            if self._ending or self._wanted is None:
                return
            number, request = self._wanted
            self._problem = ""
            self._tell_state(busy=True)
            try:
                self._do(request)
            except UserError as error:
                self._problem = plain(error, 500)
            self._number = number
            with self._changed:
                self._wanted = None

    def _is_asked(self, within_s: float | None = None) -> bool:
        """Wait for a request, or for the end; whether there is one."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._wanted is not None or self._ending, within_s
            )

    def _do(self, request: Request) -> None:
        """Do what is asked for.

        Raises:
            UserError: it cannot be done.
        """
        match request:
            case Choose(case):
                if case >= len(self._cases):
                    raise UserError(f"there are only {len(self._cases)} cases")
                self._case = case
                self._begin()
            case Simple("finish"):
                self._play_back()
            case Simple("keep"):
                self._keep()
            case Simple("discard"):
                self._next_case()
            case Simple("restart"):
                self._forget_play_back()
                self._demonstration.restart()
            case Simple("undo"):
                # The first undo after a demonstration was played goes back to its end.
                if not self._forget_play_back():
                    self._demonstration.undo()
            case Stop() | Pace() | Simple():
                raise TypeError(request)
            case command:
                self._forget_play_back()
                self._obey(command)

    def _obey(self, command: Command) -> None:
        moving = self._demonstration.obey(command)
        due_s = time.monotonic()
        for _ in moving:
            if self._stop.is_set():
                moving.close()
                return
            self._tell_step()
            due_s = self._wait(due_s)

    def _wait(self, due_s: float) -> float:
        """Wait until the next control step may begin; when the one after it may at the earliest."""
        if self._pace:
            due_s = max(due_s, time.monotonic() - 1.0) + (
                self._simulator.control_period_s / self._pace
            )
            self._stop.wait(max(0.0, due_s - time.monotonic()))
        return due_s

    def _begin(self) -> None:
        case = self._cases[self._case]
        self._played = None
        self._demonstration = Demonstration(
            self._simulator, self._task, case.situation, self._familiar
        )

    def _next_case(self) -> None:
        self._case = (self._case + 1) % len(self._cases)
        self._begin()

    def _play_back(self) -> None:
        """Play the demonstration at the task's own pace, as it will be recorded."""
        actions = self._demonstration.resampled()
        case = self._cases[self._case]
        due_s = time.monotonic()

        def on_step(step: LiveStep) -> None:
            nonlocal due_s
            if self._stop.is_set():
                raise _StoppedError
            self._tell_step(step)
            due_s = self._wait(due_s)

        try:
            episode = play(
                self._simulator,
                self._task,
                ShownByHand(actions),
                case.situation,
                seed=TutoringCase(self._task.name, case.number, self._kept[case.name]).seed,
                kind=Kind.TUTORING,
                actor=BY_HAND,
                config_digest=self._config.digest(),
                on_step=on_step,
            )
        except _StoppedError:
            self._demonstration.restore()
            return
        if problem := misfit(episode, self._task, self._simulator.control_period_s):
            self._demonstration.restore()
            raise UserError(f"nothing could be learned from this: {problem}")
        self._played = episode

    def _forget_play_back(self) -> bool:
        """Go back from a demonstration that was played to the person's own; whether one was."""
        if self._played is None:
            return False
        self._played = None
        self._demonstration.restore()
        return True

    def _keep(self) -> None:
        if self._played is None:
            raise UserError("finish the demonstration first, so that you see what will be kept")
        name = self._cases[self._case].name
        write_episode(_free_file(self._folder, name), self._played, robot=robot_meshes())
        self._kept[name] += 1
        LOG.info("kept a demonstration of %s: %s", name, self._played.outcome.reason)
        self._next_case()

    def _tell_state(self, *, busy: bool, playing: LiveStep | None = None) -> None:
        self.feed.put("robot", self._state(busy=busy, playing=playing))

    def _tell_step(self, playing: LiveStep | None = None) -> None:
        """Tell a control step; show pictures too, but not for every step."""
        self._tell_state(busy=True, playing=playing)
        if time.monotonic() >= self._pictures_due_s:
            self._show(playing)

    def _show(self, playing: LiveStep | None = None) -> None:
        """Render all pictures, and tell them."""
        if playing is None:
            crop = crop_of_focus(float(self._demonstration.action[FOCUS]))
        else:
            crop = playing.crop
        seen = self._simulator.observe(crop).image
        eye = self._simulator.eye_picture(Crop(), EYE_WIDTH, EYE_HEIGHT)
        outside = self._simulator.outside_picture(OUTSIDE_WIDTH, OUTSIDE_HEIGHT)
        self.feed.put(
            "pictures",
            {
                "of": self._number,
                "seen": base64.b64encode(seen.tobytes()).decode(),
                "eye": jpeg(eye),
                "outside": jpeg(outside),
                "crop": round(crop.width / EYE_WIDTH, 4),
            },
        )
        self._pictures_due_s = time.monotonic() + PICTURE_PERIOD_S

    def _state(self, *, busy: bool, playing: LiveStep | None) -> dict[str, Any]:
        shown, now = self._demonstration, self._demonstration.action
        hand = shown.hand
        return {
            "done": self._number,
            "busy": busy,
            "problem": self._problem,
            "task": self._task.name,
            "phases": list(self._task.phase_names),
            "phase": shown.phase
            if playing is None
            else self._task.phase_names.index(playing.phase),
            "playing": playing is not None,
            "steps": shown.steps if playing is None else playing.step,
            "undo": shown.can_undo or self._played is not None,
            "last": shown.in_last_phase,
            "hand_mm": [round(1e3 * float(value)) for value in hand.centre_m],
            "yaw_deg": round(hand.yaw_deg, 1),
            "grasp": round(float(now[GRASP]), 1),
            "focus": round(float(now[FOCUS]), 1),
            "touched": sorted(shown.touched),
            "outcome": None if self._played is None else outcome_content(self._played.outcome),
            "cases": [[case.name, self._kept[case.name]] for case in self._cases],
            "case": self._case,
            "situation": situation_content(shown.situation),
            "kept": self._kept.total(),
        }


def _free_file(folder: Path, case: str) -> Path:
    files = (folder / f"{case}_{BY_HAND}{number:02d}.mcap" for number in count())
    return next(file for file in files if not file.exists())


def _cases_in(folder: Path) -> list[str]:
    """The case of each demonstration in a folder."""
    return [file.name.partition("_")[0] for file in folder.glob(f"*_{BY_HAND}*.mcap")]
