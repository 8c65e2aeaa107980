"""Shows in Foxglove what actors do, as they do it: a WebSocket server beside the bus.

The topics are those of a recording (`proto.recordings.episodes`). Those of an actor lie under
`/actors/<id>`, and so do its frames. Topics and frames with the plain names of a recording show
one actor, so that the layout for recordings fits.

An actor is listened to only while somebody views it, and each viewer has a queue of its own that
drops what it does not take: slow viewers slow nobody.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from foxglove import Channel, Context, Schema, start_server
from foxglove.websocket import ChannelView, Client, ServerListener
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

from proto.bus import Bus
from proto.episode import UNKNOWN_OUTCOME, Episode, View
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.messages import Live, LiveScene
from proto.recordings import viewing
from proto.recordings.episodes import (
    BOXES,
    EVENTS,
    ROBOT,
    SCHEMAS,
    STATES,
    STEP,
    StepMessages,
)
from proto.recordings.schemas import ACTION_FIELDS, Message, SceneUpdate, Step, describe
from services.robot_meshes import robot_meshes

LOG = logging.getLogger(__name__)

MOST_ACTORS: Final = 32
"""So many actors have topics of their own; the others are not shown."""
SHOWN_PER_S: Final = 30.0
"""Control steps of an actor that are shown in a second; steps between them are left out."""
_STEPS_WAITING: Final = 128
_LOOK_EVERY_S: Final = 0.2
_DELETE_ALL: Final = SceneEntityDeletion.ALL
_TOPICS: Final = tuple(topic for topic in SCHEMAS if topic != STATES)


class _Viewers(ServerListener):
    """Who views which topic; the server's threads tell it.

    Attributes:
        arrivals: topics that somebody has begun to view, without what was sent there before.
    """

    def __init__(self) -> None:
        self.arrivals: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._viewers: dict[str, set[int]] = {}

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Note that a client views a topic."""
        with self._lock:
            self._viewers.setdefault(channel.topic, set()).add(client.id)
        self.arrivals.put(channel.topic)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Note that a client does not view a topic any more."""
        with self._lock:
            viewers = self._viewers.get(channel.topic, set())
            viewers.discard(client.id)
            if not viewers:
                self._viewers.pop(channel.topic, None)

    def forget(self, topics: Mapping[str, str]) -> None:
        """Forget who viewed topics (the values) that are withdrawn."""
        with self._lock:
            for topic in topics.values():
                self._viewers.pop(topic, None)

    def views_any(self, topics: Mapping[str, str]) -> bool:
        """Whether anybody views one of the topics (the values)."""
        with self._lock:
            return any(self._viewers.get(topic) for topic in topics.values())


class _Stage:
    """The topics on which one actor is shown.

    Attributes:
        topics: name of each topic by its name in a recording.
    """

    def __init__(self, context: Context, name: str, period_s: float) -> None:
        """Open the topics.

        Args:
            context: of the server.
            name: such as `actors/a-1`; empty for the plain names of a recording.
            period_s: control period of the actor (s).
        """
        self.topics = {topic: f"/{name}{topic}" if name else topic for topic in _TOPICS}
        self._prefix = f"{name}/" if name else ""
        self._period_s = period_s
        self._channels = {
            topic: Channel(
                shown, schema=_schema(topic), message_encoding="protobuf", context=context
            )
            for topic, shown in self.topics.items()
        }
        self._before: Live | None = None
        self._scene: LiveScene | None = None

    def close(self) -> None:
        """Withdraw the topics."""
        for channel in self._channels.values():
            channel.close()

    def show(self, live: Live, time_ns: int) -> None:
        """Show a control step.

        Args:
            live: the step.
            time_ns: when it was played, Unix time (ns).
        """
        before, self._before = self._before, live
        if live.scene is not None:
            known, self._scene = self._scene, live.scene
            if known is None or known.boxes != live.scene.boxes:
                self._send_boxes(time_ns)
        scene = self._scene
        if scene is None or len(scene.body_names) != len(live.body_poses):
            return  # it comes soon
        if before is None or live.step <= before.step:
            before = live
            event = viewing.episode_event(live.kind, live.policy, live.policy_version, time_ns)
            self._send(EVENTS, event.SerializeToString(), time_ns)
        if before is live or live.phase != before.phase:
            phase = viewing.phase_event(live.phase, time_ns)
            self._send(EVENTS, phase.SerializeToString(), time_ns)
        episode = _short_episode(before, live, scene, self._period_s)
        messages = StepMessages(episode, time_ns, prefix=self._prefix)
        for topic, data in messages.of(episode.steps - 1, time_ns):
            told = _step(live).SerializeToString() if topic == STEP else data
            self._send(topic, told, time_ns)

    def repeat(self, topic: str) -> None:
        """Send what comes only once on a topic, given by its name in a recording, once more."""
        if topic == ROBOT and (robot := _robot()) is not None:
            shown = SceneUpdate()
            shown.CopyFrom(robot)
            for entity in shown.entities:
                entity.frame_id = f"{self._prefix}{entity.frame_id}"
            self._send(ROBOT, shown.SerializeToString(), time.time_ns())
        elif topic == BOXES:
            self._send_boxes(time.time_ns())

    def _send_boxes(self, time_ns: int) -> None:
        if self._scene is None:
            return
        update = viewing.boxes(self._scene.boxes, time_ns, prefix=self._prefix)
        everything = update.deletions.add(type=_DELETE_ALL)  # boxes of the episode before
        viewing.set_time(everything.timestamp, time_ns - 1)
        self._send(BOXES, update.SerializeToString(), time_ns)

    def _send(self, topic: str, data: bytes, time_ns: int) -> None:
        self._channels[topic].log(data, log_time=time_ns)


class LiveView:
    """Serves what actors publish on the bus."""

    def __init__(self, bus: Bus, *, period_s: float, actor: str | None = None) -> None:
        """Start to look for actors.

        Args:
            bus: connection to the run.
            period_s: control period of the run (s).
            actor: id of the actor that the plain topics show; None for the first that there is.
        """
        self._bus = bus
        self._period_s = period_s
        self._chosen = actor
        self._context = Context()
        self._viewers = _Viewers()
        self._lock = threading.Lock()
        self._present: list[str] = []  # in the order in which they came
        self._main = _Stage(self._context, "", period_s)
        self._main_actor: str | None = None
        self._stages: dict[str, _Stage] = {}
        self._listening: dict[str, Callable[[], None]] = {}
        self._steps: queue.Queue[Live] = queue.Queue(_STEPS_WAITING)
        self._due_s: dict[str, float] = {}
        bus.watch_presence(Role.ACTOR, self._on_presence)

    def serve(self, lifecycle: Lifecycle, host: str, port: int) -> None:
        """Serve until the lifecycle is stopping.

        Args:
            lifecycle: says when to stop.
            host: address to listen at.
            port: port to listen at; 0 for any free one.

        Raises:
            UserError: it cannot listen there.
        """
        try:
            server = start_server(
                name=f"vmdnn {self._bus.keys.run}",
                host=host,
                port=port,
                server_listener=self._viewers,
                context=self._context,
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise UserError(
                f"nothing can listen at {host}:{port} ({error}); choose another port with"
                " --port [HOST:]PORT"
            ) from error
        LOG.info("Foxglove can open ws://%s:%d (run %s)", host, server.port, self._bus.keys.run)
        try:
            look_s = 0.0
            while not lifecycle.stopping:
                if time.monotonic() >= look_s:
                    self._follow_viewers()
                    look_s = time.monotonic() + _LOOK_EVERY_S
                self._show_next()
        finally:
            server.stop()

    def _on_presence(self, actor: str, alive: bool) -> None:
        with self._lock:
            others = [name for name in self._present if name != actor]
            self._present = [*others, actor] if alive else others

    def _on_step(self, live: Live) -> None:
        """Keep a step to be shown; called in Zenoh's thread."""
        now_s = time.monotonic()
        if live.step and now_s < self._due_s.get(live.actor, 0.0):
            return
        self._due_s[live.actor] = now_s + 1.0 / SHOWN_PER_S
        with contextlib.suppress(queue.Full):  # it is shown more slowly than it is played
            self._steps.put_nowait(live)

    def _follow_viewers(self) -> None:
        """Open and close topics as actors come and go, and listen to those that are viewed."""
        with self._lock:
            present = self._present[:]
        shown = [name for name in present if name in self._stages]
        shown += [name for name in present if name not in self._stages][: MOST_ACTORS - len(shown)]
        for name in self._stages.keys() - set(shown):
            gone = self._stages.pop(name)
            gone.close()
            self._viewers.forget(gone.topics)
        for name in shown:
            if name not in self._stages:
                self._stages[name] = _Stage(self._context, f"actors/{name}", self._period_s)
        self._main_actor = self._choose(present)
        viewed = {
            name for name, stage in self._stages.items() if self._viewers.views_any(stage.topics)
        }
        if self._main_actor is not None and self._viewers.views_any(self._main.topics):
            viewed.add(self._main_actor)
        for name in self._listening.keys() - viewed:
            self._listening.pop(name)()
            self._due_s.pop(name, None)
        for name in viewed - self._listening.keys():
            key = self._bus.keys.live(name)
            self._listening[name] = self._bus.subscribe(key, self._on_step, Live)
        self._repeat_for_arrivals()

    def _choose(self, present: list[str]) -> str | None:
        """The actor that the plain topics show: the one chosen, or the first that is present."""
        if self._chosen is not None:
            return self._chosen if self._chosen in present else None
        return present[0] if present else None

    def _repeat_for_arrivals(self) -> None:
        stages = {shown: (s, t) for s in self._all_stages() for t, shown in s.topics.items()}
        arrived = set()
        while not self._viewers.arrivals.empty():
            arrived.add(self._viewers.arrivals.get())
        for shown in arrived & stages.keys():
            stage, topic = stages[shown]
            stage.repeat(topic)

    def _all_stages(self) -> list[_Stage]:
        return [self._main, *self._stages.values()]

    def _show_next(self) -> None:
        try:
            live = self._steps.get(timeout=_LOOK_EVERY_S)
        except queue.Empty:
            return
        time_ns = time.time_ns()
        if live.actor in self._stages:
            self._stages[live.actor].show(live, time_ns)
        if live.actor == self._main_actor:
            self._main.show(live, time_ns)


def _short_episode(before: Live, live: Live, scene: LiveScene, period_s: float) -> Episode:
    """The episode that consists of two steps, or of one if both are the same.

    Velocities are the differences of the joints in the two steps.
    """
    steps = (live,) if before is live else (before, live)
    passed_s = max(live.step - before.step, 1) * period_s
    actions = np.stack([step.action for step in steps])
    return Episode(
        id="live",
        kind=live.kind,
        task="",
        situation={},
        seed=0,
        actor=live.actor,
        backend="",
        policy=live.policy,
        policy_version=live.policy_version,
        config_digest="",
        images=np.stack([step.image for step in steps]),
        actions=actions,
        targets=actions,
        joints_deg=np.stack([step.joints_deg for step in steps]),
        phase_names=(live.phase,),
        phases=np.zeros(len(steps), np.uint8),
        body_names=scene.body_names,
        body_poses=np.stack([live.body_poses] * len(steps)),
        outcome=UNKNOWN_OUTCOME,
        control_period_s=passed_s,
        view=View(
            scene.boxes,
            scene.fixed_links,
            np.stack([live.focal_px] * len(steps)),
        ),
    )


def _step(live: Live) -> Message:
    """The step without what only a recording knows: targets, outputs, and the phase's number."""
    action = dict(zip(ACTION_FIELDS, live.action.tolist(), strict=True))
    return Step(step=live.step, phase_name=live.phase, action=action)


def _schema(topic: str) -> Schema:
    message = SCHEMAS[topic]
    name = message.DESCRIPTOR.full_name
    return Schema(name=name, encoding="protobuf", data=describe(message))


def _robot() -> SceneUpdate | None:
    """The robot's meshes; None if this machine cannot build them."""
    try:
        return robot_meshes()
    except UserError as error:
        LOG.warning("the robot is not shown: %s", error)
        return None
