"""`vmdnn figure training` draws the newest training in a run's history."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from proto.metrics import EpochMetrics, Stage
from services.cli import main
from services.monitoring.history import history_file
from services.monitoring.sample import ActorsSample, LearnerSample, Sample, ScoreSample


def learner(*losses: float, first: int = 1, **given: Any) -> LearnerSample:
    stage = given.pop("of", Stage.COUPLED)
    epochs = tuple(
        EpochMetrics(stage=stage, epoch=number, loss=loss, learning_rate=0.001)
        for number, loss in enumerate(losses, first)
    )
    made = LearnerSample(
        training="newest",
        stage=stage,
        round=0,
        epochs=epochs,
        epochs_per_s=4.0,
        sequences=45,
        policy_version=1,
    )
    return replace(made, **given)


def counted(version: int, strict: int, suite: str = "unlearned") -> ScoreSample:
    return ScoreSample(
        suite=suite, version=version, trials=10, lenient=10, strict=strict, precise=0
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that was started anew, went back to a checkpoint, and had a round of corrections."""
    actors = ActorsSample(present=1, steps_per_s=80.0, episodes_per_s=0.5)
    told = [
        (learner(5.0, training="before"), (counted(1, 10), counted(9, 10))),
        (learner(1.0, 0.5, of=Stage.PRETRAINING), ()),
        (learner(stage=Stage.WAITING), ()),
        (learner(1.0, 9.0), (counted(1, 3),)),
        (learner(0.25, first=2), (counted(1, 4), counted(2, 5), counted(2, 6, "beyond"))),
        (learner(0.125, first=3, round=1), ()),
        (learner(0.0625, first=4, round=1, stage=Stage.FINISHED), ()),
    ]
    samples = [
        Sample(time_s=60.0 * number, learner=each, actors=actors, scores=scores)
        for number, (each, scores) in enumerate(told)
    ]
    folder = tmp_path / "told"
    folder.mkdir()
    lines = b"".join(sample.line() for sample in samples)
    history_file(folder).write_bytes(lines + b'{"time_s": 1')
    return folder


def test_it_shows_the_newest_training(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "training.png"
    assert main(["figure", "training", str(run), "--json", "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    numbers = json.loads(capsys.readouterr().out)
    coupled = numbers["stages"]["coupled training"]
    assert coupled["loss"] == [[1, 1.0], [2, 0.25], [3, 0.125], [4, 0.0625]]
    assert coupled["rounds"] == {"1": 3}
    assert numbers["stages"]["pre-training"]["loss"] == [[1, 1.0], [2, 0.5]]
    success = {
        suite: [(each["policy_version"], each["strict"]["successes"]) for each in scores]
        for suite, scores in numbers["success"].items()
    }
    assert success == {"unlearned": [(1, 4), (2, 5)], "beyond": [(2, 6)]}
    low, high = numbers["success"]["unlearned"][0]["strict"]["wilson95"]
    assert (round(low, 3), round(high, 3)) == (0.168, 0.687)
    assert numbers["rates_by_minute"]["control steps"][0] == [0.0, 80.0]
    assert numbers["damaged_lines"] == 1

    assert main(["figure", "training", str(run), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "50 (24 to 76)" in printed
    assert "coupled training, epochs 1 to 4: loss 1 to 0.0625" in printed


def test_a_folder_without_a_history_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["figure", "training", str(tmp_path), "--out", str(tmp_path / "t.png")]
    assert main(command) == 2
    assert "has no history (metrics.jsonl)" in capsys.readouterr().err
    history_file(tmp_path).write_bytes(b"nothing\n")
    assert main(command) == 2
    assert "1 damaged lines" in capsys.readouterr().err
    assert not (tmp_path / "t.png").exists()
