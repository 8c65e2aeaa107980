"""How all figures look, and how they are written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from proto.errors import UserError
from proto.storage import written_whole
from services.trials.success import Rate

Array = NDArray[np.float64]

# Okabe and Ito's colours, which colour-blind people tell apart too.
BLACK: Final = "#000000"
ORANGE: Final = "#E69F00"
SKY: Final = "#56B4E9"
GREEN: Final = "#009E73"
YELLOW: Final = "#F0E442"
BLUE: Final = "#0072B2"
RED: Final = "#D55E00"
PINK: Final = "#CC79A7"
GREY: Final = "#999999"

READING_COLOURS: Final[Mapping[str, str]] = {"lenient": ORANGE, "strict": BLUE, "precise": GREEN}

_LOOK: Final[dict[Any, Any]] = {
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "lines.linewidth": 1.2,
    "savefig.dpi": 200,
}
_UNITS: Final = {"m": "m", "deg": "degrees", "mm": "mm"}


def look() -> AbstractContextManager[None]:
    """A context within which figures look alike."""
    return mpl.rc_context(_LOOK)


def percent(rates: Iterable[Rate]) -> tuple[Array, Array]:
    """N rates in percent, (N,), and how far their intervals reach below and above, (2, N)."""
    middle, low, high = 100 * np.array([(rate.rate, *rate.wilson95) for rate in rates]).T
    return middle, np.maximum([middle - low, high - middle], 0.0)  # at 0 and 100 % they round


def check_name(path: Path) -> None:
    """Refuse a name that is none of a PNG file.

    Raises:
        UserError: it does not end in .png.
    """
    if path.suffix.lower() != ".png":
        raise UserError(f"--out {path}: figures are PNG; name a file that ends in .png")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the file appears under its name once it is whole.

    Raises:
        UserError: it cannot be written there.
    """
    with look(), written_whole(path) as stream:
        figure.savefig(stream, format="png")


def label(name: str) -> str:
    """A value of a situation for people: `object_y_m` is `object Y (m)`."""
    words, unit = words_and_unit(name)
    return f"{words} ({unit})" if unit else words


def words_and_unit(name: str) -> tuple[str, str]:
    """`object_y_m` is (`object Y`, `m`); the unit is empty where the name has none."""
    *words, last = name.split("_")
    unit = _UNITS.get(last, "")
    if not unit or not words:
        words.append(last)
    return " ".join(word.upper() if len(word) == 1 else word for word in words), unit
