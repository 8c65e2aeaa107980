"""Results as tables for people."""

from __future__ import annotations

from rich.table import Table

from services.terminal.rates import interval_text, percent_text
from services.trials.success import READINGS, Tally


def success_table(title: str, tally: Tally) -> Table:
    """The three readings of success with their intervals, and how often each reason applied."""
    table = Table(title=title)
    for heading in ("reading", "successes", "rate %", "95 % interval"):
        table.add_column(heading, justify="left" if heading == "reading" else "right")
    for reading in READINGS:
        rate = tally.rate(reading)
        table.add_row(
            reading,
            f"{rate.successes} of {rate.trials}",
            percent_text(rate.rate),
            interval_text(rate.wilson95),
        )
    if tally.reasons:
        table.add_section()
        for reason, count in tally.reasons.most_common():
            table.add_row(reason, str(count))
    return table
