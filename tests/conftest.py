"""Fixtures for several folders of tests."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from outcomes import IMPRECISE

from actors.tasks.experiment1.world import SUBTASKS
from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.episode import Episode, Kind
from proto.messages import EpisodeFailed

# The time of an example depends on the load of the machine, so hypothesis must not limit it.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


@pytest.fixture(scope="session")
def make_episode() -> Callable[..., Episode]:
    """Return a function that makes an episode with different values in every step.

    Fields can be given by name.
    """

    def make(steps: int = 40, **given: Any) -> Episode:
        random = np.random.default_rng(steps)

        def walk(*shape: int) -> np.ndarray:
            return np.cumsum(random.normal(size=shape), axis=0).astype(np.float32)

        episode = Episode(
            id="0123456789abcdef",
            kind=Kind.TUTORING,
            task="experiment1",
            situation={"obstacle_x_m": -0.27, "object_y_m": 0.25, "object_yaw_deg": -22.5},
            seed=3001,
            actor="local",
            backend="sapien",
            policy="tutor",
            policy_version=0,
            config_digest="c0ffee",
            images=random.integers(0, 256, (steps, IMAGE_HEIGHT, IMAGE_WIDTH), dtype=np.uint8),
            actions=walk(steps, ACTION_SIZE),
            targets=walk(steps, ACTION_SIZE),
            joints_deg=walk(steps, len(JOINT_NAMES)),
            phase_names=tuple(SUBTASKS),
            phases=np.linspace(0, 7, steps).astype(np.uint8),
            body_names=("object", "obstacle"),
            body_poses=walk(steps, 2, 7),
            outcome=IMPRECISE,
            outputs=random.random((steps, 110), dtype=np.float32),
        )
        return replace(episode, **given)

    return make


@pytest.fixture(scope="session")
def failure() -> Callable[..., EpisodeFailed]:
    """Return a function that makes the report of a failed simulation.

    Fields can be given by name.
    """

    def make(name: str, **given: Any) -> EpisodeFailed:
        report = EpisodeFailed(
            id=name,
            actor="actor",
            kind=Kind.TUTORING,
            task="experiment1",
            seed=0,
            situation={"object_y_m": 0.25},
            training="",
            policy_version=0,
            problem="episode.joints_deg: expected finite numbers, got NaN or infinity",
            died=False,
        )
        return replace(report, **given)

    return make


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ("mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place))
    if shutil.which("mount") is None or subprocess.run(mount, check=False).returncode != 0:
        pytest.skip("no file system can be mounted here")
    try:
        yield place
    finally:
        subprocess.run(("umount", str(place)), check=True)
