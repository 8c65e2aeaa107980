"""MuJoCo's renderer leaves out what the eye does not see, and no picture changes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("mujoco")

from actors.attention import targets_of_action
from actors.backends.mujoco.renderer import Renderer
from actors.simulator import Crop, Simulator, make_simulator
from actors.tasks.registry import make_task
from proto.config import SimulatorConfig, TaskConfig

CROPS = (Crop(), Crop(200, 150), Crop(80, 60))


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    with closing(make_simulator(SimulatorConfig(backend="mujoco"))) as simulator:
        yield simulator


def shown(renderer: Renderer) -> int:
    return int((renderer._model.geom_rgba[:, 3] > 0).sum())


@pytest.mark.parametrize("name", ["experiment1", "experiment2"])
def test_bodies_outside_the_picture_are_left_out_and_it_stays_the_same(
    name: str, simulator: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = make_task(TaskConfig(name=name))
    situation = task.tutored()[-3]
    simulator.reset(task.scene(situation))
    counts = []
    for step, action in enumerate(task.plan(situation)):
        if step % 10 == 0:
            pictures = [simulator.observe(crop).image for crop in CROPS]
            counts.append(shown(simulator._eye_renderer))
            with monkeypatch.context() as context:
                context.setattr(Renderer, "_hide_bodies_outside", show_all)
                everything = [simulator.observe(crop).image for crop in CROPS]
            assert np.array_equal(pictures, everything), f"step {step}"
        simulator.step(targets_of_action(action))
    bodies = simulator._eye_renderer._model.ngeom
    assert min(counts) < bodies / 2, "close up, most bodies are left out"


def show_all(renderer: Renderer, *_: object) -> None:
    renderer._model.geom_rgba[:, 3] = 1.0
