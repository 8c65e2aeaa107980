"""Episodes go out in formats of others and come back; what does not fit is refused."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from numbers_reader import read_numbers

from learner.training.interpolation import NeighbourGrid
from proto.body import ACTION_NAMES, ACTION_VALUES
from proto.episode import UNKNOWN_OUTCOME, Episode
from proto.errors import UserError
from proto.recordings.episodes import read_episode, write_episode
from services.cli import main
from services.exchange import contained as contained_module
from services.exchange.contained import contained
from services.exchange.joint_map import read_joint_map

MakeEpisode = Callable[..., Episode]
MIDDLES = np.array([(value.minimum + value.maximum) / 2 for value in ACTION_VALUES], np.float32)
FEATURES = {
    "observation.state",
    "action",
    "next.done",
    "next.success",
    "timestamp",
    "frame_index",
    "episode_index",
    "index",
    "task_index",
}


@pytest.fixture
def episodes(make_episode: MakeEpisode, tmp_path: Path) -> list[Episode]:
    """Three episodes of different lengths and situations, recorded in the folder `recorded`."""
    made = []
    for number, steps in enumerate((6, 9, 4)):
        random = np.random.default_rng(number)
        targets = MIDDLES + random.uniform(-5, 5, (steps, 11)).astype(np.float32) * 0.2
        images = np.full((steps, 48, 64), 40, dtype=np.uint8)
        images += (np.arange(steps) * 20).astype(np.uint8)[:, None, None]
        images[:, :10] = 200
        episode = make_episode(
            steps,
            id=f"{number:032x}",
            images=images,
            actions=targets,
            targets=targets,
            situation={"obstacle_x_m": -0.25 - number / 4},
        )
        write_episode(tmp_path / "recorded" / f"{number}.mcap", episode)
        made.append(episode)
    return made


def export(tmp_path: Path, form: str, *options: str) -> Path:
    out = tmp_path / form
    words = ["export", str(tmp_path / "recorded"), "--format", form, "--out", str(out), *options]
    assert main(words) == 0
    return out


def imported(tmp_path: Path, form: str, folder: Path, *options: str) -> list[Episode]:
    out = tmp_path / "imported"
    words = ["import", str(folder), "--format", form, "--task", "experiment1", "--out", str(out)]
    assert main([*words, *options]) == 0
    return [read_episode(path) for path in sorted(out.glob("*.mcap"))]


def assert_same_sequences(
    back: list[Episode], episodes: list[Episode], levels: float = 0.0
) -> None:
    """Each sequence came back, with pictures that differ by a few grey levels at most."""
    by_steps = {episode.steps: episode for episode in back}
    assert sorted(by_steps) == sorted(episode.steps for episode in episodes)
    for episode in episodes:
        again = by_steps[episode.steps]
        assert np.abs(again.targets - episode.targets).max() < 1e-4
        assert np.abs(again.images.astype(int) - episode.images).max() <= levels
        assert (again.situation, again.outcome) == ({}, UNKNOWN_OUTCOME)
        assert again.control_period_s == pytest.approx(0.1)


def test_npz_holds_every_array(episodes: list[Episode], tmp_path: Path) -> None:
    out = export(tmp_path, "npz")
    assert len(list(out.iterdir())) == len(episodes)
    with np.load(out / f"{episodes[1].id}.npz", allow_pickle=False) as arrays:
        for name in ("images", "actions", "targets", "joints_deg", "phases", "body_poses"):
            assert np.array_equal(arrays[name], getattr(episodes[1], name)), name
        assert arrays["action_names"].tolist() == list(ACTION_NAMES)
        about = json.loads(str(arrays["about"]))
    assert about["situation"] == {"obstacle_x_m": -0.5}
    assert about["outcome"]["reason"] == "imprecise"


@pytest.mark.parametrize("options", [[], ["--h264"]], ids=["images", "videos"])
def test_a_lerobot_dataset_has_every_required_field(
    episodes: list[Episode], tmp_path: Path, options: list[str]
) -> None:
    out = export(tmp_path, "lerobot", *options)
    info = json.loads((out / "meta" / "info.json").read_text())
    frames = sum(episode.steps for episode in episodes)
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 10, "icub")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, frames, 1)
    assert info["splits"] == {"train": "0:3"}
    assert (info["chunks_size"], info["data_files_size_in_mb"]) == (1000, 100)
    assert info["video_files_size_in_mb"] == 200
    picture = info["features"]["observation.images.eye"]
    assert picture["shape"] == [48, 64, 3]
    assert picture["dtype"] == ("video" if options else "image")
    assert set(info["features"]) == FEATURES | {"observation.images.eye"}
    for name, shape in {"observation.state": [18], "action": [11], "index": [1]}.items():
        assert info["features"][name]["shape"] == shape

    file = pq.ParquetFile(out / info["data_path"].format(chunk_index=0, file_index=0))
    assert file.num_row_groups == 3
    assert file.metadata.row_group(0).column(0).compression == "SNAPPY"
    rows = file.read().to_pylist()
    assert [row["index"] for row in rows] == list(range(frames))
    assert [row["episode_index"] for row in rows] == [0] * 6 + [1] * 9 + [2] * 4
    assert [row["timestamp"] for row in rows[6:15]] == pytest.approx(np.arange(9) / 10)
    assert [row["next.done"] for row in rows[:6]] == [False] * 5 + [True]
    assert np.array_equal(np.float32([row["action"] for row in rows[6:15]]), episodes[1].targets)
    if not options:
        content = np.frombuffer(rows[3]["observation.images.eye"]["bytes"], np.uint8)
        picture = cv2.imdecode(content, cv2.IMREAD_COLOR)
        assert np.array_equal(picture[..., 1], episodes[0].images[3])
        known = json.loads(file.schema_arrow.metadata[b"huggingface"])["info"]["features"]
        assert known["observation.images.eye"] == {"_type": "Image"}

    tasks = pq.read_table(out / "meta" / "tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "experiment1"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    listed = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in listed] == [6, 9, 4]
    assert [row["dataset_from_index"] for row in listed] == [0, 6, 15]
    assert [row["dataset_to_index"] for row in listed] == [6, 15, 19]
    assert listed[2]["tasks"] == ["experiment1"]
    assert listed[1]["data/file_index"] == listed[1]["meta/episodes/chunk_index"] == 0
    assert_statistics(out, listed, episodes)
    if options:
        assert [row["videos/observation.images.eye/from_timestamp"] for row in listed] == (
            pytest.approx([0.0, 0.6, 1.5])
        )
        path = info["video_path"].format(
            video_key="observation.images.eye", chunk_index=0, file_index=0
        )
        with av.open(str(out / path)) as container:
            assert container.streams.video[0].codec_context.name == "h264"
            assert len(list(container.decode(video=0))) == frames
    else:
        assert info["video_path"] is None


def assert_statistics(out: Path, listed: list[dict[str, Any]], episodes: list[Episode]) -> None:
    whole = json.loads((out / "meta" / "stats.json").read_text())
    names = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}
    assert set(whole) == FEATURES | {"observation.images.eye"}
    assert all(set(statistics) == names for statistics in whole.values())
    everything = np.concatenate([episode.targets for episode in episodes])
    assert whole["action"]["mean"] == pytest.approx(everything.mean(0), rel=1e-4)
    assert whole["action"]["count"] == [len(everything)]
    images = episodes[0].images / 255
    first = {name: np.array(listed[0][f"stats/observation.images.eye/{name}"]) for name in names}
    assert first["mean"].shape == first["min"].shape == (3, 1, 1)
    assert first["mean"][0, 0, 0] == pytest.approx(images.mean())
    assert first["std"][0, 0, 0] == pytest.approx(images.std())
    assert first["q50"][1, 0, 0] == pytest.approx(np.quantile(images, 0.5), abs=1 / 255)


@pytest.mark.parametrize(("options", "levels"), [([], 0), (["--h264"], 6)])
def test_a_lerobot_dataset_comes_back(
    episodes: list[Episode], tmp_path: Path, options: list[str], levels: int
) -> None:
    out = export(tmp_path, "lerobot", *options)
    assert_same_sequences(imported(tmp_path, "lerobot", out), episodes, levels)
    if not options:
        assert len(imported(tmp_path, "lerobot", out)) == 3, "imported again, nothing is added"


def test_eipl_has_a_training_and_a_test_set(episodes: list[Episode], tmp_path: Path) -> None:
    out = export(tmp_path, "eipl")
    joints = {name: np.load(out / name / "joints.npy") for name in ("train", "test")}
    images = {name: np.load(out / name / "images.npy") for name in ("train", "test")}
    assert (images["train"].dtype, images["train"].shape) == (np.uint8, (2, 9, 48, 64, 3))
    assert (joints["test"].dtype, joints["test"].shape) == (np.float32, (1, 9, 11))
    bounds = np.load(out / "joint_bounds.npy")
    both = np.concatenate([joints["train"], joints["test"]])
    assert bounds.shape == (2, 11)
    assert (bounds[0] <= both.min((0, 1))).all()
    assert (bounds[1] >= both.max((0, 1))).all()
    assert (bounds[1] - bounds[0] >= 0.0099).all()
    assert np.array_equal(joints["train"][0, 5], joints["train"][0, 8]), "the last step repeats"
    assert_same_sequences(imported(tmp_path, "eipl", out), episodes)


def test_data_of_another_robot_are_mapped(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    angles = np.radians(np.linspace(20, 60, 24).reshape(2, 12, 1))
    joints = np.concatenate([angles, np.linspace(0, 1, 24).reshape(2, 12, 1)], axis=-1)
    pictures = np.zeros((2, 12, 60, 120, 3), dtype=np.uint8)
    pictures[..., 20:100, :] = 255  # what is left of a picture twice as wide as high
    (folder / "train").mkdir(parents=True)
    np.save(folder / "train" / "images.npy", pictures)
    np.save(folder / "train" / "joints.npy", joints)
    values: dict[str, Any] = dict(zip(ACTION_NAMES, MIDDLES.tolist(), strict=True))
    values |= {"r_elbow": "elbow", "grasp_level": {"from": "grip", "scale": 9.0, "offset": 1.0}}
    theirs = {"unit": "rad", "fps": 10, "names": ["elbow", "grip"], "joints": values}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(theirs))
    first, second = imported(tmp_path, "eipl", folder, "--joints", str(tmp_path / "map.yaml"))
    both = sorted((first, second), key=lambda episode: float(episode.targets[0, 5]))
    targets = np.concatenate([episode.targets for episode in both])
    assert targets[:, 5] == pytest.approx(np.linspace(20, 60, 24), abs=1e-4)
    assert targets[:, 9] == pytest.approx(np.linspace(1, 10, 24), abs=1e-4)
    assert targets[:, 10] == pytest.approx(MIDDLES[10])
    assert (first.images == 255).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"r_elbow": "shoulder"}, "there is no joint 'shoulder' for r_elbow; it has elbow"),
        ({"r_elbow": None}, "r_elbow"),
        ({"r_elbow": 500.0}, "r_elbow goes from 500 to 500, but the robot can do 15.5 to 106"),
        ({"left_knee": "elbow"}, "there is no left_knee"),
    ],
)
def test_joints_that_do_not_fit_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], message: str
) -> None:
    folder = tmp_path / "theirs"
    (folder / "test").mkdir(parents=True)
    np.save(folder / "test" / "images.npy", np.zeros((1, 3, 48, 64, 3), dtype=np.uint8))
    np.save(folder / "test" / "joints.npy", np.full((1, 3, 1), 30.0))
    values: dict[str, Any] = dict(zip(ACTION_NAMES, MIDDLES.tolist(), strict=True)) | change
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"names": ["elbow"], "joints": values}))
    words = ["import", str(folder), "--format", "eipl", "--task", "experiment1"]
    words += ["--joints", str(tmp_path / "map.yaml"), "--out", str(tmp_path / "imported")]
    assert main(words) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "imported").exists()


@pytest.mark.usefixtures("episodes")
def test_a_table_that_would_take_all_memory_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A text of 1 MiB stands in the file once and in 100,000 rows."""
    out = export(tmp_path, "lerobot")
    rows = 100_000
    texts = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), ["x" * 2**20])
    table = pa.table({"episode_index": np.zeros(rows, np.int64), "action": texts})
    file = out / "data" / "chunk-000" / "file-000.parquet"
    pq.write_table(table.replace_schema_metadata(None), file, store_schema=False)
    assert file.stat().st_size < 2**20
    words = ["import", str(out), "--format", "lerobot", "--task", "experiment1"]
    assert main([*words, "--out", str(tmp_path / "imported")]) == 2
    told = capsys.readouterr().err
    assert re.search(r"ArrowMemoryError|too much memory", told), told
    assert not (tmp_path / "imported").exists()


def test_what_reads_foreign_data_can_neither_end_nor_hold_up_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contained_module, "PATIENCE_S", 30.0)
    assert list(contained(read_numbers, tmp_path, 2)) == [1, 2]
    for last, told in ((3, "no third one"), (4, "the process that read it has ended")):
        read = contained(read_numbers, tmp_path, last)
        assert next(read) == 1
        with pytest.raises(UserError, match=told):
            next(read)
    monkeypatch.setattr(contained_module, "PATIENCE_S", 1.0)
    with pytest.raises(UserError, match="takes too long to read"):
        list(contained(read_numbers, tmp_path, 5))


@pytest.mark.usefixtures("episodes")
def test_what_is_no_data_set_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = export(tmp_path, "lerobot")
    to = ["--task", "experiment1", "--out", str(tmp_path / "imported")]
    assert main(["import", str(tmp_path / "recorded"), "--format", "lerobot", *to]) == 2
    assert "is no LeRobotDataset" in capsys.readouterr().err
    assert main(["import", str(tmp_path / "recorded"), "--format", "eipl", *to]) == 2
    assert "neither train/joints.npy nor test/joints.npy" in capsys.readouterr().err
    data = out / "data" / "chunk-000" / "file-000.parquet"
    data.write_bytes(data.read_bytes()[: len(data.read_bytes()) // 2])
    assert main(["import", str(out), "--format", "lerobot", *to]) == 2
    assert "is damaged or not complete" in capsys.readouterr().err
    info = out / "meta" / "info.json"
    info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
    assert main(["import", str(out), "--format", "lerobot", *to]) == 2
    assert "has version v2.1; this reads v3.0" in capsys.readouterr().err
    again = ["export", str(tmp_path / "recorded"), "--format", "lerobot", "--out", str(out)]
    assert main(again) == 2
    assert "holds a data set already" in capsys.readouterr().err
    assert main(["export", str(tmp_path), "--format", "npz", "--out", str(out)]) == 2
    assert "holds no recording" in capsys.readouterr().err
    assert not (tmp_path / "imported").exists()


def test_a_sequence_without_a_situation_is_never_mixed() -> None:
    grid = NeighbourGrid([{}, {}, {"x_m": 0.0}, {"x_m": 1.0}], [5, 5, 5, 5])
    generator = torch.Generator().manual_seed(1)
    mixtures = grid.mixtures(torch.tensor([0, 1, 2, 3] * 20), 1.0, generator)
    for number, members in enumerate(mixtures.members.tolist()):
        known = number % 4 >= 2
        assert set(members) == ({2, 3} if known else {number % 4})


@pytest.mark.usefixtures("episodes")
def test_a_network_learns_from_imported_sequences(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = export(tmp_path, "eipl")
    imported(tmp_path, "eipl", out)
    words = ["train", "--data", str(tmp_path / "imported"), "--out", str(tmp_path / "run")]
    words += ["--set", "learner.epochs=2", "--set", "learner.warmup_epochs=1"]
    capsys.readouterr()
    assert main(words) == 2
    assert "Set learner.pretraining.epochs=0" in capsys.readouterr().err
    assert main([*words, "--set", "learner.pretraining.epochs=0"]) == 0
    assert "trained on 3 sequences" in capsys.readouterr().out


def test_an_imported_sequence_has_no_scene_to_show(
    episodes: list[Episode], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "foreign.mcap"
    write_episode(path, replace(episodes[0], situation={}))
    assert main(["replay", str(path), "--out", str(tmp_path / "foreign.mp4")]) == 2
    assert "is not known, so there is no scene to show" in capsys.readouterr().err


def test_pickled_arrays_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = io.BytesIO()
    np.save(content, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    (tmp_path / "train").mkdir()
    for name in ("images.npy", "joints.npy"):
        (tmp_path / "train" / name).write_bytes(content.getvalue())
    words = ["import", str(tmp_path), "--format", "eipl", "--task", "experiment1"]
    assert main([*words, "--out", str(tmp_path / "imported")]) == 2
    assert "cannot be read as an array" in capsys.readouterr().err


def test_the_documented_joint_map_can_be_read(tmp_path: Path) -> None:
    document = (Path(__file__).parents[3] / "docs" / "exchange.md").read_text()
    (written,) = re.findall(r"```yaml\n(.*?)```", document, flags=re.DOTALL)
    (tmp_path / "map.yaml").write_text(written)
    joint_map = read_joint_map(tmp_path / "map.yaml")
    assert joint_map.names is not None
    values = np.radians(np.array([[-20.0, 50, 10, 30, 5, -10, 0, np.degrees(0.5)]]))
    targets = joint_map.targets(values, joint_map.names, "documented")
    expected = [-32.0, -23, -20, 50, 10, 60, 5, -10, 0, 5.5, 1]
    assert targets[0] == pytest.approx(expected, abs=1e-4)
