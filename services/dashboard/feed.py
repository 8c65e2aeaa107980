"""What browsers are told of a run: topics, each made once for all browsers as a JSON text."""

from __future__ import annotations

import base64
import json
import math
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.attention import crop_of_focus
from actors.simulator import EYE_HEIGHT, EYE_WIDTH
from actors.tasks.contract import Task
from proto.body import ACTION_VALUES, JOINT_NAMES
from proto.episode import NO_FAILURE, Image, Outcome
from proto.keys import Role
from proto.messages import Pictures
from proto.metrics import (
    ActorMetrics,
    EvaluatorMetrics,
    HubMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    RecorderMetrics,
    Success,
    SuiteScore,
)
from proto.plain_text import plain
from proto.suites import UNLEARNED, suite_of
from proto.variables import Continuous, Situation, Variable
from services.archive import Recording, RunArchive
from services.board import ActorView, Board, ProcessKey, RunView
from services.dashboard.plane import Plane
from services.terminal.run_words import stage_words
from services.trials.success import wilson95

PROCESSES_SHOWN: Final = 200
"""So many processes are shown, those with a trouble first."""
SUITES_SHOWN: Final = 16
VERSIONS_SHOWN: Final = 200
"""So many of the newest policy versions are shown."""
EPISODES_AT_ONCE: Final = 500
JPEG_QUALITY: Final = 80
_ORDER: Final = tuple(sorted(Role, key=lambda role: role is Role.ACTOR))


class Feed:
    """The newest text of each topic, and how often it has changed."""

    def __init__(self) -> None:
        """Know no topic yet."""
        self._lock = threading.Lock()
        self._texts: dict[str, tuple[int, str]] = {}

    def __contains__(self, topic: str) -> bool:
        with self._lock:
            return topic in self._texts

    def put(self, topic: str, content: Mapping[str, Any]) -> None:
        """Set the content of a topic."""
        text = json.dumps({"topic": topic, **content}, separators=(",", ":"), allow_nan=False)
        with self._lock:
            number, before = self._texts.get(topic, (0, ""))
            if text != before:
                self._texts[topic] = (number + 1, text)

    def news(self, seen: dict[str, int]) -> list[str]:
        """The texts of the topics that have changed; `seen` is how often one has seen each change.

        `seen` is brought up to date.
        """
        with self._lock:
            changed = [
                (topic, number, text)
                for topic, (number, text) in self._texts.items()
                if seen.get(topic) != number
            ]
        seen.update({topic: number for topic, number, _ in changed})
        return [text for _, _, text in changed]


def task_content(task: Task) -> Mapping[str, Any]:
    """What a task consists of, as far as the page shows it."""
    return {
        "name": task.name,
        "variables": [_variable(each) for each in task.variables],
        "phases": list(task.phase_names),
        "reasons": dict(task.figure_words.reasons),
        "baselines": _baselines(task),
        "joints": list(JOINT_NAMES),
        "actions": [
            {"name": each.name, "minimum": each.minimum, "maximum": each.maximum}
            for each in ACTION_VALUES
        ],
    }


def processes_content(view: RunView) -> Mapping[str, Any]:
    """All processes, those with a trouble first."""
    now_s = time.time()
    keys = sorted({*view.metrics, *view.vanished_s}, key=lambda key: _rank(view, key))
    return {
        "now_s": round(now_s, 1),
        "more": max(0, len(keys) - PROCESSES_SHOWN),
        "processes": [_process(view, key, now_s) for key in keys[:PROCESSES_SHOWN]],
    }


def suites_content(view: RunView) -> Mapping[str, Any]:
    """Success by policy version in each suite."""
    return {"suites": [_suite(each) for each in view.suites[:SUITES_SHOWN]]}


def losses_content(board: Board | None, archive: RunArchive) -> Mapping[str, Any]:
    """The losses of the run's history with those heard since, and those of its policies."""
    past = archive.past_losses()
    heard = [] if board is None else board.losses
    if past:  # what the history has too is left out
        last = past[-1]
        known = [
            number
            for number, each in enumerate(heard, 1)
            if each.stage == last.stage and each.epoch <= last.epoch
        ]
        heard = heard[max(known, default=0) :]
    return {
        "losses": [[each.stage, each.epoch, _short(each.loss)] for each in (*past, *heard)],
        "policies": [
            [version, epoch, _short(loss)] for version, epoch, loss in archive.policy_losses()
        ],
    }


def logs_content(archive: RunArchive) -> Mapping[str, Any]:
    """The last lines of all logs, and how the processes ended that have ended."""
    return {"logs": archive.logs(), "endings": archive.endings()}


def episodes_text(recordings: Sequence[Recording]) -> str:
    """Recorded episodes, for the list and the map."""
    return json.dumps(
        {"topic": "episodes", "episodes": [_episode(each) for each in recordings]},
        separators=(",", ":"),
        allow_nan=False,
    )


def actor_content(view: ActorView, plane: Plane | None, known: tuple[int, int]) -> dict[str, Any]:
    """What an actor does now.

    Args:
        view: the actor.
        plane: the plane of the PFC, if there is one.
        known: episode and step up to which the browser knows the path of the PFC.
    """
    live = view.live
    crop = crop_of_focus(view.focus)
    content: dict[str, Any] = {
        "episode": view.episode,
        "kind": live.kind,
        "policy": plain(live.policy, 100),
        "version": live.policy_version,
        "step": live.step,
        "phase": live.phase,
        "image": base64.b64encode(live.image.tobytes()).decode(),
        "crop": [crop.width / EYE_WIDTH, crop.height / EYE_HEIGHT],
        "joints": np.round(live.joints_deg, 1).tolist(),
        "action": np.round(live.action, 2).tolist(),
    }
    after = known[1] if known[0] == view.episode else -1
    if plane is not None and live.pfc is not None:
        steps = [each for each in view.path if each.step > after and each.pfc is not None]
        fitting = [
            each
            for each in steps
            if each.pfc is not None and plane.fits(each.policy_version, each.pfc.size)
        ]
        if fitting:
            points = plane.project(np.stack([each.pfc for each in fitting if each.pfc is not None]))
            names = list(plane.phase_names)
            phases = [names.index(each.phase) if each.phase in names else -1 for each in fitting]
            content["path"] = [*np.round(points.T, 3).tolist(), phases]
    return content


def pictures_text(pictures: Pictures) -> str:
    """The pictures of a scene as JPEG."""
    return json.dumps(
        {
            "topic": "pictures",
            "actor": pictures.actor,
            "step": pictures.step,
            "outside": jpeg(pictures.outside),
            "eye": jpeg(pictures.eye),
        }
    )


def outcome_content(outcome: Outcome) -> Mapping[str, Any]:
    """How an episode ended."""
    return {
        "lenient": outcome.lenient,
        "strict": outcome.strict,
        "precise": outcome.precise,
        "reason": outcome.reason,
        "measures": {
            plain(name, 64): [_short(measure.value), plain(measure.unit, 16)]
            for name, measure in outcome.measures.items()
        },
    }


def situation_content(situation: Situation) -> Mapping[str, Any]:
    """The values of a situation by name; those of a damaged recording may be anything."""
    return {
        plain(name, 100): _short(value) if isinstance(value, int | float) else plain(value, 100)
        for name, value in situation.items()
    }


def _variable(variable: Variable) -> Mapping[str, Any]:
    if isinstance(variable, Continuous):
        ends = {"minimum": variable.minimum, "maximum": variable.maximum, "unit": variable.unit}
        return {"name": variable.name, **ends}
    return {"name": variable.name, "choices": list(variable.choices)}


def _baselines(task: Task) -> list[Mapping[str, Any]]:
    """Measured success of the baselines, in the suite in which they were measured."""
    return [
        {
            "name": each.name,
            "backend": each.backend,
            "suite": UNLEARNED,
            "trials": each.trials,
            **{
                reading: [_short(successes / each.trials), *wilson95(successes, each.trials)]
                for reading, successes in (
                    ("lenient", each.lenient),
                    ("strict", each.strict),
                    ("precise", each.precise),
                )
            },
        }
        for each in task.figure_words.baselines
    ]


def _rank(view: RunView, key: ProcessKey) -> tuple[bool, int, str]:
    """Those that are gone first, then in the order of their roles, with the actors at the end."""
    role, name = key
    return key not in view.vanished_s, _ORDER.index(role), name


def _process(view: RunView, key: ProcessKey, now_s: float) -> Mapping[str, Any]:
    role, name = key
    metrics, heard_s = view.metrics.get(key), view.heard_s.get(key)
    gone_s = view.vanished_s.get(key)
    content: dict[str, Any] = {
        "role": role,
        "id": name,
        "age_s": None if heard_s is None else round(now_s - heard_s, 1),
        "gone_s": None if gone_s is None else round(now_s - gone_s),
    }
    if metrics is not None:
        content |= {
            "waiting_for": plain(metrics.waiting_for, 300),
            "refused": metrics.refused,
            "paused": bool(getattr(metrics, "paused", False)),
            "words": plain(_words(metrics), 300),
            **_numbers(metrics),
        }
    return content


def _words(metrics: Metrics) -> str:
    """What a process does, in a few words."""
    match metrics:
        case ActorMetrics():
            last = f"{metrics.last_kind}: {metrics.last_outcome}" if metrics.last_kind else ""
            return f"policy {metrics.policy_version}, {metrics.episodes} episodes. {last}".strip()
        case LearnerMetrics():
            return f"{stage_words(metrics)}, {metrics.sequences} sequences"
        case EvaluatorMetrics():
            return f"{metrics.leases} trials are being played"
        case RecorderMetrics():
            return f"{metrics.episodes} episodes, {metrics.bytes / 1e6:.1f} MB"
        case HubMetrics():
            return f"{metrics.peers} connections"
        case _:
            return ""


def _numbers(metrics: Metrics) -> Mapping[str, Any]:
    """The numbers that the page uses by themselves."""
    match metrics:
        case ActorMetrics():
            return {
                "version": metrics.policy_version,
                "steps_per_s": _short(metrics.steps_per_s),
                "episodes": metrics.episodes,
                "backend": plain(metrics.backend, 100),
                "outbox": metrics.outbox,
            }
        case LearnerMetrics():
            return {
                "version": metrics.policy_version,
                "stage": stage_words(metrics),
                "epoch": metrics.epoch,
                "epochs_total": metrics.epochs_total,
                "epochs_per_s": _short(metrics.epochs_per_s),
                "loss": None if metrics.loss is None else _short(metrics.loss),
                "sequences": metrics.sequences,
                "done": metrics.done,
            }
        case _:
            return {}


def _suite(suite: SuiteScore) -> Mapping[str, Any]:
    return {
        "name": suite.name,
        "backend": plain(suite.backend, 100),
        "trials": suite.trials,
        "unplayable": plain(suite.unplayable, 300),
        "versions": [_score(each) for each in suite.policies[-VERSIONS_SHOWN:]],
    }


def _score(score: PolicyScore) -> Mapping[str, Any]:
    return {
        "version": score.version,
        "trials": score.trials,
        "lenient": _success(score.lenient),
        "strict": _success(score.strict),
        "precise": _success(score.precise),
        "reasons": {plain(reason, 64): count for reason, count in score.reasons.items()},
    }


def _success(success: Success) -> list[float | None]:
    return [_short(success.rate), *map(_short, success.wilson95)]


def _episode(recording: Recording) -> Mapping[str, Any]:
    heading = recording.heading
    outcome = heading.outcome
    reached = outcome.lenient + outcome.strict + outcome.precise
    return {
        "id": heading.id,
        "kind": heading.kind,
        "policy": plain(heading.policy, 100),
        "version": heading.policy_version,
        "backend": plain(heading.backend, 100),
        "suite": plain(suite_of(heading.conditions), 64),
        "seed": heading.seed,
        "actor": plain(heading.actor, 64),
        "situation": situation_content(heading.situation),
        "reached": reached,
        "reason": "" if outcome.reason == NO_FAILURE else plain(outcome.reason, 64),
        "steps": heading.steps,
        "started_s": None if heading.started_s is None else _finite(heading.started_s),
    }


def jpeg(picture: Image) -> str:
    """Return an RGB picture (height, width, 3) as JPEG in base64."""
    bgr: NDArray[np.uint8] = np.ascontiguousarray(picture[..., ::-1])
    encoded, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded as JPEG")
    return base64.b64encode(data.tobytes()).decode()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _short(value: float) -> float | None:
    """A number with as many digits as are shown; None if it is not finite."""
    return float(f"{value:.5g}") if math.isfinite(value) else None
