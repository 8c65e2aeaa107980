"""`vmdnn live` shows real steps of an actor to real WebSocket clients, as a recording would."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from ports import free_endpoint
from processes import PATIENCE_S, eventually, stop, vmdnn
from websockets.sync.client import ClientConnection, connect

from actors.actor import Assignment, live_message
from actors.player import LiveStep, play
from actors.policies.planned import make_tutor
from actors.simulator import make_simulator
from actors.tasks.registry import make_task
from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig, SimulatorConfig, TaskConfig
from proto.episode import Kind
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.messages import Live
from proto.periodic import every
from proto.recordings.schemas import Step
from services.monitoring.live_view import LiveView

RUN = "shown"
LAYOUT = Path(__file__).parents[3] / "docs" / "foxglove-layout.json"


@pytest.fixture(scope="module")
def lives() -> list[Live]:
    """What an actor publishes in the first steps of a demonstration, and in those of another."""
    task = make_task(TaskConfig())
    tutor = make_tutor(task)
    situation = task.tutored()[0]
    assignment = Assignment(Kind.TUTORING, task, tutor, situation, seed=0)
    told: list[Live] = []

    class EnoughError(Exception):
        pass

    def on_step(live: LiveStep) -> None:
        told.append(live_message("a-1", assignment, live))
        if live.step == 19:
            raise EnoughError

    simulator = make_simulator(SimulatorConfig(render=False))
    with pytest.raises(EnoughError):
        play(simulator, task, tutor, situation, seed=0, kind=Kind.TUTORING, on_step=on_step)
    simulator.close()
    random = np.random.default_rng(1)  # nothing was rendered
    pictures = random.integers(0, 256, (len(told), 48, 64), dtype=np.uint8)
    return [replace(live, image=picture) for live, picture in zip(told, pictures, strict=True)]


@pytest.fixture
def hub() -> Iterator[HubConfig]:
    config = HubConfig(endpoint=free_endpoint())
    with open_hub(config, RUN, "hub"):
        yield config


@contextmanager
def acting(hub: HubConfig, lives: list[Live], name: str = "a-1") -> Iterator[Bus]:
    """An actor that publishes the steps over and over, as long as somebody listens."""
    steps = iter(range(10**9))
    with open_bus(hub, RUN, Role.ACTOR, name) as bus:
        bus.announce()
        key = bus.keys.live(name)

        def act() -> None:
            if bus.watched(key):
                bus.publish(key, replace(lives[next(steps) % len(lives)], actor=name), check=False)

        with every(0.02, act):
            yield bus


class Viewer:
    """A client of Foxglove's WebSocket protocol.

    Attributes:
        channels: advertised channels by topic.
        received: messages by topic.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._topics: dict[int, str] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.received: dict[str, list[bytes]] = {}

    def wait_for(self, ready: Callable[[], bool]) -> None:
        """Read until `ready` returns true."""
        while not ready():
            self._handle(self._connection.recv(timeout=PATIENCE_S))

    def wait_for_topics(self, *topics: str) -> None:
        self.wait_for(lambda: set(topics) <= self.channels.keys())

    def subscribe(self, *topics: str) -> None:
        self.wait_for_topics(*topics)
        subscriptions = []
        for topic in topics:
            number = len(self._topics)
            self._topics[number] = topic
            subscriptions.append({"id": number, "channelId": self.channels[topic]["id"]})
        self._connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def unsubscribe_all(self) -> None:
        numbers = list(self._topics)
        self._connection.send(json.dumps({"op": "unsubscribe", "subscriptionIds": numbers}))

    def count(self, topic: str) -> int:
        return len(self.received.get(topic, []))

    def _handle(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            code, number, _time_ns = struct.unpack_from("<BIQ", message)
            if code == 1:
                self.received.setdefault(self._topics[number], []).append(message[13:])
            return
        told = json.loads(message)
        if told["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in told["channels"]}
        elif told["op"] == "unadvertise":
            gone = set(told["channelIds"])
            self.channels = {t: c for t, c in self.channels.items() if c["id"] not in gone}


@dataclass(frozen=True)
class LiveServer:
    """A running `vmdnn live`: its process and its address."""

    process: Any
    address: str

    @contextmanager
    def viewer(self) -> Iterator[Viewer]:
        with connect(
            self.address,
            subprotocols=["foxglove.sdk.v1", "foxglove.websocket.v1"],  # type: ignore[list-item]
            max_size=None,
            compression=None,
        ) as connection:
            yield Viewer(connection)


@contextmanager
def serving(hub: HubConfig, *words: str) -> Iterator[LiveServer]:
    port = free_endpoint().rpartition(":")[2]
    address = f"ws://127.0.0.1:{port}"
    options = ("--connect", hub.endpoint, "--set", f"run.name={RUN}", "--port", port, *words)
    with vmdnn("live", *options) as process:
        server = LiveServer(process, address)

        def answers() -> bool:
            try:
                with server.viewer():
                    return True
            except OSError:
                return False

        eventually(answers, "the server answers")
        yield server


def topics_of_layout() -> set[str]:
    """Topics that the layout names."""
    named = set()
    for part in LAYOUT.read_text().split('"'):
        if part.startswith("/"):
            named.add(part.partition(".")[0])
    return named


def test_a_viewer_sees_what_a_recording_would_show(hub: HubConfig, lives: list[Live]) -> None:
    with (
        serving(hub) as server,
        acting(hub, lives) as bus,
        server.viewer() as viewer,
        server.viewer() as slow,
    ):
        key = bus.keys.live("a-1")
        viewer.wait_for_topics("/actors/a-1/events")
        assert topics_of_layout() <= viewer.channels.keys()
        assert not bus.watched(key), "an actor that nobody views publishes nothing"
        shown = (
            "/eye",
            "/eye/calibration",
            "/joints",
            "/tf",
            "/step",
            "/boxes",
            "/robot",
            "/events",
        )
        slow.subscribe(*shown)  # and reads nothing from now on
        viewer.subscribe(*shown, "/actors/a-1/tf", "/actors/a-1/robot")
        viewer.wait_for(
            lambda: viewer.count("/step") >= 50 and viewer.count("/actors/a-1/robot") > 0
        )
        got = viewer.received
        steps = [Step.FromString(data) for data in got["/step"]]
        assert len({step.step for step in steps}) >= len(lives) / 2
        for step, data in zip(steps, got["/eye"], strict=False):
            live = lives[step.step]
            png = np.frombuffer(CompressedImage.FromString(data).data, dtype=np.uint8)
            assert np.array_equal(cv2.imdecode(png, cv2.IMREAD_GRAYSCALE), live.image)
            assert step.phase_name == live.phase
            assert step.action.r_elbow_deg == live.action[5]
        _check_joints(got["/joints"], steps, lives)
        _check_scene(got, lives[0])
        camera = CameraCalibration.FromString(got["/eye/calibration"][0])
        assert (camera.K[0], camera.K[4]) == tuple(lives[steps[0].step].focal_px)
        events = [Log.FromString(data) for data in got["/events"]]
        assert "tutoring by tutor" in {event.message for event in events}
        assert lives[0].phase in {event.message for event in events}
        viewer.unsubscribe_all()
        slow.unsubscribe_all()
        eventually(lambda: not bus.watched(key), "the actor is not listened to any more")
        assert stop(server.process) == 0


def _check_joints(told: list[bytes], steps: list[Any], lives: list[Live]) -> None:
    """Angles are those of the steps, and velocities the differences of the steps shown."""
    states = [JointStates.FromString(data).joints for data in told]
    for before, now, was, joints in zip(steps, steps[1:], states, states[1:], strict=False):
        angles = [joint.position for joint in joints]
        assert np.allclose(np.degrees(angles), lives[now.step].joints_deg, atol=1e-4)
        if now.step > before.step:
            passed_s = 0.1 * (now.step - before.step)
            moved = [a.position - b.position for a, b in zip(joints, was, strict=True)]
            velocities = [joint.velocity for joint in joints]
            assert np.allclose(velocities, np.array(moved) / passed_s, atol=1e-4)


def _check_scene(got: dict[str, list[bytes]], live: Live) -> None:
    """Every mesh and box lies in a frame that is told, in the tree of its own world."""
    for prefix, folder in (("", ""), ("actors/a-1/", "/actors/a-1")):
        transforms = FrameTransforms.FromString(got[f"{folder}/tf"][0]).transforms
        parents = {each.child_frame_id: each.parent_frame_id for each in transforms}
        robot = SceneUpdate.FromString(got[f"{folder}/robot"][0])
        assert len(robot.entities) > 10
        for entity in robot.entities:
            assert parents[entity.frame_id] == f"{prefix}world"
        assert parents[f"{prefix}l_eye_optical"] == f"{prefix}l_eye"
    assert live.scene is not None
    boxes = SceneUpdate.FromString(got["/boxes"][0])
    assert {entity.id for entity in boxes.entities} == set(live.scene.boxes)
    assert len(boxes.deletions) == 1


def test_each_actor_has_its_topics_and_the_plain_ones_follow_one(
    hub: HubConfig, lives: list[Live]
) -> None:
    with (
        serving(hub, "--actor", "a-2") as server,
        acting(hub, lives, "a-1") as first,
        acting(hub, lives, "a-2") as second,
        server.viewer() as viewer,
    ):
        viewer.wait_for_topics("/actors/a-1/step", "/actors/a-2/step")
        viewer.subscribe("/step")
        viewer.wait_for(lambda: viewer.count("/step") > 3)
        assert second.watched(second.keys.live("a-2"))
        assert not first.watched(first.keys.live("a-1"))
        viewer.subscribe("/actors/a-1/step")
        viewer.wait_for(lambda: viewer.count("/actors/a-1/step") > 3)
        for message in (
            replace(lives[0], actor="another"),
            replace(lives[0], image=np.zeros((2, 2), np.uint8)),
            replace(lives[0], body_poses=np.full((1, 7), np.nan, np.float32)),
        ):
            second.publish(second.keys.live("a-2"), message, check=False)
        first.close()
        viewer.wait_for(lambda: "/actors/a-1/step" not in viewer.channels)
        seen = viewer.count("/step")
        viewer.wait_for(lambda: viewer.count("/step") > seen)


def test_a_port_in_use_is_bad_input(hub: HubConfig) -> None:
    with socket.socket() as other, open_bus(hub, RUN, Role.WATCH, "w") as bus:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=f"nothing can listen at 127.0.0.1:{port}"):
            LiveView(bus, period_s=0.1).serve(Lifecycle(), "127.0.0.1", port)
