"""Rollouts in the outboxes of former versions, which were sent to the evaluator as well.

The evaluator takes outcomes instead. A rollout that it has not answered yet is divided into its
outcome, for the evaluator, and the rollout, for recorders.
"""

from __future__ import annotations

import json
from pathlib import Path

from proto.codec import MessageError, Wire, decode, encode
from proto.keys import Role
from proto.messages import EpisodeOutcome, Rollout
from proto.storage import delete_file, make_folder, written_whole

OLD_KEY = "rollout"


def divide_old_rollouts(folder: Path) -> None:
    """Divide the old rollouts in an actor's folder of outboxes. No process may use it.

    Raises:
        UserError: a file cannot be written.
    """
    for path in (folder / "rollouts").glob("*.message"):
        header, _, payload = path.read_bytes().partition(b"\n")
        try:
            values = json.loads(header)
            key, receivers = values["key"], set(values["receivers"])
            if Role.EVALUATOR not in receivers or f"/{OLD_KEY}/" not in key:
                continue
            episode = decode(Wire(values["encoding"], payload), Rollout).episode
        except (ValueError, KeyError, TypeError, RecursionError, MessageError):
            continue  # the outbox finds what is damaged
        outcome = encode(EpisodeOutcome.of(episode))
        sent = {
            "key": key.replace(f"/{OLD_KEY}/", "/outcome/"),
            "encoding": outcome.encoding,
            "receivers": [Role.EVALUATOR],
        }
        make_folder(folder / "outcomes")
        _write(folder / "outcomes" / path.name, sent, outcome.payload)
        if receivers == {Role.EVALUATOR}:
            delete_file(path)
        else:
            rest = sorted(receivers - {Role.EVALUATOR})
            _write(path, {**values, "receivers": rest}, payload)


def _write(path: Path, values: dict[str, object], payload: bytes) -> None:
    with written_whole(path) as stream:
        stream.write(json.dumps(values).encode() + b"\n" + payload)
