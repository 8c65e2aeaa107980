"""The history keeps what a run said, stays small, and survives full disks and lines cut off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_metrics import ACTOR, EVALUATOR, LEARNER, score, view_of

from proto.errors import UserError
from proto.metrics import EpochMetrics, EvaluatorMetrics, Stage, SuiteScore
from proto.storage import DiskFullError
from services.monitoring.history import History, PastSamples, read_history
from services.monitoring.sample import LearnerSample, Sample, Sampler, ScoreSample

SCORE = ScoreSample(suite="unlearned", version=1, trials=10, lenient=9, strict=8, precise=7)


def sample(time_s: float, *scores: ScoreSample) -> Sample:
    learner = LearnerSample(
        training="t",
        stage=Stage.COUPLED,
        round=0,
        epochs=(
            EpochMetrics(stage=Stage.COUPLED, epoch=int(time_s), loss=0.5, learning_rate=0.003),
        ),
        epochs_per_s=2.0,
        sequences=45,
        policy_version=1,
    )
    return Sample(time_s=time_s, learner=learner, scores=scores)


def test_samples_are_read_as_they_were_added(tmp_path: Path) -> None:
    path = tmp_path / "run" / "metrics.jsonl"
    history = History(path, period_s=1.0)
    added = [sample(1000.5, SCORE), sample(1001.5), Sample(time_s=1002.5)]
    for each in added:
        assert history.is_due(each.time_s)
        history.add(each)
        assert not history.is_due(each.time_s)
    assert not path.exists()
    history.flush()
    assert read_history(path) == PastSamples(added, 0)
    with pytest.raises(UserError, match="cannot be read"):
        read_history(tmp_path)


def test_lines_that_cannot_be_read_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    good = [sample(1.0).line(), sample(2.0).line()]
    bad = [b'{"time_s": 3, "scores": [{"suite": "s"}]}\n', b'{"time_s": NaN}\n', b"\xff\n"]
    path.write_bytes(b"".join([good[0], *bad, good[1], b'{"ti']))
    past = read_history(path)
    assert [each.time_s for each in past.samples] == [1.0, 2.0]
    assert past.damaged == 4
    history = History(path, period_s=1.0)  # it removes the line that was cut off
    history.add(sample(4.0))
    history.flush()
    assert [each.time_s for each in read_history(path).samples] == [1.0, 2.0, 4.0]


@given(
    times=st.lists(st.floats(0, 1e6), min_size=1, max_size=60).map(sorted),
    versions=st.lists(st.integers(1, 5), min_size=60, max_size=60),
)
def test_a_full_history_keeps_the_newest_scores_and_the_last_sample(
    tmp_path_factory: pytest.TempPathFactory, times: list[float], versions: list[int]
) -> None:
    path = tmp_path_factory.mktemp("history") / "metrics.jsonl"
    history, limit = History(path, period_s=1e-3, most_bytes=4000), 4000
    newest: dict[int, ScoreSample] = {}
    for number, (time_s, version) in enumerate(zip(times, versions, strict=False)):
        if not history.is_due(time_s):
            continue
        newest[version] = replace(SCORE, version=version, trials=10 + number)
        history.add(sample(time_s, newest[version]))
        history.flush()
        assert path.stat().st_size <= limit
    samples = read_history(path).samples
    told = {score.version: score for each in samples for score in each.scores}
    assert told == newest
    assert [each.time_s for each in samples] == sorted(each.time_s for each in samples)
    assert samples[-1].learner is not None
    assert samples[-1].learner.epochs


def test_a_full_disk_loses_nothing(tiny_disk: Path) -> None:
    filler, path = tiny_disk / "filler", tiny_disk / "metrics.jsonl"
    history = History(path, period_s=1.0)
    history.add(sample(1.0))
    history.flush()
    filler.write_bytes(bytes(56 * 1024))
    for number in range(2, 50):
        history.add(sample(number))
    with pytest.raises(DiskFullError):
        history.flush()
    assert len(read_history(path).samples) == 1
    filler.unlink()
    history.flush()
    assert [each.time_s for each in read_history(path).samples] == list(range(1, 50))


def evaluator(*strict: int) -> EvaluatorMetrics:
    """An evaluator that has counted ten trials of each version."""
    scores = tuple(score(version, count, 10) for version, count in enumerate(strict, 1))
    suite = SuiteScore("unlearned", "sapien", 10, "", scores)
    return replace(EVALUATOR, policies=scores, suites=(suite,))


def test_a_sample_holds_the_scores_that_changed() -> None:
    sampler = Sampler()
    epochs = (EpochMetrics(stage=Stage.COUPLED, epoch=3, loss=0.5, learning_rate=0.003),)
    first = sampler.sample(view_of(LEARNER, evaluator(3)), 100.0, epochs)
    assert first.learner is not None
    assert first.learner.epochs == epochs
    assert [(s.version, s.strict, s.trials) for s in first.scores] == [(1, 3, 10)]
    assert sampler.sample(view_of(LEARNER, evaluator(3)), 101.0).scores == ()
    changed = sampler.sample(view_of(LEARNER, evaluator(4, 5)), 102.0).scores
    assert [(s.version, s.strict) for s in changed] == [(1, 4), (2, 5)]
    other = replace(LEARNER, training="another")
    assert len(sampler.sample(view_of(other, evaluator(4, 5)), 103.0).scores) == 2


def test_a_sample_is_bounded_and_the_rest_follows() -> None:
    sampler = Sampler()
    told: set[int] = set()
    for number in range(4):
        scores = sampler.sample(view_of(evaluator(*[1] * 250)), 100.0 + number).scores
        assert len(scores) <= 100
        told |= {each.version for each in scores}
    assert told == set(range(1, 251))


def test_rates_of_actors_are_summed_and_restarts_are_noticed() -> None:
    sampler = Sampler()
    other = replace(ACTOR, id="a-2", episodes=100)
    assert sampler.sample(view_of(ACTOR, other), 100.0).actors is not None
    again = replace(other, episodes=3)  # it was started again and has played three
    later = sampler.sample(view_of(replace(ACTOR, episodes=24), again), 110.0).actors
    assert later is not None
    assert (later.present, later.steps_per_s) == (2, 2 * 81.25)
    assert later.episodes_per_s == pytest.approx((7 + 3) / 10)
    assert not Sampler().sample(view_of(), 100.0).says_something


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: line.replace(b'"strict": 8', b'"strict": 11'),
        lambda line: line.replace(b'"format": 1', b'"format": 2'),
        lambda line: line.replace(b'"loss": 0.5', b'"loss": -1'),
        lambda line: line.replace(b'"coupled"', b'"asleep"'),
        lambda line: line.replace(
            b'"epochs": [{"stage": "coupled"', b'"epochs": [{"stage": "waiting"'
        ),
    ],
)
def test_a_line_is_checked(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    line = sample(1.0, SCORE).line()
    assert damage(line) != line
    (tmp_path / "metrics.jsonl").write_bytes(line + damage(line))
    past = read_history(tmp_path / "metrics.jsonl")
    assert (len(past.samples), past.damaged) == (1, 1)
