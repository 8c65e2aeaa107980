"""The layout for Foxglove shows what a recording really has."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from proto.episode import BoxLook, Episode, View
from proto.recordings.episodes import write_episode
from proto.recordings.schemas import SceneUpdate, Step

LAYOUT = json.loads((Path(__file__).parents[1] / "docs" / "foxglove-layout.json").read_text())


def texts(value: Any) -> Iterator[str]:
    """All texts in a JSON value, keys included."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from texts(item)
    elif isinstance(value, list):
        for item in value:
            yield from texts(item)
    elif isinstance(value, str):
        yield value


def panels(node: Any) -> Iterator[str]:
    """The panels of a part of the arrangement."""
    if isinstance(node, str):
        yield node
    else:
        yield from panels(node["first"])
        yield from panels(node["second"])


def test_every_panel_is_arranged_once() -> None:
    assert sorted(panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_every_topic_and_field_is_in_a_recording(
    tmp_path: Path, make_episode: Callable[..., Episode]
) -> None:
    path = tmp_path / "episode.mcap"
    view = View({"object": BoxLook((1, 1, 1), (1, 0, 0))}, {}, np.ones((3, 2), np.float32))
    write_episode(path, make_episode(3, view=view), robot=SceneUpdate())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    recorded = {channel.topic for channel in summary.channels.values()}
    named = [text for text in texts(LAYOUT) if text.startswith("/")]
    assert len(named) > 10
    for name in named:
        topic, _, fields = name.partition(".")
        assert topic in recorded, name
        described = Step.DESCRIPTOR
        for field in filter(None, re.split(r"\.", fields)):
            assert field in described.fields_by_name, name
            described = described.fields_by_name[field].message_type
