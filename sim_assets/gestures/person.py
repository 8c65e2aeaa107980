"""The body of a subject as capsules, at one moment of a take.

Positions are in metres in the frame of `Subject.camera_m`. Proportions are fractions of the body
height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_assets.gestures.subject import Sleeve, Subject
from sim_assets.gestures.take import Take, smooth_step

Array = NDArray[np.float64]

_ABOVE_M = 1e-3
"""Depth that puts a part just in front of the part that it covers."""


@dataclass(frozen=True)
class Part:
    """A capsule of one grey level.

    Attributes:
        start_m, end_m: (3,) ends of its axis.
        start_radius_m, end_radius_m: radii at the ends.
        grey: grey level 0..255.
        depth_m: parts with a larger depth coordinate are drawn over parts with a smaller one.
    """

    start_m: Array
    end_m: Array
    start_radius_m: float
    end_radius_m: float
    grey: float
    depth_m: float = 0.0


def parts_of(subject: Subject, take: Take, frame: float) -> list[Part]:
    """All parts of the person in a frame, in the order in which they are drawn."""
    body = _Body(subject, take, frame)
    arms = sorted((*body.arm(-1), *body.arm(1)), key=lambda part: part.depth_m)
    behind = [part for part in arms if part.depth_m < 0.0]
    in_front = [part for part in arms if part.depth_m >= 0.0]
    return [*behind, *body.legs(), *body.trunk(), *body.head(), *in_front]


class _Body:
    """Places the parts of a subject in one frame of a take."""

    def __init__(self, subject: Subject, take: Take, frame: float) -> None:
        self._subject = subject
        self._take = take
        self._raised = take.raised(frame)
        self._base_m = take.base_m(frame)
        turn = take.outward * take.trunk_turn * self._raised
        self._cos, self._sin = np.cos(turn), np.sin(turn)
        self._half_shoulders_m = 0.118 * subject.height_m * (0.9 + 0.1 * subject.girth)
        self._shoulder_m = 0.815 * subject.height_m

    def _at(self, x_m: float, y_m: float, z_m: float = 0.0) -> Array:
        """A point of the turned trunk (3,): x sideways, y up from the floor, z forward."""
        across = self._cos * x_m + self._sin * z_m
        forward = self._cos * z_m - self._sin * x_m
        return np.asarray(self._base_m + np.array([across, y_m, forward]))

    def legs(self) -> list[Part]:
        height, girth, grey = self._subject.height_m, self._subject.girth, self._subject.trousers
        parts = []
        for sign in (-1, 1):
            hip = self._at(sign * 0.055 * height, 0.52 * height)
            knee = self._at(sign * 0.06 * height, 0.27 * height)
            ankle = self._at(sign * 0.06 * height, 0.03)
            parts.append(Part(hip, knee, 0.075 * girth, 0.055 * girth, grey))
            parts.append(Part(knee, ankle, 0.055 * girth, 0.04, grey))
        return parts

    def trunk(self) -> list[Part]:
        height, girth, grey = self._subject.height_m, self._subject.girth, self._subject.shirt
        half, top = self._half_shoulders_m, self._shoulder_m
        lengthways = [
            Part(
                self._at(place * 0.55 * half, top - 0.05),
                self._at(place * 0.05 * height, 0.52 * height + 0.02),
                0.085 * girth,
                0.095 * girth,
                grey,
            )
            for place in (-1, 1, 0)
        ]
        left, right = (self._at(sign * 0.8 * half, top - 0.01) for sign in (-1, 1))
        return [*lengthways, Part(left, right, 0.055, 0.055, grey)]

    def head(self) -> list[Part]:
        subject, height = self._subject, self._subject.height_m
        sideways = np.sin(self._take.outward * self._take.head_turn * self._raised)
        brow = self._at(0.03 * sideways, 0.93 * height, 0.03)
        chin = brow + np.array([0.02 * sideways, -0.045, 0.01])
        crown = self._at(0.0, 0.955 * height, -0.02)
        neck = Part(
            self._at(0.0, self._shoulder_m),
            self._at(0.0, 0.87 * height),
            0.05,
            0.05,
            0.85 * subject.skin,
        )
        skull = Part(crown, crown, 0.093, 0.09, subject.hair)
        face = Part(brow, chin, 0.075, 0.06, subject.skin)
        return [*self._long_hair(), neck, skull, face]

    def _long_hair(self) -> list[Part]:
        if not self._subject.long_hair:
            return []
        top = self._at(0.0, 0.95 * self._subject.height_m, -0.06)
        end = self._at(0.0, 0.83 * self._subject.height_m, -0.06)
        return [Part(top, end, 0.095, 0.1, self._subject.hair)]

    def arm(self, sign: int) -> list[Part]:
        """Upper arm, forearm, hand and pointing finger on one side of the picture (-1 left)."""
        subject = self._subject
        shoulder = self._at(sign * self._half_shoulders_m, self._shoulder_m - 0.02, 0.01)
        upper, lower = self._arm_directions(sign)
        elbow = shoulder + 0.172 * subject.height_m * upper
        wrist = elbow + 0.157 * subject.height_m * lower
        tip = wrist + 0.1 * lower
        palm, knuckle = wrist + 0.055 * lower, wrist + 0.05 * lower
        return [
            *self._upper_arm(shoulder, elbow),
            *self._forearm(elbow, wrist),
            Part(wrist, palm, 0.035, 0.038, subject.skin, tip[2]),
            Part(knuckle, tip, 0.02, 0.014, subject.skin, tip[2] + _ABOVE_M),
        ]

    def _upper_arm(self, shoulder: Array, elbow: Array) -> list[Part]:
        girth, skin, depth = self._subject.girth, self._subject.skin, elbow[2]
        sleeve = Part(shoulder, elbow, 0.05 * girth, 0.042 * girth, self._subject.shirt, depth)
        if self._subject.sleeve is not Sleeve.SHORT:
            return [sleeve]
        middle = (shoulder + elbow) / 2
        bare = Part(middle, elbow, 0.045 * girth, 0.042 * girth, skin, depth + _ABOVE_M)
        return [sleeve, bare]

    def _forearm(self, elbow: Array, wrist: Array) -> list[Part]:
        girth, shirt, depth = self._subject.girth, self._subject.shirt, wrist[2]
        long = self._subject.sleeve is Sleeve.LONG
        grey = shirt if long else self._subject.skin
        forearm = Part(elbow, wrist, 0.042 * girth, 0.03, grey, depth)
        if self._subject.sleeve is not Sleeve.HALF:
            return [forearm]
        end = elbow + 0.2 * (wrist - elbow)
        sleeve = Part(elbow, end, 0.046 * girth, 0.042 * girth, shirt, depth + _ABOVE_M)
        return [forearm, sleeve]

    def _arm_directions(self, sign: int) -> tuple[Array, Array]:
        """Unit vectors (3,), (3,) along the upper arm and the forearm."""
        take = self._take
        rest_upper = np.array(
            [sign * np.sin(take.rest_shoulder), -np.cos(take.rest_shoulder), 0.08]
        )
        rest_lower = np.array([sign * 0.05, -np.cos(take.rest_elbow), np.sin(take.rest_elbow)])
        if sign != take.outward:
            return _unit(rest_upper), _unit(rest_lower)
        aim = _unit(
            np.array([sign * np.sin(take.azimuth), -np.tan(take.drop), np.cos(take.azimuth)])
        )
        half_bend = take.bend / 2
        aim_upper = aim * np.cos(take.bend) - np.array([0.0, np.sin(take.bend), 0.0])
        aim_lower = aim * np.cos(half_bend) + np.array([0.0, np.sin(half_bend), 0.0])
        # The elbow bends on the way up: the forearm arrives before the upper arm.
        ahead = smooth_step(1.25 * self._raised)
        return (
            _unit(rest_upper + self._raised * (aim_upper - rest_upper)),
            _unit(rest_lower + ahead * (aim_lower - rest_lower)),
        )


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
