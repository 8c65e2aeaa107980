"""Sequences for a small training: the position of a bar in the picture determines the action."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from proto.body import ACTION_VALUES
from proto.config import Config
from proto.episode import Episode, Image

STEPS = 30
LOWEST = np.array([value.minimum for value in ACTION_VALUES])
HIGHEST = np.array([value.maximum for value in ACTION_VALUES])


def bar_images(place: float, slope: float, steps: int) -> Image:
    """A bright bar on dark ground: 0..1 says where, -1..1 how it lies."""
    rows, columns = np.mgrid[0:48, 0:64]
    distance = columns - (20 + 24 * place) - slope * (rows - 24)
    picture = np.where(np.abs(distance) < 4, 230, 40).astype(np.uint8)
    return np.repeat(picture[None], steps, axis=0)


def way(place: float, slope: float, steps: int) -> np.ndarray:
    """From the middle of all ranges to where the bar says, (steps, 11)."""
    goal = np.where(np.arange(11) % 2, 0.25 + 0.5 * place, 0.5 + 0.25 * slope)
    progress = np.linspace(0, 1, steps)[:, None]
    fractions = 0.5 + (goal - 0.5) * progress
    return (LOWEST + (HIGHEST - LOWEST) * fractions).astype(np.float32)


@pytest.fixture(scope="session")
def bar_episodes(make_episode: Callable[..., Episode]) -> Callable[..., Sequence[Episode]]:
    """Make the episodes of some places and slopes."""

    def make(
        places: Sequence[float] = (0.0, 1.0),
        slopes: Sequence[float] = (-1.0, 1.0),
        steps: int = STEPS,
    ) -> Sequence[Episode]:
        return [
            make_episode(
                steps,
                id=f"bar-{place}-{slope}",
                situation={"object_y_m": 0.2 + 0.1 * place, "object_yaw_deg": 45 * slope},
                images=bar_images(place, slope, steps),
                targets=way(place, slope, steps),
            )
            for place, slope in product(places, slopes)
        ]

    return make


@pytest.fixture(scope="session")
def small_config() -> Callable[..., Config]:
    """Make a config of a network that is quick to train; learner values can be given."""

    def make(pretraining: int = 4, **learner: object) -> Config:
        return Config.model_validate(
            {
                "network": {
                    "mstnn_fast": {"maps": 2, "kernel": [14, 10], "stride": 2, "tau": 2},
                    "mstnn_slow": {"maps": 3, "kernel": [8, 6], "stride": 2, "tau": 5},
                    "pfc": {"units": 8, "tau": 20},
                    "mtrnn_slow": {"units": 8, "tau": 5},
                    "mtrnn_fast": {"units": 16, "tau": 2},
                },
                "learner": {
                    "epochs": 6,
                    "warmup_epochs": 2,
                    "batch": 3,
                    "pretraining": {
                        "epochs": pretraining,
                        "batch": 3,
                        "image_shift": 0,
                        "image_gain": 0.0,
                    },
                    **learner,
                },
            }
        )

    return make


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine without a C++ compiler, on which no kernels have been compiled."""
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("VMDNN_CACHE", str(tmp_path))
    monkeypatch.setattr("learner.kernels.build.library_name", lambda: "never-compiled.so")
