"""Disturbances of the scene: of its boxes, of the robot, and of what happens from outside.

The *object* of a scene is the first of its boxes that can move, the *table* the first that cannot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from actors.simulator import Box, Knock, Scene, Shove
from actors.tasks.contract import Task
from proto.errors import UserError
from proto.variables import Continuous, Situation, number_of
from sim_assets.icub import ARM_JOINTS

KNOCK_STEPS: Final = 3
"""Control steps for which the torque of a knock acts."""


@dataclass(frozen=True)
class Acting:
    """A disturbance that acts in an episode.

    Attributes:
        strength: its strength.
        random: the random numbers from which it draws.
        steps: the control steps in which something may happen from outside.
    """

    strength: float
    random: np.random.Generator
    steps: range


SceneChange = Callable[[Scene, Acting], Scene]
"""Maps a scene to the disturbed scene."""


def _knocked(scene: Scene, acting: Acting) -> Scene:
    steps = acting.steps
    knock = Knock(
        joint=_joint(acting.random),
        torque_nm=acting.strength * _sign(acting.random),
        step=int(
            acting.random.integers(steps.start, max(steps.stop - KNOCK_STEPS, steps.start) + 1)
        ),
        steps=KNOCK_STEPS,
    )
    return replace(scene, knocks=(knock,))


def _joint_friction(scene: Scene, acting: Acting) -> Scene:
    return replace(scene, damping={_joint(acting.random): acting.strength})


def _camera_turned(scene: Scene, acting: Acting) -> Scene:
    """Turn about an axis that is uniform on the sphere."""
    axis = acting.random.standard_normal(3)
    axis /= np.linalg.norm(axis)
    half = np.deg2rad(acting.strength) / 2
    x, y, z = (float(value) for value in np.sin(half) * axis)
    return replace(scene, eye_turn=(float(np.cos(half)), x, y, z))


def _table_shade(scene: Scene, acting: Acting) -> Scene:
    factor = 1.0 + _sign(acting.random) * acting.strength / 100.0
    table = table_of(scene)
    red, green, blue = (min(value * factor, 1.0) for value in table.colour)
    return _with(scene, replace(table, colour=(red, green, blue)))


def _larger(scene: Scene, acting: Acting) -> Scene:
    """Only width and depth grow, so that heights mean the same as without the disturbance."""
    thing, factor = object_of(scene), 1.0 + acting.strength / 100.0
    width, depth, height = thing.size_m
    return _with(scene, replace(thing, size_m=(width * factor, depth * factor, height)))


def _heavier(scene: Scene, acting: Acting) -> Scene:
    thing = object_of(scene)
    mass_kg = (thing.mass_kg or 0.0) * (1.0 + acting.strength / 100.0)
    return _with(scene, replace(thing, mass_kg=mass_kg))


def _slippery(scene: Scene, acting: Acting) -> Scene:
    thing = object_of(scene)
    return _with(scene, replace(thing, friction=thing.friction * (1.0 - acting.strength / 100.0)))


SCENE_CHANGES: Final[Mapping[str, SceneChange]] = {
    "knocked": _knocked,
    "joint-friction": _joint_friction,
    "camera-turned": _camera_turned,
    "table-shade": _table_shade,
    "larger": _larger,
    "heavier": _heavier,
    "slippery": _slippery,
}
"""How the scene changes, by the name of the disturbance."""

VARIABLE_CHANGES: Final[Mapping[str, tuple[str, float]]] = {
    "pushed": ("pushed_variable", 1e-3),
    "turned": ("turned_variable", 1.0),
}
"""For disturbances that change a variable of the situation: the task's attribute that names the
variable, and the unit of the strength in units of the variable."""


def changed_situation(
    task: Task, situation: Situation, disturbance: str, acting: Acting
) -> Situation:
    """The situation after the object was pushed or turned.

    Of both directions the one is drawn in which the variable stays inside its range; if it leaves
    the range in both, the one in which it leaves it less.

    Raises:
        UserError: the task does not name the variable.
    """
    variable = changed_variable(task, disturbance)
    _, unit = VARIABLE_CHANGES[disturbance]
    before = number_of(situation, variable.name)
    by = acting.strength * unit * _sign(acting.random)

    def outside(value: float) -> float:
        return max(variable.minimum - value, value - variable.maximum, 0.0)

    after = min((before + by, before - by), key=outside)
    return {**situation, variable.name: after}


def changed_variable(task: Task, disturbance: str) -> Continuous:
    """The variable that a disturbance of VARIABLE_CHANGES changes.

    Raises:
        UserError: the task does not name it.
    """
    attribute, _ = VARIABLE_CHANGES[disturbance]
    name = getattr(task, attribute, "")
    for variable in task.variables:
        if variable.name == name and isinstance(variable, Continuous):
            return variable
    raise UserError(
        f"the task {task.name} cannot be played with the disturbance {disturbance!r}: it names no"
        f" {attribute}"
    )


def shove_between(before: Scene, after: Scene, step: int) -> Shove:
    """The shove that brings the object from its pose in one scene to that in another."""
    start, end = object_of(before).pose, object_of(after).pose
    x, y, _ = np.subtract(end.position_m, start.position_m)
    turn_deg = _yaw_deg(end.quaternion) - _yaw_deg(start.quaternion)
    return Shove(object_of(before).name, step, (float(x), float(y)), turn_deg)


def shove_step(acting: Acting) -> int:
    """The control step of a shove: in the first half of those in which something may happen."""
    half = max(len(acting.steps) // 2, 1)
    return int(acting.random.integers(acting.steps.start, acting.steps.start + half))


def disturbed_steps(task: Task) -> range:
    """Control steps in which an object may be shoved or the arm be knocked.

    They are those of the phase that the task names, or the middle third of the episode.
    """
    phase = getattr(task, "disturbed_phase", "")
    total = len(task.phases)
    if phase not in task.phase_names:
        return range(total // 3, max(2 * total // 3, total // 3 + 1))
    steps = np.flatnonzero(task.phases == task.phase_names.index(phase))
    return range(int(steps[0]), int(steps[-1]) + 1)


def object_of(scene: Scene) -> Box:
    """The first box of a scene that can move.

    Raises:
        UserError: there is none.
    """
    return _first([box for box in scene.boxes if box.mass_kg is not None], "can move")


def table_of(scene: Scene) -> Box:
    """The first box of a scene that cannot move.

    Raises:
        UserError: there is none.
    """
    return _first([box for box in scene.boxes if box.mass_kg is None], "cannot move")


def _first(boxes: list[Box], what: str) -> Box:
    if not boxes:
        raise UserError(f"the scene cannot be disturbed: it has no box that {what}")
    return boxes[0]


def _with(scene: Scene, changed: Box) -> Scene:
    boxes = (changed if box.name == changed.name else box for box in scene.boxes)
    return replace(scene, boxes=tuple(boxes))


def _joint(random: np.random.Generator) -> str:
    return str(ARM_JOINTS[int(random.integers(len(ARM_JOINTS)))])


def _sign(random: np.random.Generator) -> float:
    return 1.0 if random.integers(2) else -1.0


def _yaw_deg(quaternion: tuple[float, float, float, float]) -> float:
    w, x, y, z = quaternion
    return float(np.rad2deg(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
