"""A task as a table for people and as JSON."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE
from rich.table import Table

from actors.tasks.contract import Task
from proto.variables import Continuous, Variable


def task_description(task: Task) -> dict[str, Any]:
    """What a task consists of, for `json.dumps`."""
    return {
        "name": task.name,
        "variables": [_variable(variable) for variable in task.variables],
        "phases": dict(task.subtasks),
        "tutored_cases": len(task.tutored()),
        "baselines": ["tutor", *task.baselines],
        "blinded": [f"{name}:POLICY" for name in task.blinded],
        "questions": [question.variable for question in task.questions],
    }


def task_table(task: Task) -> Table:
    """What a task consists of, one line for each part."""
    table = Table(box=SIMPLE, show_header=False, title=f"task {task.name}", title_justify="left")
    table.add_column(no_wrap=True)
    table.add_column()
    for variable in task.variables:
        table.add_row(f"variable {variable.name}", _values(variable))
    phases = (f"{name} ({steps})" for name, steps in task.subtasks.items())
    table.add_row("phases (steps)", ", ".join(phases))
    table.add_row("tutored cases", str(len(task.tutored())))
    table.add_row("baselines", ", ".join(["tutor", *task.baselines]))
    if task.blinded:
        table.add_row("blinded policies", ", ".join(f"{name}:POLICY" for name in task.blinded))
    asked = ", ".join(question.variable for question in task.questions)
    table.add_row("pre-training asks for", asked or "nothing")
    return table


def _variable(variable: Variable) -> dict[str, Any]:
    if isinstance(variable, Continuous):
        limits = {"minimum": variable.minimum, "maximum": variable.maximum}
        return {"name": variable.name, **limits, "unit": variable.unit}
    return {"name": variable.name, "choices": list(variable.choices)}


def _values(variable: Variable) -> str:
    if isinstance(variable, Continuous):
        return f"{variable.minimum:g} to {variable.maximum:g} {variable.unit}".rstrip()
    return ", ".join(variable.choices)
