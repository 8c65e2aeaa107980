"""The robot's visible shapes: the official meshes, and a hand of our own.

Three sets are made. The *eye* set holds what the left eye can see of the robot, simplified because
it is drawn in every control step. The *outside* set holds the whole robot in full detail. The
*recorded* set holds the whole robot with few triangles, because every recording contains it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.ply import export_ply

from sim_assets import hand
from sim_assets.built_visuals import MANIFEST, Colour, SetName, mesh_path
from sim_assets.urdf import Matrix, Tree, Vector, find, numbers, origin_pose

EYE_LINKS: Final = (
    "chest",
    "r_shoulder_1",
    "r_shoulder_2",
    "r_shoulder_3",
    "r_upper_arm",
    "r_elbow_1",
    "r_forearm",
    "r_wrist_1",
)
"""Official links that the left eye can see."""
EYE_FACES: Final = 800
"""Triangles of each official mesh in the eye set, at most."""
EYE_HAND_FACES: Final = 80
"""Triangles of each part of our hand in the eye set, at most."""
RECORDED_FACES: Final = 60
"""Triangles of each mesh in the recorded set, at most."""
CREASE_DEG: Final = 35.0
"""Edges with a larger angle between their faces stay sharp; all others are shaded smoothly."""

# The left arm and the legs do not move in any task. They are only shown, in this posture.
STANDING_POSTURE_DEG: Final[Mapping[str, float]] = {
    "l_shoulder_pitch": 10.0,
    "l_shoulder_roll": 12.0,
    "l_elbow": 16.0,
}
_UNMOVED_PREFIXES: Final = (
    "l_",
    "r_hip",
    "r_upper_leg",
    "r_lower_leg",
    "r_ankle",
    "r_foot",
    "r_sole",
)

# The network sees only grey values. Linear luminance of hand, wrist and covers is 0.03 to 0.1; of
# objects, obstacle and table at least 0.3. The covers' official red would have an object's grey.
_OFFICIAL_RED: Final = "0.635 0.137 0.114"
_COVERS: Final[Colour] = (0.20, 0.03, 0.03)
_BODY: Final[Colour] = (0.75, 0.75, 0.75)
_EYEBALL: Final[Colour] = (0.95, 0.95, 0.95)
_SHELL: Final[Colour] = (0.03, 0.03, 0.035)
_METAL: Final[Colour] = (0.09, 0.09, 0.095)
_TIP: Final[Colour] = (0.05, 0.05, 0.055)


@dataclass(frozen=True)
class _Part:
    """A mesh of one colour on one link, not yet written.

    Attributes:
        link: link that carries it.
        mesh: triangles in the link's frame (m).
        colour: red, green, blue in 0..1, linear.
    """

    link: str
    mesh: trimesh.Trimesh
    colour: Colour


def write_visuals(folder: Path, source: Tree, meshes: Path, links: Iterable[str]) -> None:
    """Write all sets, and a file that lists them, into a folder.

    Args:
        folder: where to write; it exists.
        source: the official model.
        meshes: the folder that `package://` stands for.
        links: the official links that the built robot keeps.
    """
    kept = [link for link in links if link != "r_hand"]  # our hand replaces it
    official = list(_official_parts(source, meshes, kept))
    hand_parts = list(_hand_parts())
    unmoved = [*_unmoved_parts(source, meshes), *_eyeball_parts()]
    seen = [_simplified(part, EYE_FACES) for part in official if part.link in EYE_LINKS]
    sets: dict[SetName, list[_Part]] = {
        "eye": seen + [_simplified(part, EYE_HAND_FACES) for part in hand_parts],
        "outside": official + unmoved + hand_parts,
        "recorded": [_simplified(part, RECORDED_FACES) for part in official + unmoved + hand_parts],
    }
    listing = {name: _write_set(folder / name, parts) for name, parts in sets.items()}
    (folder / MANIFEST).write_text(json.dumps(listing, indent=1))


def _write_set(folder: Path, parts: Iterable[_Part]) -> list[dict[str, object]]:
    """Write one mesh for each link and colour into a new folder, and list them."""
    folder.mkdir()
    groups: dict[tuple[str, Colour], list[trimesh.Trimesh]] = {}
    for part in parts:
        groups.setdefault((part.link, part.colour), []).append(part.mesh)
    listing: list[dict[str, object]] = []
    for (link, colour), group in groups.items():
        name = f"{len(listing):02d}-{link}.ply"
        mesh = trimesh.util.concatenate([_shaded(mesh) for mesh in group])
        (folder / name).write_bytes(export_ply(mesh, vertex_normal=True))
        listing.append({"link": link, "mesh": name, "colour": colour})
    return listing


def _official_parts(source: Tree, meshes: Path, links: Iterable[str]) -> Iterator[_Part]:
    for name in links:
        visual = source.links[name].find("visual")
        if visual is not None:
            mesh = find(find(visual, "geometry"), "mesh")
            shape = trimesh.load_mesh(mesh_path(mesh.get("filename", ""), meshes))
            scale = np.diag([*numbers(mesh.get("scale", "1 1 1")), 1.0])
            shape.apply_transform(origin_pose(visual) @ scale)
            rgba = find(find(visual, "material"), "color").get("rgba", "")
            yield _Part(name, shape, _official_colour(name, rgba))


def _official_colour(link: str, rgba: str) -> Colour:
    if link == "r_wrist_1":
        return _METAL
    return _COVERS if rgba.startswith(_OFFICIAL_RED) else _BODY


def _unmoved_parts(source: Tree, meshes: Path) -> Iterator[_Part]:
    """The left arm and the legs, as parts of the root link."""
    links = [name for name in source.links if name.startswith(_UNMOVED_PREFIXES)]
    for part in _official_parts(source, meshes, links):
        part.mesh.apply_transform(source.pose(part.link, STANDING_POSTURE_DEG))
        yield _Part("root_link", part.mesh, part.colour)


def _eyeball_parts() -> Iterator[_Part]:
    """Eyeballs; the official head has none."""
    for x in (-0.034, 0.034):
        yield _Part("head", _ball(0.016, (x, 0.099, 0.057)), _EYEBALL)
        yield _Part("head", _ball(0.008, (x, 0.097, 0.067)), _SHELL)


def _simplified(part: _Part, faces: int) -> _Part:
    if len(part.mesh.faces) <= faces:
        return part
    return replace(part, mesh=part.mesh.simplify_quadric_decimation(face_count=faces))


def _shaded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh, its vertices doubled along sharp edges so that they are drawn sharp."""
    shaded: trimesh.Trimesh = trimesh.graph.smooth_shade(mesh, angle=np.deg2rad(CREASE_DEG))
    return shaded


def _hand_parts() -> Iterator[_Part]:
    """Palm, knuckles and phalanges in black and metal, like the iCub's own hand."""
    yield from _palm_parts()
    parents = {phalanx.parent for phalanx in hand.PHALANGES}
    for phalanx in hand.PHALANGES:
        link = phalanx.link
        yield _Part(link, _knuckle(phalanx.axis), _METAL)
        if link.endswith("_0"):
            yield _Part(link, _bone(phalanx.length_m, 0.0055, 0.0055), _METAL)
        elif link in parents:
            radius = hand.FINGER_RADIUS_M
            yield _Part(link, _bone(phalanx.length_m, radius, 0.94 * radius), _SHELL)
        else:
            radius = 0.94 * hand.FINGER_RADIUS_M
            yield _Part(link, _bone(phalanx.length_m - 0.004, radius, radius), _TIP)


def _palm_parts() -> Iterator[_Part]:
    x, y, z = hand.PALM_CENTRE_M
    length, width, thickness = hand.PALM_SIZE_M
    shell = _rounded_box(hand.PALM_SIZE_M, 0.008)
    shell.apply_translation(hand.PALM_CENTRE_M)
    yield _Part("r_hand_dh_frame", shell, _SHELL)
    back = _rounded_box((0.75 * length, 0.75 * width, 0.006), 0.003)
    back.apply_translation((x, y, z - thickness / 2))
    yield _Part("r_hand_dh_frame", back, _METAL)
    wrist = _cylinder(0.014, np.array([x - length / 2 - 0.012, y, z]), np.array([x, y, z]))
    yield _Part("r_hand_dh_frame", wrist, _METAL)


def _knuckle(axis: tuple[float, float, float]) -> trimesh.Trimesh:
    """A short cylinder around a joint's axis, a little wider than the finger."""
    half = 1.05 * hand.FINGER_RADIUS_M * np.array(axis)
    return _cylinder(0.0048, -half, half)


def _ball(radius_m: float, centre_m: Vector) -> trimesh.Trimesh:
    ball: trimesh.Trimesh = trimesh.creation.icosphere(subdivisions=2, radius=radius_m)
    ball.apply_translation(centre_m)
    return ball


def _cylinder(
    radius_m: float, start: NDArray[np.float64], end: NDArray[np.float64]
) -> trimesh.Trimesh:
    cylinder: trimesh.Trimesh = trimesh.creation.cylinder(
        radius=radius_m, segment=[start, end], sections=16
    )
    return cylinder


def _bone(length_m: float, start_radius_m: float, end_radius_m: float) -> trimesh.Trimesh:
    """A capsule along x from the origin, with a radius at each end."""
    start = _ball(start_radius_m, (0.0, 0.0, 0.0))
    end = _ball(end_radius_m, (length_m, 0.0, 0.0))
    return _hull(np.vstack([start.vertices, end.vertices]))


def _rounded_box(size_m: Iterable[float], radius_m: float) -> trimesh.Trimesh:
    """A box with round edges."""
    corners = _corners(np.array(tuple(size_m)) / 2 - radius_m)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=radius_m).vertices
    return _hull(np.vstack([corner + ball for corner in corners]))


def _hull(points: NDArray[np.float64]) -> trimesh.Trimesh:
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    return hull


def _corners(half: NDArray[np.float64]) -> Matrix:
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return np.asarray(signs * half, dtype=np.float64)
