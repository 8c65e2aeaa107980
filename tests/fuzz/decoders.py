"""What reads bytes from outside, each with valid inputs to begin with and its declared errors."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from fitting import make_policy
from outcomes import IMPRECISE

from learner.checkpoint import checkpoint_from_bytes
from proto.body import ACTION_NAMES, ACTION_VALUES
from proto.bus import Attachment
from proto.codec import MessageError, Wire, decode, encode, schema_of
from proto.config import load_config
from proto.episode import BoxLook, Episode, Kind, View
from proto.errors import UserError
from proto.keys import Role
from proto.messages import (
    EYE_SIZE,
    OUTSIDE_SIZE,
    Claim,
    ConfigurationRequest,
    EpisodeFailed,
    EpisodeOutcome,
    Identity,
    Live,
    Pictures,
    PolicyVersion,
    Receipt,
    Rollout,
    RunConfiguration,
    Setting,
    Settings,
    Trial,
    TrialRequest,
    TutoringCase,
    Verdict,
)
from proto.messages import (
    Sequence as SequenceMessage,
)
from proto.metrics import METRICS, EvaluatorMetrics, HubMetrics, PolicyScore, Success, SuiteScore
from proto.outbox import Outbox, message_problem
from proto.recordings.episodes import read_episode, read_heading, read_summary, write_episode
from proto.recordings.recovery import recover
from proto.suites import Conditions, Player
from services.exchange.eipl import import_eipl
from services.exchange.joint_map import read_joint_map
from services.exchange.lerobot import export_lerobot, read_lerobot
from services.trials.trial_log import CountedTrial, TrialLog, parse_line

SMALL_NETWORK = (
    *("network.mstnn_fast.maps=1", "network.mstnn_fast.kernel=[4, 4]"),
    *("network.mstnn_fast.stride=12", "network.mstnn_slow.maps=1"),
    *("network.mstnn_slow.kernel=[2, 2]", "network.pfc.units=2", "network.mtrnn_slow.units=2"),
    *("network.mtrnn_fast.units=2", "network.softmax_units=2"),
)
MESSAGES = (
    *(SequenceMessage, Rollout, EpisodeFailed, Receipt, TutoringCase, Verdict, TrialRequest),
    *(Trial, Live, Pictures, PolicyVersion, Settings, Attachment, EpisodeOutcome, Claim),
    *(Identity, ConfigurationRequest, RunConfiguration),
)


@dataclass(frozen=True)
class Decoder:
    """Something that reads bytes from outside.

    Attributes:
        read: reads an input; the folder is empty, or holds what the decoder wrote before.
        valid: makes inputs that it reads without an error, in an empty folder.
        errors: what it may raise.
        share: of all inputs; slow decoders get fewer.
    """

    read: Callable[[bytes, Path], object]
    valid: Callable[[Path], Sequence[bytes]]
    errors: tuple[type[Exception], ...]
    share: float


def small_episode(steps: int = 3) -> Episode:
    """An episode with every optional field."""
    random = np.random.default_rng(1)

    def numbers(*shape: int) -> np.ndarray:
        return random.random(shape, dtype=np.float32)

    return Episode(
        id="0123456789abcdef",
        kind=Kind.TRIAL,
        task="experiment1",
        situation={"obstacle_x_m": -0.27, "indicated": "left"},
        seed=3001,
        actor="local",
        backend="sapien",
        policy="run",
        policy_version=3,
        config_digest="c0ffee",
        images=random.integers(0, 256, (steps, 48, 64), dtype=np.uint8),
        actions=numbers(steps, 11),
        targets=numbers(steps, 11),
        joints_deg=numbers(steps, 18),
        phase_names=("reach", "lift"),
        phases=np.zeros(steps, np.uint8),
        body_names=("object", "obstacle"),
        body_poses=numbers(steps, 2, 7),
        outcome=IMPRECISE,
        outputs=numbers(steps, 22),
        states={"pfc": numbers(steps, 4)},
        training="ab12",
        started_s=1_700_000_000.25,
        view=View({"object": BoxLook((0.1, 0.1, 0.1), (1.0, 0.0, 0.0))}, {}, numbers(steps, 2) + 1),
        conditions=Conditions("disturbed", 1.0, "pushed", 20.0),
    )


def small_policy() -> PolicyVersion:
    return make_policy(3, network=load_config(None, SMALL_NETWORK).network)


def _messages() -> list[object]:
    episode, outcome = small_episode(1), small_episode(1).outcome
    player = Player("sapien", ("push",))
    return [
        SequenceMessage(replace(episode, kind=Kind.TUTORING)),
        Rollout(episode, "ab12"),
        EpisodeFailed(
            *("e1", "actor", Kind.TRIAL, "experiment1", 7, episode.situation, "ab12", 3, "NaN"),
            died=False,
        ),
        EpisodeOutcome.of(replace(episode, kind=Kind.TRIAL)),
        Receipt("e1", "no"),
        TutoringCase("experiment1", 3, 1),
        Verdict("ab12", 3, "experiment1", 7, episode.situation, outcome, "sapien"),
        TrialRequest("actor", "ab12", 3, "c0ffee", player, (1, 2)),
        Trial(3, 1000, episode.conditions),
        Live(
            *("actor", Kind.TRIAL, "run", 3, 1, "lift", episode.images[0]),
            *(episode.joints_deg[0], episode.actions[0], episode.body_poses[0]),
            focal_px=np.ones(2, np.float32),
        ),
        Pictures("actor", 3, *(np.zeros(size, np.uint8) for size in (OUTSIDE_SIZE, EYE_SIZE))),
        small_policy(),
        Settings(Role.ACTOR, "actor", (Setting("network.pfc.tau", "150.0"),)),
        Attachment.of(b"", "actor/1"),
        Claim(Role.LEARNER, "learner", "0123456789abcdef", works=True),
        Identity("0123456789abcdef0123456789abcdef", joined=False),
        ConfigurationRequest(Role.ACTOR),
        RunConfiguration("{}", "c0ffee"),
    ]


def _with_encoding(messages: Sequence[object]) -> list[bytes]:
    wires = [encode(message) for message in messages]
    return [wire.encoding.encode() + b"\n" + wire.payload for wire in wires]


def _read_message(content: bytes, _folder: Path, classes: Sequence[type] = MESSAGES) -> object:
    encoding, _, payload = content.partition(b"\n")
    return decode(Wire(encoding.decode(errors="replace"), payload), *classes)


def wire_input(message: type, payload: bytes) -> bytes:
    """The input of a message decoder with some payload."""
    return schema_of(message).encoding.encode() + b"\n" + payload


def _metrics() -> list[object]:
    rate = Success(3, 0.75, (0.3, 0.95))
    scores = (PolicyScore(2, 4, rate, rate, rate, {"not_lifted": 1}),)
    suites = (SuiteScore("unlearned", "sapien", 52, "", scores),)
    common = {"time_s": 1.5, "refused": 0}
    return [
        HubMetrics(id="hub", peers=3, **common),
        EvaluatorMetrics(
            id="evaluator", policies=scores, suites=suites, leases=1, damaged=0, paused=False,
            done=False, **common,
        ),
    ]  # fmt: skip


def _file(content: bytes, folder: Path, name: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def _recording(folder: Path) -> list[bytes]:
    path = folder / "valid.mcap"
    write_episode(path, small_episode())
    return [path.read_bytes()]


def _read_recording(content: bytes, folder: Path) -> None:
    path = _file(content, folder, "episode.mcap")
    for read in (read_heading, read_summary):
        with suppress(UserError):
            read(path)
    read_episode(path, partial=True)


def _config(content: bytes, folder: Path) -> object:
    return load_config(_file(content, folder, "config.yaml"))


CONFIGS = (
    b"run: {name: a, seed: 3}\nlearner:\n  rate: 1e-3\n  cases: [1, 2]\n",
    b"evaluator:\n  suites:\n  - unlearned\n  - {name: b, disturbances: {pushed: [10, 30]}}\n",
    b"x: &a [1, .inf, 0x1F, 'x', \"y\", ~, true]\nnetwork: {pfc: {units: 7}}\nb: *a\n",
    b"task:\n  name: experiment2\n  gestures: |\n    a\nrecorder:\n  keep: {gib: 1.5}\n",
)
OVERRIDES = (b"learner.rate=1e-3", b"task.delay_steps=[1, {a: 2}]", b"evaluator.suites=[beyond]")


def _set(content: bytes, _folder: Path) -> object:
    return load_config(None, [content.decode("utf-8", errors="replace")])


def _trial_lines(_folder: Path) -> list[bytes]:
    episode = small_episode(1)
    lines = [CountedTrial.of(each, "ab12").line() for each in (episode, replace(episode, seed=9))]
    old = Path(__file__).parents[1] / "data" / "format1" / "trials.jsonl"
    return [b"".join(lines), lines[0].rstrip(b"\n"), *old.read_bytes().splitlines()]


def _read_trials(content: bytes, folder: Path) -> None:
    if b"\n" in content:
        TrialLog(_file(content, folder, "trials.jsonl"))
    else:
        parse_line(content)


def _outbox_files(folder: Path) -> list[bytes]:
    outbox = Outbox(folder, lambda _key, _wire: None)
    outbox.add("e1", "vmdnn/run/rollout/a", encode(Receipt("e1")), [Role.EVALUATOR])
    (path,) = folder.glob("*.message")
    return [path.read_bytes()]


def _read_outbox(content: bytes, folder: Path) -> None:
    """Every input is sent, or set aside: nothing is raised."""
    path = _file(content, folder, "read/1-e1.message")
    if message_problem(path):
        outbox = Outbox(path.parent, lambda _key, _wire: None)
        outbox.send_due()
        assert len(outbox) == 0
        assert outbox.put_aside == 1
        path.with_suffix(".damaged").unlink()


def _eipl_files(folder: Path) -> list[bytes]:
    np.save(folder / "joints.npy", np.tile(_middles(), (1, 2, 1)))
    return [(folder / "joints.npy").read_bytes()]


def _middles() -> np.ndarray:
    return np.array([(v.minimum + v.maximum) / 2 for v in ACTION_VALUES], np.float32)


def _read_eipl(content: bytes, folder: Path) -> None:
    _file(content, folder, "train/joints.npy")
    images = folder / "train" / "images.npy"
    if not images.exists():
        np.save(images, np.zeros((1, 2, 4, 4, 3), np.uint8))
    for _ in import_eipl(folder, None, "experiment1"):
        pass


LEROBOT_FILES = (
    "meta/info.json",
    "meta/episodes/chunk-000/file-000.parquet",
    "data/chunk-000/file-000.parquet",
)


LEROBOT_VIDEO = "videos/observation.images.eye/chunk-000/file-000.mp4"


@cache
def _lerobot_set(folder: Path, *, videos: bool = False) -> dict[str, bytes]:
    episode = replace(small_episode(2), targets=np.tile(_middles(), (2, 1)))
    export_lerobot([episode], folder / "set", period_s=0.1, videos=videos)
    names = (*LEROBOT_FILES, LEROBOT_VIDEO) if videos else LEROBOT_FILES
    return {name: (folder / "set" / name).read_bytes() for name in names}


def _lerobot_files(folder: Path) -> list[bytes]:
    return [
        bytes([number]) + content for number, content in enumerate(_lerobot_set(folder).values())
    ]


def _read_lerobot(content: bytes, folder: Path) -> None:
    """The first byte says which file of the data set the rest replaces."""
    name = LEROBOT_FILES[(content or b"\0")[0] % len(LEROBOT_FILES)]
    _read_set(name, content[1:], folder, _lerobot_set(folder))


def _read_video(content: bytes, folder: Path) -> None:
    _read_set(LEROBOT_VIDEO, content, folder, _lerobot_set(folder, videos=True))


def _read_set(name: str, content: bytes, folder: Path, files: dict[str, bytes]) -> None:
    """Read a data set in which a file has another content."""
    _file(content, folder / "set", name)
    try:
        for _ in read_lerobot(folder / "set", None, "experiment1"):
            pass
    finally:
        _file(files[name], folder / "set", name)


def _joint_maps(_folder: Path) -> list[bytes]:
    joints = dict.fromkeys(ACTION_NAMES, 0.0) | {"r_elbow": {"from": "j", "scale": 2.0}}
    return [json.dumps({"unit": "rad", "names": ["j"], "joints": joints}).encode()]


def _recover(content: bytes, folder: Path) -> None:
    recover(_file(content, folder, "damaged.mcap"), folder / "out.mcap")


DECODERS: dict[str, Decoder] = {
    "messages": Decoder(
        _read_message, lambda _: _with_encoding(_messages()), (MessageError,), 0.40
    ),
    "metrics": Decoder(
        lambda content, folder: _read_message(content, folder, METRICS),
        lambda _: _with_encoding(_metrics()),
        (MessageError,),
        0.15,
    ),
    "trial log": Decoder(_read_trials, _trial_lines, (MessageError,), 0.13),
    "outbox": Decoder(_read_outbox, _outbox_files, (), 0.12),
    "set": Decoder(_set, lambda _: OVERRIDES, (UserError,), 0.05),
    "checkpoints": Decoder(
        lambda content, _: checkpoint_from_bytes(content, "it"),
        lambda _: [small_policy().weights],
        (UserError,),
        0.05,
    ),
    "recordings": Decoder(_read_recording, _recording, (UserError,), 0.03),
    "recover": Decoder(_recover, _recording, (UserError,), 0.02),
    "config": Decoder(_config, lambda _: CONFIGS, (UserError,), 0.02),
    "joint maps": Decoder(
        lambda content, folder: read_joint_map(_file(content, folder, "map.yaml")),
        _joint_maps,
        (UserError,),
        0.01,
    ),
    "eipl": Decoder(_read_eipl, _eipl_files, (UserError,), 0.01),
    "lerobot": Decoder(_read_lerobot, _lerobot_files, (UserError,), 0.005),
    "lerobot videos": Decoder(
        _read_video,
        lambda folder: [_lerobot_set(folder, videos=True)[LEROBOT_VIDEO]],
        (UserError,),
        0.005,
    ),
}
