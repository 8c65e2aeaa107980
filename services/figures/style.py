"""Style, labels and writing of all figures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from proto.errors import UserError
from proto.storage import written_whole
from services.trials.success import Rate

Array = NDArray[np.float64]

# The palette of Okabe and Ito, which colour-blind people can distinguish.
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

_STYLE: Final[dict[Any, Any]] = {
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


def figure_style() -> AbstractContextManager[None]:
    """Return a context in which matplotlib uses the style of all figures."""
    return mpl.rc_context(_STYLE)


def percent(rates: Iterable[Rate]) -> tuple[Array, Array]:
    """Return N rates (N,) and their error bars (2, N) below and above, in percent."""
    middle, low, high = 100 * np.array([(rate.rate, *rate.wilson95) for rate in rates]).T
    # At 0 and 100 % rounding can make a bar slightly negative.
    return middle, np.maximum([middle - low, high - middle], 0.0)


def show_percent(axes: Axes, lowest: float) -> None:
    """Let an axis show success from a bit below the lowest value up to 100 %, in whole numbers.

    Args:
        axes: the panel.
        lowest: lowest value that is drawn (percent).
    """
    bottom = max(0.0, math.floor(lowest) - 0.02 * (100 - lowest))
    axes.set_ylim(bottom, 100 + 0.04 * (100 - bottom))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))


def check_name(path: Path) -> None:
    """Check that a file name ends in .png.

    Raises:
        UserError: it does not.
    """
    if path.suffix.lower() != ".png":
        raise UserError(f"--out {path}: figures are PNG; name a file that ends in .png")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the file appears under its name only when it is complete.

    Raises:
        UserError: the file cannot be written.
    """
    with figure_style(), written_whole(path) as stream:
        figure.savefig(stream, format="png")


def label(name: str) -> str:
    """Return the label of a variable: `object_y_m` gives `object Y (m)`."""
    words, unit = words_and_unit(name)
    return f"{words} ({unit})" if unit else words


def words_and_unit(name: str) -> tuple[str, str]:
    """Split the name of a variable into words and unit: `object_y_m` gives (`object Y`, `m`).

    The unit is empty if the name has none.
    """
    *words, last = name.split("_")
    unit = _UNITS.get(last, "")
    if not unit or not words:
        words.append(last)
    return " ".join(word.upper() if len(word) == 1 else word for word in words), unit
