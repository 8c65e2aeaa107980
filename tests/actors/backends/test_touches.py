"""The built-in simulators agree on when the robot touches the obstacle."""

from __future__ import annotations

import pytest

from actors.attention import targets_of_action
from actors.simulator import ROBOT, make_simulator
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
