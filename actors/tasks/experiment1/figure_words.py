"""Labels and grasp errors of Experiment I for figures."""

from __future__ import annotations

from typing import Final

from actors.tasks.contract import FigureWords, MeasuredBaseline
from actors.tasks.experiment1 import judge
from actors.tasks.grasp_errors import grasp_errors
from proto.episode import NO_FAILURE, Outcome


def _in_place(outcome: Outcome) -> bool:
    return (
        outcome.value("closed_at") >= 0
        and outcome.value("moved_mm") <= judge.MOVED_MM
        and outcome.value("turned_deg") <= judge.TURNED_DEG
    )


FIGURE_WORDS: Final = FigureWords(
    reasons={
        NO_FAILURE: "precise",
        judge.IMPRECISE: "strict, not precise",
        judge.NOT_LIFTED: "not lifted",
        judge.NEVER_CLOSED: "never closed",
        judge.MOVED_OBJECT: "moved the object",
        judge.TOUCHED_OBSTACLE: "touched the obstacle",
    },
    errors=grasp_errors(judge.TOLERANCE, yaw="object_yaw_deg", y="object_y_m"),
    in_place=_in_place,
    baselines=(  # docs/results.md
        MeasuredBaseline("tutor", "sapien", 300, 300, 300, 300),
        MeasuredBaseline("lookup", "sapien", 300, 263, 236, 177),
        MeasuredBaseline("obstacle-blind", "sapien", 300, 286, 141, 141),
        MeasuredBaseline("yaw-blind", "sapien", 300, 162, 140, 72),
        MeasuredBaseline("replay", "sapien", 300, 123, 56, 11),
    ),
    published={30.0: (32, 52), 150.0: (44, 52)},
)
