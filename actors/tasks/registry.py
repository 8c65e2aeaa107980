"""Makes tasks by name: built-in tasks, and users' classes as `package.module:Class`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from actors.tasks.contract import Task
from proto.config import Config, TaskConfig
from proto.extensions import check_attributes, load_class

TASKS: Final[Mapping[str, str]] = {
    "experiment1": "actors.tasks.experiment1.task:Experiment1",
    "reaching": "actors.tasks.experiment1.reaching:Reaching",
    "experiment2": "actors.tasks.experiment2.task:Experiment2",
}
_METHODS: Final = ("tutored", "sample", "check", "corners", "scene", "plan", "judge")
_ATTRIBUTES: Final = (
    *("variables", "subtasks", "start", "questions", "baselines", "figure_words"),
    *("blinded", "phases", "phase_names", "attention"),
)


def make_pretraining_task(config: Config) -> Task:
    """Make the task whose sequences are used for pre-training."""
    return make_task(config.task_called(config.pretraining_task or config.task.name))


def make_task(config: TaskConfig) -> Task:
    """Make the task that the section `task` of a configuration names.

    Raises:
        UserError: there is no such task, its class lacks a method or an attribute, or an option is
            unknown.
    """
    made = load_class("task.name", config.name, TASKS, _METHODS)
    made.name = config.name  # recordings store it, so that the task can be made from them
    task: Task = made(config)
    check_attributes("task.name", config.name, task, _ATTRIBUTES)
    return task
