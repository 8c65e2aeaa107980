"""The robot: the official iCub, pruned to what the tasks move, with a right hand of our own.

The kinematics, masses and meshes are those of `iCubGazeboV2_5` in the `icub-models` package (CC
BY-SA 4.0). Kept are the chains from the root to the head and to the right hand; only the neck's
pitch and yaw, the right arm and the fingers (`sim_assets.hand`) still move. A left eye is added.
Colliders are primitives, because meshes cost ten times as much physics time.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import icub_models
import numpy as np
from numpy.typing import NDArray

from sim_assets import hand

Vector = tuple[float, float, float]

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
    """The phalanges that stick out of the palm; the tips end in a round cap inside their length."""
    parents = {phalanx.parent for phalanx in hand.PHALANGES}
    for phalanx in hand.PHALANGES:
        link = phalanx.joint.removesuffix("_joint")
        if not link.endswith("_0"):
            tip_m = 0.0 if link in parents else -0.004
            end_m = (phalanx.length_m + tip_m, 0.0, 0.0)
            yield Capsule(link, (0.0, 0.0, 0.0), end_m, hand.FINGER_RADIUS_M)


COLLIDERS: Final[tuple[Collider, ...]] = (
    # Radii: the median distance of the covers' surfaces from these axes, less two millimetres.
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
        colliders: the shapes that touch things; most URDF readers know no capsules.
        joints: names of the joints that move: neck, arm, then phalanges.
    """

    urdf: Path
    colliders: tuple[Collider, ...]
    joints: tuple[str, ...]


def build_icub(cache: Path | None = None) -> IcubModel:
    """Build the robot, or find it in the cache folder.

    The folder is `cache`, else the environment variable VMDNN_CACHE, else `~/.cache/vmdnn`. Many
    processes may build at once: each builds under a name of its own and renames it when done.
    """
    source = Path(icub_models.get_model_file(SOURCE_MODEL))
    folder = _cache_folder(cache) / f"icub-{_digest(source)}"
    if not folder.is_dir():
        _build_into(folder, source)
    return IcubModel(
        urdf=folder / "icub.urdf",
        colliders=COLLIDERS,
        joints=(*JOINT_LIMITS_DEG, *(phalanx.joint for phalanx in hand.PHALANGES)),
    )


def _cache_folder(cache: Path | None) -> Path:
    if cache is not None:
        return cache
    return Path(os.environ.get("VMDNN_CACHE") or Path.home() / ".cache" / "vmdnn")


def _digest(source: Path) -> str:
    """Sixteen hexadecimal digits over everything that the build depends on."""
    inputs = (source, Path(__file__), Path(hand.__file__))
    digest = hashlib.sha256()
    for path in inputs:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _build_into(folder: Path, source: Path) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", dir=folder.parent))
    try:
        robot = ET.ElementTree(_robot(ET.parse(source).getroot()))
        ET.indent(robot)
        robot.write(unfinished / "icub.urdf")
        unfinished.chmod(0o755)
        try:
            unfinished.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another process was faster
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _robot(source: ET.Element) -> ET.Element:
    """The pruned and completed URDF."""
    joint_of = {_child(joint): joint for joint in source.iterfind("joint")}
    joints = _chain(joint_of, "head") + [
        joint for joint in _chain(joint_of, HAND) if joint not in _chain(joint_of, "head")
    ]
    links = {link.get("name"): link for link in source.iterfind("link")}
    robot = ET.Element("robot", name="icub")
    robot.append(_official_link(links[ROOT]))
    for joint in joints:
        robot.append(_official_link(links[_child(joint)]))
        robot.append(_official_joint(joint))
    _append_eye(robot, _head_pose(_chain(joint_of, "head")))
    for phalanx in hand.PHALANGES:
        _append_phalanx(robot, phalanx)
    return robot


def _child(joint: ET.Element) -> str:
    return _find(joint, "child").get("link", "")


def _find(element: ET.Element, tag: str) -> ET.Element:
    found = element.find(tag)
    if found is None:
        raise ValueError(f"{element.tag} {element.get('name')!r} has no <{tag}>")
    return found


def _chain(joint_of: dict[str, ET.Element], link: str) -> list[ET.Element]:
    """Joints from the root to a link."""
    joints: list[ET.Element] = []
    while link in joint_of:
        joints.insert(0, joint_of[link])
        link = _find(joints[0], "parent").get("link", "")
    return joints


def _official_link(source: ET.Element) -> ET.Element:
    link = ET.Element("link", name=source.get("name", ""))
    inertial = source.find("inertial")
    link.append(_inertial(0.001, 1e-7) if inertial is None else inertial)
    return link


def _official_joint(source: ET.Element) -> ET.Element:
    name = source.get("name", "")
    joint = ET.Element("joint", name=name, type="revolute" if name in JOINT_LIMITS_DEG else "fixed")
    joint.extend(_find(source, tag) for tag in ("origin", "parent", "child"))
    if name in JOINT_LIMITS_DEG:
        joint.append(_find(source, "axis"))
        joint.append(_limit(*JOINT_LIMITS_DEG[name]))
    return joint


def _append_eye(robot: ET.Element, head: NDArray[np.float64]) -> None:
    """Fix the eye to the head, whose pose in the root frame at zero is given."""
    tilt = math.radians(-EYE_TILT_DEG)
    level = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])  # root x points back
    eye = np.eye(4)
    eye[:3, :3] = level @ rotation_from_rpy((0.0, tilt, 0.0))
    eye[:3, 3] = EYE_POSITION_M
    in_head = np.linalg.inv(head) @ eye
    link = ET.SubElement(robot, "link", name=EYE)
    link.append(_inertial(0.001, 1e-7))
    joint = ET.SubElement(robot, "joint", name=f"{EYE}_joint", type="fixed")
    joint.append(_origin(in_head[:3, 3], _rpy_from_rotation(in_head[:3, :3])))
    ET.SubElement(joint, "parent", link="head")
    ET.SubElement(joint, "child", link=EYE)


def _head_pose(chain: Iterable[ET.Element]) -> NDArray[np.float64]:
    """Product (4, 4) of the joints' origins: the last link in the root frame at zero."""
    pose = np.eye(4)
    for joint in chain:
        origin = _find(joint, "origin")
        step = np.eye(4)
        step[:3, :3] = rotation_from_rpy(_numbers(origin.get("rpy", "0 0 0")))
        step[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
        pose = pose @ step
    return pose


def _append_phalanx(robot: ET.Element, phalanx: hand.Phalanx) -> None:
    name = phalanx.joint.removesuffix("_joint")
    link = ET.SubElement(robot, "link", name=name)
    link.append(_inertial(0.02, 1.5e-6, (phalanx.length_m / 2, 0.0, 0.0)))
    joint = ET.SubElement(robot, "joint", name=phalanx.joint, type="revolute")
    joint.append(_origin(phalanx.origin_m, (0.0, 0.0, math.radians(phalanx.parent_yaw_deg))))
    ET.SubElement(joint, "parent", link=phalanx.parent)
    ET.SubElement(joint, "child", link=name)
    ET.SubElement(joint, "axis", xyz=_text(phalanx.axis))
    motor = next(motor for motor in hand.MOTORS if motor.name == phalanx.motor)
    ends = [
        phalanx.offset_deg + phalanx.gain * angle
        for angle in (motor.minimum_deg, motor.maximum_deg)
    ]
    joint.append(_limit(min(ends), max(ends)))


def _inertial(
    mass_kg: float, inertia_kgm2: float, centre_m: Vector = (0.0, 0.0, 0.0)
) -> ET.Element:
    inertial = ET.Element("inertial")
    inertial.append(_origin(centre_m))
    ET.SubElement(inertial, "mass", value=repr(mass_kg))
    diagonal = dict.fromkeys(("ixx", "iyy", "izz"), repr(inertia_kgm2))
    ET.SubElement(inertial, "inertia", {**diagonal, "ixy": "0", "ixz": "0", "iyz": "0"})
    return inertial


def _limit(lower_deg: float, upper_deg: float) -> ET.Element:
    lower, upper = repr(math.radians(lower_deg)), repr(math.radians(upper_deg))
    return ET.Element("limit", lower=lower, upper=upper, effort="100", velocity="100")


def _origin(xyz: Iterable[float], rpy: Iterable[float] = (0.0, 0.0, 0.0)) -> ET.Element:
    return ET.Element("origin", xyz=_text(xyz), rpy=_text(rpy))


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def rotation_from_rpy(rpy: Iterable[float]) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a URDF's roll, pitch, yaw in radians."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(angle), math.cos(angle)) for angle in rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _rpy_from_rotation(rotation: NDArray[np.float64]) -> Vector:
    return (
        math.atan2(rotation[2, 1], rotation[2, 2]),
        math.atan2(-rotation[2, 0], math.hypot(rotation[2, 1], rotation[2, 2])),
        math.atan2(rotation[1, 0], rotation[0, 0]),
    )
