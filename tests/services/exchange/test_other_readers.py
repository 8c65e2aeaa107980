"""Programs of others read what vmdnn writes: Rerun the recordings, Rerun and LeRobot the data sets.

Each program has an environment of its own, made at the first run of these tests.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from environments import environment

from proto.body import ACTION_NAMES, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.episode import Episode
from proto.recordings.episodes import read_episode
from proto.recordings.schemas import ACTION_FIELDS
from services.cli import main

HERE = Path(__file__).parent
RERUN = ("rerun-sdk==0.41.0",)
LEROBOT = ("lerobot-dataset==0.4.4",)
TORCHVISION = ("torchvision==0.23.0",)  # the last one that can read videos

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]  # the first run installs the programs


@pytest.fixture(scope="module")
def rerun(request: pytest.FixtureRequest) -> Path:
    """Python of an environment with Rerun."""
    return environment(request.config.cache, "rerun", RERUN)


@pytest.fixture(scope="module")
def lerobot(request: pytest.FixtureRequest) -> Path:
    """Python of an environment with LeRobot's reader, and the PyTorch of this environment."""
    ours = Path(torch.__file__).parents[1]
    cache = request.config.cache
    return environment(cache, "lerobot", LEROBOT, alone=TORCHVISION, see=[ours])


@pytest.fixture(scope="module")
def episodes(recordings: Path) -> dict[Path, Episode]:
    """The recorded episodes by file, in the order in which they are exported."""
    return {path: read_episode(path) for path in sorted(recordings.glob("*.mcap"))}


def run(*words: str | Path) -> str:
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def converted(
    rerun: Path, episodes: Mapping[Path, Episode], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Episode, dict[str, Any]]:
    """A tutored episode, and what Rerun's converter made of its recording."""
    path, episode = next(iter(episodes.items()))
    out = tmp_path_factory.mktemp("converted") / "episode.rrd"
    run(rerun.with_name("rerun"), "mcap", "convert", path, "-o", out)
    run(rerun.with_name("rerun"), "rrd", "verify", out)
    return episode, json.loads(run(rerun, HERE / "read_with_rerun.py", "recording", out))


def times_ns(episode: Episode, steps: int) -> list[int]:
    """Unix time of the first steps, as a recording has it."""
    assert episode.started_s is not None
    begin = round(episode.started_s * 1e9)
    return [begin + round(step * episode.control_period_s * 1e9) for step in range(steps)]


def one_each(rows: list[list[Any]]) -> list[Any]:
    """The values of rows that have one value each."""
    assert all(len(row) == 1 for row in rows)
    return [row[0] for row in rows]


def test_rerun_shows_what_the_eye_saw(converted: tuple[Episode, dict[str, Any]]) -> None:
    episode, entities = converted
    eye, camera = entities["/eye"], entities["/eye/calibration"]
    assert eye["message_log_time"] == eye["timestamp"] == times_ns(episode, episode.steps)
    assert set(one_each(eye["EncodedImage:media_type"])) == {"image/png"}
    pictures = [
        cv2.imdecode(np.array(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        for content in one_each(eye["EncodedImage:blob"])
    ]
    assert np.array_equal(pictures, episode.images)
    # the picture lies in the image plane of a camera that stands in the robot's eye
    planes = set(one_each(eye["CoordinateFrame:frame"]))
    assert planes == set(one_each(camera["Pinhole:child_frame"]))
    assert set(one_each(camera["Pinhole:parent_frame"])) == {"l_eye_optical"}
    assert one_each(camera["Pinhole:resolution"]) == [[IMAGE_WIDTH, IMAGE_HEIGHT]] * episode.steps
    matrices = np.array(one_each(camera["Pinhole:image_from_camera"])).reshape(-1, 3, 3)
    assert episode.view is not None
    assert matrices[:, [0, 1], [0, 1]] == pytest.approx(episode.view.focal_px, rel=1e-6)


def test_rerun_knows_where_everything_is(converted: tuple[Episode, dict[str, Any]]) -> None:
    episode, entities = converted
    tf = entities["/tf"]
    names = one_each(tf["Transform3D:child_frame"])
    parents = dict(zip(names, one_each(tf["Transform3D:parent_frame"]), strict=True))
    assert episode.view is not None
    assert set(parents) == {*episode.body_names, *episode.view.fixed_links, "l_eye_optical"}
    assert parents.pop("l_eye_optical") == "l_eye"
    assert "l_eye" in parents
    assert set(parents.values()) == {"world"}
    poses: dict[str, list[list[float]]] = {name: [] for name in names}
    places = one_each(tf["Transform3D:translation"])
    turns = one_each(tf["Transform3D:quaternion"])
    for name, place, (x, y, z, w) in zip(names, places, turns, strict=True):
        poses[name].append([*place, w, x, y, z])
    for number, name in enumerate(episode.body_names):
        assert np.allclose(poses[name], episode.body_poses[:, number], atol=1e-6), name
    for name, pose in episode.view.fixed_links.items():
        assert np.allclose(poses[name], pose, atol=1e-6), name


def test_rerun_tells_what_happened(converted: tuple[Episode, dict[str, Any]]) -> None:
    episode, entities = converted
    *phases, outcome = one_each(entities["/events"]["TextLog:text"])
    begun = np.flatnonzero(np.diff(episode.phases, prepend=255))
    assert phases == [episode.phase_names[episode.phases[step]] for step in begun]
    times = times_ns(episode, episode.steps + 1)
    assert entities["/events"]["timestamp"] == [*(times[step] for step in begun), times[-1]]
    assert outcome.startswith("lenient, strict, precise; ")
    (metadata,) = one_each(entities["/__mcap_metadata"]["episode"])
    about = {entry["first"]: entry["second"] for entry in metadata}
    assert (about["id"], about["policy"]) == (episode.id, "tutor")


def test_rerun_keeps_joints_steps_and_meshes(converted: tuple[Episode, dict[str, Any]]) -> None:
    episode, entities = converted
    states = one_each(entities["/joints"]["foxglove.JointStates:message"])
    assert [joint["name"] for joint in states[0]["joints"]] == list(JOINT_NAMES)
    angles = np.degrees([[joint["position"] for joint in each["joints"]] for each in states])
    assert angles == pytest.approx(episode.joints_deg, abs=1e-4)
    steps = one_each(entities["/step"]["vmdnn.Step:message"])
    actions = [[each["action"][name] for name in ACTION_FIELDS] for each in steps]
    assert np.allclose(actions, episode.actions)
    (boxes,) = one_each(entities["/boxes"]["foxglove.SceneUpdate:message"])
    assert episode.view is not None
    sizes = {
        each["id"]: tuple(each["cubes"][0]["size"][axis] for axis in "xyz")
        for each in boxes["entities"]
    }
    assert sizes == {name: box.size_m for name, box in episode.view.boxes.items()}
    (robot,) = one_each(entities["/robot"]["foxglove.SceneUpdate:message"])
    frames = {each["frame_id"] for each in robot["entities"]}
    assert {"head", "r_hand"} & frames
    assert frames <= {*episode.body_names, *episode.view.fixed_links}
    assert all(each["triangles"] for each in robot["entities"])


@pytest.fixture(scope="module", params=[(), ("--h264",)], ids=["images", "videos"])
def dataset(
    recordings: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Path:
    """The recorded episodes as a LeRobotDataset."""
    out = tmp_path_factory.mktemp("exported") / "dataset"
    words = ["export", str(recordings), "--format", "lerobot", "--out", str(out), *request.param]
    assert main(words) == 0
    return out


def test_rerun_reads_the_dataset(
    rerun: Path, dataset: Path, episodes: Mapping[Path, Episode]
) -> None:
    read = json.loads(run(rerun, HERE / "read_with_rerun.py", "dataset", dataset))
    assert len(read) == len(episodes)
    for entities, episode in zip(read, episodes.values(), strict=True):
        assert np.allclose(entities["/action"]["Scalars:scalars"], episode.targets)
        assert entities["/action"]["SeriesLines:names"] == [list(ACTION_FIELDS)]
        assert np.allclose(entities["/observation.state"]["Scalars:scalars"], episode.joints_deg)
        assert set(one_each(entities["/task"]["TextDocument:text"])) == {"experiment1"}
        eye = entities["/observation.images.eye"]
        if "VideoStream:sample" in eye:
            assert len(eye["VideoStream:sample"]) == episode.steps
            continue
        pictures = [
            cv2.imdecode(np.array(content, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
            for content in one_each(eye["EncodedImage:blob"])
        ]
        assert np.array_equal(pictures, episode.images)


def test_lerobot_reads_the_dataset(
    lerobot: Path, dataset: Path, episodes: Mapping[Path, Episode], tmp_path: Path
) -> None:
    run(lerobot, HERE / "read_with_lerobot.py", dataset, tmp_path / "read.npz")
    expected = list(episodes.values())
    lengths = [episode.steps for episode in expected]
    targets = np.concatenate([episode.targets for episode in expected])
    images = np.concatenate([episode.images for episode in expected])
    ends = np.cumsum(lengths) - 1
    with np.load(tmp_path / "read.npz", allow_pickle=False) as read:
        assert read["lengths"].tolist() == lengths
        assert set(read["tasks"]) == {"experiment1"}
        assert np.allclose(read["action_mean"], targets.mean(axis=0), atol=1e-4)
        # the action of each step and of the next; after the last of an episode there is none
        assert read["action"].shape == (len(targets), 2, len(ACTION_NAMES))
        assert np.allclose(read["action"][:, 0], targets)
        assert np.flatnonzero(read["action_is_pad"][:, 1]).tolist() == ends.tolist()
        assert np.flatnonzero(read["next.done"]).tolist() == ends.tolist()
        joints = np.concatenate([episode.joints_deg for episode in expected])
        assert np.allclose(read["observation.state"], joints)
        pictures = read["observation.images.eye"]
        assert pictures.shape == (len(targets), 3, IMAGE_HEIGHT, IMAGE_WIDTH)
        differences = np.abs(pictures * 255 - images[:, None])
        videos = (dataset / "videos").exists()
        assert differences.max() < (40 if videos else 0.01)
        assert differences.mean() < (2 if videos else 0.01)
