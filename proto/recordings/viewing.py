"""Messages of a recording that only viewers such as Foxglove need, and the frames that they use.

Each body and each fixed link is a frame in `world`. The eye's camera has the frame `l_eye_optical`
in the frame `l_eye`: x to the right of the picture, y down, z along the optical axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.episode import NO_FAILURE, BoxLook, Kind, Outcome, View
from proto.recordings.schemas import CameraCalibration, FrameTransforms, Log, SceneUpdate

WORLD: Final = "world"
EYE_FRAME: Final = "l_eye"
"""Frame of the left eye: x forward along the optical axis, y left, z up."""
CAMERA_FRAME: Final = "l_eye_optical"
_CAMERA_IN_EYE: Final = (0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5)
"""Pose of the camera's frame in that of the eye: position (m), quaternion (w first)."""
_NANOSECONDS: Final = 1_000_000_000


def set_time(timestamp: Any, time_ns: int) -> None:
    """Set a protobuf Timestamp."""
    timestamp.seconds, timestamp.nanos = divmod(time_ns, _NANOSECONDS)


def set_pose(transform: Any, pose: Sequence[float]) -> None:
    """Set the pose (7,), position (m) and quaternion (w first), of a FrameTransform."""
    position, rotation = transform.translation, transform.rotation
    position.x, position.y, position.z = pose[:3]
    rotation.w, rotation.x, rotation.y, rotation.z = pose[3:]


def set_colour(colour: Any, linear: Sequence[float]) -> None:
    """Set a protobuf Color, which is sRGB, to a linear colour (3,) in 0..1."""
    colour.r, colour.g, colour.b = (
        12.92 * part if part <= 0.0031308 else 1.055 * part ** (1 / 2.4) - 0.055 for part in linear
    )
    colour.a = 1.0


def velocities(positions: NDArray[np.float64], period_s: float) -> NDArray[np.floating]:
    """Velocities (T, N) of positions (T, N): central differences, one-sided at both ends."""
    if len(positions) < 2:
        return np.zeros_like(positions)
    # In float32, whose shorter numbers are packed better.
    return np.asarray(np.gradient(positions, period_s, axis=0), dtype=np.float32)


def fixed_transforms(view: View | None, time_ns: int, *, prefix: str = "") -> FrameTransforms:
    """Frames that never move: the robot's fixed links, and the camera in the eye.

    Args:
        view: the view of the episode.
        time_ns: Unix time (ns).
        prefix: beginning of the names of all frames.
    """
    transforms = FrameTransforms()

    def add(parent: str, name: str, pose: Sequence[float]) -> None:
        transform = transforms.transforms.add(
            parent_frame_id=f"{prefix}{parent}", child_frame_id=f"{prefix}{name}"
        )
        set_time(transform.timestamp, time_ns)
        set_pose(transform, pose)

    for name, pose in {} if view is None else view.fixed_links.items():
        add(WORLD, name, pose.tolist())
    add(EYE_FRAME, CAMERA_FRAME, _CAMERA_IN_EYE)
    return transforms


def calibration(focal_px: Sequence[float], time_ns: int, *, prefix: str = "") -> CameraCalibration:
    """The camera that took the picture of a step, with focal lengths (across, down) in pixels."""
    across, down = focal_px
    cx, cy = IMAGE_WIDTH / 2, IMAGE_HEIGHT / 2
    camera = CameraCalibration(
        frame_id=f"{prefix}{CAMERA_FRAME}",
        width=IMAGE_WIDTH,
        height=IMAGE_HEIGHT,
        K=[across, 0.0, cx, 0.0, down, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[across, 0.0, cx, 0.0, 0.0, down, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
    set_time(camera.timestamp, time_ns)
    return camera


def boxes(looks: Mapping[str, BoxLook], time_ns: int, *, prefix: str = "") -> SceneUpdate:
    """The boxes of the scene, each in the frame of its own name, which moves with it."""
    update = SceneUpdate()
    for name, look in looks.items():
        entity = update.entities.add(frame_id=f"{prefix}{name}", id=name, frame_locked=True)
        set_time(entity.timestamp, time_ns)
        cube = entity.cubes.add()
        cube.pose.orientation.w = 1.0
        cube.size.x, cube.size.y, cube.size.z = look.size_m
        set_colour(cube.color, look.colour)
    return update


def phase_event(phase: str, time_ns: int) -> Log:
    """Event: a phase begins."""
    return _event("phase", phase, Log.INFO, time_ns)


def episode_event(kind: Kind, policy: str, version: int, time_ns: int) -> Log:
    """Event: an episode begins."""
    words = f"{kind} by {policy}" + (f" version {version}" if version else "")
    return _event("episode", words, Log.INFO, time_ns)


def outcome_event(outcome: Outcome, time_ns: int) -> Log:
    """Event: the episode has ended, with its outcome and what was measured."""
    readings = [name for name in ("lenient", "strict", "precise") if getattr(outcome, name)]
    words = [", ".join(readings) or "failed"]
    if outcome.reason != NO_FAILURE:
        words.append(f"reason {outcome.reason}")
    words += [
        f"{name} {measure.value:.4g} {measure.unit}".rstrip()
        for name, measure in outcome.measures.items()
    ]
    level = Log.INFO if outcome.reason == NO_FAILURE else Log.WARNING
    return _event("outcome", "; ".join(words), level, time_ns)


def _event(name: str, message: str, level: Log.Level.ValueType, time_ns: int) -> Log:
    event = Log(name=name, message=message, level=level)
    set_time(event.timestamp, time_ns)
    return event
