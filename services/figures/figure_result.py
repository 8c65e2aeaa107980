"""The result of a figure's command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table


@dataclass(frozen=True)
class FigureResult:
    """A figure with its numbers.

    Attributes:
        figure: the drawing.
        numbers: the numbers that it shows, for `json.dumps`.
        table: a summary of the numbers, for the terminal.
    """

    figure: Figure
    numbers: Mapping[str, Any]
    table: Table
