"""Success against the number of tutored cases, as corrections come in round by round."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from services.figures.style import BLACK, BLUE, GREEN, ORANGE, PINK, RED, SKY, look, percent
from services.trials.round_trials import LapEnd, Run
from services.trials.success import Tally

READINGS: Final = ("strict", "precise")
_COLOURS: Final = (BLUE, ORANGE, GREEN, PINK, SKY, RED, BLACK)
_MARKERS: Final = "osD^vPX"


@dataclass(frozen=True)
class Curve:
    """What was counted of one run.

    Attributes:
        run: the run.
        tallies: one for each of `run.lap_ends`.
    """

    run: Run
    tallies: Sequence[Tally]

    @property
    def choose(self) -> str:
        """In which situations the run was corrected; `none` if it was not."""
        corrections = self.run.config.learner.corrections
        return corrections.choose if corrections.rounds else "none"

    @property
    def points(self) -> Sequence[tuple[LapEnd, Tally]]:
        """Each policy and what was counted of it."""
        return list(zip(self.run.lap_ends, self.tallies, strict=True))


def numbers(curves: Sequence[Curve]) -> dict[str, Any]:
    """All that the figure shows, for `json.dumps`."""
    return {
        "runs": [
            {
                "run": str(curve.run.folder),
                "choose": curve.choose,
                "policies": [_numbers_of(lap_end, tally) for lap_end, tally in curve.points],
            }
            for curve in curves
        ]
    }


def table(curves: Sequence[Curve]) -> Table:
    """Success after each round."""
    result = Table(caption="% of the trials with the 95 % interval")
    for heading in ("run", "round", "cases", *READINGS):
        result.add_column(heading, justify="left" if heading == "run" else "right")
    for curve in curves:
        for lap_end, tally in curve.points:
            first = lap_end is curve.run.lap_ends[0]
            result.add_row(
                f"{curve.run.config.run.name}: {curve.choose}" if first else "",
                str(lap_end.round),
                str(lap_end.cases),
                *(_text(tally, reading) for reading in READINGS),
            )
        result.add_section()
    return result


def draw(curves: Sequence[Curve]) -> Figure:
    """One panel for each reading of success, one line a run."""
    labels = _labels(curves)
    with look():
        figure = Figure(figsize=(7.0, 3.2), layout="constrained")
        panels = figure.subplots(1, len(READINGS), sharey=True)
        for axes, reading in zip(panels, READINGS, strict=True):
            looks = zip(cycle(_COLOURS), cycle(_MARKERS), strict=False)
            for curve, label, (colour, marker) in zip(curves, labels, looks, strict=False):
                _draw_curve(axes, curve, reading, label=label, color=colour, marker=marker)
            axes.set_title(reading)
            axes.set_xlabel("tutored cases")
            axes.set_ylim(0, 102)
        panels[0].set_ylabel("success (%)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
        return figure


def _draw_curve(axes: Axes, curve: Curve, reading: str, **look_of: Any) -> None:
    middle, reach = percent(tally.rate(reading) for tally in curve.tallies)
    cases = [lap_end.cases for lap_end in curve.run.lap_ends]
    axes.errorbar(
        cases, middle, yerr=reach, linewidth=1.0, markersize=4, elinewidth=0.9, capsize=2, **look_of
    )


def _labels(curves: Sequence[Curve]) -> list[str]:
    """What was corrected in each run, and its name where that does not tell it from others."""
    count = Counter(curve.choose for curve in curves)
    return [
        curve.choose
        if count[curve.choose] == 1
        else f"{curve.choose} ({curve.run.config.run.name})"
        for curve in curves
    ]


def _numbers_of(lap_end: LapEnd, tally: Tally) -> Mapping[str, Any]:
    return {
        "round": lap_end.round,
        "policy_version": lap_end.version,
        "cases": lap_end.cases,
        "sequences": lap_end.sequences,
        **tally.as_json(),
    }


def _text(tally: Tally, reading: str) -> str:
    rate = tally.rate(reading)
    low, high = rate.wilson95
    return f"{100 * rate.rate:.1f} ({100 * low:.0f} to {100 * high:.0f})"
