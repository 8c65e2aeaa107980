"""Labels and grasp errors of Experiment II for figures."""

from __future__ import annotations

from typing import Final

from actors.tasks.contract import FigureWords, MeasuredBaseline, MemoryProbe
from actors.tasks.experiment2 import judge
from actors.tasks.experiment2.setting import INDICATED_X
from actors.tasks.grasp_errors import grasp_errors
from proto.episode import NO_FAILURE, Outcome


def _in_place(outcome: Outcome) -> bool:
    return (
        outcome.value("closed_at") >= 0
        and outcome.value("distance_mm") < outcome.value("other_distance_mm")
        and outcome.value("moved_mm") <= judge.MOVED_MM
        and outcome.value("tilted_deg") <= judge.TOPPLED_DEG
    )


FIGURE_WORDS: Final = FigureWords(
    reasons={
        NO_FAILURE: "precise",
        judge.IMPRECISE: "strict, not precise",
        judge.NOT_LIFTED: "not lifted",
        judge.NEVER_CLOSED: "never closed",
        judge.MOVED_OBJECT: "moved the object",
        judge.TOPPLED: "toppled the object",
        judge.OTHER_MOVED: "moved the other object",
        judge.WRONG_OBJECT: "chose the wrong object",
    },
    errors=grasp_errors(judge.TOLERANCE, yaw="indicated_yaw_deg", y="indicated_y_m"),
    in_place=_in_place,
    baselines=(  # docs/results.md
        MeasuredBaseline("tutor", "sapien", 500, 500, 500, 500),
        MeasuredBaseline("pose-blind", "sapien", 150, 148, 148, 78),
        MeasuredBaseline("kind-blind", "sapien", 100, 44, 3, 3),
        MeasuredBaseline("last-gesture", "sapien", 60, 26, 26, 26),
    ),
    memory=MemoryProbe("observe task space", INDICATED_X, "neck_yaw"),
)
