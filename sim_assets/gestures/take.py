"""One take: how a subject moves, and how the picture differs, each time the clip is recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_assets.gestures.clip import SIDES, Side

Array = NDArray[np.float64]

_TAKE_STREAM = 11
"""First word of the seed of every take."""
_SWAY_RAD_PER_FRAME = 0.35


@dataclass(frozen=True)
class Take:
    """The movement of one take. Angles are in radians, times in frames.

    The person points with the arm on the indicated side, never across the body: across the body the
    arm cannot be told from the trunk once the picture is 64 x 48.

    Attributes:
        outward: direction of the indicated side along x: -1 picture-left, +1 picture-right.
        onset, rise, hold, fall: frame at which the arm starts, and how long it is raised, held and
            lowered.
        azimuth: direction of the raised arm from the camera towards the indicated side.
        drop: how far the raised arm points below the horizontal.
        bend: bend of the raised elbow.
        rest_shoulder, rest_elbow: angles of the hanging arm.
        place_m: (3,) where the person stands (see `Subject.camera_m`).
        trunk_turn, head_turn: turn towards the indicated side while the arm is up.
        lean_m: shift towards the indicated side while the arm is up.
        sway_m: (3,) amplitudes of the body's sway.
        light: grey levels added to the whole clip.
        noise: standard deviation of each pixel's noise, in grey levels.
        noise_seed: seed of that noise.
    """

    outward: int
    onset: float
    rise: float
    hold: float
    fall: float
    azimuth: float
    drop: float
    bend: float
    rest_shoulder: float
    rest_elbow: float
    place_m: Array
    trunk_turn: float
    head_turn: float
    lean_m: float
    sway_m: Array
    light: float
    noise: float
    noise_seed: int

    @classmethod
    def from_seeds(cls, side: Side, subject_seed: int, take_seed: int) -> Take:
        """Draw a take; the same side and seeds give the same take."""
        random = np.random.default_rng([_TAKE_STREAM, subject_seed, take_seed, SIDES.index(side)])
        return cls(
            outward=1 if side == "picture-right" else -1,
            onset=random.uniform(2.0, 9.0),
            rise=random.uniform(7.0, 14.0),
            hold=random.uniform(14.0, 24.0),
            fall=random.uniform(8.0, 13.0),
            azimuth=np.deg2rad(random.normal(52.0, 8.0)),
            drop=np.deg2rad(random.normal(22.0, 8.0)),
            bend=np.deg2rad(random.uniform(0.0, 18.0)),
            rest_shoulder=np.deg2rad(random.normal(8.0, 3.0)),
            rest_elbow=np.deg2rad(random.uniform(5.0, 35.0)),
            place_m=random.normal(0.0, [0.05, 0.0, 0.06]),
            trunk_turn=np.deg2rad(random.uniform(5.0, 18.0)),
            head_turn=np.deg2rad(random.uniform(5.0, 30.0)),
            lean_m=random.uniform(0.0, 0.05),
            sway_m=random.normal(0.0, 0.006, 3),
            light=random.normal(0.0, 6.0),
            noise=random.uniform(1.0, 4.0),
            noise_seed=int(random.integers(2**32)),
        )

    def raised(self, frame: float) -> float:
        """How far the arm is up in a frame: 0 hanging .. 1 pointing."""
        up = smooth_step((frame - self.onset) / self.rise)
        down = smooth_step((frame - self.onset - self.rise - self.hold) / self.fall)
        return up - down

    def base_m(self, frame: float) -> Array:
        """Position (3,) of the point on the floor below the person's middle."""
        phases = np.sin(_SWAY_RAD_PER_FRAME * frame + np.arange(3))
        lean = self.raised(frame) * self.lean_m * np.array([self.outward, 0.0, 0.4])
        return np.asarray(self.place_m + self.sway_m * phases + lean)


def smooth_step(share: float) -> float:
    """Position 0..1 of a minimum-jerk movement at a share of its time; outside 0..1 it rests."""
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
