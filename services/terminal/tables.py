"""Results as tables for people."""

from __future__ import annotations

from rich.table import Table

from services.trials.success import READINGS, Tally


def success_table(title: str, tally: Tally) -> Table:
    """The three readings of success with their intervals, and what went wrong how often."""
    table = Table(title=title)
    for heading in ("reading", "successes", "rate %", "95 % interval"):
        table.add_column(heading, justify="left" if heading == "reading" else "right")
    for reading in READINGS:
        rate = tally.rate(reading)
        low, high = rate.wilson95
        table.add_row(
            reading,
            f"{rate.successes} of {rate.trials}",
            f"{100 * rate.rate:.1f}",
            f"{100 * low:.1f} to {100 * high:.1f}",
        )
    if tally.reasons:
        table.add_section()
        for reason, count in tally.reasons.most_common():
            table.add_row(reason, str(count))
    return table
