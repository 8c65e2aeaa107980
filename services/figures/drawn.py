"""What a figure's command hands over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table


@dataclass(frozen=True)
class Drawn:
    """A figure and what it shows.

    Attributes:
        figure: to be written.
        numbers: all that it shows, for `json.dumps`.
        table: the gist of it, for people.
    """

    figure: Figure
    numbers: Mapping[str, Any]
    table: Table
