"""Built-in simulators: the sun casts shadows in the picture from outside, never in the eye's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from actors.backends import eye, light
from actors.simulator import (
    Box,
    Crop,
    JointTargets,
    Pose,
    Scene,
    Simulator,
    installed_backends,
    make_simulator,
)
from proto.config import SimulatorConfig

WIDTH, HEIGHT = 320, 240
COLOUR = (0.8, 0.7, 0.6)
TABLE = Box("table", (0.9, 0.44, 0.04), Pose((0.05, 0.31, -0.02)), COLOUR)
HEIGHT_OF_PLATE_M = 0.15
SHADED = (-0.2, 0.4, 0.0)
"""A place on the table that the plate hides from the sun, but not from the outside camera."""
LIT = (-0.33, 0.3, 0.0)
PLATE = Box(
    "plate",
    (0.1, 0.1, 0.005),
    Pose(tuple(np.add(SHADED, np.array(light.TO_SUN) * HEIGHT_OF_PLATE_M / light.TO_SUN[2]))),
    COLOUR,
)
START = JointTargets(np.array([-38.0, -10.0]), np.array([0.0, 20, 0, 30, 0, 0, 0]), np.full(9, 5.0))


@pytest.fixture(scope="module", params=installed_backends())
def simulator(request) -> Iterator[Simulator]:
    with closing(make_simulator(SimulatorConfig(backend=request.param))) as simulator:
        yield simulator


def outside_colour(simulator, place_m):
    """Colour (3,) at a place of the world in the picture from outside."""
    camera = eye.outside_pose()
    depth, left, up = camera[:3, :3].T @ (np.array(place_m) - camera[:3, 3])
    focal, _ = eye.outside_focal_lengths(HEIGHT)
    row, column = HEIGHT / 2 - focal * up / depth, WIDTH / 2 - focal * left / depth
    return simulator.outside_picture(WIDTH, HEIGHT)[int(row), int(column)].astype(float)


def colour_of(brightness):
    return 255 * (brightness * np.array(COLOUR)) ** (1 / light.GAMMA)


def test_a_plate_shades_the_table_in_the_picture_from_outside(simulator):
    simulator.reset(Scene((TABLE, PLATE), START, table_drop_m=0.15))
    lit = colour_of(light.brightness(np.array([0.0, 0.0, 1.0])))
    assert outside_colour(simulator, LIT) == pytest.approx(lit, abs=3)
    assert outside_colour(simulator, SHADED) == pytest.approx(colour_of(light.SKY), abs=3)
    simulator.reset(Scene((TABLE,), START, table_drop_m=0.15))
    assert outside_colour(simulator, SHADED) == pytest.approx(lit, abs=3), "nothing shades it"


def test_the_eye_sees_no_shadow(simulator):
    """A plate that the eye does not see changes nothing in its picture, not one bit."""
    simulator.reset(Scene((TABLE,), START, table_drop_m=0.15))
    plain = simulator.observe(Crop()).image
    above = Pose(tuple(np.add((0.05, 0.31, 0.0), np.array(light.TO_SUN) * 1.2)))
    roof = Box("roof", (1.5, 1.5, 0.005), above, COLOUR)
    simulator.reset(Scene((TABLE, roof), START, table_drop_m=0.15))
    assert outside_colour(simulator, LIT) == pytest.approx(colour_of(light.SKY), abs=3)
    assert np.array_equal(simulator.observe(Crop()).image, plain)
