"""The view of an episode agrees with the simulator and with the recorded pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from actors.backends.robot import STATIC_LINKS
from actors.backends.sapien.simulator import SapienSimulator
from actors.player import play
from actors.policies.planned import make_tutor
from actors.simulator import Crop
from actors.tasks.registry import make_task
from actors.view import view_of
from proto.config import SimulatorConfig, TaskConfig
from proto.episode import Kind

TASK = make_task(TaskConfig(name="experiment1"))


@pytest.fixture(scope="module")
def simulator() -> Iterator[SapienSimulator]:
    with closing(SapienSimulator(SimulatorConfig())) as made:
        yield made


def test_fixed_links_are_where_the_simulator_has_them(simulator: SapienSimulator) -> None:
    scene = TASK.scene(TASK.tutored()[0])
    simulator.reset(scene)
    assert simulator._world is not None
    poses = simulator._world.poses()
    fixed = view_of(scene, [Crop()]).fixed_links
    assert set(fixed) == STATIC_LINKS
    for link, (*place, w, x, y, z) in fixed.items():
        assert place == pytest.approx(poses[link].p, abs=1e-5), link
        turned = Rotation.from_quat([w, x, y, z], scalar_first=True)
        expected = Rotation.from_quat(poses[link].q, scalar_first=True)
        assert (turned * expected.inv()).magnitude() < 1e-4, link


def test_the_camera_sees_the_object_where_the_picture_shows_it(simulator: SapienSimulator) -> None:
    """The object is darker than the table that surrounds it."""
    situation = TASK.tutored()[22]
    episode = play(simulator, TASK, make_tutor(TASK), situation, seed=1, kind=Kind.TUTORING)
    assert episode.view is not None
    widest, narrow = episode.view.focal_px[[0, 80]]
    assert widest == pytest.approx([51.46, 51.46], abs=0.01)
    assert narrow[0] > 1.5 * widest[0]
    for step in (0, 80):
        *place, w, x, y, z = episode.body_poses[step, episode.body_names.index("l_eye")]
        to_eye = Rotation.from_quat([w, x, y, z], scalar_first=True).inv()
        centre = episode.body_poses[step, episode.body_names.index("object"), :3]
        forward, left, up = to_eye.apply(centre - np.array(place))
        across, down = episode.view.focal_px[step]
        column, row = 32 - across * left / forward, 24 - down * up / forward
        picture = episode.images[step].astype(int)
        assert picture[int(row), int(column)] < 150
        assert np.median(picture) > 190
