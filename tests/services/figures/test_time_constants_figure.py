"""Networks with several time constants are trained, tested and drawn, each of them once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from learner.tutoring.store import TutoringStore
from proto.config import Config, load_config
from services.cli import main
from services.figures import time_constants
from services.trials import sweeps
from services.trials.success import Rate, Tally, difference95

QUICK = (
    "--set learner.pretraining.epochs=1 --set learner.epochs=2 --set learner.warmup_epochs=1"
    " --tau 30 150 --seeds 1 --trials 1 --workers 1 --json"
)


def draw(recordings: Path, out: Path, words: str = "") -> int:
    command = f"figure time-constants --data {recordings} --out {out} {QUICK} {words}"
    return main(command.split())


def everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_one_command_trains_tests_and_draws_and_repeats_nothing(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "five.png"
    assert draw(recordings, out) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [(each["tau"], each["trials"]) for each in result["time_constants"]] == [
        (30, 1),
        (150, 1),
    ]
    assert result["time_constants"][0]["against_150"].keys() == {"lenient", "strict", "precise"}
    assert {tau: rate["successes"] for tau, rate in result["paper"].items()} == {
        "30": 32,
        "150": 44,
    }
    kept = everything(tmp_path / "five")
    saved = load_config(tmp_path / "five" / "tau30_seed1" / "config.yaml")
    assert (saved.network.pfc.tau, saved.run.seed) == (30, 1)

    assert draw(recordings, out) == 0
    assert json.loads(capsys.readouterr().out) == result
    assert everything(tmp_path / "five") == kept

    assert draw(recordings, out, "--trials 2 --tau 30") == 0
    (more,) = json.loads(capsys.readouterr().out)["time_constants"]
    assert more["trials"] == 2
    name = Path("five", "tau30_seed1", "trials.jsonl")
    first, second = (tmp_path / name).read_bytes().splitlines(keepends=True)
    assert first == kept[tmp_path / name], "what was counted is not played again"
    assert first != second

    assert draw(recordings, out, "--set learner.rate=1e-3") == 2
    assert "another config" in capsys.readouterr().err
    assert draw(recordings, out, "--tau 0.5") == 2
    assert "tau0.5" in capsys.readouterr().err


def test_experiment_2_with_a_delay_is_swept_without_rates_of_another_experiment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = "--set task.name=experiment2 --set task.delay_steps=30"
    tutored = tmp_path / "tutored"
    assert main(f"tutor --cases 0,1 --repeats 1 --workers 1 --out {tutored} {task}".split()) == 0
    capsys.readouterr()
    assert draw(tutored, tmp_path / "two.png", task) == 0
    told = json.loads(capsys.readouterr().out)
    assert [each["tau"] for each in told["time_constants"]] == [30, 150]
    assert told["paper"] == {}
    saved = load_config(tmp_path / "two" / "tau30_seed1" / "config.yaml")
    assert saved.task.options == {"delay_steps": 30}


def test_a_stopped_training_continues(recordings: Path, tmp_path: Path) -> None:
    values = {"learner": {"pretraining": {"epochs": 1}, "epochs": 2, "warmup_epochs": 1}}
    variant = sweeps.Variant("short", Config.model_validate(values))
    (run,) = sweeps.open_runs([variant], [1], tmp_path)
    store = TutoringStore(recordings)
    done = [sweeps.epochs_done(run)]
    while not sweeps.train(run, store, None, lambda _loss: False):
        done.append(sweeps.epochs_done(run))
    done.append(sweeps.epochs_done(run))
    assert done == [0, 1, 2, 3]
    assert done[-1] == sweeps.epochs_total(run)


def test_the_interval_of_a_difference_is_that_of_newcombe() -> None:
    """The example of Newcombe's paper: 56 of 70 against 48 of 80."""
    low, high = difference95(Rate(56, 70), Rate(48, 80))
    assert (low, high) == (pytest.approx(0.0524, abs=1e-4), pytest.approx(0.3339, abs=1e-4))


def test_the_published_rates_stand_beside_the_lenient_reading_only() -> None:
    figure = time_constants.draw({30.0: {1: Tally(10)}}, {30.0: Rate(32, 52), 150.0: Rate(44, 52)})
    named = {axes.get_title(): axes.get_legend_handles_labels()[1] for axes in figure.get_axes()}
    assert any("paper" in label for label in named["lenient"])
    for reading in ("strict", "precise"):
        assert not any("paper" in label for label in named[reading])
