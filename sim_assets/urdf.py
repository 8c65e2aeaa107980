"""Reads and writes the parts of URDF that building the robot needs."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
Matrix = NDArray[np.float64]


def find(element: ET.Element, tag: str) -> ET.Element:
    """The child element with a tag.

    Raises:
        ValueError: there is none.
    """
    found = element.find(tag)
    if found is None:
        raise ValueError(f"{element.tag} {element.get('name')!r} has no <{tag}>")
    return found


class Tree:
    """The links of a URDF by name, and the joints that connect them."""

    def __init__(self, robot: ET.Element) -> None:
        self.links = {link.get("name", ""): link for link in robot.iterfind("link")}
        self._joint_of = {child_of(joint): joint for joint in robot.iterfind("joint")}

    def chain(self, link: str) -> list[ET.Element]:
        """The joints from the root to a link, in this order."""
        joints: list[ET.Element] = []
        while link in self._joint_of:
            joints.insert(0, self._joint_of[link])
            link = find(joints[0], "parent").get("link", "")
        return joints

    def pose(self, link: str, angles_deg: Mapping[str, float] | None = None) -> Matrix:
        """Pose (4, 4) of a link in the root frame; joints not in `angles_deg` are at zero."""
        pose = np.eye(4)
        for joint in self.chain(link):
            pose = pose @ origin_pose(joint)
            angle_deg = (angles_deg or {}).get(joint.get("name", ""), 0.0)
            if angle_deg:
                axis = numbers(find(joint, "axis").get("xyz", ""))
                pose[:3, :3] = pose[:3, :3] @ rotation_about(axis, math.radians(angle_deg))
        return pose


def child_of(joint: ET.Element) -> str:
    """Name of the link that a joint moves."""
    return find(joint, "child").get("link", "")


def origin_pose(element: ET.Element) -> Matrix:
    """Pose (4, 4) that an element's <origin> stands for."""
    origin = find(element, "origin")
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_rpy(numbers(origin.get("rpy", "0 0 0")))
    pose[:3, 3] = numbers(origin.get("xyz", "0 0 0"))
    return pose


def origin(xyz: Iterable[float], rpy: Iterable[float] = (0.0, 0.0, 0.0)) -> ET.Element:
    """An <origin> element of a position (m) and roll, pitch, yaw (radians)."""
    return ET.Element("origin", xyz=text(xyz), rpy=text(rpy))


def inertial(mass_kg: float, inertia_kgm2: float, centre_m: Vector = (0.0, 0.0, 0.0)) -> ET.Element:
    """An <inertial> element with the same moment of inertia about every axis."""
    element = ET.Element("inertial")
    element.append(origin(centre_m))
    ET.SubElement(element, "mass", value=repr(mass_kg))
    diagonal = dict.fromkeys(("ixx", "iyy", "izz"), repr(inertia_kgm2))
    ET.SubElement(element, "inertia", {**diagonal, "ixy": "0", "ixz": "0", "iyz": "0"})
    return element


def limit(lower_deg: float, upper_deg: float) -> ET.Element:
    """A <limit> element; the drives, not the URDF, limit torque and speed."""
    lower, upper = repr(math.radians(lower_deg)), repr(math.radians(upper_deg))
    return ET.Element("limit", lower=lower, upper=upper, effort="100", velocity="100")


def text(values: Iterable[float]) -> str:
    """Numbers in the form of an attribute."""
    return " ".join(repr(float(value)) for value in values)


def numbers(attribute: str) -> tuple[float, ...]:
    """The numbers in an attribute."""
    return tuple(float(word) for word in attribute.split())


def rotation_about(axis: Iterable[float], angle: float) -> Matrix:
    """Rotation matrix (3, 3) about an axis by an angle in radians (Rodrigues)."""
    x, y, z = np.array(tuple(axis)) / np.linalg.norm(tuple(axis))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Matrix = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turned


def rotation_from_rpy(rpy: Iterable[float]) -> Matrix:
    """Rotation matrix (3, 3) of roll, pitch, yaw in radians."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(angle), math.cos(angle)) for angle in rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(rotation: Matrix) -> Vector:
    """Roll, pitch, yaw in radians of a rotation matrix (3, 3)."""
    return (
        math.atan2(rotation[2, 1], rotation[2, 2]),
        math.atan2(-rotation[2, 0], math.hypot(rotation[2, 1], rotation[2, 2])),
        math.atan2(rotation[1, 0], rotation[0, 0]),
    )
