"""LeRobotDataset, version 3.0: written from recordings, and read as tutoring sequences.

| file | content |
|---|---|
| `meta/info.json` | features, rate, counts, where the files are |
| `meta/tasks.parquet` | the tasks and their numbers |
| `meta/episodes/chunk-000/file-000.parquet` | a row for each episode: where it is, statistics |
| `meta/stats.json` | statistics of all episodes |
| `data/chunk-000/file-000.parquet` | a row for each step, a row group for each episode |
| `videos/KEY/chunk-000/file-000.mp4` | the pictures, if they are not in the data |

`action` holds the targets: what is to be learned.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.episode import Episode, Image
from proto.errors import UserError
from proto.plain_text import plain
from proto.reading import read_limited
from proto.recordings.schemas import ACTION_FIELDS
from proto.storage import written_whole
from services.exchange.contained import contained
from services.exchange.foreign import LARGEST_SIDE, check_picture, eye_picture, foreign_episode
from services.exchange.joint_map import JointMap, own_map
from services.exchange.lerobot_statistics import (
    Statistics,
    grey_histogram,
    statistics_of_grey,
    statistics_of_values,
)
from services.playing.video_file import video_file

VERSION: Final = "v3.0"
EYE: Final = "observation.images.eye"
STATE: Final = "observation.state"
ACTION: Final = "action"
CHUNK: Final = 1000
"""Files in a folder, at most."""
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_LARGEST_INFO: Final = 2**20
_LARGEST_PICTURE: Final = 64 * 2**20
_PLACE: Final = re.compile(r"(?:[^{}]|\{(?:video_key|(?:chunk_index|file_index)(?::0?[0-9]d)?)\})*")
"""What may stand in a path of `info.json`: a format of Python could ask for any width."""
_MOST_ROWS: Final = 100_000
_ROWS_PER_BYTE: Final = 1
_UNPACKED_BYTES: Final = 16 * 2**20
_UNPACKED_PER_BYTE: Final = 16
_PIXELS: Final = 30_000_000
_PIXELS_PER_BYTE: Final = 200
"""Limits of what a file may become: those of a file of tables, and of a video."""
_BROKEN: Final = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
    MemoryError,
)
"""What reading damaged data raises, besides errors of the libraries."""
EPISODES_IN_FILE: Final = 200
"""Episodes in one file of data or video; such files stay below 100 MB."""


def _arrow() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet.

    Raises:
        UserError: pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: PLC0415
        import pyarrow.parquet  # noqa: PLC0415
    except ImportError as error:
        raise UserError(
            "the format lerobot needs pyarrow, which is not installed: pip install pyarrow"
        ) from error
    return pyarrow, pyarrow.parquet


@dataclass
class _Place:
    """Where an episode is: chunk and file, and seconds from the beginning of its video."""

    chunk: int
    file: int
    begin_s: float


@dataclass
class _Written:
    """What is known of the episodes that were written.

    Attributes:
        rows: the row of each episode in `meta/episodes`.
        values: by feature, the values of each episode.
        histogram: (256,) grey levels of all pictures.
        tasks: number of each task.
        frames: number of steps.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    values: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(256, dtype=np.int64))
    tasks: dict[str, int] = field(default_factory=dict)
    frames: int = 0


def export_lerobot(episodes: Iterable[Episode], out: Path, *, period_s: float, videos: bool) -> int:
    """Write episodes as a LeRobotDataset and return their number.

    Args:
        episodes: the episodes, not none; each is read when it is written.
        out: the folder; it must not hold a data set.
        period_s: control period of all of them; its inverse must be a whole number.
        videos: write the pictures as H.264 instead of PNG in the data.

    Raises:
        UserError: the folder holds a data set, the rate is not whole, pyarrow is missing, or a file
            cannot be written.
    """
    _arrow()
    fps = round(1.0 / period_s)
    if abs(fps * period_s - 1.0) > 1e-6:
        raise UserError(f"LeRobot needs a whole number of steps per second, not {1 / period_s:.3f}")
    if (out / "meta" / "info.json").exists():
        raise UserError(f"{out} holds a data set already; choose another folder")
    written = _Written()
    for number, group in enumerate(_groups(episodes, EPISODES_IN_FILE)):
        _write_group(group, out, divmod(number, CHUNK), fps, videos, written)
    _write_meta(out, fps, videos, written)
    return len(written.rows)


def _groups(episodes: Iterable[Episode], size: int) -> Iterator[list[Episode]]:
    group: list[Episode] = []
    for episode in episodes:
        group.append(episode)
        if len(group) == size:
            yield group
            group = []
    if group:
        yield group


def _write_group(
    group: Sequence[Episode],
    out: Path,
    place: tuple[int, int],
    fps: int,
    videos: bool,
    written: _Written,
) -> None:
    """Write one file of data, and one of video."""
    pa, pq = _arrow()
    chunk, file = place
    at = {"chunk_index": chunk, "file_index": file}
    schema = _data_schema(pa, videos)
    begin = 0
    with ExitStack() as stack:
        stream = stack.enter_context(written_whole(out / DATA_PATH.format(**at)))
        data = stack.enter_context(pq.ParquetWriter(stream, schema, compression="snappy"))
        show = None
        if videos:
            path = out / VIDEO_PATH.format(video_key=EYE, **at)
            show = stack.enter_context(video_file(path, float(fps)))
        for episode in group:
            columns = _columns(episode, fps, written)
            if show is None:
                columns[EYE] = [{"bytes": _png(image), "path": None} for image in episode.images]
            else:
                for step, image in enumerate(episode.images):
                    show(np.repeat(image[..., None], 3, axis=-1), key=step == 0)
            arrays = [_arrow_array(pa, columns[name], schema.field(name)) for name in schema.names]
            data.write_table(pa.table(arrays, schema=schema))
            _note(episode, columns, _Place(chunk, file, begin / fps), fps, videos, written)
            begin += episode.steps


def _columns(episode: Episode, fps: int, written: _Written) -> dict[str, Any]:
    """The values of each feature but the picture, in every step."""
    steps = np.arange(episode.steps)
    last = steps == episode.steps - 1
    task = written.tasks.setdefault(episode.task, len(written.tasks))
    return {
        STATE: episode.joints_deg,
        ACTION: episode.targets,
        "next.done": last,
        "next.success": last & episode.outcome.strict,
        "timestamp": (steps / fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(episode.steps, len(written.rows)),
        "index": written.frames + steps,
        "task_index": np.full(episode.steps, task),
    }


def _note(
    episode: Episode,
    columns: Mapping[str, Any],
    place: _Place,
    fps: int,
    videos: bool,
    written: _Written,
) -> None:
    """Keep what `meta` says of an episode."""
    row: dict[str, Any] = {
        "episode_index": len(written.rows),
        "tasks": [episode.task],
        "length": episode.steps,
        "data/chunk_index": place.chunk,
        "data/file_index": place.file,
        "dataset_from_index": written.frames,
        "dataset_to_index": written.frames + episode.steps,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    if videos:
        row |= {
            f"videos/{EYE}/chunk_index": place.chunk,
            f"videos/{EYE}/file_index": place.file,
            f"videos/{EYE}/from_timestamp": place.begin_s,
            f"videos/{EYE}/to_timestamp": place.begin_s + episode.steps / fps,
        }
    histogram = grey_histogram(episode.images)
    numbers = {name: np.asarray(values) for name, values in columns.items() if name != EYE}
    told = {name: statistics_of_values(values) for name, values in numbers.items()}
    told[EYE] = statistics_of_grey(histogram, episode.steps)
    for feature, statistics in told.items():
        row |= {f"stats/{feature}/{name}": each.tolist() for name, each in statistics.items()}
    for name, values in numbers.items():
        written.values.setdefault(name, []).append(values)
    written.histogram += histogram
    written.frames += episode.steps
    written.rows.append(row)


def _write_meta(out: Path, fps: int, videos: bool, written: _Written) -> None:
    pa, pq = _arrow()
    tasks = pa.table(
        {
            "task_index": pa.array(list(written.tasks.values()), pa.int64()),
            "task": pa.array(list(written.tasks), pa.string()),
        }
    ).replace_schema_metadata({"pandas": json.dumps(_index_of_tasks(pa.__version__))})
    with written_whole(out / "meta" / "tasks.parquet") as stream:
        pq.write_table(tasks, stream)
    with written_whole(out / EPISODES_PATH.format(chunk_index=0, file_index=0)) as stream:
        pq.write_table(pa.Table.from_pylist(written.rows), stream)
    whole: dict[str, Statistics] = {
        name: statistics_of_values(np.concatenate(values))
        for name, values in written.values.items()
    }
    whole[EYE] = statistics_of_grey(written.histogram, written.frames)
    _write_json(
        out / "meta" / "stats.json",
        {
            feature: {name: each.tolist() for name, each in statistics.items()}
            for feature, statistics in whole.items()
        },
    )
    info = {
        "codebase_version": VERSION,
        "robot_type": "icub",
        "total_episodes": len(written.rows),
        "total_frames": written.frames,
        "total_tasks": len(written.tasks),
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(written.rows)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if videos else None,
        "features": _features(fps, videos),
    }
    _write_json(out / "meta" / "info.json", info)  # last: without it there is no data set


def _features(fps: int, videos: bool) -> dict[str, Any]:
    def numbers(dtype: str, names: Sequence[str] | None = None) -> dict[str, Any]:
        return {
            "dtype": dtype,
            "shape": [1 if names is None else len(names)],
            "names": None if names is None else list(names),
        }

    eye: dict[str, Any] = {
        "dtype": "video" if videos else "image",
        "shape": [IMAGE_HEIGHT, IMAGE_WIDTH, 3],
        "names": ["height", "width", "channels"],
    }
    if videos:
        eye["info"] = {
            "video.height": IMAGE_HEIGHT,
            "video.width": IMAGE_WIDTH,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        }
    return {
        STATE: numbers("float32", [f"{name}_deg" for name in JOINT_NAMES]),
        ACTION: numbers("float32", ACTION_FIELDS),
        EYE: eye,
        "next.done": numbers("bool"),
        "next.success": numbers("bool"),
        "timestamp": numbers("float32"),
        "frame_index": numbers("int64"),
        "episode_index": numbers("int64"),
        "index": numbers("int64"),
        "task_index": numbers("int64"),
    }


def _data_schema(pa: Any, videos: bool) -> Any:
    """Arrow schema of the data, with the note by which Hugging Face's `datasets` knows pictures."""
    fields: list[Any] = []
    known: dict[str, Any] = {}
    for name, feature in _features(1, videos).items():
        if name == EYE and videos:
            continue
        if name == EYE:
            fields.append(pa.field(name, pa.struct({"bytes": pa.binary(), "path": pa.string()})))
            known[name] = {"_type": "Image"}
            continue
        kind = pa.bool_() if feature["dtype"] == "bool" else pa.type_for_alias(feature["dtype"])
        value = {"dtype": feature["dtype"], "_type": "Value"}
        (size,) = feature["shape"]
        if size > 1:
            fields.append(pa.field(name, pa.list_(kind, size)))
            known[name] = {"feature": value, "length": size, "_type": "Sequence"}
        else:
            fields.append(pa.field(name, kind))
            known[name] = value
    note = {"info": {"features": known}}
    return pa.schema(fields, metadata={"huggingface": json.dumps(note)})


def _arrow_array(pa: Any, values: Any, described: Any) -> Any:
    if isinstance(values, np.ndarray) and values.ndim == 2:
        flat = pa.array(values.ravel(), described.type.value_type)
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return pa.array(values, described.type)


def _index_of_tasks(version: str) -> dict[str, Any]:
    """The note by which pandas knows that the column `task` is the index."""

    def column(name: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": name,
            "pandas_type": pandas_type,
            "numpy_type": numpy_type,
            "metadata": None,
        }

    return {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            column("task_index", "int64", "int64"),
            column("task", "unicode", "object"),
        ],
        "creator": {"library": "pyarrow", "version": version},
        "pandas_version": "2.2.0",
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    with written_whole(path) as stream:
        stream.write(json.dumps(content, indent=4).encode())


def _png(image: Image) -> bytes:
    _, data = cv2.imencode(".png", cv2.merge([image, image, image]))
    return bytes(data)


def import_lerobot(folder: Path, joint_map: JointMap | None, task: str) -> Iterator[Episode]:
    """Yield the episodes of a LeRobotDataset as tutoring sequences of a task.

    They are read in a process of its own: a small file can ask for any amount of memory and time.

    Args:
        folder: the data set.
        joint_map: what its actions are; None if vmdnn exported it.
        task: name of the task.

    Raises:
        UserError: it is no data set of version 3.0, its content does not fit, or it is made to take
            too much memory or time.
    """
    return contained(read_lerobot, folder, joint_map, task)


def read_lerobot(folder: Path, joint_map: JointMap | None, task: str) -> Iterator[Episode]:
    """`import_lerobot` in this process, without limits of memory and time."""
    info = _read_info(folder)
    joint_map = joint_map or own_map()
    key = _picture(info, joint_map, folder)
    names = joint_map.names or _names(info, folder)
    pa, pq = _arrow()
    reader = _Reader(folder, info, pq)
    try:
        for row in reader.episodes():
            values, pictures = reader.steps(row, key)
            where = f"{folder}, episode {row['episode_index']}"
            targets = joint_map.targets(values, names, where)
            if len(pictures) != len(targets):
                raise UserError(f"{where}: {len(pictures)} pictures of {len(targets)} steps")
            yield foreign_episode(
                pictures, targets, task=task, origin="lerobot", fps=float(info["fps"])
            )
    except (pa.ArrowException, av.FFmpegError, cv2.error, OSError, *_BROKEN) as error:
        raise UserError(
            f"{folder} is damaged or not complete: {plain(repr(error), 500)}"
        ) from error


def _read_info(folder: Path) -> dict[str, Any]:
    path = folder / "meta" / "info.json"
    try:
        info: dict[str, Any] = json.loads(read_limited(path, _LARGEST_INFO))
        version, features = info["codebase_version"], info["features"]
        valid = float(info["fps"]) > 0 and all(isinstance(f, dict) for f in features.values())
        _ = features[ACTION]
    except OSError as error:
        raise UserError(
            f"{folder} is no LeRobotDataset: {path} cannot be read ({error.strerror})"
        ) from error
    except _BROKEN as error:
        raise UserError(
            f"{path} does not describe a data set with actions ({plain(repr(error), 300)})"
        ) from error
    if version != VERSION or not valid:
        raise UserError(
            f"{folder} has version {plain(version, 100)}; this reads {VERSION}: convert it with"
            " LeRobot's own conversion script"
        )
    return info


def _picture(info: Mapping[str, Any], joint_map: JointMap, folder: Path) -> str:
    features = info["features"].items()
    pictures = [name for name, each in features if each.get("dtype") in ("image", "video")]
    wanted = joint_map.picture
    if wanted in pictures:
        return str(wanted)
    if wanted is None and len(pictures) == 1:
        return str(pictures[0])
    raise UserError(
        f"{folder} has the pictures {', '.join(pictures) or 'none'}; name one of them as `picture`"
        " in the joint map"
    )


def _names(info: Mapping[str, Any], folder: Path) -> list[str]:
    names = info["features"][ACTION].get("names")
    if isinstance(names, dict):  # {"motors": [...]}, as some data sets have it
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{folder} does not name its actions: list `names` in the joint map")
    return names


class _Reader:
    """Reads the episodes of a data set; keeps the file that was read last."""

    def __init__(self, folder: Path, info: Mapping[str, Any], pq: Any) -> None:
        self._folder = folder
        self._info = info
        self._pq = pq
        self._data: tuple[Path, Any] | None = None
        self._video: tuple[Path, NDArray[np.uint8]] | None = None

    def episodes(self) -> Iterator[dict[str, Any]]:
        """The row of each episode."""
        files = sorted((self._folder / "meta" / "episodes").glob("*/*.parquet"))
        if not files:
            raise UserError(f"{self._folder} lists no episodes in meta/episodes")
        for file in files:
            yield from self._read(file).to_pylist()

    def steps(self, row: Mapping[str, Any], key: str) -> tuple[NDArray[np.float64], Image]:
        """Actions (T, D) and pictures (T, 48, 64) of an episode."""
        place = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
        table = self._table(self._path(self._info["data_path"], place))
        chosen = np.flatnonzero(
            table.column("episode_index").to_numpy() == int(row["episode_index"])
        )
        part = table.take(chosen)
        actions = np.array(part.column(ACTION).to_pylist(), dtype=np.float64)
        if self._info["features"][key]["dtype"] == "video":
            return actions, self._frames(row, key)
        packed = part.column(key).to_pylist()
        return actions, np.stack([self._decoded(each) for each in packed])

    def _path(self, template: str, place: Mapping[str, Any]) -> Path:
        """A file of the data set.

        Raises:
            ValueError: the path is none inside the data set.
        """
        if _PLACE.fullmatch(template) is None:
            raise ValueError(f"{template[:100]!r} is no path of a file")
        return self._inside(template.format(**place))

    def _inside(self, name: str) -> Path:
        path = (self._folder / name).resolve()
        if not path.is_relative_to(self._folder.resolve()):
            raise ValueError(f"{name[:100]!r} lies outside of the data set")
        return path

    def _table(self, path: Path) -> Any:
        if self._data is None or self._data[0] != path:
            self._data = (path, self._read(path))
        return self._data[1]

    def _read(self, path: Path) -> Any:
        """Read a table; refuse one that says that it is much larger than its file."""
        size = path.stat().st_size
        metadata = self._pq.read_metadata(path)
        unpacked = sum(
            metadata.row_group(number).total_byte_size for number in range(metadata.num_row_groups)
        )
        if (
            metadata.num_rows > _MOST_ROWS + _ROWS_PER_BYTE * size
            or unpacked > _UNPACKED_BYTES + _UNPACKED_PER_BYTE * size
        ):
            raise ValueError(f"{path} is too large when it is unpacked")
        return self._pq.read_table(path, use_threads=False)

    def _decoded(self, packed: Mapping[str, Any]) -> Image:
        content = packed["bytes"]
        if content is None:
            content = read_limited(self._inside(packed["path"]), _LARGEST_PICTURE)
        check_picture(*_size_of_picture(content))
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is None:
            raise ValueError("a picture cannot be decoded")
        return eye_picture(np.asarray(picture, dtype=np.uint8))

    def _frames(self, row: Mapping[str, Any], key: str) -> Image:
        prefix = f"videos/{key}"
        place = {
            "video_key": key,
            "chunk_index": row[f"{prefix}/chunk_index"],
            "file_index": row[f"{prefix}/file_index"],
        }
        path = self._path(self._info["video_path"], place)
        if self._video is None or self._video[0] != path:
            self._video = (path, _video_pictures(path))
        first = round(row[f"{prefix}/from_timestamp"] * self._info["fps"])
        return self._video[1][first : first + int(row["length"])]


def _video_pictures(path: Path) -> Image:
    """The pictures (N, 48, 64) of a video.

    Raises:
        ValueError: it has none, or more than a video of its size has.
    """
    left = _PIXELS + _PIXELS_PER_BYTE * path.stat().st_size
    pictures = []
    with av.open(str(path)) as container:
        for stream in container.streams.video[:1]:
            check_picture(stream.codec_context.height, stream.codec_context.width)
            # The size may change later in the stream.
            stream.codec_context.options = {"max_pixels": str(LARGEST_SIDE**2)}
        for frame in container.decode(video=0):
            left -= frame.width * frame.height
            if left < 0:
                raise ValueError(f"{path} has more pictures than a video of its size")
            pictures.append(
                eye_picture(np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8))
            )
    return np.stack(pictures)


def _size_of_picture(content: bytes) -> tuple[int, int]:
    """Height and width of a PNG or JPEG, without decoding it.

    Raises:
        ValueError: it is neither.
    """
    if content.startswith(b"\x89PNG\r\n\x1a\n") and len(content) > 24:
        return int.from_bytes(content[20:24], "big"), int.from_bytes(content[16:20], "big")
    at = 2
    while content.startswith(b"\xff\xd8") and at + 9 < len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], int.from_bytes(content[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame's header
            return (
                int.from_bytes(content[at + 5 : at + 7], "big"),
                int.from_bytes(content[at + 7 : at + 9], "big"),
            )
        at += 2 + length
    raise ValueError("a picture is neither PNG nor JPEG")
