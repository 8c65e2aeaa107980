"""`vmdnn evaluate`: its output, and that every policy is tested in the same situations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.tasks.registry import make_task
from learner.network_policy import NetworkPolicy
from proto.config import Config, TaskConfig
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.recordings.episodes import read_episode
from proto.variables import parse_situation
from services.cli import main
from services.playing.workers import play_all
from services.trials.evaluation import trial_jobs
from services.trials.success import Tally, wilson95
from services.trials.trial_log import read_trials

TASK = make_task(TaskConfig())


def evaluate(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["evaluate", "--json", "--workers", "1", *words]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_the_json_has_the_documented_fields(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--policy", "replay", "--task", "experiment1", "--trials", "3", "--seed", "11"]
    result = evaluate(capsys, *words)
    assert result.keys() == {
        *("policy", "task", "backend", "trials", "strict", "lenient", "precise", "reasons"),
        "wall_s",
    }
    assert (result["policy"], result["task"], result["backend"], result["trials"]) == (
        *("replay", "experiment1", "sapien", 3),
    )
    for reading in ("strict", "lenient", "precise"):
        assert result[reading].keys() == {"successes", "rate", "wilson95"}
        assert result[reading]["rate"] == pytest.approx(result[reading]["successes"] / 3)
        assert result[reading]["wilson95"] == list(wilson95(result[reading]["successes"], 3))
    assert sum(result["reasons"].values()) == 3 - result["precise"]["successes"]
    again = evaluate(capsys, *words)
    assert result | {"wall_s": None} == again | {"wall_s": None}


def test_without_json_it_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--policy", "tutor", "--trials", "1", "--workers", "1"]) == 0
    printed = capsys.readouterr()
    assert "precise" in printed.out
    assert "1 of 1" in printed.out
    assert "evaluating tutor" in printed.err


def test_a_suite_is_played_without_the_bus(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    outcomes = tmp_path / "o.jsonl"
    words = f"--policy tutor --suite pushed --trials 2 --outcomes {outcomes}".split()
    result = evaluate(capsys, *words)
    assert (result["suite"], result["trials"], result["precise"]["successes"]) == ("pushed", 2, 2)
    suite = Config().suite("pushed")
    trials = read_trials(outcomes)
    assert [trial.seed for trial in trials] == list(suite.test_seeds[:2])
    assert [trial.conditions for trial in trials] == [
        suite.conditions(seed) for seed in suite.test_seeds[:2]
    ]


def test_a_suite_of_the_configuration_has_its_own_trials(
    capsys: pytest.CaptureFixture[str],
) -> None:
    suites = "evaluator.suites=[{name: far, trials: 1, seed: 7, stretch: 1.1}]"
    result = evaluate(capsys, "--policy", "replay", "--suite", "far", "--set", suites)
    assert (result["suite"], result["trials"]) == ("far", 1)


def test_an_unknown_suite_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--policy", "tutor", "--suite", "pusht"]) == 2
    assert "there is no suite 'pusht'; there are: unlearned, beyond" in capsys.readouterr().err


def test_rollouts_are_recorded_in_the_situations_of_the_seed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    result = evaluate(capsys, *f"--policy lookup --trials 2 --seed 40 --out {tmp_path}".split())
    kept = [read_episode(tmp_path / f"trial{trial:04d}.mcap") for trial in range(2)]
    assert [episode.situation for episode in kept] == [TASK.sample(40 + i) for i in (0, 1)]
    assert {(episode.kind, episode.policy) for episode in kept} == {(Kind.TRIAL, "lookup")}
    assert sum(episode.outcome.strict for episode in kept) == result["strict"]["successes"]
    assert kept[0].images.any(), "what is kept is seen, even if the policy does not look"


def test_rendering_and_workers_do_not_change_episodes(tmp_path: Path) -> None:
    """Physics alone, with pictures, and in two processes: the same episodes."""
    config = Config()
    blind = by_seed(config, workers=1)
    shared = by_seed(config, workers=2)
    seen = by_seed(config, workers=1, folder=tmp_path)
    assert blind.keys() == shared.keys() == seen.keys() == {7, 8}
    for seed, episode in blind.items():
        assert not episode.images.any()
        for other in (shared[seed], seen[seed]):
            assert np.array_equal(other.joints_deg, episode.joints_deg)
            assert np.array_equal(other.body_poses, episode.body_poses)
            assert other.outcome == episode.outcome


def test_given_situations_are_played_and_their_states_kept(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    situation = "obstacle_x_m=-0.27,object_y_m=0.25,object_yaw_deg=44"
    words = f"--policy {checkpoint} --situation {situation} --seed 7 --states --out {tmp_path}"
    assert evaluate(capsys, *words.split())["trials"] == 1
    episode = read_episode(tmp_path / "trial0000.mcap")
    assert episode.situation == parse_situation(situation, TASK.variables, TASK.name)
    assert episode.seed == 7
    assert episode.states is not None
    units = {name: activity.shape for name, activity in episode.states.items()}
    assert units == {
        "mstnn_fast": (episode.steps, 3 * 18 * 22),
        "mstnn_slow": (episode.steps, 6 * 7 * 8),
        "pfc": (episode.steps, 20),
        "mtrnn_slow": (episode.steps, 30),
        "mtrnn_fast": (episode.steps, 50),
    }
    again = NetworkPolicy.from_file(checkpoint).states(episode.images)
    assert all(np.array_equal(again[name], episode.states[name]) for name in units)


def test_outcomes_can_be_saved_without_rollouts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "outcomes.jsonl"
    result = evaluate(capsys, *f"--policy replay --trials 3 --seed 9 --outcomes {path}".split())
    trials = read_trials(path)
    assert [trial.situation for trial in trials] == [TASK.sample(9 + i) for i in range(3)]
    assert [trial.seed for trial in trials] == [9, 10, 11]
    assert {trial.run_id for trial in trials} == {"replay"}
    kept = Tally.of(trial.outcome for trial in trials).as_json()
    assert all(result[name] == value for name, value in kept.items())


def by_seed(config: Config, workers: int, folder: Path | None = None) -> dict[int, Episode]:
    played = play_all(config, "yaw-blind", trial_jobs(config, 2, 7, folder), workers=workers)
    return {job.seed: episode for job, episode in played}


@pytest.mark.parametrize("workers", [1, 2])
def test_an_unknown_policy_is_named(workers: int) -> None:
    config = Config()
    with pytest.raises(UserError, match="no such policy"):
        list(play_all(config, "missing.safetensors", trial_jobs(config, 2, 1), workers=workers))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--policy nobody --trials 1", "no such policy"),
        ("--policy pretraned:experiment1", "Did you mean pretrained:experiment1?"),
        ("--policy tutor --backend nothing", "simulator.backend: there is no 'nothing'"),
        ("--policy tutor --task experiment9", "task.name"),
        ("--policy tutor --set tutor.speed=3", "tutor.speed"),
        ("--policy tutor --situation object_y_m", "write NAME=VALUE"),
        ("--policy tutor --situation object_y_m=0.2", "a situation has"),
        ("--policy tutor --states", "--out"),
        ("--policy tutor --trials 1 --states --out /nowhere", "'tutor' has no states"),
    ],
)
def test_bad_input_says_what_to_do(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--workers", "1", *words.split()]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert not printed.out
