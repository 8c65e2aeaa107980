"""The figure of failures distinguishes policies that snap to tutored values from others."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from outcomes import measures

from actors.tasks.experiment1.world import GRID
from actors.tasks.registry import make_task
from proto.config import TaskConfig, load_config
from proto.episode import NO_FAILURE, UNKNOWN_OUTCOME, Outcome
from proto.errors import UserError
from services.cli import main
from services.figures.failures import Trials, draw, numbers, snapping, table
from services.trials.trial_log import CountedTrial

YAW, POSITION = "object_yaw_deg", "object_y_m"
TASK = make_task(TaskConfig())
Believes = Callable[[str, float], float]


def nearest(name: str, value: float) -> float:
    return min(GRID[name], key=lambda taught: abs(taught - value))


def outcome(situation: Mapping[str, float], believes: Believes) -> Outcome:
    """How a policy fares whose hand goes where it believes the object is."""
    yaw = situation[YAW]
    yaw_error = believes(YAW, yaw) - yaw
    offset_mm = 1e3 * (believes(POSITION, situation[POSITION]) - situation[POSITION])
    along, across = offset_mm * np.cos(np.deg2rad(yaw)), -offset_mm * np.sin(np.deg2rad(yaw))
    precise = abs(yaw_error) <= 10 and abs(along) <= 20 and abs(across) <= 10
    reason = NO_FAILURE if precise else "imprecise"
    measured = measures(
        moved_mm=0, turned_deg=0, yaw_error_deg=yaw_error, along_mm=along, across_mm=across
    )
    return Outcome(True, True, precise, reason, measured)


def play(believes: Believes, count: int = 400, version: int = 1) -> list[CountedTrial]:
    situations = [TASK.sample(seed) for seed in range(count)]
    return [
        CountedTrial("run", version, seed, f"e{seed}", "local", each, outcome(each, believes))
        for seed, each in enumerate(situations)
    ]


def write(path: Path, trials: Sequence[CountedTrial]) -> Path:
    path.write_bytes(b"".join(trial.line() for trial in trials))
    return path


@pytest.mark.parametrize("share", [0.0, 0.4, 0.8])
@pytest.mark.parametrize("name", [YAW, POSITION])
def test_snapping_is_estimated_in_the_presence_of_other_errors(name: str, share: float) -> None:
    random = np.random.default_rng(7)
    middle = {YAW: 0.0, POSITION: 0.25}
    noise = {YAW: 0.5, POSITION: 0.0005}

    def believes(asked: str, value: float) -> float:
        if asked != name:
            return value
        pulled = value + 0.1 * (middle[name] - value)  # to the middle of the range
        snapped = pulled + share * (nearest(name, value) - value)
        return snapped + noise[name] * random.normal()

    found = snapping(Trials.of(play(believes), TASK), name)
    assert found is not None
    assert found.share == pytest.approx(share, abs=0.03)
    assert found.half_width < 0.06


def test_success_is_counted_near_and_between_tutored_values() -> None:
    found = numbers(Trials.of(play(nearest), TASK))
    for name in (YAW, POSITION):
        places = found["near_and_between"][name]
        assert places["near"]["precise"]["rate"] > places["between"]["precise"]["rate"] + 0.1
    for name in GRID:
        bins = found["by_value"][name]
        assert len(bins) == 2 * len(GRID[name]) - 1  # tutored values and gaps, by turns
        assert sum(part["strict"]["trials"] for part in bins) == found["trials"] == 400
        assert (bins[0]["from"], bins[-1]["to"]) == (min(GRID[name]), max(GRID[name]))


def test_one_command_draws_the_outcomes_of_evaluate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = write(tmp_path / "outcomes.jsonl", play(nearest, 60)), tmp_path / "failures.png"
    assert main(f"figure failures --outcomes {path} --out {out} --json".split()) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    result = json.loads(capsys.readouterr().out)
    assert (result["policy"], result["policy_version"], result["trials"]) == ("run", 1, 60)
    assert result["snapping"].keys() == {YAW, POSITION}


def test_recorded_rollouts_can_be_drawn(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "failures.png"
    assert main(f"figure failures --rollouts {recordings} --out {out}".split()) == 0
    assert out.exists()
    assert "snapping" in capsys.readouterr().out


def test_the_newest_of_several_versions_is_drawn_unless_another_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trials = [*play(nearest, 20), *play(nearest, 10, version=2)]
    path, out = write(tmp_path / "trials.jsonl", trials), tmp_path / "failures.png"
    command = f"figure failures --outcomes {path} --out {out} --json"
    for more, drawn in (("", 10), ("--policy-version newest", 10), ("--policy-version 1", 20)):
        assert main([*command.split(), *more.split()]) == 0
        assert json.loads(capsys.readouterr().out)["trials"] == drawn
    other = [replace(trial, run_id="other") for trial in play(nearest, 3, version=2)]
    path = write(tmp_path / "trials.jsonl", [*trials, *other])
    assert main(command.split()) == 2
    assert "other version 2, run version 2" in capsys.readouterr().err


def make_run(folder: Path, trials: Sequence[CountedTrial], *settings: str) -> Path:
    """The folder of a run whose training is called `run`, with policies for its trials."""
    load_config(None, [f"run.name={folder.name}", *settings]).save(folder / "config.yaml")
    (folder / "policies").mkdir()
    for version in {trial.policy_version for trial in trials}:
        (folder / "policies" / f"{version:06d}.safetensors").touch()
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "run_id").write_text("run")
    (folder / "evaluation").mkdir()
    write(folder / "evaluation" / "trials.jsonl", trials)
    return folder


def test_the_trials_of_a_run_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = [replace(trial, run_id="earlier-training") for trial in play(nearest, 5, version=3)]
    trials = [replace(t, seed=1000 + t.seed) for t in [*play(nearest, 9), *old]]
    run, out = make_run(tmp_path / "tried", trials), tmp_path / "failures.png"
    assert main(["figure", "failures", str(run), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["policy"], told["policy_version"], told["trials"]) == ("tried", 1, 9)
    words = ["figure", "failures", str(run), "--out", str(out), "--outcomes", "x.jsonl"]
    assert main(words) == 2
    assert "name either the folder of a run" in capsys.readouterr().err
    assert main(["figure", "failures", str(tmp_path), "--out", str(out)]) == 2
    assert "is not the folder of a run" in capsys.readouterr().err


def test_a_variable_with_hundreds_of_choices_is_not_drawn() -> None:
    task = make_task(TaskConfig(name="experiment2"))
    trials = Trials.of(
        [
            CountedTrial("run", 1, seed, f"e{seed}", "local", task.sample(seed), UNKNOWN_OUTCOME)
            for seed in range(30)
        ],
        task,
    )
    assert len(trials.axes["take"].variable.choices) > 100  # type: ignore[union-attr]
    figure = draw(trials, "Experiment II")
    maps, rest = figure.subfigs
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in maps.axes]
    assert len(set(labels)) == 6, "each pair of the four continuous variables"
    assert not any("kind" in word or "take" in word for pair in labels for word in pair)
    assert {axes.get_xlabel() for axes in rest.axes} >= {"indicated kind", "other Y (m)"}
    assert not any(axes.get_xlabel() == "take" for axes in rest.axes)
    first_column = list(table(trials).columns[0].cells)
    assert "indicated kind laying" in first_column
    assert not any(str(cell).startswith("take") for cell in first_column)


def test_a_range_without_trials_is_not_drawn_as_a_failure() -> None:
    trials = [t for t in play(lambda _, value: value, 60) if float(t.situation[YAW]) < 20]
    figure = draw(Trials.of(trials, TASK), "left half")
    rates = figure.subfigs[1].axes[2]
    assert rates.lines, "success by yaw"
    drawn = np.concatenate([np.asarray(line.get_ydata(), float) for line in rates.lines[:2]])
    assert drawn.min() == 100


def test_files_without_trials_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "failures.png"
    (tmp_path / "other.jsonl").write_text('{"a": 1}\n')
    for words, message in (
        (f"--outcomes {tmp_path / 'missing'}", "cannot be read"),
        (f"--outcomes {tmp_path / 'other.jsonl'}", "is not a file of counted trials"),
        (f"--rollouts {tmp_path}", "no trial"),
        ("", "--outcomes"),
    ):
        assert main(f"figure failures --out {out} {words}".split()) == 2
        assert message in capsys.readouterr().err
    assert not out.exists()


def test_trials_of_another_task_are_refused() -> None:
    (trial,) = play(nearest, 1)
    foreign = CountedTrial("run", 1, 0, "e", "local", {"object_y_m": 0.2}, trial.outcome)
    with pytest.raises(UserError, match="a situation has"):
        Trials.of([foreign], TASK)
