"""A video is of a format that browsers play, and shows the pictures that were written."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from proto.errors import UserError
from services.playing.video_file import video_file

COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (200, 200, 200))


def write(path: Path, fps: float = 10.0) -> None:
    """Write one picture of each colour; a corner of it is black."""
    with video_file(path, fps) as add:
        for colour in COLOURS:
            picture = np.full((96, 128, 3), colour, dtype=np.uint8)
            picture[:48, :64] = 0
            add(picture)


@pytest.mark.parametrize(("name", "scale"), [("video.mp4", 1), ("video.gif", 2)])
def test_the_pictures_are_seen_in_their_order_at_their_times(
    tmp_path: Path, name: str, scale: int
) -> None:
    path = tmp_path / name
    write(path)
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    for frame, colour in zip(frames, COLOURS, strict=True):
        picture = frame.to_ndarray(format="rgb24")
        assert picture.shape == (96 // scale, 128 // scale, 3)
        assert picture[-5, -5] == pytest.approx(colour, abs=12)
        assert picture[5, 5] == pytest.approx((0, 0, 0), abs=12)
    assert list(tmp_path.iterdir()) == [path]


def test_an_mp4_file_is_what_browsers_play(tmp_path: Path) -> None:
    """H.264 with colours of half resolution, and the index in front of the pictures."""
    path = tmp_path / "video.mp4"
    write(path)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    content = path.read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")


def test_a_video_can_be_played_from_each_key_picture(tmp_path: Path) -> None:
    """As readers of data sets do, which begin with any episode."""
    path = tmp_path / "video.mp4"
    with video_file(path, 10.0) as add:
        for number in range(40):
            grey = np.linspace(0, 150, 128, dtype=np.uint8) + np.uint8(number)
            add(np.broadcast_to(grey[:, None], (96, 128, 3)), key=number in (0, 13))
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        keys = {number for number, packet in enumerate(packets) if packet.is_keyframe}
        assert {0, 13} <= keys
        assert [packet.pts for packet in packets] == sorted(packet.pts for packet in packets)


def test_a_rate_that_is_no_whole_number_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "video.mp4", fps=12.5)
    with av.open(str(tmp_path / "video.mp4")) as container:
        assert float(container.streams.video[0].average_rate or 0) == pytest.approx(12.5)


def test_an_interrupted_video_leaves_nothing(tmp_path: Path) -> None:
    ragged = [np.zeros((96, 128, 3), dtype=np.uint8), np.zeros((96, 128), dtype=np.uint8)]
    with (
        pytest.raises(ValueError, match="numpy array"),
        video_file(tmp_path / "v.mp4", 10.0) as add,
    ):
        list(map(add, ragged))
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write(tmp_path / "file" / "video.mp4")
    with pytest.raises(UserError, match=r"must end in \.mp4 or \.gif"):
        write(tmp_path / "video.webm")
