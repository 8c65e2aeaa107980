"""The losses of a training are read from a history that grows, is thinned out, or is damaged."""

from __future__ import annotations

from pathlib import Path

from proto.metrics import EpochMetrics, Stage
from services.board import Loss
from services.monitoring.history import History, history_file
from services.monitoring.past_losses import MOST_LOSSES, PastLosses
from services.monitoring.sample import LearnerSample, Sample


def sample(time_s: float, stage: Stage, *epochs: int, training: str = "ab12") -> Sample:
    """A sample with the losses 1 / epoch."""
    told = tuple(
        EpochMetrics(stage=stage, epoch=epoch, loss=1 / epoch, learning_rate=0.1)
        for epoch in epochs
    )
    learner = LearnerSample(
        **{"training": training, "stage": stage, "round": 0, "epochs": told},
        **{"epochs_per_s": 1.0, "sequences": 3, "policy_version": 0},
    )
    return Sample(time_s=time_s, learner=learner)


def add(history: History, *samples: Sample) -> None:
    for each in samples:
        history.add(each)
    history.flush()


def epochs_of(past: PastLosses) -> list[tuple[str, int]]:
    past.look()
    return [(each.stage, each.epoch) for each in past.losses()]


def test_losses_of_both_stages_are_found_while_the_history_grows(tmp_path: Path) -> None:
    path = history_file(tmp_path)
    past = PastLosses(path)
    assert epochs_of(past) == []
    history = History(path, period_s=1.0)
    add(history, sample(1.0, Stage.PRETRAINING, 1, 2), sample(2.0, Stage.COUPLED, 1))
    assert epochs_of(past) == [("pretraining", 1), ("pretraining", 2), ("coupled", 1)]
    with path.open("ab") as stream:
        stream.write(b"nothing\n" + sample(3.0, Stage.COUPLED, 2).line()[:-9])  # not finished
    assert len(epochs_of(past)) == 3
    add(History(path, period_s=1.0), sample(4.0, Stage.COUPLED, 2, 3))
    assert epochs_of(past)[2:] == [("coupled", 1), ("coupled", 2), ("coupled", 3)]
    assert past.losses()[-1] == Loss(Stage.COUPLED, 3, 1 / 3)


def test_only_the_newest_training_counts(tmp_path: Path) -> None:
    past = PastLosses(history_file(tmp_path))
    history = History(history_file(tmp_path), period_s=1.0)
    add(history, sample(1.0, Stage.COUPLED, 5, 6), sample(2.0, Stage.COUPLED, 1, training="new"))
    assert epochs_of(past) == [("coupled", 1)]


def test_many_losses_are_thinned_out_and_the_last_one_stays(tmp_path: Path) -> None:
    path = history_file(tmp_path)
    past = PastLosses(path)
    history = History(path, period_s=0.001, most_bytes=300_000)
    for number in range(100):
        first = 1 + 30 * number
        add(history, sample(float(number), Stage.COUPLED, *range(first, first + 30)))
        past.look()  # the file is written anew when it is full
    assert MOST_LOSSES // 4 < len(past.losses()) <= MOST_LOSSES
    assert past.losses()[-1].epoch == 3000
    assert [each.epoch for each in past.losses()] == sorted(each.epoch for each in past.losses())
