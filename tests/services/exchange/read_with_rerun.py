"""Prints as JSON what Rerun makes of a file; runs in an environment that has Rerun.

`read_with_rerun.py recording FILE.rrd`: rows of each component that changes, by entity.
`read_with_rerun.py dataset FOLDER`: the same for each episode of a LeRobotDataset.
"""

from __future__ import annotations

import base64
import json
import sys
from collections import defaultdict
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader
from rerun.experimental import LeRobotReader


def rows(chunks: Any) -> dict[str, dict[str, list[Any]]]:
    """Values by entity and component; those of the timelines are whole numbers."""
    told: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for chunk in chunks:
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if name == "rerun.controls.RowId":
                continue
            plain = column.cast("int64") if pa.types.is_timestamp(column.type) else column
            told[chunk.entity_path][name] += plain.to_pylist()
    return told


def text(value: Any) -> str:
    """Bytes as base64."""
    return base64.b64encode(value).decode()


if __name__ == "__main__":
    form, path = sys.argv[1:]
    if form == "recording":
        answer: Any = rows(RrdReader(path).stream())
    else:
        reader = LeRobotReader(path)
        answer = [rows(reader.stream(episode)) for episode in reader.episodes()]
    json.dump(answer, sys.stdout, default=text)
