"""Maps the joints of other robots' data to the eleven action values.

A map is a small YAML file:

    unit: rad                       # of their angles; deg without it
    fps: 10                         # steps per second, where the data do not say it
    picture: observation.images.top # which picture, where there are several
    names: [j1, j2, gripper]        # their columns, where the data do not name them
    joints:                         # ours: theirs
      r_elbow: j1                   # an angle
      grasp_level: {from: gripper, scale: 9.0, offset: 1.0}   # theirs * scale + offset
      focus_level: 1.0              # always this (degrees, or a level)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from proto.body import ACTION_NAMES, ACTION_VALUES, FOCUS, GRASP
from proto.episode import Floats
from proto.errors import UserError
from proto.plain_text import plain, plain_lines
from proto.reading import read_limited
from proto.recordings.schemas import ACTION_FIELDS
from proto.strict_yaml import LONGEST, load_yaml

_ROUNDING: Final = 1e-3


class Source(BaseModel):
    """Where an action value comes from: theirs * scale + offset, after the change of unit.

    Attributes:
        source: their name of the joint.
        scale: factor.
        offset: what is added (degrees, or a level).
    """

    model_config = ConfigDict(extra="forbid", strict=True)
    source: str = Field(alias="from")
    scale: float = 1.0
    offset: float = 0.0


class JointMap(BaseModel):
    """A map as read from its file; the module's docstring shows one.

    Attributes:
        joints: by our name, their name, a `Source`, or a constant.
        unit: unit of their angles.
        fps: steps per second; None if the data say it.
        picture: their name of the picture; None if there is only one.
        names: names of their columns, in order; None if the data name them.
    """

    model_config = ConfigDict(extra="forbid", strict=True)
    joints: dict[str, str | float | Source]
    unit: Literal["deg", "rad"] = "deg"
    fps: float | None = Field(default=None, gt=0)
    picture: str | None = None
    names: list[str] | None = None

    def targets(self, values: NDArray[np.floating], names: Sequence[str], where: str) -> Floats:
        """Return the actions (T, 11) of their values (T, D), see `proto.body`.

        Args:
            values: their values.
            names: names of their columns.
            where: which data, for errors.

        Raises:
            UserError: a name is missing, or a value is beyond what the robot can do.
        """
        if values.ndim != 2 or values.shape[1] != len(names):
            raise UserError(
                f"{where}: {len(names)} joints are named, but the values are {values.shape}"
            )
        columns = [self._column(name, values, names, where) for name in ACTION_NAMES]
        targets = np.stack(columns, axis=1)
        for value, column in zip(ACTION_VALUES, targets.T, strict=True):
            lowest, highest = float(column.min()), float(column.max())
            if not (value.minimum - _ROUNDING <= lowest and highest <= value.maximum + _ROUNDING):
                raise UserError(
                    f"{where}: {value.name} goes from {lowest:.4g} to {highest:.4g}, but the robot"
                    f" can do {value.minimum:g} to {value.maximum:g}; correct unit, scale or offset"
                    " in the joint map"
                )
        return targets.astype(np.float32)

    def _column(
        self, ours: str, values: NDArray[np.floating], names: Sequence[str], where: str
    ) -> NDArray[np.float64]:
        wanted = self.joints[ours]
        if isinstance(wanted, float):
            return np.full(len(values), wanted)
        source = Source.model_validate({"from": wanted}) if isinstance(wanted, str) else wanted
        if source.source not in names:
            raise UserError(
                f"{where}: there is no joint {source.source!r} for {ours}; it has"
                f" {', '.join(names)}"
            )
        column = values[:, list(names).index(source.source)].astype(np.float64)
        is_angle = ACTION_NAMES.index(ours) not in (GRASP, FOCUS)
        if self.unit == "rad" and is_angle:
            column = np.degrees(column)
        return np.asarray(column * source.scale + source.offset)


def own_map() -> JointMap:
    """The map of data that vmdnn exported."""
    return JointMap(joints=dict(zip(ACTION_NAMES, ACTION_FIELDS, strict=True)))


def read_joint_map(path: Path) -> JointMap:
    """Read a map.

    Raises:
        UserError: the file cannot be read, or is not a map with all eleven action values.
    """
    try:
        joint_map = JointMap.model_validate(load_yaml(read_limited(path, LONGEST).decode()))
    except OSError as error:
        raise UserError(f"joint map {path} cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"joint map {path} is not YAML: {plain_lines(error)[:1000]}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = plain(".".join(map(str, first["loc"])), 200)
        raise UserError(f"joint map {path}: {key}: {plain(first['msg'], 300)}") from error
    if missing := [name for name in ACTION_NAMES if name not in joint_map.joints]:
        raise UserError(
            f"joint map {path}: joints: {', '.join(missing)} missing; give each of"
            f" {', '.join(ACTION_NAMES)} a joint of theirs or a number"
        )
    if unknown := sorted(joint_map.joints.keys() - set(ACTION_NAMES)):
        raise UserError(f"joint map {path}: joints: there is no {plain(', '.join(unknown), 300)}")
    return joint_map
