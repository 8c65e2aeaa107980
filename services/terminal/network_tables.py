"""What `vmdnn inspect` shows of networks, as tables for people."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

from rich.box import SIMPLE
from rich.table import Table

from learner.network.subnets import Subnet
from learner.network.vision_probe import ClassifierScore, RegressionScore


def subnet_numbers(subnet: Subnet) -> dict[str, Any]:
    """One subnet; sizes as in the paper: (maps, width, height), kernels (width, height)."""
    return {
        "name": subnet.name,
        "symbol": subnet.symbol,
        "shape": _paper_shape(subnet),
        "tau": subnet.tau,
        "kernel": subnet.kernel,
        "stride": subnet.stride,
        "weights": subnet.weights,
        "biases": subnet.biases,
    }


def subnet_table(subnets: Sequence[Subnet]) -> Table:
    """A row for each subnet, and the sums of weights and biases."""
    rows = [subnet_numbers(subnet) for subnet in subnets]
    table = Table(
        box=SIMPLE,
        padding=(0, 1, 0, 0),
        caption="shape: maps x width x height; kernel: width x height",
    )
    for column in rows[0]:
        table.add_column(column, no_wrap=True)
    for row in rows:
        table.add_row(*(_cell(value) for value in row.values()))
    table.add_section()
    sums = (str(sum(row[key] for row in rows)) for key in ("weights", "biases"))
    table.add_row("all", *[""] * 5, *sums)
    return table


def classifier_table(scores: Sequence[ClassifierScore], sequences: int) -> Table:
    """A row for each value; `sequences` is the number of sequences that were classified."""
    table = Table(box=SIMPLE, title=f"The classifier, {sequences} sequences", title_justify="left")
    for column in ("value", "classes", "nearest class %", "mean error"):
        table.add_column(column, justify="left" if column == "value" else "right", no_wrap=True)
    for score in scores:
        right = f"{100 * score.right:.1f}"
        error = "" if score.error is None else _with_unit(score.value, score.error)
        table.add_row(score.value, str(score.classes), right, error)
    return table


def regression_table(scores: Sequence[RegressionScore], learned: int, tested: int) -> Table:
    """A row for each phase, a column for each value.

    Args:
        scores: scores by phase and value.
        learned: number of sequences that the regression was fitted to.
        tested: number of sequences that it was tested on.
    """
    values = list(dict.fromkeys(score.value for score in scores))
    table = Table(
        box=SIMPLE,
        title=f"Linear regression from V_S at the end of each phase, learned from {learned}"
        f" sequences: mean error on {tested} others",
        title_justify="left",
    )
    table.add_column("phase", no_wrap=True)
    for value in values:
        table.add_column(value, justify="right", no_wrap=True)
    for number, (phase, group) in enumerate(groupby(scores, lambda score: score.phase), 1):
        errors = (_with_unit(score.value, score.error) for score in group)
        table.add_row(f"{number} {phase}", *errors)
    blind = {score.value: score.blind_error for score in scores}
    table.add_section()
    table.add_row("without seeing", *(_with_unit(value, blind[value]) for value in values))
    return table


def _with_unit(value: str, error: float) -> str:
    """An error in the usual unit of a value of the situation."""
    if value.endswith("_m"):
        return f"{1e3 * error:.1f} mm"
    return f"{error:.2f} deg" if value.endswith("_deg") else f"{error:.3g}"


def _paper_shape(subnet: Subnet) -> tuple[int, ...]:
    if len(subnet.shape) < 3:
        return subnet.shape
    maps, height, width = subnet.shape
    return maps, width, height


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " x ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
