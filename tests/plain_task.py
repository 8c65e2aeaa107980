"""A user's task whose object no disturbance can push."""

from __future__ import annotations

from actors.tasks.experiment1.task import Experiment1


class PlainTask(Experiment1):
    """Experiment I, without saying which variable a push changes."""

    pushed_variable = ""
