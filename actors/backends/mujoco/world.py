"""The physical world of one scene: the robot and the boxes in MuJoCo, without any graphics."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from itertools import combinations, product
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from actors.backends import robot
from actors.simulator import ROBOT, Array, Bodies, Box, Pose, Scene, Shove
from sim_assets.icub import ROOT, Capsule, Collider, Cuboid, IcubModel

LOG = logging.getLogger(__name__)
# Else MuJoCo writes warnings to a file in the current folder.
mujoco.set_mju_user_warning(LOG.warning)

# How bodies touch. A grasp must hold for seconds by friction alone: with a pyramidal cone, or
# without the passes against slip, the object creeps out of the hand; with 3, by 1.5 mm in 10 s.
SOLVER_ITERATIONS: Final = 100
SOLVER_TOLERANCE: Final = 1e-8
FRICTIONAL_TO_NORMAL_IMPEDANCE: Final = 10.0
NOSLIP_ITERATIONS: Final = 10
CONTACT_TIME_CONSTANT_S: Final = 0.01
"""Time in which an overlap of two bodies decays; at least two physics steps."""
CONTACT_DAMPING_RATIO: Final = 1.0
CONTACT_IMPEDANCE: Final = (0.95, 0.99, 0.001, 0.5, 2.0)
"""MuJoCo's `solimp`: how hard a contact is, by depth."""
CONTACT_DIMENSIONS: Final = 3
"""A normal force and friction in two directions; no friction against spinning and rolling."""
LEAST_FRICTION: Final = 1e-5
"""MuJoCo's own lower limit."""
TOUCH_MARGIN_M: Final = 0.004
"""Bodies nearer than this to a watched box are looked at: will they overlap in a physics step?"""

_NO_TOUCH: Final = -1
"""Number of two bodies whose touch is not reported."""


class RobotBuilder:
    """Holds the robot's description, which each world copies, so that the URDF is read once."""

    def __init__(self, model: IcubModel, period_s: float) -> None:
        self.joints = model.joints
        self._spec = mujoco.MjSpec.from_string(model.urdf.read_text())
        self._spec.compiler.fusestatic = False  # keep the links that never move, for drawing
        self._spec.compiler.degree = False
        _set_options(self._spec.option, period_s)
        for body in self._spec.bodies:
            body.gravcomp = 1.0  # as if the robot's controller compensated for gravity
        for number, collider in enumerate(model.colliders):
            _add_collider(self._spec.body(collider.link), f"{collider.link}:{number}", collider)
        for name in model.joints:
            _add_drive(self._spec, name, robot.drive_of(name))

    def build(self, height_m: float) -> Any:
        """A description of the robot, its root link `height_m` above the origin."""
        spec = self._spec.copy()
        root = spec.body(ROOT)
        root.pos = [0.0, 0.0, height_m]
        root.quat = robot.ROOT_QUATERNION
        return spec


def _set_options(option: Any, period_s: float) -> None:
    option.timestep = period_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.iterations = SOLVER_ITERATIONS
    option.tolerance = SOLVER_TOLERANCE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = FRICTIONAL_TO_NORMAL_IMPEDANCE
    option.noslip_iterations = NOSLIP_ITERATIONS
    # Else a simulation that diverges begins anew, instead of showing that it has diverged.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _add_collider(body: Any, name: str, collider: Collider) -> None:
    # Only the pairs of `_add_contacts` touch, so that the robot never touches itself.
    geom = body.add_geom(name=name, contype=0, conaffinity=0)
    match collider:
        case Cuboid(_, centre_m, size_m):
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.pos = centre_m
            geom.size = np.array(size_m) / 2
        case Capsule(_, start_m, end_m, radius_m) if start_m == end_m:
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.pos = start_m
            geom.size = [radius_m, 0.0, 0.0]
        case Capsule(_, start_m, end_m, radius_m):
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            geom.fromto = [*start_m, *end_m]
            geom.size = [radius_m, 0.0, 0.0]


def _add_drive(spec: Any, name: str, drive: robot.Drive) -> None:
    joint = spec.joint(name)
    joint.armature = drive.armature
    joint.actfrclimited = False  # the drive has the limit; that of the URDF is another
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.gainprm[0] = drive.stiffness
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.biasprm[1:3] = -drive.stiffness, -drive.damping
    actuator.forcelimited = True
    actuator.forcerange = [-drive.torque_limit, drive.torque_limit]


class World:
    """The robot and the boxes of one scene.

    Made anew for each scene, so that nothing MuJoCo keeps from an earlier scene can change it.
    """

    def __init__(self, builder: RobotBuilder, scene: Scene, start_rad: Array) -> None:
        spec = builder.build(scene.table_drop_m)
        skin = [geom.name for geom in spec.geoms]
        for box in scene.boxes:
            _add_box(spec, box)
        _add_contacts(spec, skin, scene.boxes)
        self._model = spec.compile()
        for name, factor in scene.damping.items():
            self._model.actuator(name).biasprm[2] *= factor
        self._data = mujoco.MjData(self._model)
        self._angles = np.array([self._model.joint(name).qposadr[0] for name in builder.joints])
        self._boxes = {box.name: self._model.body(box.name).id for box in scene.boxes}
        # The first body is MuJoCo's own world.
        names = [self._model.body(number).name for number in range(1, self._model.nbody)]
        self._places = {name: place for place, name in enumerate(names)}
        moving = [name for name in names if name not in robot.STATIC_LINKS]
        self._moving_places = {name: place for place, name in enumerate(moving)}
        self._moving_rows = np.array([self._places[name] for name in moving])
        self._touches, self._touch_numbers = _touches_of(self._model, scene.boxes)
        self.put(start_rad, {})
        self.drive(start_rad)

    def drive(self, targets_rad: Array) -> None:
        """Set the target angles (J,) of all joints."""
        self._data.ctrl[:] = targets_rad

    def push_joints(self, torques_nm: Mapping[str, float]) -> None:
        """Let outside torques act on joints, by name, until this is called again."""
        self._data.qfrc_applied[:] = 0.0
        for name, torque_nm in torques_nm.items():
            self._data.qfrc_applied[self._model.joint(name).dofadr] = torque_nm

    def shove(self, shove: Shove, share: float) -> None:
        """Move a box by a share of a shove, from where it is, and stop it."""
        body = self._boxes[shove.box]
        x, y, z = self._data.xpos[body].tolist()
        w, i, j, k = self._data.xquat[body].tolist()
        self._put_box(body, shove.moved(Pose((x, y, z), (w, i, j, k)), share))
        start = self._model.jnt_dofadr[self._model.body_jntadr[body]]
        self._data.qvel[start : start + 6] = 0.0
        mujoco.mj_step1(self._model, self._data)

    def step(self) -> None:
        """Run one physics step.

        MuJoCo's own step leaves poses and contacts as they were before it moved the bodies. So the
        first half of the next step, which computes them, is run here already.
        """
        mujoco.mj_step2(self._model, self._data)
        mujoco.mj_step1(self._model, self._data)

    def touches(self) -> Iterator[tuple[str, str]]:
        """(watched box, toucher) pairs of bodies that overlap, or will within a physics step.

        A grazing hand may approach and leave again within one step. Engines that look ahead, such
        as PhysX, push it away in that step, and so it counts as a touch here, too.
        """
        if not self._touches or not self._data.ncon:
            return
        geoms = self._data.contact.geom
        for pairs in (geoms, geoms[:, ::-1]):
            numbers = self._touch_numbers[pairs[:, 0], pairs[:, 1]]
            for place in np.flatnonzero(numbers != _NO_TOUCH).tolist():
                if self._overlaps_soon(self._data.contact[place]):
                    yield self._touches[numbers[place]]

    def _overlaps_soon(self, contact: Any) -> bool:
        if contact.dist < 0.0:
            return True
        one, other = (
            self._velocity(self._model.geom_bodyid[geom], contact.pos) for geom in contact.geom
        )
        normal = contact.frame[:3]  # from the first geom to the second
        approach_mps = float(normal @ (one - other))
        return bool(contact.dist < approach_mps * self._model.opt.timestep)

    def _velocity(self, body: int, point_m: Array) -> Array:
        """Velocity (3,) in m/s of a point of a body, both in world coordinates."""
        turn_and_move = np.zeros(6)
        mujoco.mj_objectVelocity(
            self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, body, turn_and_move, 0
        )
        velocity: Array = turn_and_move[3:] + np.cross(
            turn_and_move[:3], point_m - self._data.xpos[body]
        )
        return velocity

    def joints_rad(self) -> Array:
        """Measured joint angles (J,)."""
        return np.asarray(self._data.qpos[self._angles], dtype=np.float64)

    def put(self, joints_rad: Array, boxes: Mapping[str, Pose]) -> None:
        """Put the robot, at rest, and some of the boxes where they are told to be."""
        self._data.qpos[self._angles] = joints_rad
        self._data.qvel[:] = 0.0
        for name, pose in boxes.items():
            self._put_box(self._boxes[name], pose)
        mujoco.mj_step1(self._model, self._data)

    def _put_box(self, body: int, pose: Pose) -> None:
        if self._model.body_jntnum[body]:
            start = self._model.jnt_qposadr[self._model.body_jntadr[body]]
            self._data.qpos[start : start + 7] = [*pose.position_m, *pose.quaternion]
        else:
            self._model.body_pos[body] = pose.position_m
            self._model.body_quat[body] = pose.quaternion

    def poses(self) -> Bodies:
        """Poses of all links and boxes, by name, for drawing."""
        return Bodies(self._places, np.hstack([self._data.xpos[1:], self._data.xquat[1:]]))

    def bodies(self) -> Bodies:
        """Poses of all links that can move and of all boxes, by name."""
        return Bodies(self._moving_places, self.poses().rows[self._moving_rows])


def _add_box(spec: Any, box: Box) -> None:
    body = spec.worldbody.add_body(name=box.name, pos=box.pose.position_m, quat=box.pose.quaternion)
    geom = body.add_geom(name=box.name, contype=0, conaffinity=0)
    geom.type = mujoco.mjtGeom.mjGEOM_BOX
    geom.size = np.array(box.size_m) / 2
    if box.mass_kg is not None:
        geom.mass = box.mass_kg
        body.add_freejoint()


def _add_contacts(spec: Any, skin: list[str], boxes: tuple[Box, ...]) -> None:
    """Let the robot touch all boxes, and moving boxes all others.

    MuJoCo by itself takes the greater of two frictions; a pair has a friction of its own.
    """
    for geom, box in product(skin, boxes):
        friction = (robot.SKIN_FRICTION + box.friction) / 2
        _add_contact(spec, geom, box.name, friction, watched=box.watched)
    for one, other in combinations(boxes, 2):
        if one.mass_kg is not None or other.mass_kg is not None:
            friction = (one.friction + other.friction) / 2
            watched = one.watched or other.watched
            _add_contact(spec, one.name, other.name, friction, watched=watched)


def _add_contact(spec: Any, one: str, other: str, friction: float, *, watched: bool) -> None:
    pair = spec.add_pair(geomname1=one, geomname2=other)
    pair.condim = CONTACT_DIMENSIONS
    pair.friction[:2] = max(friction, LEAST_FRICTION)
    pair.solref = [CONTACT_TIME_CONSTANT_S, CONTACT_DAMPING_RATIO]
    pair.solimp = CONTACT_IMPEDANCE
    if watched:  # reported from a distance on; a force acts from the overlap on all the same
        pair.gap = TOUCH_MARGIN_M


def _touches_of(
    model: Any, boxes: tuple[Box, ...]
) -> tuple[list[tuple[str, str]], NDArray[np.intp]]:
    """Touches to report, and for two of G geoms the number (G, G) of the touch of the first."""
    by_name = {box.name: box for box in boxes}
    owners = [by_name.get(model.body(number).name) for number in model.geom_bodyid]
    touches: list[tuple[str, str]] = []
    numbers = np.full((model.ngeom, model.ngeom), _NO_TOUCH, dtype=np.intp)
    for (geom, box), (other, toucher) in product(enumerate(owners), repeat=2):
        if box is None or not box.watched or toucher is box:
            continue
        if toucher is None or toucher.mass_kg is not None:
            numbers[geom, other] = len(touches)
            touches.append((box.name, ROBOT if toucher is None else toucher.name))
    return touches, numbers
