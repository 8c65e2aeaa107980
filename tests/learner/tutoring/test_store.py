from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from learner.tutoring.store import TutoringStore
from proto.episode import Episode

MakeEpisodes = Callable[..., Sequence[Episode]]


def test_sequences_are_kept_across_restarts(tmp_path: Path, bar_episodes: MakeEpisodes) -> None:
    store = TutoringStore(tmp_path / "tutoring")
    episodes = bar_episodes()
    assert [store.add(episode) for episode in episodes] == [True] * 4
    again = TutoringStore(tmp_path / "tutoring")
    assert again.ids == tuple(sorted(episode.id for episode in episodes))
    loaded = again.load(episodes[2].id)
    assert loaded is not None
    np.testing.assert_array_equal(loaded.images, episodes[2].images)
    np.testing.assert_array_equal(loaded.targets, episodes[2].targets)
    summaries = filter(None, map(again.summary, again.ids))
    known = [(summary.id, summary.seed, summary.kind) for summary in summaries]
    assert known == sorted((episode.id, episode.seed, episode.kind) for episode in episodes)


def test_the_same_sequence_is_stored_once(tmp_path: Path, bar_episodes: MakeEpisodes) -> None:
    store = TutoringStore(tmp_path)
    episode = bar_episodes()[0]
    assert store.add(episode)
    assert not store.add(episode)
    assert len(store) == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_a_damaged_file_is_reported_and_can_be_replaced(
    tmp_path: Path, bar_episodes: MakeEpisodes, caplog: pytest.LogCaptureFixture
) -> None:
    good, bad, *_ = bar_episodes()
    store = TutoringStore(tmp_path)
    store.add(good)
    store.add(bad)
    path = tmp_path / f"{bad.id}.mcap"
    path.write_bytes(path.read_bytes()[:-2000])

    again = TutoringStore(tmp_path)
    assert again.load(bad.id) is None
    assert again.ids == (good.id,)
    assert list(again.damaged) == [bad.id]
    assert "vmdnn recover" in caplog.text
    assert path.exists()

    summaries = TutoringStore(tmp_path)
    found = filter(None, map(summaries.summary, summaries.ids))
    assert [summary.id for summary in found] == [good.id]
    assert list(summaries.damaged) == [bad.id]

    assert again.add(bad)
    assert again.load(bad.id) is not None
    assert not again.damaged
