"""Tasks by name."""

from __future__ import annotations

from actors.tasks.contract import Task
from actors.tasks.experiment1.reaching import Reaching
from actors.tasks.experiment1.task import Experiment1
from proto.config import TaskConfig

TASKS = {task.name: task for task in (Experiment1, Reaching)}


def make_task(config: TaskConfig) -> Task:
    """Make the task that the configuration names."""
    return TASKS[config.name](config.attention)
