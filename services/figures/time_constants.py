"""Figure of success against the time constant of the PFC (paper, figure 5)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from actors.tasks.contract import FigureWords
from services.figures.style import BLACK, BLUE, GREY, figure_style, percent
from services.terminal.rates import difference_text, percent_text, rate_text
from services.trials.success import READINGS, Rate, Tally, difference95, pooled
from services.trials.sweeps import RunOutcomes

PAPER_TAU: Final = 150.0
"""Time constant of the PFC in the paper's network."""

PAPER_READING: Final = "lenient"
"""Our reading of success that is the paper's criterion."""

Tallies = Mapping[float, Mapping[int, Tally]]
"""Counted trials by time constant and training seed."""
Published = Mapping[float, Rate]
"""Published rates by time constant; the paper's criterion of success is our `lenient`."""


def tallies_of(tested: Sequence[RunOutcomes]) -> Tallies:
    """Count the outcomes; time constants and seeds are in ascending order."""
    by_tau: dict[float, dict[int, Tally]] = defaultdict(dict)
    for each in sorted(tested, key=lambda each: (_tau(each), each.run.seed)):
        by_tau[_tau(each)][each.run.seed] = Tally.of(each.outcomes)
    return by_tau


def published_rates(words: FigureWords) -> Published:
    """Return the published rates of a task."""
    return {tau: Rate(*counts) for tau, counts in words.published.items()}


def numbers(tallies: Tallies, published: Published) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    return {
        "time_constants": [
            {
                "tau": tau,
                "trials": sum(tally.trials for tally in by_seed.values()),
                "pooled": {
                    reading: pooled(by_seed.values(), reading).as_json() for reading in READINGS
                },
                "by_seed": {str(seed): tally.as_json() for seed, tally in by_seed.items()},
                "against_150": {
                    reading: _against(tallies, tau, reading)
                    for reading in READINGS
                    if PAPER_TAU in tallies and tau != PAPER_TAU
                },
            }
            for tau, by_seed in tallies.items()
        ],
        "paper": {
            f"{tau:g}": rate.as_json() | {"trials": rate.trials} for tau, rate in published.items()
        },
    }


def table(tallies: Tallies) -> Table:
    """Return a table of success by time constant, and of the difference from 150."""
    result = Table(
        caption="% of the trials of all seeds with 95 % Wilson intervals, by seed, and difference"
        " from 150 in points with its 95 % interval; the intervals cover the choice of trials, the"
        " seeds show how networks differ"
    )
    for heading in ("tau", "reading", "all seeds", "by seed", "against 150"):
        result.add_column(heading, justify="right" if heading == "tau" else "left")
    for tau, by_seed in tallies.items():
        for reading in READINGS:
            rate = pooled(by_seed.values(), reading)
            seeds = ", ".join(
                percent_text(tally.rate(reading).rate, 0) for tally in by_seed.values()
            )
            result.add_row(
                f"{tau:g}" if reading == READINGS[0] else "",
                reading,
                rate_text(rate),
                seeds,
                _against_text(tallies, tau, reading),
            )
        result.add_section()
    return result


def draw(tallies: Tallies, published: Published) -> Figure:
    """Draw one panel for each reading; the published rates stand beside ours of their reading."""
    with figure_style():
        figure = Figure(figsize=(8.4, 3.2), layout="constrained")
        panels = figure.subplots(1, len(READINGS), sharey=True)
        for axes, reading in zip(panels, READINGS, strict=True):
            _draw_reading(axes, tallies, published, reading)
            axes.set_title(reading)
            axes.set_xlabel("time constant of the PFC (steps)")
            axes.set_xticks(sorted({*tallies, *published}))
            axes.set_ylim(0, 102)
        panels[0].set_ylabel("success (%)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        return figure


def _draw_reading(axes: Axes, tallies: Tallies, published: Published, reading: str) -> None:
    if published and reading == PAPER_READING:
        words = "paper (lifted at the end)"
        _draw_rates(axes, published, -4.0, color=GREY, marker="D", linestyle="none", label=words)
    rates = {tau: pooled(by_seed.values(), reading) for tau, by_seed in tallies.items()}
    _draw_rates(axes, rates, 0.0, color=BLUE, marker="o", linewidth=1.0, label="ours, all seeds")
    places = [(tau, tally) for tau, by_seed in tallies.items() for tally in by_seed.values()]
    axes.scatter(
        [tau + 4.0 for tau, _ in places],
        [100 * tally.rate(reading).rate for _, tally in places],
        s=10,
        facecolors="none",
        edgecolors=BLACK,
        linewidths=0.6,
        label="ours, one seed",
        zorder=3,
    )


def _draw_rates(axes: Axes, rates: Mapping[float, Rate], offset: float, **style: Any) -> None:
    middle, reach = percent(rates.values())
    axes.errorbar(
        np.array(list(rates)) + offset,
        middle,
        yerr=reach,
        markersize=4,
        elinewidth=0.9,
        capsize=2,
        **style,
    )


def _against(tallies: Tallies, tau: float, reading: str) -> dict[str, Any]:
    rate, paper = (pooled(tallies[each].values(), reading) for each in (tau, PAPER_TAU))
    return {"difference": rate.rate - paper.rate, "interval95": list(difference95(rate, paper))}


def _against_text(tallies: Tallies, tau: float, reading: str) -> str:
    if PAPER_TAU not in tallies or tau == PAPER_TAU:
        return ""
    found = _against(tallies, tau, reading)
    return difference_text(found["difference"], found["interval95"])


def _tau(tested: RunOutcomes) -> float:
    return tested.run.config.network.pfc.tau
