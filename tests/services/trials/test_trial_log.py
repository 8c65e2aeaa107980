"""Each trial is counted once, also when processes are killed and started again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from outcomes import PRECISE, measures

from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.messages import Rollout
from proto.suites import Conditions
from services.trials.trial_log import TrialLog, read_trials

MakeEpisode = Callable[..., Episode]


@pytest.fixture
def trial(make_episode: MakeEpisode) -> Callable[..., Rollout]:
    def make(seed: int, version: int = 1, run_id: str = "run") -> Rollout:
        episode = make_episode(
            2, kind=Kind.TRIAL, seed=seed, policy_version=version, id=f"{seed}-{version}-{run_id}"
        )
        return Rollout(episode, run_id)

    return make


def test_a_trial_counts_once_for_each_policy(tmp_path: Path, trial: Callable[..., Rollout]) -> None:
    path = tmp_path / "evaluation" / "trials.jsonl"
    book = TrialLog(path)
    assert [book.add(trial(seed)) for seed in (5, 6, 5)] == [True, True, False]
    assert book.add(trial(5, version=2))
    assert book.add(trial(5, run_id="another"))
    again = TrialLog(path)
    for known in (book, again):
        assert known.versions("run") == [1, 2]
        assert sorted(known.outcomes("run", 1)) == [5, 6]
        assert known.outcomes("run", 1)[5] == trial(5).episode.outcome
        assert known.outcomes("another", 7) == {}
    assert not again.add(trial(6))
    assert len(path.read_text().splitlines()) == 4


def test_each_suite_is_counted_on_its_own_and_plain_lines_stay_as_they_were(
    tmp_path: Path, trial: Callable[..., Rollout]
) -> None:
    path = tmp_path / "trials.jsonl"
    log = TrialLog(path)
    plain = trial(5)
    pushed = replace(
        plain,
        episode=replace(plain.episode, conditions=Conditions("disturbed", 1.0, "pushed", 20.0)),
    )
    assert [log.add(each) for each in (plain, pushed, pushed)] == [True, True, False]
    again = TrialLog(path)
    for known in (log, again):
        assert sorted(known.outcomes("run", 1)) == sorted(known.outcomes("run", 1, "disturbed"))
        assert known.versions("run", "disturbed") == [1]
        assert known.versions("run", "beyond") == []
    first, second = read_trials(path)
    assert (first.suite, first.format, second.suite, second.format) == (
        *("unlearned", 2, "disturbed", 3),
    )
    assert second.conditions == pushed.episode.conditions
    assert b"conditions" not in path.read_bytes().splitlines()[0]


@pytest.mark.parametrize("kept", [1, 40, -1])
def test_an_incomplete_line_is_dropped_and_counted_again(
    tmp_path: Path, trial: Callable[..., Rollout], kept: int
) -> None:
    path = tmp_path / "trials.jsonl"
    TrialLog(path).add(trial(1))
    whole = path.read_bytes()
    path.write_bytes(whole + whole.replace(b'"seed": 1', b'"seed": 2')[:kept])
    book = TrialLog(path)
    assert sorted(book.outcomes("run", 1)) == [1]
    assert path.read_bytes() == whole
    assert book.add(trial(2))
    assert sorted(TrialLog(path).outcomes("run", 1)) == [1, 2]


def test_a_damaged_line_is_skipped_and_reported(
    tmp_path: Path, trial: Callable[..., Rollout], caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "trials.jsonl"
    book = TrialLog(path)
    for seed in (1, 2, 3):
        book.add(trial(seed))
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + lines[1].replace(b'"strict"', b'"strikt"') + lines[2])
    assert sorted(TrialLog(path).outcomes("run", 1)) == [1, 3]
    assert "line 2 is not counted: outcome" in caplog.text
    assert TrialLog(path).damaged == 1


def test_lines_of_format_1_can_be_read(tmp_path: Path) -> None:
    old = Path(__file__).parents[2] / "data" / "format1" / "trials.jsonl"
    touched, precise = read_trials(old)
    assert touched.outcome.reason == "touched_obstacle"
    assert touched.outcome.measures == measures(yaw_error_deg=11, obstacle_touched_at=30)
    assert precise.outcome == replace(PRECISE, measures=measures(closed_at=81))
    path = tmp_path / "trials.jsonl"
    path.write_bytes(old.read_bytes())
    assert sorted(TrialLog(path).outcomes("run", 3)) == [3001, 3002]


def test_lines_of_a_newer_format_are_reported(
    tmp_path: Path, trial: Callable[..., Rollout]
) -> None:
    path = tmp_path / "trials.jsonl"
    TrialLog(path).add(trial(5))
    path.write_text(path.read_text().replace('"format": 2', '"format": 4'))
    with pytest.raises(UserError, match="4 was written by a newer vmdnn"):
        read_trials(path)
