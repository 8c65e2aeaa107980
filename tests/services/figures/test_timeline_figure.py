"""`vmdnn figure timeline` tells what each process of a run did when."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from proto.episode import Episode, Kind
from proto.metrics import Stage
from proto.recordings.episodes import write_episode
from services.cli import main
from services.figures.timeline import PlayedEpisode, Timeline, draw
from services.monitoring.history import history_file
from services.monitoring.sample import LearnerSample, Sample

STAGES = [
    (0.0, Stage.WAITING, 0),
    (5.0, Stage.PRETRAINING, 0),
    (10.0, Stage.PRETRAINING, 0),
    (15.0, Stage.COUPLED, 1),
    (20.0, Stage.COUPLED, 2),
]


def sample(time_s: float, stage: Stage, version: int = 0) -> Sample:
    learner = LearnerSample(
        training="only",
        stage=stage,
        round=0,
        epochs=(),
        epochs_per_s=1.0,
        sequences=45,
        policy_version=version,
    )
    return Sample(time_s=time_s, learner=learner)


def samples() -> list[Sample]:
    return [sample(*each) for each in STAGES]


def test_the_learners_stages_follow_one_another() -> None:
    timeline = Timeline.of("run", samples(), [])
    spans = [(span.what, span.start_s, span.end_s) for span in timeline.spans]
    assert spans == [
        (Stage.WAITING, 0.0, 5.0),
        (Stage.PRETRAINING, 5.0, 15.0),
        (Stage.COUPLED, 15.0, 20.0),
    ]
    assert timeline.policies == {1: 15.0, 2: 20.0}


def test_what_a_lost_learner_did_is_not_known() -> None:
    told = [*samples(), sample(300.0, Stage.COUPLED), sample(305.0, Stage.COUPLED)]
    timeline = Timeline.of("run", told, [])
    assert timeline.seconds("learner")[Stage.COUPLED] == 10.0
    assert timeline.seconds("learner")["nothing"] == 280.0


def test_an_episode_ends_when_it_is_recorded_or_the_next_one_begins() -> None:
    episodes = [
        PlayedEpisode("a", Kind.TUTORING, 0.0, 3.0),
        PlayedEpisode("a", Kind.TRIAL, 10.0, 500.0),  # its recording was copied later
        PlayedEpisode("a", Kind.TRIAL, 12.0, 13.0),
        PlayedEpisode("b", Kind.PRACTICE, 4.0, 20.0),
    ]
    timeline = Timeline.of("run", [], episodes)
    assert timeline.processes == ["a", "b"]
    assert timeline.seconds("a") == {Kind.TUTORING: 3.0, Kind.TRIAL: 3.0, "nothing": 14.0}
    assert timeline.seconds("b") == {Kind.PRACTICE: 16.0, "nothing": 4.0}


def test_a_recording_that_was_copied_does_not_lengthen_the_run() -> None:
    copied = [
        PlayedEpisode("a", Kind.TUTORING, 3.0, 9e9),
        PlayedEpisode("a", Kind.TRIAL, 18.0, 9e9),
    ]
    timeline = Timeline.of("run", samples(), copied)
    assert timeline.end_s == 20.0, "when the history ends"
    assert timeline.seconds("a") == {Kind.TUTORING: 15.0, Kind.TRIAL: 2.0, "nothing": 3.0}


def test_numbers_of_policies_do_not_cover_each_other() -> None:
    close = [sample(100.0 + number, Stage.COUPLED, number + 1) for number in range(12)]
    timeline = Timeline.of("run", [*samples(), *close, sample(400.0, Stage.COUPLED, 13)], [])
    figure = draw(timeline)
    with warnings.catch_warnings(action="error"):  # as when something does not fit
        figure.draw_without_rendering()
    (axes,) = figure.axes
    boxes = [text.get_window_extent() for text in axes.texts]
    assert {text.get_text() for text in axes.texts} >= {"1", "13"}
    assert all(one.x1 <= other.x0 for one, other in pairwise(boxes))


def test_the_command_reads_a_run(
    tmp_path: Path, make_episode: Callable[..., Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "played"
    run.mkdir()
    history_file(run).write_bytes(b"".join(each.line() for each in samples()))
    for folder, kind, actor in (("tutoring", Kind.TUTORING, "a"), ("rollouts", Kind.TRIAL, "b")):
        path = run / folder / "episode.mcap"
        write_episode(path, make_episode(kind=kind, actor=actor, started_s=2.0))
        os.utime(path, (9.0, 9.0))
    (run / "rollouts" / "damaged.mcap").write_bytes(b"no recording")
    out = tmp_path / "timeline.png"
    assert main(["figure", "timeline", str(run), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["duration_s"] == 20.0
    assert told["policies_s"] == {"1": 15.0, "2": 20.0}
    assert told["seconds"]["a"] == {"tutoring": 7.0, "nothing": 13.0}
    assert told["seconds"]["learner"]["pretraining"] == 10.0
    assert out.read_bytes().startswith(b"\x89PNG")
    assert main(["figure", "timeline", str(run), "--out", str(out)]) == 0
    assert "learner" in capsys.readouterr().out


def test_a_folder_without_a_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "timeline.png")
    assert main(["figure", "timeline", str(tmp_path), "--out", out]) == 2
    assert "has no history (metrics.jsonl) and no recordings" in capsys.readouterr().err
