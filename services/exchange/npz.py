"""Episodes as NPZ files for numpy: one file for each episode, without pickled objects."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_NAMES, JOINT_NAMES
from proto.episode import Episode
from proto.storage import written_whole

_PACKED: Final = zipfile.ZIP_DEFLATED


def export_npz(episode: Episode, out: Path) -> Path:
    """Write an episode as `<id>.npz` into a folder and return the file.

    Raises:
        UserError: the file cannot be written.
    """
    path = out / f"{episode.id}.npz"
    with written_whole(path) as stream, zipfile.ZipFile(stream, "w", _PACKED) as packed:
        for name, array in arrays_of(episode).items():
            content = io.BytesIO()
            np.save(content, array, allow_pickle=False)
            packed.writestr(f"{name}.npy", content.getvalue())
    return path


def arrays_of(episode: Episode) -> dict[str, NDArray[Any]]:
    """The arrays of an episode by the names of its fields; `about` is JSON with all the rest."""
    arrays: dict[str, NDArray[Any]] = {
        "images": episode.images,
        "actions": episode.actions,
        "targets": episode.targets,
        "joints_deg": episode.joints_deg,
        "phases": episode.phases,
        "body_poses": episode.body_poses,
        "action_names": np.array(ACTION_NAMES),
        "joint_names": np.array(JOINT_NAMES),
        "phase_names": np.array(episode.phase_names),
        "body_names": np.array(episode.body_names),
        "about": np.array(json.dumps(_about(episode))),
    }
    if episode.outputs is not None:
        arrays["outputs"] = episode.outputs
    for name, activity in (episode.states or {}).items():
        arrays[f"states.{name}"] = activity
    return arrays


def _about(episode: Episode) -> dict[str, Any]:
    outcome = episode.outcome
    return {
        "id": episode.id,
        "kind": episode.kind.value,
        "task": episode.task,
        "situation": dict(episode.situation),
        "seed": episode.seed,
        "policy": episode.policy,
        "policy_version": episode.policy_version,
        "training": episode.training,
        "control_period_s": episode.control_period_s,
        "started_s": episode.started_s,
        "outcome": {
            "lenient": outcome.lenient,
            "strict": outcome.strict,
            "precise": outcome.precise,
            "reason": outcome.reason,
            "measures": {n: [m.value, m.unit] for n, m in outcome.measures.items()},
        },
    }
