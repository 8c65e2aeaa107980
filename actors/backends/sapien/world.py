"""The physical world of one scene: the robot and the boxes in PhysX, without any graphics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx
from sapien.wrapper.urdf_loader import URDFLoader

from actors.backends import robot
from actors.simulator import ROBOT, Array, Bodies, Box, Pose, Scene, Shove
from sim_assets.icub import Capsule, Collider, Cuboid, IcubModel

POSITION_ITERATIONS: Final = 12
VELOCITY_ITERATIONS: Final = 1
CONTACT_OFFSET_M: Final = 0.004

# Collision groups of the robot's links. Two shapes pass through each other if their third groups
# share a bit. So the robot never touches itself; boxes, whose third group is 0, touch everything.
_ROBOT_GROUPS: Final = [1, 1, 1, 0]


class RobotBuilder:
    """Builds the robot for each scene, but reads the URDF only once."""

    def __init__(self, model: IcubModel) -> None:
        loader = URDFLoader()
        loader.set_scene(sapien.Scene([physx.PhysxCpuSystem()]))
        self._builder = loader.load_file_as_articulation_builder(str(model.urdf))
        self._joints = model.joints
        material = physx.PhysxMaterial(robot.SKIN_FRICTION, robot.SKIN_FRICTION, 0.0)
        links = {link.name: link for link in self._builder.link_builders}
        for collider in model.colliders:
            links[collider.link].collision_groups = _ROBOT_GROUPS
            _add_collider(links[collider.link], collider, material)

    def build(self, scene: sapien.Scene, height_m: float, damping: Mapping[str, float]) -> Any:
        """Put the robot into a scene.

        Args:
            scene: the scene.
            height_m: height of its root link above the origin.
            damping: by joint, the factor of the damping of its drive.
        """
        self._builder.set_scene(scene)
        self._builder.set_initial_pose(sapien.Pose([0.0, 0.0, height_m], robot.ROOT_QUATERNION))
        articulation = self._builder.build(fix_root_link=True)
        for link in articulation.links:
            link.disable_gravity = True  # as if the robot's controller compensated for it
        for name in self._joints:
            drive = robot.drive_of(name)
            drive = replace(drive, damping=drive.damping * damping.get(name, 1.0))
            _set_drive(articulation.find_joint_by_name(name), drive)
        return articulation


def _add_collider(link: Any, collider: Collider, material: Any) -> None:
    match collider:
        case Cuboid(_, centre_m, size_m):
            link.add_box_collision(sapien.Pose(centre_m), np.array(size_m) / 2, material)
        case Capsule(_, start_m, end_m, radius_m) if start_m == end_m:
            link.add_sphere_collision(sapien.Pose(start_m), radius_m, material)
        case Capsule(_, start_m, end_m, radius_m):
            pose, length_m = _along(np.array(start_m), np.array(end_m))
            link.add_capsule_collision(pose, radius_m, length_m / 2, material)


def _along(start: Array, end: Array) -> tuple[sapien.Pose, float]:
    """Pose in the middle of a segment, x along it, and its length."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    x = axis / length
    helper = np.eye(3)[np.argmin(np.abs(x))]
    y = np.cross(helper, x)
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    matrix[:3, 3] = (start + end) / 2
    return sapien.Pose(matrix), length


def _set_drive(joint: Any, drive: robot.Drive) -> None:
    joint.set_drive_properties(drive.stiffness, drive.damping, drive.torque_limit)
    joint.set_armature(np.full((1, 1), drive.armature))


class World:
    """The robot and the boxes of one scene.

    Made anew for each scene, so that nothing PhysX keeps from an earlier scene can change it.
    """

    def __init__(
        self,
        builder: RobotBuilder,
        joints: tuple[str, ...],
        scene: Scene,
        start_rad: Array,
        period_s: float,
    ) -> None:
        _configure_physics()
        self._scene = sapien.Scene([physx.PhysxCpuSystem()])
        self._system = self._scene.physx_system
        self._system.timestep = period_s
        self._robot = builder.build(self._scene, scene.table_drop_m, scene.damping)
        self._order = order = [joint.name for joint in self._robot.active_joints]
        self._drives = [self._robot.find_joint_by_name(name) for name in joints]
        # Position of each of PhysX's joints among the model's, and the other way round.
        self._model_rows = np.array([joints.index(name) for name in order])
        self._physx_rows = np.array([order.index(name) for name in joints])
        self._links = {link.name: link for link in self._robot.links}
        self._bodies = {box.name: _add_box(self._scene, box) for box in scene.boxes}
        moving = {box.name for box in scene.boxes if box.mass_kg is not None}
        self._watched = {self._bodies[box.name]: box.name for box in scene.boxes if box.watched}
        self._touchers = dict.fromkeys(self._links.values(), ROBOT)
        self._touchers |= {self._bodies[name]: name for name in moving}
        self._places, self._pose_numbers = _in_packed_poses(self._scene)
        self.put(start_rad, {})
        self.drive(start_rad)

    def drive(self, targets_rad: Array) -> None:
        """Set the target angles (J,) of all joints."""
        for joint, target in zip(self._drives, targets_rad.tolist(), strict=True):
            joint.set_drive_target(target)

    def push_joints(self, torques_nm: Mapping[str, float]) -> None:
        """Let outside torques act on joints, by name, until this is called again."""
        forces = np.zeros(len(self._model_rows), dtype=np.float32)
        for joint, torque_nm in torques_nm.items():
            forces[self._order.index(joint)] = torque_nm
        self._robot.set_qf(forces)

    def shove(self, shove: Shove, share: float) -> None:
        """Move a box by a share of a shove, from where it is, and stop it."""
        body = self._bodies[shove.box]
        now = body.entity.get_pose()
        pose = shove.moved(Pose(tuple(now.p.tolist()), tuple(now.q.tolist())), share)
        body.entity.set_pose(sapien.Pose(pose.position_m, pose.quaternion))
        body.set_linear_velocity([0.0, 0.0, 0.0])
        body.set_angular_velocity([0.0, 0.0, 0.0])

    def step(self) -> None:
        """Run one physics step."""
        self._system.step()

    def touches(self) -> Iterator[tuple[str, str]]:
        """(watched box, toucher) pairs of the physics step that has just run."""
        for contact in self._system.get_contacts():
            first, second = contact.bodies
            for box, other in ((first, second), (second, first)):
                if box in self._watched and other in self._touchers and _is_touch(contact):
                    yield self._watched[box], self._touchers[other]

    def joints_rad(self) -> Array:
        """Measured joint angles (J,)."""
        return np.asarray(self._robot.qpos[self._physx_rows], dtype=np.float64)

    def put(self, joints_rad: Array, boxes: Mapping[str, Pose]) -> None:
        """Put the robot, at rest, and some of the boxes where they are told to be."""
        self._robot.set_qpos(joints_rad[self._model_rows])
        self._robot.set_qvel(np.zeros(len(joints_rad)))
        for name, pose in boxes.items():
            self._bodies[name].entity.set_pose(sapien.Pose(pose.position_m, pose.quaternion))

    def poses(self) -> dict[str, sapien.Pose]:
        """Poses of all links and boxes, by name, for drawing."""
        parts = self._links | self._bodies
        return {name: body.entity_pose for name, body in parts.items()}

    def bodies(self) -> Bodies:
        """Poses of all links that can move and of all boxes, by name."""
        packed = np.frombuffer(self._scene.pack_poses(), dtype=np.float32)
        return Bodies(self._places, packed[self._pose_numbers])


def _in_packed_poses(scene: sapien.Scene) -> tuple[dict[str, int], NDArray[np.intp]]:
    """Row of each body by name, and the indices (B, 7) of each row's numbers in packed poses.

    SAPIEN packs a pose as the quaternion (w first), then the position.
    """
    entities = [
        (number, entity.name)
        for number, entity in enumerate(scene.entities)
        if entity.name not in robot.STATIC_LINKS
    ]
    places = {name: row for row, (_, name) in enumerate(entities)}
    starts = np.array([7 * number for number, _ in entities])
    return places, starts[:, None] + np.array([4, 5, 6, 0, 1, 2, 3])


def _configure_physics() -> None:
    """Set what PhysX keeps for the whole process."""
    physx.set_body_config(
        solver_position_iterations=POSITION_ITERATIONS,
        solver_velocity_iterations=VELOCITY_ITERATIONS,
    )
    physx.set_shape_config(contact_offset=CONTACT_OFFSET_M, rest_offset=0.0)
    physx.set_scene_config(bounce_threshold=0.2, enable_pcm=True, enable_tgs=True)


def _add_box(scene: sapien.Scene, box: Box) -> Any:
    builder = scene.create_actor_builder()
    builder.add_box_collision(
        half_size=np.array(box.size_m) / 2,
        material=physx.PhysxMaterial(box.friction, box.friction, 0.0),
        density=0.0 if box.mass_kg is None else box.mass_kg / float(np.prod(box.size_m)),
    )
    builder.set_initial_pose(sapien.Pose(box.pose.position_m, box.pose.quaternion))
    if box.mass_kg is None:
        entity = builder.build_static(box.name)
        return entity.find_component_by_type(physx.PhysxRigidStaticComponent)
    entity = builder.build(box.name)
    return entity.find_component_by_type(physx.PhysxRigidDynamicComponent)


def _is_touch(contact: Any) -> bool:
    """Whether two bodies overlap or push each other; PhysX also reports pairs that are near."""
    return any(point.separation < 0.0 or point.impulse.any() for point in contact.points)
