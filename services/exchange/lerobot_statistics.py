"""Statistics of the features of a LeRobotDataset, by episode and of all episodes."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Statistics = dict[str, NDArray[Any]]

QUANTILES: Final = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def statistics_of_values(values: NDArray[Any]) -> Statistics:
    """Statistics (D,) of values (T, D) or (T,), and the number of values."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
        **{name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()},
    }


def statistics_of_grey(histogram: NDArray[np.int64], pictures: int) -> Statistics:
    """Statistics (3, 1, 1) in 0..1 of grey pictures that are shown in three channels.

    Args:
        histogram: (256,) number of pixels of each grey level.
        pictures: number of pictures.
    """
    levels = np.arange(256) / 255.0
    pixels = histogram.sum()
    seen = np.flatnonzero(histogram)
    mean = float((histogram * levels).sum() / pixels)
    variance = float((histogram * (levels - mean) ** 2).sum() / pixels)
    below = np.cumsum(histogram) / pixels
    values = {
        "min": levels[seen[0]],
        "max": levels[seen[-1]],
        "mean": mean,
        "std": variance**0.5,
        **{name: levels[np.searchsorted(below, share)] for name, share in QUANTILES.items()},
    }
    spread = {name: np.full((3, 1, 1), value) for name, value in values.items()}
    return {**spread, "count": np.array([pictures])}


def grey_histogram(images: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Number of pixels of each grey level (256,) in images (T, height, width)."""
    return np.bincount(images.ravel(), minlength=256).astype(np.int64)
