"""Videos of other programs become datasets: packets as they were, times as they are or as listed.

The videos are written, and what comes out is read, with PyAV and mcap.
"""

from __future__ import annotations

import json
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

import mp4ds
from commands import call, refused
from conftest import real
from in_parts import InlineExecutor, use
from test_import import ROS_CALIBRATION, messages, stamp

TOPIC = "/camera/image_raw"
SIZE = (64, 48)
TICKS = [0, 100, 200, 330, 400, 500, 700]  # milliseconds
REORDERED = {"bf": "2", "g": "7", "x264-params": "b-adapt=0:scenecut=0"}
START = 1_700_000_000_500_000_000


def picture(number: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.stack([x * 3 + number * 9, y * 4, x + y], axis=-1).astype(np.uint8)


def write_video(path: Path, encoder: str, **options: str) -> Path:
    """A video with uneven times."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(encoder, rate=10, options={"g": "4", **options})
        stream.width, stream.height = SIZE
        usual = "yuvj420p" if encoder == "mjpeg" else "yuv420p"
        stream.pix_fmt = options.pop("pix_fmt", usual)
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number, tick in enumerate(TICKS):
            frame = av.VideoFrame.from_ndarray(picture(number), "rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def shown(path: Path) -> list[NDArray[np.uint8]]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray() for frame in container.decode(video=0)]


def listed(tmp_path: Path, text: str) -> str:
    (tmp_path / "times.txt").write_text(text)
    return str(tmp_path / "times.txt")


VIDEOS = [
    ("a.mp4", "libx264", {"bf": "0"}, "h264"),
    ("a.mov", "libx265", {"x265-params": "bframes=0:log-level=error"}, "h265"),
    ("a.mp4", "libsvtav1", {"preset": "12", "svtav1-params": "fast-decode=1"}, "av1"),
    ("a.mov", "mjpeg", {}, "mjpeg"),
]


@pytest.mark.parametrize(("name", "encoder", "options", "codec"), VIDEOS)
def test_packets_and_times_are_kept(
    name: str, encoder: str, options: dict[str, str], codec: str, tmp_path: Path
) -> None:
    video = write_video(tmp_path / name, encoder, **options)
    chosen = mp4ds.ImportOptions(offset="1700000000.5")
    summary = mp4ds.pack(video, tmp_path / "ds", mp4ds.PackOptions(images=chosen))
    assert not any(topic.verbatim for topic in summary.topics)
    assert mp4ds.validate(tmp_path / "ds", deep=True) == []
    stored = next((tmp_path / "ds").glob("*.mp4"))
    assert all(map(np.array_equal, shown(stored), shown(video)))
    assert len(shown(stored)) == len(TICKS)
    mp4ds.unpack(tmp_path / "ds", "mcap", tmp_path / "again.mcap")
    ((topic, found),) = messages(tmp_path / "again.mcap").items()
    suffix, kind = ("compressed", "jpeg") if codec == "mjpeg" else ("compressed_video", codec)
    assert topic == f"{TOPIC}/{suffix}"
    assert {message.format for _, message in found} == {kind}
    assert [time for time, _ in found] == [START + tick * 10**6 for tick in TICKS]
    with (tmp_path / "again.mcap").open("rb") as stream:
        (record,) = make_reader(stream).iter_metadata()
    assert record.metadata["file"] == name


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        ("\n".join(f"{n}.25" for n in range(7)), {}, [n * 10**9 + 25 * 10**7 for n in range(7)]),
        ("stamp_ns,x\n" + "\n".join(f"{n},9" for n in range(7)), {}, [*range(7)]),
        ("7\n7\n8\n9\n10\n11\n12", {"unit": "us", "offset": "1"},
         [10**9 + n * 1000 for n in (7, 7, 8, 9, 10, 11, 12)]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("encoder", ["libx264", "mjpeg"])
def test_times_of_a_list(
    encoder: str, text: str, options: dict[str, str], expected: list[int], tmp_path: Path
) -> None:
    video = write_video(tmp_path / "a.mov", encoder, **({"bf": "0"} if encoder != "mjpeg" else {}))
    (tmp_path / "camera.yaml").write_text(ROS_CALIBRATION.replace("32", "64").replace("24.", "48"))
    images = mp4ds.ImportOptions(
        stamps=listed(tmp_path, text), calibration=str(tmp_path / "camera.yaml"), **options
    )
    mp4ds.pack(video, tmp_path / "ds", mp4ds.PackOptions(images=images))
    with mp4ds.open(tmp_path / "ds") as dataset:
        (stream,) = dataset.streams
        assert stream.stamps.tolist() == stream.log_times.tolist() == expected
        assert stream.calibrations[0].width == SIZE[0]
        assert len(dataset.manifest.sources) == 3
    mp4ds.unpack(tmp_path / "ds", "mcap", tmp_path / "again.mcap")
    found = messages(tmp_path / "again.mcap")
    assert [stamp(message) for _, message in found["/camera/camera_info"]] == expected


def test_frames_coded_in_another_order_are_decoded_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = write_video(tmp_path / "a.mp4", "libx264", **REORDERED)
    with pytest.raises(mp4ds.SourceError, match=r"another order.*B-frames.*Give `decode`"):
        mp4ds.pack(video, tmp_path / "ds", mp4ds.PackOptions(images=mp4ds.ImportOptions()))
    assert not (tmp_path / "ds").exists()
    chosen = mp4ds.ImportOptions(decode=True)
    executor = use(monkeypatch, InlineExecutor())
    options = mp4ds.PackOptions(images=chosen, codec="ffv1", window=3, gop=3)
    mp4ds.pack(video, tmp_path / "ds", options)
    assert len(executor.ran) == 3
    assert mp4ds.validate(tmp_path / "ds", deep=True) == []
    with mp4ds.open(tmp_path / "ds") as dataset:
        stream = dataset[TOPIC]
        assert stream.stamps.tolist() == [tick * 10**6 for tick in TICKS]
        for number, frame in enumerate(stream):
            # the encoder and conversions of colours cost a little
            assert np.abs(frame.data.astype(int) - picture(number)).mean() < 6


@pytest.mark.parametrize(
    ("options", "text", "problem"),
    [
        ({}, "1.0\n2.0", "has 2 times, but .* has 7 frames"),
        ({}, "1.0\n2.0\n1.5\n3.0\n4.0\n5.0\n6.0", "line 3: it is earlier than the time before"),
        ({}, "1\n2\n3\n4\n5\n6\n7", "integers of an unknown unit. Give `unit`"),
        ({"offset": "2147483648"}, None, "after 2038.* Give `offset`"),
        ({"unit": "ms"}, None, "`unit` is that of `stamps`"),
        ({"rate": "10"}, None, "`rate` works with plain, not with video"),
    ],
)
def test_wrong_times_are_refused(
    options: dict[str, str], text: str | None, problem: str, tmp_path: Path
) -> None:
    video = write_video(tmp_path / "a.mp4", "libx264", bf="0")
    if text is not None:
        options = {**options, "stamps": listed(tmp_path, text)}
    images = mp4ds.PackOptions(images=mp4ds.ImportOptions(**options))
    with pytest.raises(mp4ds.Mp4dsError, match=problem):
        mp4ds.pack(video, tmp_path / "ds", images)
    assert not (tmp_path / "ds").exists()


def test_what_is_no_such_video_is_refused(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", "libx264", bf="0")
    data = video.read_bytes()
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    (tmp_path / "a.exact.mp4").write_bytes(data)
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "a.mp4").write_bytes(data)
    (tmp_path / "drive" / "dataset.yaml").touch()
    write_video(tmp_path / "a.mkv", "libx264", bf="0")
    write_twice(tmp_path / "twice.mp4", video)
    write_video(tmp_path / "a.avi", "mjpeg")
    write_video(tmp_path / "mpeg4.mp4", "mpeg4")
    for name, problem in (
        ("text.mp4", ["is not an mp4"]),
        ("cut.mp4", ["was cut short"]),
        ("a.mkv", ["is not an mp4", "ffmpeg -i FILE -c copy NEW.mp4"]),
        ("twice.mp4", ["several descriptions", "ffmpeg -i FILE -c:v libx264 -qp 0"]),
        ("a.avi", ["is not an mp4", "Give an mp4, m4v or mov file"]),
        ("mpeg4.mp4", ["is coded as mpeg4, not h264", "Give --decode"]),
        ("a.exact.mp4", ["is a video of a dataset", "Use the dataset itself"]),
        ("drive/a.mp4", ["is a video of a dataset", "Use the dataset itself"]),
    ):
        result = call("import", "video", tmp_path / name, "-o", tmp_path / "ds")
        refused(result, 2, *problem)
        assert result.err.count("ffmpeg") <= 1
        assert not (tmp_path / "ds").exists()


def write_twice(path: Path, video: Path) -> None:
    """A video whose last frames have a description, with parameters, of their own."""
    data = bytearray(video.read_bytes())
    (size,) = struct.unpack_from(">I", data, entry := data.index(b"avc1", data.index(b"stsd")) - 4)
    # its frames in two chunks instead of one, of which the second has the second entry
    sizes = struct.unpack_from(f">{len(TICKS)}I", data, data.index(b"stsz") + 16)
    (start,) = struct.unpack_from(">I", data, data.index(b"stco") + 12)
    made = {
        b"stsd": struct.pack(">2I", 0, 2) + 2 * data[entry : entry + size],
        b"stsc": struct.pack(">8I", 0, 2, 1, 4, 1, 2, len(TICKS) - 4, 2),
        b"stco": struct.pack(">4I", 0, 2, start, start + sum(sizes[:4])),
    }
    added = 0
    for kind, body in made.items():
        (old,) = struct.unpack_from(">I", data, at := data.index(kind) - 4)
        data[at : at + old] = struct.pack(">I4s", len(body) + 8, kind) + body
        added += len(body) + 8 - old
    for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        at = data.index(kind) - 4
        struct.pack_into(">I", data, at, struct.unpack_from(">I", data, at)[0] + added)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("name", "left_out"),
    [
        ("carnd_solidWhiteRight.mp4", {"audio tracks": 1}),
        ("decord_rotated90.mov", {"turn by 270 degrees, which players apply": 1}),
    ],
)
def test_real_videos(name: str, left_out: dict[str, int], tmp_path: Path) -> None:
    video = real(f"video/{name}")
    said = json.loads(call("import", "video", video, "-o", tmp_path / "ds", "--json").out)
    assert said["skipped"] == left_out
    stored = next((tmp_path / "ds").glob("*.mp4"))
    for found, due in zip(shown(stored), shown(video), strict=True):
        assert np.array_equal(found, due)
