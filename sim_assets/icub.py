"""The robot: the official iCub, reduced to what the tasks move, with a right hand of our own.

The kinematics, masses and meshes are those of `iCubGazeboV2_5` in the `icub-models` package (CC
BY-SA 4.0). The chains from the root to the head and to the right hand are kept. In them only the
neck's pitch and yaw, the right arm and the fingers (`sim_assets.hand`) move. A left eye is added.
Colliders are simple shapes, because meshes cost ten times as much physics time.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import icub_models
import numpy as np

from sim_assets import built_visuals, hand, urdf
from sim_assets.built_visuals import Visual, mesh_files, read_visuals
from sim_assets.urdf import Vector

SOURCE_MODEL: Final = "iCubGazeboV2_5"
ROOT: Final = "root_link"
HAND: Final = "r_hand_dh_frame"
EYE: Final = "l_eye"
"""Frame of the left eye: x forward along the optical axis, y left, z up."""

JOINT_LIMITS_DEG: Final[dict[str, tuple[float, float]]] = {
    "neck_pitch": (-40.0, 30.0),
    "neck_yaw": (-55.0, 55.0),
    "r_shoulder_pitch": (-95.0, 10.0),
    "r_shoulder_roll": (0.0, 160.8),
    "r_shoulder_yaw": (-37.0, 80.0),
    "r_elbow": (15.5, 106.0),
    "r_wrist_prosup": (-90.0, 90.0),
    "r_wrist_pitch": (-90.0, 0.0),
    "r_wrist_yaw": (-20.0, 40.0),
}
"""The joints of neck and arm that move, with the limits of the iCub simulator of the paper."""
NECK_JOINTS: Final = tuple(JOINT_LIMITS_DEG)[:2]
ARM_JOINTS: Final = tuple(JOINT_LIMITS_DEG)[2:]

EYE_POSITION_M: Final[Vector] = (-0.0628, -0.034, 0.3408)
"""Left eye in the root frame when all joints are at zero."""
EYE_TILT_DEG: Final = -30.0
"""Fixed tilt of the eyes: the neck alone cannot look down at the table."""


@dataclass(frozen=True)
class Capsule:
    """A capsule collider; a sphere if both ends are the same point.

    Attributes:
        link: link that carries it.
        start_m: centre of one cap in the link's frame (m).
        end_m: centre of the other cap.
        radius_m: radius (m).
    """

    link: str
    start_m: Vector
    end_m: Vector
    radius_m: float


@dataclass(frozen=True)
class Cuboid:
    """A box collider, aligned with its link's frame.

    Attributes:
        link: link that carries it.
        centre_m: centre in the link's frame (m).
        size_m: full edge lengths (m).
    """

    link: str
    centre_m: Vector
    size_m: Vector


Collider = Capsule | Cuboid


def _finger_colliders() -> Iterable[Capsule]:
    """Colliders of the phalanges outside the palm; a fingertip's axis ends 4 mm before its tip."""
    parents = {phalanx.parent for phalanx in hand.PHALANGES}
    for phalanx in hand.PHALANGES:
        if not phalanx.link.endswith("_0"):
            tip_m = 0.0 if phalanx.link in parents else -0.004
            end_m = (phalanx.length_m + tip_m, 0.0, 0.0)
            yield Capsule(phalanx.link, (0.0, 0.0, 0.0), end_m, hand.FINGER_RADIUS_M)


COLLIDERS: Final[tuple[Collider, ...]] = (
    # Radii: the median distance of the covers' surfaces from these axes, minus two millimetres.
    Capsule("r_upper_arm", (-0.015, 0.0, -0.005), (-0.015, 0.0, 0.075), 0.036),
    Capsule("r_forearm", (0.010, 0.0, -0.008), (-0.088, 0.0, 0.020), 0.034),
    Capsule("r_wrist_1", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.022),
    Cuboid(HAND, hand.PALM_CENTRE_M, hand.PALM_SIZE_M),
    *_finger_colliders(),
)


@dataclass(frozen=True)
class IcubModel:
    """The built robot.

    Attributes:
        urdf: kinematics and masses. Root frame: x back, y right, z up.
        colliders: the shapes that touch other bodies. They are not in the URDF, because most URDF
            readers do not know capsules.
        joints: names of the joints that move: neck, arm, then phalanges.
        seen_by_eye: what the left eye can see of the robot, in simplified meshes.
        seen_from_outside: the whole robot in full detail.
        seen_in_recordings: the whole robot with few triangles.
    """

    urdf: Path
    colliders: tuple[Collider, ...]
    joints: tuple[str, ...]
    seen_by_eye: tuple[Visual, ...]
    seen_from_outside: tuple[Visual, ...]
    seen_in_recordings: tuple[Visual, ...]


_BUILDING: Final = threading.Lock()


def build_icub(cache: Path) -> IcubModel:
    """Build the robot in the folder `cache`, or find it there.

    Many processes may build at once: each builds in a folder of its own and renames it when done.
    Threads of a process take turns, because the library that simplifies meshes keeps global data.

    Raises:
        OSError: a mesh cannot be read, or the folder cannot be written.
    """
    official = Path(icub_models.get_model_file(SOURCE_MODEL))
    meshes = official.parents[3]  # SHARE/iCub/robots/MODEL/model.urdf; package:// is SHARE
    source = urdf.Tree(ET.parse(official).getroot())
    inputs = [official, *mesh_files(source, meshes)]
    folder = cache / f"icub-{_digest(inputs)}"
    with _BUILDING:
        if not folder.is_dir():
            _build_into(folder, source, meshes)
    return IcubModel(
        urdf=folder / "icub.urdf",
        colliders=COLLIDERS,
        joints=(*JOINT_LIMITS_DEG, *(phalanx.joint for phalanx in hand.PHALANGES)),
        seen_by_eye=read_visuals(folder, "eye"),
        seen_from_outside=read_visuals(folder, "outside"),
        seen_in_recordings=read_visuals(folder, "recorded"),
    )


def _digest(inputs: Iterable[Path]) -> str:
    """Sixteen hexadecimal digits that change with the input files and with this code."""
    code = [Path(str(module.__file__)) for module in (built_visuals, hand, urdf)]
    digest = hashlib.sha256()
    for path in (*inputs, *code, Path(__file__), Path(__file__).with_name("icub_visuals.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _build_into(folder: Path, source: urdf.Tree, meshes: Path) -> None:
    # Only this needs trimesh, which takes a second to import; and it is done once.
    from sim_assets import icub_visuals  # noqa: PLC0415

    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", dir=folder.parent))
    try:
        robot = ET.ElementTree(_robot(source))
        ET.indent(robot)
        robot.write(unfinished / "icub.urdf")
        links = [ROOT, *(urdf.child_of(joint) for joint in _kept_joints(source))]
        icub_visuals.write_visuals(unfinished, source, meshes, links)
        unfinished.chmod(0o755)
        try:
            unfinished.rename(folder)
        except OSError:
            if not folder.is_dir():  # if it is, another process has just built it
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _robot(source: urdf.Tree) -> ET.Element:
    """The reduced URDF, with eye and hand."""
    robot = ET.Element("robot", name="icub")
    robot.append(_official_link(source.links[ROOT]))
    for joint in _kept_joints(source):
        robot.append(_official_link(source.links[urdf.child_of(joint)]))
        robot.append(_official_joint(joint))
    _append_eye(robot, source.pose("head"))
    for phalanx in hand.PHALANGES:
        _append_phalanx(robot, phalanx)
    return robot


def _kept_joints(source: urdf.Tree) -> list[ET.Element]:
    to_head = source.chain("head")
    return to_head + [joint for joint in source.chain(HAND) if joint not in to_head]


def _official_link(source: ET.Element) -> ET.Element:
    link = ET.Element("link", name=source.get("name", ""))
    inertial = source.find("inertial")
    link.append(urdf.inertial(0.001, 1e-7) if inertial is None else inertial)
    return link


def _official_joint(source: ET.Element) -> ET.Element:
    name = source.get("name", "")
    joint = ET.Element("joint", name=name, type="revolute" if name in JOINT_LIMITS_DEG else "fixed")
    joint.extend(urdf.find(source, tag) for tag in ("origin", "parent", "child"))
    if name in JOINT_LIMITS_DEG:
        joint.append(urdf.find(source, "axis"))
        joint.append(urdf.limit(*JOINT_LIMITS_DEG[name]))
    return joint


def _append_eye(robot: ET.Element, head: urdf.Matrix) -> None:
    """Add the eye, fixed to the head; `head` is its pose (4, 4) in the root frame at zero."""
    level = np.diag([-1.0, -1.0, 1.0])  # the root's x points back
    eye = np.eye(4)
    eye[:3, :3] = level @ urdf.rotation_from_rpy((0.0, math.radians(-EYE_TILT_DEG), 0.0))
    eye[:3, 3] = EYE_POSITION_M
    in_head = np.linalg.inv(head) @ eye
    link = ET.SubElement(robot, "link", name=EYE)
    link.append(urdf.inertial(0.001, 1e-7))
    joint = ET.SubElement(robot, "joint", name=f"{EYE}_joint", type="fixed")
    joint.append(urdf.origin(in_head[:3, 3], urdf.rpy_from_rotation(in_head[:3, :3])))
    ET.SubElement(joint, "parent", link="head")
    ET.SubElement(joint, "child", link=EYE)


def _append_phalanx(robot: ET.Element, phalanx: hand.Phalanx) -> None:
    link = ET.SubElement(robot, "link", name=phalanx.link)
    link.append(urdf.inertial(0.02, 1.5e-6, (phalanx.length_m / 2, 0.0, 0.0)))
    joint = ET.SubElement(robot, "joint", name=phalanx.joint, type="revolute")
    joint.append(urdf.origin(phalanx.origin_m, (0.0, 0.0, math.radians(phalanx.parent_yaw_deg))))
    ET.SubElement(joint, "parent", link=phalanx.parent)
    ET.SubElement(joint, "child", link=phalanx.link)
    ET.SubElement(joint, "axis", xyz=urdf.text(phalanx.axis))
    motor = next(motor for motor in hand.MOTORS if motor.name == phalanx.motor)
    ends = [
        phalanx.offset_deg + phalanx.gain * angle
        for angle in (motor.minimum_deg, motor.maximum_deg)
    ]
    joint.append(urdf.limit(min(ends), max(ends)))
