"""Figure of how long networks hold what they saw, by the time constant of the PFC.

A network sees the pictures of a rollout up to the last one that is the same for all choices of a
variable, and then this picture again and again. As long as it remembers what it saw before, its
output tells the choice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from actors.policies.contract import Policy
from actors.tasks.contract import Array, MemoryProbe, Task
from proto.body import ACTION_NAMES
from proto.episode import Episode, Image
from proto.errors import UserError
from services.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    figure_style,
    percent,
    words_and_unit,
)
from services.terminal.rates import rate_text
from services.trials.success import Rate

COLOURS: Final = (RED, BLUE, GREEN, ORANGE, PINK, SKY, BLACK)
"""Colours of the time constants in ascending order; repeated if there are more."""
TABLE_STEPS: Final = (0, 10, 30, 60, 100, 150, 200)
"""Frozen steps that the table shows."""


@dataclass(frozen=True)
class MemoryTask:
    """What must be remembered in a task, and how the output tells it.

    Attributes:
        name: name of the task.
        probe: the task's probe.
        turned_after: number of steps after the phase of the probe in which the tutor's output
            reaches the value of its choice.
        values: the value of the output that the tutor reaches, by choice; the mean of all tutored
            situations with this choice.
    """

    name: str
    probe: MemoryProbe
    turned_after: int
    values: Mapping[str, float]

    @classmethod
    def of(cls, task: Task) -> MemoryTask:
        """Learn the values from the tutor's plans.

        Raises:
            UserError: the task does not say what must be remembered.
        """
        probe = task.figure_words.memory
        if probe is None:
            raise UserError(
                f"the task {task.name} does not say what must be remembered; its figure_words need"
                " a `memory`, see actors/tasks/contract.py"
            )
        phase = task.phase_names.index(probe.phase)
        reached = int(np.flatnonzero(task.phases == phase + 1)[-1])
        by_choice: dict[str, list[float]] = {}
        for situation in task.tutored():
            value = task.plan(situation)[reached, ACTION_NAMES.index(probe.output)]
            by_choice.setdefault(str(situation[probe.variable]), []).append(float(value))
        return cls(
            task.name,
            probe,
            turned_after=int((task.phases == phase + 1).sum()),
            values={choice: float(np.mean(values)) for choice, values in by_choice.items()},
        )

    def cue_of(self, episode: Episode) -> Cue:
        """Return the part of a rollout before the output tells the choice.

        Raises:
            UserError: it is a rollout of another task, lacks the phase, or its choice was not
                tutored.
        """
        if episode.task != self.name:
            raise UserError(
                f"rollout {episode.id} shows the task {episode.task!r}, not {self.name!r}"
            )
        choice = str(episode.situation.get(self.probe.variable))
        if choice not in self.values:
            raise UserError(
                f"rollout {episode.id} has {self.probe.variable} = {choice}; tutored are"
                f" {', '.join(self.values)}"
            )
        if self.probe.phase not in episode.phase_names:
            raise UserError(f"rollout {episode.id} has no phase {self.probe.phase!r}")
        phase = episode.phase_names.index(self.probe.phase)
        steps = np.flatnonzero(episode.phases == phase)
        if not len(steps):
            raise UserError(f"rollout {episode.id} ended before the phase {self.probe.phase!r}")
        return Cue(choice, episode.images[: steps[-1] + 1])

    def tells(self, outputs: Array, choice: str) -> NDArray[np.bool_]:
        """Return (N,) whether each output (N,) is nearest to the tutored value of a choice.

        For two choices this is the right side of the midpoint between their values.
        """
        values = np.array(list(self.values.values()))
        nearest = np.abs(outputs[:, None] - values).argmin(axis=1)
        return np.asarray(nearest == list(self.values).index(choice))

    def outputs(self, policy: Policy, cue: Cue, steps: int) -> Array:
        """Return the output (steps + 1,) of a policy that sees a cue, then its last picture.

        Args:
            policy: the policy.
            cue: the pictures.
            steps: number of steps in which the last picture is shown again. Output 0 is that for
                the last picture itself.
        """
        policy.begin({}, seed=0)
        last = cue.pictures[-1]
        for picture in cue.pictures[:-1]:
            policy.step(picture)
        index = ACTION_NAMES.index(self.probe.output)
        return np.array([policy.step(last)[index] for _ in range(steps + 1)])


@dataclass(frozen=True)
class Cue:
    """The pictures (T, 48, 64) uint8 of a rollout from which a choice must be remembered."""

    choice: str
    pictures: Image


@dataclass(frozen=True)
class Network:
    """A network.

    Attributes:
        policy: the network as a policy.
        file: the checkpoint.
        tau: time constant of its PFC.
    """

    policy: Policy
    file: str
    tau: float


@dataclass(frozen=True)
class Recall:
    """Whether a network still tells the choice of each rollout.

    Attributes:
        network: the network.
        right: (rollouts, steps + 1), by number of frozen steps.
    """

    network: Network
    right: NDArray[np.bool_]


@dataclass(frozen=True)
class Retention:
    """The networks of one time constant together.

    Attributes:
        tau: time constant of their PFC.
        recalls: the networks.
    """

    tau: float
    recalls: Sequence[Recall]

    @property
    def rates(self) -> list[Rate]:
        """Share of the rollouts of all networks whose choice is told, by frozen steps."""
        return rates_of(np.concatenate([recall.right for recall in self.recalls]))


def rates_of(right: NDArray[np.bool_]) -> list[Rate]:
    """Return the rate of each column of `right` (trials, steps + 1)."""
    return [Rate(int(count), len(right)) for count in right.sum(axis=0)]


def recall_of(memory: MemoryTask, network: Network, cues: Iterable[Cue], steps: int) -> Recall:
    """Test a network with rollouts."""
    return Recall(
        network,
        np.stack(
            [memory.tells(memory.outputs(network.policy, cue, steps), cue.choice) for cue in cues]
        ),
    )


def retentions_of(recalls: Iterable[Recall]) -> list[Retention]:
    """Group networks by the time constant of their PFC, in ascending order."""
    by_tau: dict[float, list[Recall]] = {}
    for recall in sorted(recalls, key=lambda each: each.network.tau):
        by_tau.setdefault(recall.network.tau, []).append(recall)
    return [Retention(tau, group) for tau, group in by_tau.items()]


def numbers(memory: MemoryTask, retentions: Sequence[Retention]) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`; lists run over the frozen steps."""
    return {
        "task": memory.name,
        "phase": memory.probe.phase,
        "variable": memory.probe.variable,
        "output": memory.probe.output,
        "tutored": dict(memory.values),
        "tutor_turned_after": memory.turned_after,
        "time_constants": [
            {
                "tau": retention.tau,
                "trials": retention.rates[0].trials,
                "right": [rate.successes for rate in retention.rates],
                "rate": [rate.rate for rate in retention.rates],
                "wilson95": [list(rate.wilson95) for rate in retention.rates],
                "networks": [
                    {
                        "file": recall.network.file,
                        "run": recall.network.policy.name,
                        "version": recall.network.policy.version,
                        "right": recall.right.sum(axis=0).tolist(),
                    }
                    for recall in retention.recalls
                ],
            }
            for retention in retentions
        ],
    }


def table(memory: MemoryTask, retentions: Sequence[Retention]) -> Table:
    """Return a table of the share that is right, a row for some numbers of frozen steps."""
    words = words_and_unit(memory.probe.output)[0]
    result = Table(
        caption=f"% of rollouts whose choice the {words} tells, with 95 % Wilson intervals; the"
        f" tutor's {words} takes {memory.turned_after} steps to tell it"
    )
    rates = {retention.tau: retention.rates for retention in retentions}
    for heading in ("frozen steps", *(f"tau {tau:g}" for tau in rates)):
        result.add_column(heading, justify="right")
    result.add_row("networks", *(str(len(retention.recalls)) for retention in retentions))
    result.add_row("trials", *(str(of_tau[0].trials) for of_tau in rates.values()))
    result.add_section()
    for step in TABLE_STEPS:
        if step < len(retentions[0].rates):
            result.add_row(
                str(step), *(rate_text(of_tau[step], digits=0) for of_tau in rates.values())
            )
    return result


def draw(memory: MemoryTask, retentions: Sequence[Retention]) -> Figure:
    """Draw the share that is right against the number of frozen steps."""
    with figure_style():
        figure = Figure(figsize=(6.0, 3.6), layout="constrained")
        axes = figure.subplots()
        for number, retention in enumerate(retentions):
            _draw_retention(axes, retention, COLOURS[number % len(COLOURS)])
        axes.axhline(100 / len(memory.values), color=GREY, linewidth=0.7, label="chance")
        axes.axvline(
            memory.turned_after,
            color=GREY,
            linewidth=0.7,
            linestyle=(0, (2, 2)),
            label="tutor's output tells it",
        )
        variable, output = (
            words_and_unit(name)[0] for name in (memory.probe.variable, memory.probe.output)
        )
        axes.set_xlabel(f"steps with the last picture of “{memory.probe.phase}” again")
        axes.set_ylabel(f"{variable} told by the {output} (%)")
        axes.set_xlim(0, len(retentions[0].rates) - 1)
        axes.set_ylim(0, 102)
        figure.legend(loc="outside upper center", ncols=3)
        return figure


def _draw_retention(axes: Axes, retention: Retention, colour: str) -> None:
    middle, reach = percent(retention.rates)
    steps = np.arange(len(middle))
    count = len(retention.recalls)
    networks = f"{count} network" if count == 1 else f"{count} networks"
    axes.plot(steps, middle, color=colour, label=f"PFC with tau {retention.tau:g} ({networks})")
    axes.fill_between(
        steps, middle - reach[0], middle + reach[1], color=colour, alpha=0.15, linewidth=0
    )
