"""A contact sheet of gesture clips: some frames of each subject's clip for both sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from services.figures.style import figure_style
from sim_assets.gestures.clip import FRAMES, SIDES, Clip, GestureLibrary, Side

SHOWN_FRAMES: Final = (0, 8, 14, 20, 28, 39)
_GAP: Final = 3
"""White pixels between two frames."""


@dataclass(frozen=True)
class Row:
    """A row of the sheet.

    Attributes:
        subject: name of the person.
        take: name of the recording.
        clips: the clip of each side.
    """

    subject: str
    take: str
    clips: dict[Side, Clip]

    def largest_change(self, side: Side) -> float:
        """Mean change of a pixel from the first frame, in the frame where it is largest."""
        clip = self.clips[side].astype(float)
        return float(np.abs(clip - clip[0]).mean(axis=(1, 2)).max())


def rows_of(library: GestureLibrary) -> list[Row]:
    """Return one row for the first take of each subject, or for each take of a single subject."""
    takes = library.takes if len(library.subjects) == 1 else library.takes[:1]
    return [
        Row(subject, take, {side: library.clip(side, subject, take) for side in SIDES})
        for subject in library.subjects
        for take in takes
    ]


def draw(rows: Sequence[Row]) -> Figure:
    """Draw one row for each take and one column for each side."""
    with figure_style():
        figure = Figure(figsize=(7.2, 0.3 + 0.62 * len(rows)), layout="constrained")
        panels = figure.subplots(len(rows), len(SIDES), squeeze=False)
        for row, pair in zip(rows, panels, strict=True):
            for side, axes in zip(SIDES, pair, strict=True):
                _draw_clip(axes, row.clips[side])
            pair[0].set_ylabel(f"{row.subject}, {row.take}", rotation=0, ha="right", va="center")
        for side, axes in zip(SIDES, panels[0], strict=True):
            axes.set_title(side)
        figure.supxlabel(f"frames {', '.join(map(str, SHOWN_FRAMES))} of {FRAMES}", fontsize=8)
        figure.supylabel("subject, take", fontsize=8)
        return figure


def numbers(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    return {
        "frames": list(SHOWN_FRAMES),
        "clips": [
            {
                "subject": row.subject,
                "take": row.take,
                "side": side,
                "mean_grey": float(row.clips[side].mean()),
                "largest_change": row.largest_change(side),
            }
            for row in rows
            for side in SIDES
        ],
    }


def table(rows: Sequence[Row]) -> Table:
    """Return a table of the brightness and movement of each clip."""
    result = Table(caption="grey levels, 0 to 255")
    for heading in ("subject", "take", "side", "mean", "largest change from the first frame"):
        result.add_column(heading, justify="left" if heading == "side" else "right")
    for clip in numbers(rows)["clips"]:
        result.add_row(
            clip["subject"],
            clip["take"],
            clip["side"],
            f"{clip['mean_grey']:.0f}",
            f"{clip['largest_change']:.1f}",
        )
    return result


def _draw_clip(axes: Axes, clip: Clip) -> None:
    strip = np.concatenate(
        [np.pad(clip[frame], ((0, 0), (0, _GAP)), constant_values=255) for frame in SHOWN_FRAMES],
        axis=1,
    )
    axes.imshow(strip, cmap="gray", vmin=0, vmax=255)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
