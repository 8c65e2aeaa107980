"""The robot's visible shapes, as `sim_assets.icub_visuals` has written them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from sim_assets.urdf import Tree

Colour = tuple[float, float, float]
SetName = Literal["eye", "outside", "recorded"]

MANIFEST: Final = "visuals.json"
"""File that lists the sets."""


@dataclass(frozen=True)
class Visual:
    """A mesh of one colour on one link.

    Attributes:
        link: link that carries it.
        mesh: PLY file in the link's frame (m).
        colour: red, green, blue in 0..1, linear.
    """

    link: str
    mesh: Path
    colour: Colour


def read_visuals(folder: Path, name: SetName) -> tuple[Visual, ...]:
    """Read one of the sets that `write_visuals` wrote."""
    listing = json.loads((folder / MANIFEST).read_text())
    return tuple(
        Visual(entry["link"], folder / name / entry["mesh"], tuple(entry["colour"]))
        for entry in listing[name]
    )


def mesh_files(source: Tree, meshes: Path) -> list[Path]:
    """Every mesh file that `write_visuals` may read."""
    drawn = (link.find("visual/geometry/mesh") for link in source.links.values())
    return sorted(
        {mesh_path(mesh.get("filename", ""), meshes) for mesh in drawn if mesh is not None}
    )


def mesh_path(uri: str, meshes: Path) -> Path:
    """The file that a `package://` address of the official model names."""
    return meshes / uri.removeprefix("package://")
