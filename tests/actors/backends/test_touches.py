"""The built-in simulators agree on when the robot touches the obstacle."""

from __future__ import annotations

import pytest

from actors.attention import targets_of_action
from actors.simulator import ROBOT, Box, Pose, Scene, make_simulator
from actors.tasks.registry import make_task
from proto.config import SimulatorConfig, TaskConfig


@pytest.mark.parametrize("name", ["sapien", "mujoco"])
@pytest.mark.parametrize("seed", [900_135, 900_153])
def test_a_hand_that_grazes_the_obstacle_touches_it(name: str, seed: int) -> None:
    """The hand comes within 0.1 mm and is on its way out again a physics step later."""
    pytest.importorskip(name)
    task = make_task(TaskConfig(name="experiment1"))
    situation = task.sample(seed)
    plan = task.plan({**situation, "obstacle_x_m": -0.22})  # for an obstacle that is elsewhere
    simulator = make_simulator(SimulatorConfig(backend=name, render=False))
    simulator.reset(task.scene(situation))
    touched = [
        ("obstacle", ROBOT) in simulator.step(targets_of_action(action)).touches
        for action in plan[:31]
    ]
    assert True in touched
    assert touched.index(True) in {28, 29, 30}


def test_mujoco_reports_no_touch_of_a_box_that_falls_past_another() -> None:
    """Only the speed towards each other counts. PhysX pushes such a box away at the corner."""
    pytest.importorskip("mujoco")
    task = make_task(TaskConfig(name="experiment1"))
    start = task.scene(task.sample(0)).start
    ledge = Box("ledge", (0.1, 0.1, 0.02), Pose((0.3, 0.3, 0.5)), (1, 1, 1), watched=True)
    beside = Pose((0.371, 0.3, 0.56))  # one millimetre from its side
    falling = Box("falling", (0.04, 0.04, 0.04), beside, (1, 1, 1), mass_kg=0.1)
    simulator = make_simulator(SimulatorConfig(backend="mujoco", render=False))
    simulator.reset(Scene((ledge, falling), start, table_drop_m=0.15))
    assert not any(simulator.step(start).touches for _ in range(8))
    assert simulator.bodies()["falling"].position_m[2] < 0.2
