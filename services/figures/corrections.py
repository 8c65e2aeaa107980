"""Figure of success against the number of tutored cases after each round of corrections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count, cycle
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.table import Table

from services.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    figure_style,
    percent,
    show_percent,
)
from services.terminal.rates import rate_text
from services.trials.round_trials import RoundPolicy, Run
from services.trials.success import Tally

READINGS: Final = ("strict", "precise")
APART: Final = 0.3
"""Curves are drawn so far apart (cases) that those with equal values do not hide each other."""
_COLOURS: Final = (BLUE, ORANGE, GREEN, PINK, SKY, RED, BLACK)
_MARKERS: Final = "osD^vPX"


@dataclass(frozen=True)
class Curve:
    """Counted trials of one run.

    Attributes:
        run: the run.
        tallies: the counted trials of each policy in `run.policies`.
    """

    run: Run
    tallies: Sequence[Tally]

    @property
    def choose(self) -> str:
        """How situations were chosen for corrections; `none` without corrections."""
        corrections = self.run.config.learner.corrections
        return corrections.choose if corrections.rounds else "none"

    @property
    def points(self) -> Sequence[tuple[RoundPolicy, Tally]]:
        """Each policy and its counted trials."""
        return list(zip(self.run.policies, self.tallies, strict=True))


def numbers(curves: Sequence[Curve]) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    return {
        "runs": [
            {
                "run": str(curve.run.folder),
                "choose": curve.choose,
                "policies": [_numbers_of(policy, tally) for policy, tally in curve.points],
            }
            for curve in curves
        ]
    }


def table(curves: Sequence[Curve]) -> Table:
    """Return a table of success after each round."""
    result = Table(caption="% of the trials with the 95 % interval")
    for heading in ("run", "round", "cases", *READINGS):
        result.add_column(heading, justify="left" if heading == "run" else "right")
    for curve in curves:
        for policy, tally in curve.points:
            first = policy is curve.run.policies[0]
            result.add_row(
                f"{curve.run.config.run.name}: {curve.choose}" if first else "",
                str(policy.round),
                str(policy.cases),
                *(rate_text(tally.rate(reading)) for reading in READINGS),
            )
        result.add_section()
    return result


def draw(curves: Sequence[Curve]) -> Figure:
    """Draw one panel for each reading of success, with one line for each run."""
    labels = _labels(curves)
    with figure_style():
        figure = Figure(figsize=(7.0, 3.2), layout="constrained")
        panels = figure.subplots(1, len(READINGS), sharey=True)
        for axes, reading in zip(panels, READINGS, strict=True):
            styles = zip(cycle(_COLOURS), cycle(_MARKERS), strict=False)
            drawn = zip(count(), curves, labels, styles, strict=False)
            for number, curve, label, (colour, marker) in drawn:
                style = {"label": label, "color": colour, "marker": marker}
                _draw_curve(axes, curve, reading, APART * (number - (len(curves) - 1) / 2), **style)
            axes.set_title(reading)
            axes.set_xlabel("tutored cases")
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            show_percent(axes, _lowest(curves))
        panels[0].set_ylabel("success (%)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=min(len(labels), 4),
            title="situations of the corrections",
        )
        return figure


def _lowest(curves: Sequence[Curve]) -> float:
    """The lowest end of an interval that is drawn (percent)."""
    rates = [tally.rate(each) for curve in curves for tally in curve.tallies for each in READINGS]
    return 100 * min(rate.wilson95[0] for rate in rates)


def _draw_curve(axes: Axes, curve: Curve, reading: str, offset: float, **style: Any) -> None:
    middle, reach = percent(tally.rate(reading) for tally in curve.tallies)
    cases = [policy.cases + offset for policy in curve.run.policies]
    axes.errorbar(
        cases, middle, yerr=reach, linewidth=1.0, markersize=4, elinewidth=0.9, capsize=2, **style
    )


def _labels(curves: Sequence[Curve]) -> list[str]:
    """Return a label for each run: how its situations were chosen, with its name if ambiguous."""
    runs = Counter(curve.choose for curve in curves)
    return [
        curve.choose if runs[curve.choose] == 1 else f"{curve.choose} ({curve.run.config.run.name})"
        for curve in curves
    ]


def _numbers_of(policy: RoundPolicy, tally: Tally) -> Mapping[str, Any]:
    return {
        "round": policy.round,
        "policy_version": policy.version,
        "cases": policy.cases,
        "sequences": policy.sequences,
        **tally.as_json(),
    }
