"""Trajectories of a subnet: how they branch can be read from the figure and its numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from proto.episode import Episode
from proto.errors import UserError
from proto.recordings.episodes import write_episode
from services.cli import main
from services.figures.rollouts import Activity
from services.figures.trajectories import Components, Trajectories, draw, table

UNITS = 20
PHASES = ("observe gesture", "attend object", "approach", "lift")
SIDES, KINDS = ("-0.15", "0.07"), ("standing", "laying")

MakeEpisode = Callable[..., Episode]


def pfc_states(side: int, kind: int) -> np.ndarray:
    """States (40, 20) that part by side from step 10 on, and by kind from step 20 on."""
    steps = np.arange(40.0)
    states = np.zeros((40, UNITS), np.float32)
    states[:, 11] = steps / 50
    states[:, 4] = side * np.maximum(steps - 10, 0) / 10
    states[:, 7] = kind * np.maximum(steps - 20, 0) / 20
    return states


@pytest.fixture
def rollouts(make_episode: MakeEpisode) -> list[Activity]:
    """The four cases of the paper's figure 7."""
    found = []
    for (side, place), (kind, kind_name) in product(enumerate(SIDES), enumerate(KINDS)):
        episode = make_episode(
            40,
            id=f"{side}{kind}",
            task="experiment2",
            situation={"indicated_x_m": place, "indicated_kind": kind_name, "other_y_m": 0.25},
            phase_names=PHASES,
            phases=np.repeat(np.arange(4, dtype=np.uint8), 10),
            states={"pfc": pfc_states(side, kind), "mtrnn_slow": pfc_states(1, 1)[:, ::-1].copy()},
        )
        assert episode.states is not None
        found.append(Activity(episode, episode.states))
    return found


@pytest.fixture
def files(rollouts: Sequence[Activity], tmp_path: Path) -> str:
    """The same rollouts on disk, as words of a command."""
    paths = [tmp_path / f"{number}.mcap" for number in range(len(rollouts))]
    for path, rollout in zip(paths, rollouts, strict=True):
        write_episode(path, rollout.episode)
    return " ".join(map(str, paths))


def numbers_of(command: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main(command.split()) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_one_command_draws_them_and_says_when_they_part(
    files: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "trajectories.png"
    found = numbers_of(f"figure trajectories --rollouts {files} --out {out} --json", capsys)
    assert out.read_bytes().startswith(b"\x89PNG")
    assert (found["subnet"], found["units"]) == ("pfc", [4, 7])
    assert found["phases"] == list(PHASES)
    assert found["phase_starts"] == [0, 10, 20, 30]
    assert found["rollouts"][1]["label"] == "indicated X -0.15 m, indicated kind laying"
    assert np.shape(found["rollouts"][0]["components"]) == (40, 2)
    assert np.shape(found["rollouts"][0]["units"]) == (40, 2)
    first, second = found["explained_variance"]
    assert 0.5 < second + first <= 1.0
    assert first > second

    by_pair = {tuple(each["rollouts"]): each for each in found["distances"]}
    assert len(by_pair) == 6
    sides, kinds, both = by_pair[0, 2], by_pair[0, 1], by_pair[0, 3]
    assert sides["differ_in"] == ["indicated_x_m"]
    assert kinds["differ_in"] == ["indicated_kind"]
    assert both["differ_in"] == ["indicated_x_m", "indicated_kind"]
    assert sides["mean_by_phase"] == pytest.approx([0, 0.45, 1.45, 2.45])
    assert kinds["mean_by_phase"] == pytest.approx([0, 0, 0.225, 0.725])


def test_units_and_subnet_can_be_chosen(
    files: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"figure trajectories --rollouts {files} --out {tmp_path / 'a.png'} --json"
    found = numbers_of(f"{command} --units 7 3", capsys)
    assert found["units"] == [7, 3]
    assert found["rollouts"][1]["units"][-1] == pytest.approx([0.95, 0])
    assert numbers_of(f"{command} --subnet mtrnn_slow", capsys)["units"] == [15, 12]
    assert main(f"{command} --subnet mtrnn_fast".split()) == 2
    assert "has no states of mtrnn_fast" in capsys.readouterr().err


@pytest.mark.parametrize("units", [(3, 3), (0, 20)])
def test_units_that_cannot_be_shown_are_named(
    rollouts: Sequence[Activity], units: tuple[int, int]
) -> None:
    with pytest.raises(UserError, match="which has the units 0 to 19"):
        Trajectories.of(rollouts, "pfc", units)


def test_rollouts_with_other_phases_are_refused(
    rollouts: Sequence[Activity], make_episode: MakeEpisode
) -> None:
    shorter = make_episode(30, states={"pfc": np.zeros((30, UNITS), np.float32)})
    assert shorter.states is not None
    with pytest.raises(UserError, match="different phases"):
        Trajectories.of([*rollouts, Activity(shorter, shorter.states)], "pfc")


def test_the_plane_of_the_main_components_keeps_distances_of_flat_states() -> None:
    random = np.random.default_rng(3)
    directions, _ = np.linalg.qr(random.normal(size=(UNITS, 2)))
    points = random.normal(size=(50, 2)) * (3.0, 1.0)
    components = Components.of(points @ directions.T + 0.5)
    projected = components.project(points @ directions.T + 0.5)
    assert components.explained.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(projected, axis=0), axis=1),
        np.linalg.norm(np.diff(points, axis=0), axis=1),
    )
    assert projected[:, 0].var() > projected[:, 1].var()


def test_states_that_never_change_are_drawn(make_episode: MakeEpisode) -> None:
    still = make_episode(states={"pfc": np.ones((40, UNITS), np.float32)})
    assert still.states is not None
    found = Trajectories.of([Activity(still, still.states)], "pfc")
    assert found.components.explained.tolist() == [0, 0]
    assert found.distances() == []
    draw(found)


def test_each_subtask_has_its_number_where_the_trajectories_are_apart(
    rollouts: Sequence[Activity],
) -> None:
    """Where they lie on each other, the number is drawn once."""
    components = draw(Trajectories.of(rollouts, "pfc")).axes[0]
    shown = [text.get_text() for text in components.texts]
    assert [shown.count(number) for number in "1234"] == [1, 1, 2, 4]
    assert [len(line.get_xdata()) for line in components.lines] == [40] * 4


def test_the_table_has_a_row_for_each_way_to_differ(rollouts: Sequence[Activity]) -> None:
    found = table(Trajectories.of(rollouts, "pfc"))
    words = [str(cell) for cell in found.columns[0].cells]
    assert words == ["indicated kind", "indicated X", "indicated X, indicated kind"]
    assert [str(cell) for cell in found.columns[1].cells] == ["2", "2", "2"]
