"""What a person shows in one situation: commands, the control steps they take, and undoing them."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.attention import (
    clip_action,
    crop_of_focus,
    targets_of_action,
    with_attention_of,
)
from actors.hand_control import FamiliarPostures, HandControl, HandPlace
from actors.kinematics import Gaze
from actors.motion import minimum_jerk
from actors.pointing import Camera, point_seen
from actors.policies.contract import Policy
from actors.simulator import Simulator
from actors.tasks.contract import Task
from proto.body import ARM, FOCUS, GRASP, NECK
from proto.episode import Image
from proto.errors import UserError
from proto.variables import Situation
from services.by_hand.resampling import resample

Array = NDArray[np.float64]

MOST_STEPS: Final = 3000
"""Control steps of a demonstration, five minutes of the robot's time."""
GAZE_DEG: Final = 5.0
"""Mean movement of the neck in a control step."""
_NEAR_M: Final = 0.0015
_NEAR_DEG: Final = 1.0
_ASTRAY_M: Final = 0.01
_ASTRAY_DEG: Final = 5.0
_STILL_DEG: Final = 0.05
_CHANGED: Final = 0.01
"""A person has changed what the policy wants if a value of the action differs by more."""
_FOLLOW_TRIES: Final = 3
_MOVE_STEPS: Final = 12
_REACH_STEPS: Final = 80


@dataclass(frozen=True)
class Look:
    """Look at a place of a picture; see `actors.pointing.point_seen`."""

    camera: Camera
    across: float
    down: float


@dataclass(frozen=True)
class Reach:
    """Move the hand horizontally until it is above or below a place of a picture."""

    camera: Camera
    across: float
    down: float


@dataclass(frozen=True)
class TurnHead:
    """Move the neck by some degrees."""

    pitch_deg: float
    yaw_deg: float


@dataclass(frozen=True)
class MoveHand:
    """Move the hand a little.

    Attributes:
        shift_m: (3,) to the right, forward, up; with `own`, along the hand's own axes.
        turn_deg: turn about the vertical, counter-clockwise from above.
        own: along the axes of the hand, not those of the world.
    """

    shift_m: tuple[float, float, float]
    turn_deg: float = 0.0
    own: bool = False


@dataclass(frozen=True)
class Focus:
    """Change the focus level."""

    by: float


@dataclass(frozen=True)
class Grasp:
    """Change the grasp level."""

    by: float


@dataclass(frozen=True)
class NextPhase:
    """The next phase of the task begins."""


@dataclass(frozen=True)
class LetAct:
    """The policy acts, until its episode is over or the command is interrupted."""


Command = Look | Reach | TurnHead | MoveHand | Focus | Grasp | NextPhase | LetAct


@dataclass(frozen=True)
class _State:
    """What `undo` goes back to.

    Attributes:
        steps: number of control steps so far.
        acted: number of steps of the policy so far.
        alone: whether the person shows the rest alone.
        phase: index of the phase.
        wanted: where the hand should be.
    """

    steps: int
    acted: int
    alone: bool
    phase: int
    wanted: HandPlace


@dataclass(frozen=True)
class _Change:
    """What a person has changed of what a policy does; it stays changed.

    Attributes:
        shift_m: (3,) where the hand is, seen from where the policy wants it.
        turn_deg: how far it is turned from there about the vertical.
        values: (11,) what is added to the other values of the action; 0 for the arm.
    """

    shift_m: Array
    turn_deg: float
    values: Array


class Demonstration:
    """One demonstration. The simulator runs only while a command is obeyed.

    With a policy it is a correction: the policy acts in the task's phases, a person takes over at
    any time, and the policy goes on from there. What the person has changed stays changed: the hand
    stays as far from where the policy wants it, and so do gaze, focus and grasp.

    Attributes:
        situation: the situation.
        phase: index of the phase that the person, or the policy, is in.
        touched: names of the watched boxes that were touched.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        situation: Situation,
        familiar: FamiliarPostures,
        policy: Policy | None = None,
    ) -> None:
        """Put the robot into the situation.

        Args:
            simulator: plays the scene.
            task: the task.
            situation: values of the task's variables by name.
            familiar: postures that the arm prefers.
            policy: the policy that is corrected; None if the person shows everything.

        Raises:
            UserError: the situation is not valid for the task.
        """
        task.check(situation)
        self.situation = situation
        self.phase = 0
        self.touched: set[str] = set()
        self._simulator = simulator
        self._task = task
        self._scene = task.scene(situation)
        self._hand = HandControl(self._scene, familiar)
        self._gaze = Gaze(self._scene.table_drop_m)
        self._actions: list[Array] = []
        self._phases: list[int] = []
        self._wanted = self._hand.place(task.start[ARM])
        self._states: list[_State] = []
        self._policy = policy
        self._seen: list[Image] = []
        self._proposed = task.start
        self._alone = False
        self._restart_policy()
        simulator.reset(self._scene)

    @property
    def corrected(self) -> bool:
        """Whether a person did something that the policy did not."""
        return len(self._seen) < self.steps or self._alone

    @property
    def can_act(self) -> bool:
        """Whether there is a policy that goes on when it is let."""
        return (
            self._policy is not None
            and not self._alone
            and len(self._seen) < len(self._task.phases)
        )

    @property
    def action(self) -> Array:
        """The last action (11,)."""
        return self._actions[-1] if self._actions else self._task.start

    @property
    def steps(self) -> int:
        """Number of control steps so far."""
        return len(self._actions)

    @property
    def can_undo(self) -> bool:
        """Whether there is a command to undo."""
        return bool(self._states)

    @property
    def in_last_phase(self) -> bool:
        """Whether the person has come to the task's last phase."""
        return self.phase == len(self._task.subtasks) - 1

    @property
    def hand(self) -> HandPlace:
        """Where the hand is commanded to be."""
        return self._hand.place(self.action[ARM])

    def obey(self, command: Command) -> Generator[None, None, None]:
        """Obey a command; each `next` of the iterator runs one control step.

        If the iterator is closed before its end, the robot stays where it is.

        Raises:
            UserError: the command cannot be obeyed; the robot has not moved.
        """
        before = _State(self.steps, len(self._seen), self._alone, self.phase, self._wanted)
        if isinstance(command, NextPhase):
            if self.in_last_phase:
                raise UserError("this is the last phase: finish the demonstration")
            self.phase += 1
            self._alone = True
            self._states.append(before)
            return
        if isinstance(command, LetAct):
            acting = self._let_act()
            next(acting)
            self._states.append(before)
            yield
            yield from acting
            return
        moves = self._moves(command)
        self._states.append(before)
        try:
            for action in moves:
                if self.steps >= MOST_STEPS:
                    raise UserError(
                        f"a demonstration has at most {MOST_STEPS} control steps: undo some, or"
                        " restart"
                    )
                self._step(action, self.phase)
                yield
        except GeneratorExit:
            self._wanted = self.hand
            raise
        if self.steps == before.steps:
            self._states.pop()
            self._wanted = before.wanted
            raise UserError("the robot cannot go further in this direction")

    def undo(self) -> None:
        """Go back to before the last command."""
        if self._states:
            before = self._states.pop()
            self.phase, self._wanted = before.phase, before.wanted
            self._alone = before.alone
            if before.steps < self.steps:
                self._return_to(before.steps)
            if before.acted < len(self._seen):
                del self._seen[before.acted :]
                self._restart_policy()

    def restart(self) -> None:
        """Go back to the start."""
        if self._states:
            del self._states[1:]
            self.undo()

    def restore(self) -> None:
        """Bring the simulator to where the demonstration is, after it was used otherwise."""
        self._return_to(self.steps)

    def resampled(self) -> Array:
        """Return the demonstration as actions (T, 11) of the task's phases.

        Raises:
            UserError: a phase of the task was not begun yet, or a policy did everything.
        """
        if self._policy is not None and not self.corrected:
            raise UserError("the policy did all of this: nothing was corrected")
        if not self.in_last_phase:
            names = self._task.phase_names
            raise UserError(
                f"the demonstration is in the phase {names[self.phase]!r}; it must come to the"
                f" last one, {names[-1]!r}, before it can be finished"
            )
        actions = np.array(self._actions).reshape(-1, len(self._task.start))
        durations = list(self._task.subtasks.values())
        return resample(actions, self._phases, durations, self._task.start)

    def _restart_policy(self) -> None:
        """Bring the policy to where it is after it saw the pictures that it has seen."""
        self._proposed = self._task.start
        if self._policy is not None:
            self._policy.begin(self.situation, 0)
            for image in self._seen:
                self._proposed = self._allowed(self._policy.step(image))

    def _let_act(self) -> Iterator[None]:
        """Let the policy act from where the robot is.

        Raises:
            UserError: there is no policy, or it has done all.
        """
        policy = self._policy
        if policy is None or not self.can_act:
            raise UserError("no policy acts any more: show the rest, or undo")
        change = self._change()
        for phase in self._task.phases[len(self._seen) :]:
            image = self._simulator.observe(crop_of_focus(float(self.action[FOCUS]))).image
            before, self._proposed = self._proposed, self._allowed(policy.step(image))
            self._seen.append(image)
            self.phase = int(phase)
            action = self._proposed if change is None else self._follow(before, change)
            self._step(action, self.phase)
            self._wanted = self.hand
            yield

    def _change(self) -> _Change | None:
        """What the person has changed so far; None if nothing."""
        values = self.action - self._proposed
        if float(np.abs(values).max()) < _CHANGED:
            return None
        here, there = self.hand, self._hand.place(self._proposed[ARM])
        values[ARM] = 0.0
        return _Change(here.centre_m - there.centre_m, here.yaw_deg - there.yaw_deg, values)

    def _follow(self, before: Array, change: _Change) -> Array:
        """Do what the policy wants next (11,), changed as the person did.

        Args:
            before: (11,) what it wanted before.
            change: what the person has changed.
        """
        action = self._proposed + change.values
        there = self._hand.place(self._proposed[ARM]).moved(change.shift_m, change.turn_deg)
        arm = clip_action(self.action + self._proposed - before)[ARM]
        for _ in range(_FOLLOW_TRIES):
            arm = self._hand.towards(arm, there)
        action[ARM] = arm
        return action

    def _return_to(self, steps: int) -> None:
        """Play the first control steps again; the others are forgotten."""
        actions, phases = self._actions[:steps], self._phases[:steps]
        self._simulator.reset(self._scene)
        self._actions, self._phases = [], []
        self.touched = set()
        for action, phase in zip(actions, phases, strict=True):
            self._step(action, phase)

    def _step(self, action: Array, phase: int) -> None:
        action = self._allowed(action)
        report = self._simulator.step(targets_of_action(action))
        self.touched.update(box for box, _ in report.touches)
        self._actions.append(action)
        self._phases.append(phase)

    def _allowed(self, action: Array) -> Array:
        """Return an action (11,) within the robot's limits and the task's attention."""
        action = clip_action(action)
        if self._task.attention == "active":
            return action
        return with_attention_of(self._task.start, action)

    def _moves(self, command: Command) -> Iterator[Array]:
        """The actions that a command takes.

        Raises:
            UserError: it cannot be obeyed.
        """
        match command:
            case Look(camera, across, down):
                point = self._point(camera, across, down)
                return self._turn_head(self._gaze.neck_deg(point))
            case TurnHead(pitch_deg, yaw_deg):
                return self._turn_head(self.action[NECK] + [pitch_deg, yaw_deg])
            case Reach(camera, across, down):
                point = self._point(camera, across, down)
                self._wanted = HandPlace(
                    np.array([point[0], point[1], self._wanted.centre_m[2]]), self._wanted.yaw_deg
                )
                return self._move_hand(_REACH_STEPS)
            case MoveHand(shift_m, turn_deg, own):
                shift = np.array(shift_m)
                shift = self._wanted.along_own_axes(shift) if own else shift
                self._wanted = self._wanted.moved(shift)
                if turn_deg:  # from what the person sees, even if the hand could not turn so far
                    self._wanted = HandPlace(self._wanted.centre_m, self._turned(turn_deg))
                return self._move_hand(_MOVE_STEPS)
            case Focus(by):
                return self._change_level(FOCUS, by)
            case Grasp(by):
                return self._change_level(GRASP, by)
            case _:
                raise TypeError(command)

    def _point(self, camera: Camera, across: float, down: float) -> Array:
        bodies = self._simulator.bodies()
        point = point_seen(camera, across, down, self._scene.boxes, bodies)
        if point is None:
            raise UserError("there is nothing at this place of the picture")
        return point

    def _turned(self, turn_deg: float) -> float:
        """Return the yaw after a turn (degrees)."""
        here = self.hand.yaw_deg
        _, missing_deg = self._hand.misses(self.action[ARM], self._wanted)
        return (here if missing_deg > _ASTRAY_DEG else self._wanted.yaw_deg) + turn_deg

    def _turn_head(self, neck_deg: Array) -> Iterator[Array]:
        start, goal = self.action.copy(), self.action.copy()
        goal[NECK] = neck_deg
        way = clip_action(goal) - start
        steps = math.ceil(float(np.abs(way).max()) / GAZE_DEG)
        for step in range(1, steps + 1):
            yield start + way * minimum_jerk(step / steps)

    def _change_level(self, value: int, by: float) -> Iterator[Array]:
        start, goal = self.action.copy(), self.action.copy()
        goal[value] += by
        way = clip_action(goal) - start
        steps = math.ceil(float(np.abs(way).max()))
        for step in range(1, steps + 1):
            yield start + way * step / steps

    def _move_hand(self, most_steps: int) -> Iterator[Array]:
        """Move the hand to `_wanted`, or as far as the arm can bring it."""
        for _ in range(most_steps):
            action = self.action.copy()
            action[ARM] = self._hand.towards(self.action[ARM], self._wanted)
            if float(np.abs(action - self.action).max()) < _STILL_DEG:
                break
            yield action
            far_m, turned_deg = self._hand.misses(action[ARM], self._wanted)
            if far_m < _NEAR_M and turned_deg < _NEAR_DEG:
                break
        here = self.hand
        if float(np.linalg.norm(here.centre_m - self._wanted.centre_m)) > _ASTRAY_M:
            self._wanted = HandPlace(here.centre_m, self._wanted.yaw_deg)
