"""The robot that a person tutors. It obeys one request at a time, and moves only while it obeys.

It tells what there is to see through a `Feed`.
"""

from __future__ import annotations

import base64
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from actors.attention import crop_of_focus
from actors.hand_control import FamiliarPostures
from actors.player import LiveStep, play
from actors.pointing import OUTSIDE_HEIGHT, OUTSIDE_WIDTH
from actors.simulator import EYE_HEIGHT, EYE_WIDTH, Crop, Simulator
from actors.tasks.contract import Task
from actors.tasks.grasp_reading import yaw_deg
from proto.acceptance import misfit
from proto.body import FOCUS, GRASP
from proto.episode import Episode
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.plain_text import plain
from services.by_hand.asked import Asked
from services.by_hand.demonstration import Command, Demonstration, LetAct
from services.by_hand.policy import ShownByHand
from services.by_hand.requests import Choose, Pace, Request, Simple, Stop
from services.dashboard.feed import Feed, jpeg, outcome_content, situation_content

PICTURE_PERIOD_S: Final = 0.15
"""Least time between two pictures while the robot moves."""
MOVING: Final = 3.0
"""While it moves, the robot takes at least so many times as long for it as for pictures."""
SHOW_AFTER_S: Final = 0.08
"""When nothing is asked for this time, or for as long as it takes to render pictures, the robot
shows what it has come to."""
_LOOK_AGAIN_S: Final = 0.5


class _StoppedError(Exception):
    """The person has stopped the robot."""


class Robot:
    """Obeys requests of one person. `show` runs it; `ask` may be called by another thread.

    Attributes:
        feed: topics `robot` (what state it is in) and `pictures`.
    """

    def __init__(self, lifecycle: Lifecycle) -> None:
        """Show nothing yet.

        Args:
            lifecycle: says when to stop, and what is waited for.
        """
        self.feed = Feed()
        self._lifecycle = lifecycle
        self._pace = 1.0
        self._problem = ""
        self._number = 0
        self._familiar: dict[str, FamiliarPostures] = {}
        self._shows = False
        self._pictures_due_s = 0.0
        self._rendering_s = 0.0
        self._wanted: tuple[int, Request] | None = None
        self._after: tuple[int, Request] | None = None
        self._changed = threading.Condition()
        self._stop = threading.Event()

    def show(
        self, simulator: Simulator, asked: Asked, cases: Sequence[tuple[str, int]], case: int
    ) -> Episode | Choose | None:
        """Let the person show something; what they keep.

        Args:
            simulator: plays the scene.
            asked: what is to be shown.
            cases: name of each case to choose from, and how many demonstrations of it are kept.
            case: index of the case that is asked for.

        Returns:
            The episode if the person keeps it, the case if they choose another one, None if they
            discard it or the process is to stop.

        Raises:
            UserError: the situation cannot be played.
        """
        self._simulator, self._asked = simulator, asked
        self._cases, self._case = cases, case
        self._played: Episode | None = None
        self._demonstration = Demonstration(
            simulator, asked.task, asked.situation, self._postures(asked.task), asked.policy
        )
        with self._changed:
            self._shows = True
        try:
            return self._obey_requests()
        finally:
            with self._changed:
                self._shows = False

    def ask(self, number: int, request: Request) -> bool:
        """Ask for something; False if the robot is busy with something else.

        A policy that acts is interrupted.

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
            if not self._shows or self._after is not None:
                return False
            if self._wanted is None:
                self._stop.clear()
                self._wanted = number, request
                self._changed.notify()
                return True
            if isinstance(self._wanted[1], LetAct):
                self._after = number, request
                self._stop.set()
                return True
            return False

    def stop(self) -> None:
        """Stop moving. What was shown so far stays."""
        self._stop.set()

    def tell_waiting(self) -> None:
        """Tell what is waited for while there is nothing to show."""
        with self._changed:
            if not self._shows:
                what = plain(self._lifecycle.waiting_for, 500) or "the simulator"
                self.feed.put("robot", {"waiting": what, "done": self._number})

    def _postures(self, task: Task) -> FamiliarPostures:
        if task.name not in self._familiar:
            self._familiar[task.name] = FamiliarPostures.of_tutor(task)
        return self._familiar[task.name]

    def _obey_requests(self) -> Episode | Choose | None:
        while True:
            self._tell_state(busy=False)
            # A request that follows at once, as while a key is held, need not wait for pictures.
            if not self._is_asked(within_s=max(SHOW_AFTER_S, self._rendering_s)):
                self._show()
                self._is_asked()
            if self._wanted is None:
                return None
            number, request = self._wanted
            self._problem = ""
            self._tell_state(busy=True)
            end: Episode | Choose | Simple | None = None
            try:
                end = self._do(request)
            except UserError as error:
                self._problem = plain(error, 500)
            self._number = number
            with self._changed:
                self._wanted, self._after = self._after, None
                if self._wanted is not None:
                    self._stop.clear()
            if end is not None:
                return None if isinstance(end, Simple) else end

    def _is_asked(self, within_s: float | None = None) -> bool:
        """Wait for a request, at most for some time or until the process is to stop."""
        over_s = None if within_s is None else time.monotonic() + within_s
        with self._changed:
            while self._wanted is None and not self._lifecycle.stopping:
                self._lifecycle.goes_on()
                left_s = _LOOK_AGAIN_S if over_s is None else over_s - time.monotonic()
                if left_s <= 0.0:
                    break
                self._changed.wait(left_s)
            return self._wanted is not None

    def _do(self, request: Request) -> Episode | Choose | Simple | None:
        """Do what is asked for; what ends the demonstration, if it does.

        Raises:
            UserError: it cannot be done.
        """
        match request:
            case Choose(case):
                if case >= len(self._cases):
                    raise UserError(f"there are only {len(self._cases)} cases")
                return request
            case Simple(what):
                return self._do_simply(what)
            case Stop() | Pace():
                raise TypeError(request)
            case command:
                self._forget_play_back()
                self._obey(command)
                return None

    def _do_simply(self, what: str) -> Episode | Simple | None:
        match what:
            case "finish":
                self._play_back()
            case "keep":
                if self._played is None:
                    raise UserError(
                        "finish the demonstration first, so that you see what will be kept"
                    )
                return self._played
            case "discard":
                return Simple(what)
            case "restart":
                self._forget_play_back()
                self._demonstration.restart()
            case "undo":
                # The first undo after a demonstration was played goes back to its end.
                if not self._forget_play_back():
                    self._demonstration.undo()
        return None

    def _obey(self, command: Command) -> None:
        moving = self._demonstration.obey(command)
        due_s = time.monotonic()
        for _ in moving:
            if self._is_stopped:
                moving.close()
                return
            self._tell_step()
            due_s = self._wait(due_s)

    @property
    def _is_stopped(self) -> bool:
        self._lifecycle.goes_on()
        return self._stop.is_set() or self._lifecycle.stopping

    def _wait(self, due_s: float) -> float:
        """Wait until the next control step may begin; when the one after it may at the earliest."""
        if self._pace:
            due_s = max(due_s, time.monotonic() - 1.0) + (
                self._simulator.control_period_s / self._pace
            )
            self._stop.wait(max(0.0, due_s - time.monotonic()))
        return due_s

    def _play_back(self) -> None:
        """Play the demonstration at the task's own pace, as it will be recorded.

        Raises:
            UserError: it is not complete, or nothing could be learned from it.
        """
        asked = self._asked
        version = 0 if asked.policy is None else asked.policy.version
        actions = self._demonstration.resampled()
        due_s = time.monotonic()

        def on_step(step: LiveStep) -> None:
            nonlocal due_s
            if self._is_stopped:
                raise _StoppedError
            self._tell_step(step)
            due_s = self._wait(due_s)

        try:
            episode = play(
                self._simulator,
                asked.task,
                ShownByHand(actions, version),
                asked.situation,
                seed=asked.seed,
                kind=asked.kind,
                actor=asked.actor,
                config_digest=asked.config_digest,
                on_step=on_step,
                conditions=asked.conditions,
            )
        except _StoppedError:
            self._demonstration.restore()
            return
        if problem := misfit(episode, asked.task, self._simulator.control_period_s):
            self._demonstration.restore()
            raise UserError(f"nothing could be learned from this: {problem}")
        self._played = replace(episode, training=asked.training)

    def _forget_play_back(self) -> bool:
        """Go back from a demonstration that was played to the person's own; whether one was."""
        if self._played is None:
            return False
        self._played = None
        self._demonstration.restore()
        return True

    def _tell_state(self, *, busy: bool, playing: LiveStep | None = None) -> None:
        self.feed.put("robot", self._state(busy=busy, playing=playing))

    def _tell_step(self, playing: LiveStep | None = None) -> None:
        """Tell a control step; show pictures too, but not for every step."""
        self._tell_state(busy=True, playing=playing)
        if time.monotonic() >= self._pictures_due_s:
            self._show(playing)

    def _show(self, playing: LiveStep | None = None) -> None:
        """Render all pictures, and tell them."""
        begun_s = time.monotonic()
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
        shown_s = time.monotonic()
        self._rendering_s = shown_s - begun_s
        self._pictures_due_s = shown_s + max(PICTURE_PERIOD_S, MOVING * self._rendering_s)

    def _state(self, *, busy: bool, playing: LiveStep | None) -> dict[str, Any]:
        shown, now, asked = self._demonstration, self._demonstration.action, self._asked
        hand = shown.hand
        return {
            "done": self._number,
            "busy": busy,
            "problem": self._problem,
            "task": asked.task.name,
            "kind": asked.kind.value,
            "policy": plain(asked.policy_words, 200),
            "acting": busy and self._wanted is not None and isinstance(self._wanted[1], LetAct),
            "can_act": shown.can_act and self._played is None,
            "corrected": asked.policy is not None and shown.corrected,
            "phases": list(asked.task.phase_names),
            "phase": shown.phase
            if playing is None
            else asked.task.phase_names.index(playing.phase),
            "playing": playing is not None,
            "steps": shown.steps if playing is None else playing.step,
            "undo": shown.can_undo or self._played is not None,
            "last": shown.in_last_phase,
            "hand_mm": [round(1e3 * float(value)) for value in hand.centre_m],
            "yaw_deg": round(hand.yaw_deg, 1),
            "things": self._things(),
            "grasp": round(float(now[GRASP]), 1),
            "focus": round(float(now[FOCUS]), 1),
            "touched": sorted(shown.touched),
            "outcome": None if self._played is None else outcome_content(self._played.outcome),
            "cases": [list(each) for each in self._cases],
            "case": self._case,
            "situation": situation_content(shown.situation),
            "kept": sum(kept for _, kept in self._cases),
        }

    def _things(self) -> list[list[Any]]:
        """Name, place (mm) and turn (degrees) of each box that stands on the table."""
        bodies = self._simulator.bodies()
        return [
            [
                plain(box.name, 64),
                *(round(1e3 * float(value)) for value in bodies[box.name].position_m),
                round(yaw_deg(bodies[box.name]), 1),
            ]
            for box in self._asked.task.scene(self._asked.situation).boxes
            if box.pose.position_m[2] > 0.0
        ]
