"""`vmdnn runs`, `rollouts`, `compare-runs` and `evaluate --run`: what runs have left on disk."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from outcomes import IMPRECISE, NOT_LIFTED, PRECISE

from actors.tasks.registry import make_task
from proto.config import Config, TaskConfig, load_config
from proto.episode import Episode, Kind, Outcome
from proto.keys import Role
from proto.recordings.episodes import write_episode
from proto.run_locks import single_process
from services.cli import main
from services.commands import evaluate
from services.trials.trial_log import CountedTrial

MakeEpisode = Callable[..., Episode]
TASK = make_task(TaskConfig())


def counted(version: int, seed: int, outcome: Outcome, training: str) -> bytes:
    situation = dict(TASK.sample(seed))
    return CountedTrial(
        training, version, seed, f"e{version}-{seed}", "a", situation, outcome
    ).line()


def make_run(folder: Path, versions: dict[int, list[Outcome]], *settings: str) -> Path:
    """The folder of a run with empty policies, and trials of each version from seed 1000 on."""
    load_config(None, [f"run.name={folder.name}", *settings]).save(folder / "config.yaml")
    for part in ("policies", "checkpoints", "evaluation"):
        (folder / part).mkdir()
    (folder / "checkpoints" / "run_id").write_text("abc")
    lines = []
    for version, outcomes in versions.items():
        (folder / "policies" / f"{version:06d}.safetensors").touch()
        lines += [counted(version, 1000 + n, each, "abc") for n, each in enumerate(outcomes)]
    (folder / "evaluation" / "trials.jsonl").write_bytes(b"".join(lines))
    return folder


def as_json(capsys: pytest.CaptureFixture[str], *words: object) -> object:
    assert main([*map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_runs_are_listed_with_their_best_version(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "one", {1: [], 2: [PRECISE, PRECISE], 3: [PRECISE, NOT_LIFTED]})
    make_run(tmp_path / "none", {})
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.yaml").write_text("learner: {ratee: 1}")
    listed = as_json(capsys, "runs", tmp_path)
    assert isinstance(listed, list)
    found = {each["run"]: each for each in listed}
    assert found.keys() == {"one", "none"}
    one = found["one"]
    assert (one["newest_version"], one["best_version"], one["trials"]) == (3, 2, 2)
    assert one["precise"]["successes"] == 2
    assert found["none"]["best_version"] is None
    assert main(["runs", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert "one" in printed.out
    assert "broken is left out" in printed.err
    assert main(["runs", str(tmp_path / "one")]) == 2


def test_rollouts_are_found_by_their_outcome(
    tmp_path: Path, make_episode: MakeEpisode, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run" / "rollouts"
    for name, version, outcome, started_s in (
        ("z", 1, NOT_LIFTED, 10.0),
        ("y", 2, PRECISE, 30.0),
        ("x", 2, IMPRECISE, 20.0),
    ):
        episode = make_episode(
            2, id=name, kind=Kind.TRIAL, policy="network", policy_version=version,
            outcome=outcome, started_s=started_s,
        )  # fmt: skip
        write_episode(folder / f"{name}.mcap", episode)
    (folder / "broken.mcap").write_bytes(b"no recording")

    def found(*options: str) -> list[str]:
        listed = as_json(capsys, "rollouts", tmp_path / "run", *options)
        assert isinstance(listed, list)
        return [each["id"] for each in listed]

    assert found() == ["z", "x", "y"], "in the order in which they were played"
    assert found("--failed") == ["z", "x"]
    assert found("--reason", "not_lifted") == found("--reason", "not lifted") == ["z"]
    assert found("--policy-version", "2") == ["x", "y"]
    assert main(["rollouts", str(tmp_path / "run"), "--failed"]) == 0
    printed = capsys.readouterr()
    assert "not lifted" in printed.out
    assert "object_y_m 0.25" in " ".join(printed.out.split())
    assert "broken.mcap" in printed.err
    assert main(["rollouts", str(tmp_path / "run"), "--reason", "not_lifed"]) == 0
    printed = capsys.readouterr()
    assert (printed.out, "no recording fits; there are: " in printed.err) == ("", True)
    assert "not lifted 1" in printed.err
    assert main(["rollouts", str(tmp_path)]) == 2
    assert "holds no recording" in capsys.readouterr().err
    assert main(["rollouts", str(tmp_path / "rum")]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_two_runs_are_compared_in_configuration_and_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = make_run(tmp_path / "a", {1: [NOT_LIFTED] * 6, 2: [PRECISE] * 6})
    second = make_run(tmp_path / "b", {1: [NOT_LIFTED] * 6 + [PRECISE]}, "network.pfc.tau=30")
    compared = as_json(capsys, "compare-runs", first, second)
    assert isinstance(compared, dict)
    assert compared["config"] == [{"key": "network.pfc.tau", "first": 150.0, "second": 30.0}]
    assert compared["versions"] == [2, 1]
    assert compared["paired"]["trials"] == 6
    assert compared["paired"]["strict"]["only_first"] == 6
    assert compared["paired"]["strict"]["mcnemar_p"] == pytest.approx(2 * 0.5**6)
    assert main(["compare-runs", str(first), str(second)]) == 0
    printed = capsys.readouterr().out
    assert "network.pfc.tau" in printed
    assert "6 / 0" in printed
    assert max(map(len, printed.splitlines())) <= 80
    assert printed.count("100.0 (61.0 to 100.0)") == 3, "not broken into two lines"


def test_runs_are_compared_in_the_suite_that_was_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = make_run(tmp_path / "a", {1: [PRECISE] * 3})
    second = make_run(tmp_path / "b", {1: [PRECISE] * 3})
    words = ("compare-runs", first, second, "--policy-version", "newest", "--suite", "beyond")
    compared = as_json(capsys, *words)
    assert isinstance(compared, dict)
    assert [each["trials"] for each in compared["success"]] == [0, 0]
    assert compared["paired"] is None
    assert main([*map(str, words)]) == 0
    assert "alone" not in capsys.readouterr().out
    assert main(["compare-runs", str(first), str(second), "--suite", "beyond"]) == 2
    assert "no trial of suite beyond was counted" in capsys.readouterr().err


@pytest.fixture
def trained(checkpoint: Path, tmp_path: Path) -> Path:
    """The folder of a training, in which the first of two trials was counted."""
    folder = tmp_path / "run"
    shutil.copytree(checkpoint.parents[1], folder)
    config = load_config(folder / "config.yaml", ["evaluator.trials_per_policy=2"])
    config.save(folder / "config.yaml")
    (folder / "evaluation").mkdir()
    line = counted(1, 1000, PRECISE, config.run.name)
    (folder / "evaluation" / "trials.jsonl").write_bytes(line)
    return folder


def test_missing_trials_of_a_run_are_played_and_counted(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("evaluate", "--run", trained, "--workers", "1", "--policy-version")
    result = as_json(capsys, *words, "all")
    assert isinstance(result, dict)
    assert [(each["version"], each["trials"]) for each in result["versions"]] == [(1, 2)]
    assert result["versions"][0]["precise"]["successes"] >= 1
    log = (trained / "evaluation" / "trials.jsonl").read_bytes()
    assert as_json(capsys, *words, "best") == result, "nothing is played again"
    assert (trained / "evaluation" / "trials.jsonl").read_bytes() == log


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--policy-version 7", "has the versions 1 to 1"),
        ("--seed 3", "--seed goes with --policy"),
        ("--suite nothing", "there is no suite"),
    ],
)
def test_bad_input_about_a_run(
    trained: Path, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    assert main(["evaluate", "--run", str(trained), *words.split()]) == 2
    assert said in capsys.readouterr().err


def test_a_run_whose_evaluator_is_at_work_is_left_alone(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with single_process(trained, Role.EVALUATOR, None):
        assert main(["evaluate", "--run", str(trained)]) == 2
    assert "is at work; stop the run" in capsys.readouterr().err


def test_ctrl_c_prints_what_was_counted_so_far(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    played = evaluate.play_all

    def interrupted(config: Config, policy: str, jobs: list[object], **more: int) -> object:
        yield next(played(config, policy, jobs, **more))  # type: ignore[call-overload, arg-type]
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "play_all", interrupted)
    outcomes = tmp_path / "outcomes.jsonl"
    words = f"evaluate --policy tutor --trials 3 --workers 1 --outcomes {outcomes}"
    assert main(words.split()) == 130
    printed = capsys.readouterr()
    assert "stopped after 1 of 3 trials" in printed.err
    assert "1 of 1" in printed.out
    assert len(outcomes.read_text().splitlines()) == 1
