"""What a browser can ask of the robot; checked before anything moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from actors.pointing import CAMERAS, Camera
from services.by_hand.demonstration import (
    Command,
    Focus,
    Grasp,
    LetAct,
    Look,
    MoveHand,
    NextPhase,
    Reach,
    TurnHead,
)
from services.dashboard.viewer import BadRequestError, parsed

LARGEST_SHIFT_M: Final = 0.05
LARGEST_TURN_DEG: Final = 30.0
LARGEST_LEVELS: Final = 20.0
SIMPLE: Final = ("undo", "restart", "finish", "keep", "discard")
FASTEST_PACE: Final = 4.0


@dataclass(frozen=True)
class Stop:
    """Stop the robot at once."""


@dataclass(frozen=True)
class Pace:
    """How fast the robot's time runs at most.

    Attributes:
        factor: times real time; 0 for as fast as it can.
    """

    factor: float


@dataclass(frozen=True)
class Simple:
    """One of SIMPLE: something that is done with the whole demonstration."""

    what: str


@dataclass(frozen=True)
class Choose:
    """Begin the case with an index in the list of cases."""

    case: int


Request = Command | Stop | Pace | Simple | Choose


def request_of(text: str) -> tuple[int, Request]:
    """Return the number and the content of a request.

    Raises:
        BadRequestError: it is none; the message says why.
    """
    asked = parsed(text)
    match asked:
        case {"id": int(number), "do": str(what)} if abs(number) < 2**31:
            if what in SIMPLE:
                return number, Simple(what)
            if what in _PARSERS:
                return number, _PARSERS[what](asked)
    raise BadRequestError("that is not a request")


def _number(asked: Mapping[str, Any], name: str, least: float, most: float) -> float:
    value = asked.get(name, 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadRequestError(f"{name} is no number")
    if not least <= value <= most:
        raise BadRequestError(f"{name} is {value:g}; it must be from {least:g} to {most:g}")
    return float(value)


def _place(asked: Mapping[str, Any]) -> tuple[Camera, float, float]:
    camera: Camera | None = next((each for each in CAMERAS if each == asked.get("camera")), None)
    if camera is None:
        raise BadRequestError("there is no such picture")
    return camera, _number(asked, "across", 0.0, 1.0), _number(asked, "down", 0.0, 1.0)


def _move(asked: Mapping[str, Any]) -> MoveHand:
    x, y, z = (_number(asked, name, -LARGEST_SHIFT_M, LARGEST_SHIFT_M) for name in "xyz")
    turn = _number(asked, "turn", -LARGEST_TURN_DEG, LARGEST_TURN_DEG)
    return MoveHand((x, y, z), turn, own=asked.get("own") is True)


def _turn_head(asked: Mapping[str, Any]) -> TurnHead:
    pitch, yaw = (
        _number(asked, name, -LARGEST_TURN_DEG, LARGEST_TURN_DEG) for name in ("pitch", "yaw")
    )
    return TurnHead(pitch, yaw)


def _levels(asked: Mapping[str, Any]) -> float:
    return _number(asked, "by", -LARGEST_LEVELS, LARGEST_LEVELS)


_PARSERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Request]]] = {
    "look": lambda asked: Look(*_place(asked)),
    "reach": lambda asked: Reach(*_place(asked)),
    "head": _turn_head,
    "move": _move,
    "focus": lambda asked: Focus(_levels(asked)),
    "grasp": lambda asked: Grasp(_levels(asked)),
    "next": lambda _: NextPhase(),
    "act": lambda _: LetAct(),
    "stop": lambda _: Stop(),
    "pace": lambda asked: Pace(_number(asked, "factor", 0.0, FASTEST_PACE)),
    "case": lambda asked: Choose(int(_number(asked, "case", 0, 2**31))),
}
