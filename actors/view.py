"""What a viewer needs of an episode besides the poses of what moves: looks, fixed links, camera."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from actors.backends.eye import eye_focal_lengths
from actors.backends.robot import ROOT_QUATERNION, STATIC_LINKS, build_robot
from actors.simulator import Array, Crop, Scene
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.episode import BoxLook, View
from sim_assets import urdf


def view_of(scene: Scene, crops: Sequence[Crop]) -> View:
    """Return the view of an episode.

    Args:
        scene: what it began with.
        crops: the part of the eye image that was seen in each control step.
    """
    rise = np.array([0.0, 0.0, scene.table_drop_m, 0.0, 0.0, 0.0, 0.0])
    return View(
        boxes={box.name: BoxLook(box.size_m, box.colour) for box in scene.boxes},
        fixed_links={
            link: (pose + rise).astype(np.float32) for link, pose in _fixed_links().items()
        },
        focal_px=np.array([focal_lengths(crop) for crop in crops], np.float32).reshape(-1, 2),
    )


def focal_lengths(crop: Crop) -> NDArray[np.float32]:
    """Focal lengths (2,), across and down, of the picture that shows a crop (pixels)."""
    return np.array(eye_focal_lengths(crop, IMAGE_WIDTH, IMAGE_HEIGHT), np.float32)


@cache
def _fixed_links() -> Mapping[str, Array]:
    """Pose (7,) of each fixed link in the world frame if the root link were at its origin."""
    model = urdf.Tree(ET.parse(build_robot().urdf).getroot())
    root = Rotation.from_quat(ROOT_QUATERNION, scalar_first=True)
    poses = {}
    for link in sorted(STATIC_LINKS):
        matrix = model.pose(link)
        turn = root * Rotation.from_matrix(matrix[:3, :3])
        place = root.apply(matrix[:3, 3])
        poses[link] = np.concatenate([place, turn.as_quat(canonical=True, scalar_first=True)])
    return poses
