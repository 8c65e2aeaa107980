"""The activity of a network can be drawn for any rollout that its checkpoint played."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from learner.network_policy import NetworkPolicy
from proto.episode import Episode
from proto.errors import UserError
from proto.recordings.episodes import read_episode, write_episode
from services.cli import main
from services.figures.activity import SUBNETS, UNITS_SHOWN, difference_by_phase, draw
from services.figures.rollouts import Activity, activity_of

UNITS = {"mstnn_fast": 1188, "mstnn_slow": 336, "pfc": 20, "mtrnn_slow": 30, "mtrnn_fast": 50}


@pytest.fixture(scope="module")
def rollouts(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two rollouts of one network, the first with its states."""
    folder = tmp_path_factory.mktemp("rollouts")
    situation = "obstacle_x_m=-0.27,object_y_m=0.25,object_yaw_deg="
    evaluate = f"evaluate --policy {checkpoint} --workers 1"
    for name, words in (("with", "=44 --states"), ("without", "=-44")):
        command = f"{evaluate} --situation {situation[:-1]}{words} --out {folder / name}"
        assert main(command.split()) == 0
    return [folder / name / "trial0000.mcap" for name in ("with", "without")]


def test_one_command_draws_two_rollouts_and_prints_their_difference(
    rollouts: list[Path], checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "activity.png"
    files = " ".join(map(str, rollouts))
    command = f"figure activity --rollouts {files} --policy {checkpoint} --out {out} --json"
    assert main(command.split()) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    numbers = json.loads(capsys.readouterr().out)
    episode = read_episode(rollouts[0])
    assert {name: len(units) for name, units in numbers["units"].items()} == {
        "mstnn_fast": UNITS_SHOWN,
        "pfc": 20,
        "mtrnn_slow": 30,
        "mtrnn_fast": 50,
    }
    per_map = UNITS["mstnn_fast"] // 3
    maps = Counter(unit // per_map for unit in numbers["units"]["mstnn_fast"])
    assert maps == dict.fromkeys(range(3), UNITS_SHOWN // 3), "as many of each map"
    first = numbers["rollouts"][0]
    assert first["situation"]["object_yaw_deg"] == 44
    assert [episode.phases[start] for start in first["phase_starts"]] == list(range(8))
    assert first["phases"] == list(episode.phase_names)
    assert np.shape(first["activity"]["pfc"]) == (episode.steps, 20)
    assert {len(apart) for apart in numbers["difference_by_phase"].values()} == {8}


def test_recorded_states_equal_those_computed_from_the_pictures(
    rollouts: list[Path], checkpoint: Path
) -> None:
    episode = read_episode(rollouts[0])
    recorded = activity_of(episode, None, UNITS).states
    computed = activity_of(episode, NetworkPolicy.from_file(checkpoint), UNITS).states
    assert {name: activity.shape for name, activity in recorded.items()} == {
        name: (episode.steps, units) for name, units in UNITS.items()
    }
    assert all(np.array_equal(recorded[name], computed[name]) for name in UNITS)


def test_for_a_rollout_without_states_the_error_says_what_to_do(
    rollouts: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"figure activity --rollouts {rollouts[1]} --out {tmp_path / 'a.png'}"
    assert main(command.split()) == 2
    assert "vmdnn evaluate --states" in capsys.readouterr().err


def test_the_policy_of_another_rollout_is_refused(
    rollouts: list[Path], checkpoint: Path, tmp_path: Path
) -> None:
    episode = read_episode(rollouts[1])
    assert episode.outputs is not None
    foreign = replace(episode, outputs=episode.outputs[::-1].copy())
    write_episode(tmp_path / "foreign.mcap", foreign)
    with pytest.raises(UserError, match="not by this policy"):
        activity_of(
            read_episode(tmp_path / "foreign.mcap"), NetworkPolicy.from_file(checkpoint), UNITS
        )


def test_a_policy_without_states_and_a_file_name_other_than_png_are_refused(
    rollouts: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"figure activity --rollouts {rollouts[0]} --out {tmp_path / 'a.png'} --policy tutor"
    assert main(command.split()) == 2
    assert "--policy tutor has no states" in capsys.readouterr().err
    assert main(f"figure activity --rollouts {rollouts[0]} --out {tmp_path / 'a.pdf'}".split()) == 2
    assert "ends in .png" in capsys.readouterr().err


def test_the_difference_of_rollouts_is_computed_for_each_phase(
    make_episode: Callable[..., Episode],
) -> None:
    episode = make_episode(6, phases=np.array([1, 1, 2, 2, 3, 3], np.uint8))
    still = {name: np.zeros((6, 4), np.float32) for name in SUBNETS}
    moved = {name: np.zeros((6, 4), np.float32) for name in SUBNETS}
    moved["pfc"][2:4] = 0.5
    apart = difference_by_phase(Activity(episode, still), Activity(episode, moved))
    assert apart == {name: [0, 0.5 * (name == "pfc"), 0] for name in SUBNETS}


def test_columns_say_what_differs_and_subtasks_have_names(
    make_episode: Callable[..., Episode],
) -> None:
    """Discrete values, such as those of Experiment II, have their units too."""
    names = ("observe gesture", "wait", "lift")
    situation = {"indicated_x_m": "-0.15", "indicated_kind": "laying", "indicated_y_m": 0.25}
    phases = np.array([0, 0, 1, 1, 2, 2], np.uint8)
    episodes = [
        make_episode(6, phases=phases, phase_names=names, situation={**situation, **changed})
        for changed in ({}, {"indicated_x_m": "0.07", "indicated_y_m": 0.26})
    ]
    states = {name: np.zeros((6, 4), np.float32) for name in SUBNETS}
    figure = draw([Activity(episode, states) for episode in episodes])
    titles = [axes.get_title() for axes in figure.axes[:2]]
    assert titles == [
        "indicated X -0.15 m, indicated Y 0.25 m",
        "indicated X 0.07 m, indicated Y 0.26 m",
    ]
    assert figure.get_supxlabel() == "subtasks: (1) observe gesture, (2) wait, (3) lift"
