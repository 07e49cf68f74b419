"""Folders of images and pairs of the paper's tool become datasets.

The folders are written with OpenCV, Pillow and text; what comes out is read with mcap and rosbags.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from PIL import Image
from rosbags.highlevel import AnyReader

import mp4ds
from commands import call, refused
from in_parts import InlineExecutor, facts, leftovers, use
from mp4ds.errors import SourceError
from mp4ds.format.sidecars import load_manifest
from mp4ds.packing.options import ImportOptions
from mp4ds.plugins.importing.images import open_images
from mp4ds.video.images import read_image
from test_import_ros_mp4 import FIXTURE, STAMPS, TOPICS, document, nanoseconds, write_text

WIDTH, HEIGHT = 32, 24
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n%%EOF\n"
START = 1_403_636_579_763_555_584
Pixels = NDArray[Any]


def noise(channels: int = 1, dtype: str = "u1") -> Pixels:
    """All bits of all samples vary."""
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    return np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def image(number: int, channels: int = 1, dtype: str = "u1") -> Pixels:
    """Slopes that move, of which a video is smaller than its images."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    planes = [x * (3 + plane) + y * 2 + number * 5 for plane in range(channels)]
    values = np.stack(planes, axis=-1) * (100 if dtype == "u2" else 1)
    return (values[..., 0] if channels == 1 else values).astype(dtype)


def save(path: Path, pixels: Pixels) -> Path:
    """Write an image by OpenCV, whose colours are the other way round."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = {2: slice(None), 3: [2, 1, 0], 4: [2, 1, 0, 3]}
    colours = pixels if pixels.ndim == 2 else pixels[:, :, order[pixels.shape[2]]]
    assert cv2.imwrite(str(path), colours)
    return path


def folder(**options: Any) -> mp4ds.PackOptions:
    return mp4ds.PackOptions(images=mp4ds.ImportOptions(**options), codec="ffv1")


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Log times and messages of an MCAP file, by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as stream:
        for item in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(item.channel.topic, []).append(
                (item.message.log_time, item.decoded_message)
            )
    return found


def attachments(path: Path) -> dict[str, bytes]:
    with path.open("rb") as stream:
        return {item.name: item.data for item in make_reader(stream).iter_attachments()}


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def pixels_of(message: Any, dtype: str = "u1", channels: int = 1) -> Pixels:
    shape = (
        (message.height, message.width) if channels == 1 else (message.height, message.width, -1)
    )
    return np.frombuffer(bytes(message.data), dtype).reshape(shape)


def imported(source: Path, tmp_path: Path, **options: Any) -> dict[str, list[tuple[int, Any]]]:
    """Pack, validate, unpack; returns what came out."""
    mp4ds.pack(source, tmp_path / "ds", folder(**options))
    assert mp4ds.validate(tmp_path / "ds", deep=True) == []
    mp4ds.unpack(tmp_path / "ds", "mcap", tmp_path / "again.mcap")
    found = messages(tmp_path / "again.mcap")
    for rows in found.values():
        for time, message in rows:
            if hasattr(message, "header"):
                assert time == stamp(message)
    return found


# ---------------------------------------------------------------- pixels

DEEP = noise(1, "u2")
EXACT: dict[str, tuple[Callable[[Path], Any], str, Pixels]] = {
    "grey.png": (lambda path: save(path, noise()), "mono8", noise()),
    "grey16.png": (lambda path: save(path, DEEP), "mono16", DEEP),
    "rgb.png": (lambda path: save(path, noise(3)), "rgb8", noise(3)),
    "rgb16.png": (lambda path: save(path, noise(3, "u2")), "rgb16", noise(3, "u2")),
    "rgba.png": (lambda path: save(path, noise(4)), "rgba8", noise(4)),
    "rgba16.png": (lambda path: save(path, noise(4, "u2")), "rgba16", noise(4, "u2")),
    "la.png": (lambda path: Image.fromarray(noise(2), "LA").save(path), "8UC2", noise(2)),
    "bits.png": (
        lambda path: Image.fromarray(noise() > 99).save(path),
        "mono8",
        np.where(noise() > 99, 255, 0).astype("u1"),
    ),
    "grey16.tiff": (lambda path: save(path, DEEP), "mono16", DEEP),
    "rgb16.tif": (lambda path: save(path, noise(3, "u2")), "rgb16", noise(3, "u2")),
    "float.tiff": (
        lambda path: save(path, DEEP.astype("f4") / 7),
        "32FC1",
        DEEP.astype("f4") / 7,
    ),
    "grey.pgm": (lambda path: save(path, noise()), "mono8", noise()),
    "grey16.pgm": (lambda path: save(path, DEEP), "mono16", DEEP),
    "rgb.ppm": (lambda path: save(path, noise(3)), "rgb8", noise(3)),
    # 12 bits stay 12 bits
    "bits12.pgm": (
        lambda path: path.write_bytes(
            b"P5 # a comment\n32 24\n4095\n" + (DEEP >> 4).astype(">u2").tobytes()
        ),
        "mono16",
        DEEP >> 4,
    ),
    "grey.bmp": (lambda path: save(path, noise()), "mono8", noise()),
}


@pytest.mark.parametrize("name", EXACT)
def test_files_are_read_to_the_bit(name: str, tmp_path: Path) -> None:
    write, encoding, expected = EXACT[name]
    write(tmp_path / name)
    found, pixels = read_image(tmp_path / name)
    assert found == encoding
    assert pixels.dtype == expected.dtype.newbyteorder("<")
    assert np.array_equal(pixels, expected)


def test_what_cannot_be_had_as_it_is_is_refused(tmp_path: Path) -> None:
    grey = Image.fromarray(noise())
    grey.convert("P").save(tmp_path / "palette.png")
    grey.convert("CMYK").save(tmp_path / "inks.tiff")
    grey.save(tmp_path / "pages.tiff", save_all=True, append_images=[grey])
    whole = save(tmp_path / "whole.png", noise())
    (tmp_path / "cut.png").write_bytes(whole.read_bytes()[:300])
    (tmp_path / "cut.pgm").write_bytes(b"P5 4 4 255\n123")
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "empty.png").write_bytes(b"")
    whole.unlink()
    for path in tmp_path.iterdir():
        with pytest.raises(SourceError) as caught:
            read_image(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- plain folders


def plain(place: Path, names: list[str], dtype: str = "u1") -> list[Pixels]:
    pictures = [image(number, dtype=dtype) for number in range(len(names))]
    for name, pixels in zip(names, pictures, strict=True):
        save(place / name, pixels)
    return pictures


CASES: dict[str, tuple[list[str], str | None, dict[str, str], list[int]]] = {
    "names-ns": ([f"{START + n * 50_000_001}.png" for n in range(3)], None, {},
                 [START + n * 50_000_001 for n in range(3)]),
    "names-seconds": (["1305031102.175304.png", "1305031102.211214.png"], None, {},
                      [1305031102_175304000, 1305031102_211214000]),
    "names-unit": (["9.png", "10.png"], None, {"unit": "ms"}, [9_000_000, 10_000_000]),
    "lines": (["2.png", "10.png"], "1305031102.175304\n\n1305031102.2\n", {},
              [1305031102_175304000, 1305031102_200000000]),
    "lines-unit": (["a.png", "b.png"], "# us\n7\n9\n", {"unit": "us"}, [7000, 9000]),
    "named": (["a.png", "b.png"], "1305031102.5 a.png\n1305031103.5 b.png\n", {},
              [1305031102_500000000, 1305031103_500000000]),
    "csv": (["a.png", "b.png"], "#timestamp [ns],filename\n1403636579763555584,a.png\n"
            "1403636579813555456,b.png\n", {}, [1403636579763555584, 1403636579813555456]),
    "our-csv": (["0.png", "1.png"], "file,stamp_ns,log_time_ns,frame_id\n0.png,5,6,cam\n"
                "1.png,7,8,cam\n", {}, [5, 7]),
    "rate": (["f9.png", "f10.png", "f11.png"], None, {"rate": "30"}, [0, 33333333, 66666667]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_times_of_plain_folders(case: str, tmp_path: Path) -> None:
    names, listed, options, expected = CASES[case]
    pictures = plain(tmp_path / "images", names)
    if listed is not None:
        (tmp_path / "images" / "stamps.txt").write_text(listed)
        options = {**options, "stamps": str(tmp_path / "images" / "stamps.txt")}
    summary = mp4ds.pack(tmp_path / "images", tmp_path / "ds", folder(**options))
    assert summary.skipped == {}
    with mp4ds.open(tmp_path / "ds") as dataset:
        stream = dataset["/camera/image_raw"]
        assert stream.stamps.tolist() == stream.log_times.tolist() == expected
        for frame, pixels in zip(stream, pictures, strict=True):
            assert (frame.encoding, frame.frame_id) == ("mono8", "camera")
            assert np.array_equal(frame.data, pixels)


@pytest.mark.parametrize(
    "names",
    [
        ("color_{}.jpg", "depth_{}.png"),
        ("frame-{:06}.depth.png", "frame-{:06}.rgb.png"),
        ("{}.jpg", "{}.png"),
        ("cam0_{}.png", "cam1_{}.png"),
        ("{}.png", "{}_mask.png"),
    ],
)
def test_a_rate_is_not_that_of_several_cameras(names: tuple[str, str], tmp_path: Path) -> None:
    for number in range(8, 11):
        for name in names:
            save(tmp_path / name.format(number), image(number, 3 if name.endswith("jpg") else 1))
    with pytest.raises(SourceError, match=r"several cameras.* folder of its own"):
        open_images(tmp_path, ImportOptions(rate="30"))


@pytest.mark.parametrize(
    "names",
    [
        ["a.png", "b.png", "c.png"],
        ["img_1.png", "img_2.png", "dsc_3.png", "dsc_4.png"],
        ["1.jpg", "2.jpg", "3.png", "4.png"],
        [f"{number:04x}.png" for number in range(32)],
        ["cam1.png", "cam2.png", "cam3.png"],
        ["large_1.png", "large_2.png", "small_3.png", "small_4.png"],
    ],
)
def test_a_rate_is_that_of_one_camera(names: list[str], tmp_path: Path) -> None:
    for name in names:
        pixels = image(1, 3 if name.endswith("jpg") else 1)
        save(tmp_path / name, pixels[:8] if "small" in name else pixels)
    with open_images(tmp_path, ImportOptions(rate="30")) as reader:
        assert sum(map(len, reader.times().values())) == len(names)
        assert len(set(np.concatenate(list(reader.times().values())).tolist())) == len(names)


def test_a_plain_folder_round_trip(tmp_path: Path) -> None:
    """Depths out of order, a calibration, a file that is no image, and an image without a time."""
    pictures = plain(tmp_path / "in", ["a.png", "b.png", "c.png", "d.png"], "u2")
    (tmp_path / "in" / "notes.txt").write_text("of the day")
    (tmp_path / "times.csv").write_text("t,name\n3.5,a.png\n1.000000001,b.png\n2.25,c.png\n")
    (tmp_path / "cam.yaml").write_text(ROS_CALIBRATION)
    found = imported(
        tmp_path / "in", tmp_path, stamps=str(tmp_path / "times.csv"), topic="/d/image",
        frame_id="optical", encoding="16UC1", calibration=str(tmp_path / "cam.yaml"),
    )  # fmt: skip
    assert set(found) == {"/d/image", "/d/camera_info"}
    for (time, message), (due, number) in zip(
        found["/d/image"], [(1_000_000_001, 1), (2_250_000_000, 2), (3_500_000_000, 0)], strict=True
    ):
        assert (time, message.encoding, message.header.frame_id) == (due, "16UC1", "optical")
        assert np.array_equal(pixels_of(message, "<u2"), pictures[number])
    assert [time for time, _ in found["/d/camera_info"]] == [10**9 + 1, 2250 * 10**6, 3500 * 10**6]
    for _, info in found["/d/camera_info"]:
        assert (info.width, info.height, info.distortion_model) == (32, 24, "plumb_bob")
        assert list(info.d) == [-0.3, 0.1, 1e-05, -2.0, 0.0]
        assert list(info.k) == [30.5, 0, 16, 0, 31, 12, 0, 0, 1]
        assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        assert list(info.p) == [30.5, 0, 16, 0, 0, 31, 12, 0, 0, 0, 1, 0]
    summary = mp4ds.pack(
        tmp_path / "in", tmp_path / "ds2", folder(stamps=str(tmp_path / "times.csv"))
    )
    assert summary.skipped == {"images without a time": 1, "files in in that are not images": 1}
    kept = attachments(tmp_path / "ds" / "messages.mcap")
    assert kept["cam.yaml"].decode() == ROS_CALIBRATION
    assert kept["images.csv"].decode().splitlines() == [
        "topic,stamp_ns,file", "/d/image,1000000001,b.png", "/d/image,2250000000,c.png",
        "/d/image,3500000000,a.png",
    ]  # fmt: skip


ROS_CALIBRATION = """\
image_width: 32
image_height: 24.
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [30.5, 0., 16, 0, 31.0, 12, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 1.0e-01, 1e-05, -2, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [30.5, 0, 16, 0, 0, 31, 12, 0, 0, 0, 1, 0]
"""


def test_jpeg_files_are_kept_beside_others(tmp_path: Path) -> None:
    for number in range(3):
        save(tmp_path / "in" / f"{number}.jpg", image(number, 3))
    save(tmp_path / "in" / "3.png", image(3, 3))
    found = imported(tmp_path / "in", tmp_path, rate="2")
    rows = found["/camera/image_raw/compressed"]
    assert [time for time, _ in rows] == [0, 500_000_000, 1_000_000_000]
    for number, (_, message) in enumerate(rows):
        assert message.format == "jpeg"
        assert bytes(message.data) == (tmp_path / "in" / f"{number}.jpg").read_bytes()
    ((time, raw),) = found["/camera/image_raw"]
    assert (time, raw.encoding) == (1_500_000_000, "rgb8")
    assert np.array_equal(pixels_of(raw, channels=3), image(3, 3))
    assert (tmp_path / "ds" / "camera_image_raw_compressed.mp4").is_file()


def test_in_parts_is_as_in_one_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "MH_01/mav0/cam0/data"
    plain(place, [f"{START + number * 50_000_128}.png" for number in range(5)])
    options = mp4ds.PackOptions(images=mp4ds.ImportOptions(), codec="ffv1", gop=2)
    mp4ds.pack(place, tmp_path / "whole", options)
    use(monkeypatch, InlineExecutor())
    tasks: list[int] = []
    mp4ds.pack(
        place,
        tmp_path / "parts",
        replace(options, window=2),
        progress=lambda state: tasks.append(state.tasks_total),
    )
    assert max(tasks) == 3
    assert facts(tmp_path / "parts") == facts(tmp_path / "whole")
    assert mp4ds.validate(tmp_path / "parts", deep=True) == []
    assert leftovers(tmp_path) == []
    (source,) = load_manifest(tmp_path / "parts" / "dataset.yaml").sources
    images = sorted(place.iterdir())
    listing = "".join(f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}\n" for p in images)
    assert (source.name, source.size, source.sha256) == (
        "data",
        sum(path.stat().st_size for path in images),
        hashlib.sha256(listing.encode()).hexdigest(),
    )
    done = call("import", "images", tmp_path / "MH_01", "-o", tmp_path / "ds")
    refused(done, 2, "there are some in mav0/cam0/data")


# ---------------------------------------------------------------- bad input


BAD: dict[str, tuple[list[str], str | bytes, str, str]] = {
    "no-images": ([], "", "", "holds no images"),
    "no-times": (["a.png"], "", "", "--rate HZ"),
    "frame-numbers": (["0.png", "1.png"], "", "", "--rate HZ"),
    "names-of-no-unit": (["a.png"], "", "--unit ns", "name that is not a time"),
    "unknown-unit": (["a.png"], "17\n", "--stamps t", "Give --unit"),
    "no-unit": (["a.png"], "", "--unit h", "s, ms, us, ns"),
    "fewer-times": (["a.png", "b.png"], "1.5\n", "--stamps t", "1 times, but there are 2"),
    "empty-list": (["a.png"], "# none\n", "--stamps t", "holds no times"),
    "binary-list": (["a.png"], "", "--stamps in/a.png", "is not a text file"),
    "no-list": (["a.png"], "", "--stamps none", "cannot be read"),
    "unlisted": (["a.png"], "1.5 b.png\n", "--stamps t", "does not exist"),
    "both": (["a.png"], "", "--stamps t --rate 2", "Give only one of them"),
    "bad-rate": (["a.png"], "", "--rate fast", "'fast' is not a rate"),
    "bad-encoding": (["a.png"], "", "--rate 2 --encoding x", "--encoding 'x'"),
    "other-encoding": (["a.png"], "", "--rate 2 --encoding rgb8", "cannot be rgb8"),
    "jpeg-encoding": (["a.jpg"], "", "--rate 2 --encoding mono8", "JPEG"),
    "no-topic": (["a.png"], "", "--rate 2 --topic /", "is not a topic name"),
    "no-stamp": (["a.png"], "#t\nt f\nx a.png\n", "--stamps t", "line 3 has no time"),
    "bad-stamp": (["a.png"], "1. a.png\n2x a.png\n", "--stamps t", "line 2: '2x' is not a time"),
    "outside": (["a.png"], "1.5 ../../x.png\n", "--stamps t", "outside"),
    "short": (["a.png"], "1.5 a.png\n1.6\n", "--stamps t", "line 2 has 1 values"),
    "late": (["a.png"], "9999999999999999999,a.png\n", "--stamps t", "2038"),
    "long-line": (["a.png"], f"1.5 {' ' * 65_600}a.png\n", "--stamps t", "line 1 is too long"),
    "damaged": (["a.png"], b"\x89PNG", "--rate 2", "cannot be read as an image"),
    # Pillow runs Ghostscript for it, whatever the file is called
    "postscript": (["a.png"], POSTSCRIPT, "--rate 2", "cannot identify image file"),
}
"""Images, a list of times ``t`` or bytes of the first image, options, and words of the error."""


@pytest.mark.parametrize("case", BAD)
def test_bad_folders_are_refused_in_a_sentence(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, times, options, words = BAD[case]
    monkeypatch.chdir(tmp_path)
    Path("in").mkdir()
    plain(Path("in"), names)
    if isinstance(times, bytes):
        Path("in", names[0]).write_bytes(times)
    elif times:
        Path("t").write_text(times)
    before = {path.name for path in tmp_path.iterdir()}
    refused(call("import", "images", "in", "-o", "ds", *options.split()), 2, words)
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (ROS_CALIBRATION.replace("32", "33", 1), "33x24"),
        (ROS_CALIBRATION.replace("plumb_bob", "fov"), "known are plumb_bob"),
        (ROS_CALIBRATION.replace("32", "true", 1), "image_width: it is not a number"),
        ("a: !!opencv-matrix {}\n", "tags"),
    ],
)
def test_bad_calibrations_are_refused(text: str, words: str, tmp_path: Path) -> None:
    plain(tmp_path / "in", ["a.png"])
    (tmp_path / "c").write_text(text)
    options = ("--rate", "2", "--calibration", tmp_path / "c")
    refused(call("import", "images", tmp_path / "in", "-o", tmp_path / "ds", *options), 2, words)
    assert {path.name for path in tmp_path.iterdir()} == {"in", "c"}


# ---------------------------------------------------------------- pairs of the paper's tool


def packets(path: Path) -> tuple[list[bytes], list[Fraction]]:
    with av.open(str(path)) as container:
        found = [packet for packet in container.demux(video=0) if packet.size]
        return [bytes(packet) for packet in found], [p.pts * p.time_base for p in found]


def test_a_pair_becomes_a_dataset(tmp_path: Path) -> None:
    done = call(
        "import", "ros-mp4", FIXTURE / "drive.mp4", FIXTURE / "drive.yaml", "-o", tmp_path / "ds"
    )
    assert done.code == 0, done.err
    assert "float seconds" in done.out
    dataset = tmp_path / "ds"
    assert mp4ds.validate(dataset, deep=True) == []
    due = list(map(nanoseconds, STAMPS))
    (video,) = dataset.glob("*.mp4")
    data, shown = packets(video)
    assert data == packets(FIXTURE / "drive.mp4")[0]
    assert [int(time * 10**6) for time in shown] == [(time - due[0]) // 1000 for time in due]
    with mp4ds.open(dataset) as opened:
        assert opened.topics == [TOPICS[1]]
        stream = opened[TOPICS[1]]
        assert stream.stamps.tolist() == stream.log_times.tolist() == due
        sidecar = opened.streams[0].sidecar
        assert (sidecar.stamps, sidecar.profile) == ("record-float", "crf=22")
        frames = list(stream)
        for frame in frames:
            calibration, written = frame.intrinsics, document()["camera_info"]
            assert calibration is not None
            assert (calibration.width, calibration.height) == (frame.data.shape[1::-1])
            assert calibration.distortion_model == "plumb_bob"
            for name in "DKRP":
                assert getattr(calibration, name.lower()) == written[name]
    assert mp4ds.unpack(dataset, "bag", tmp_path / "again.bag").messages == {TOPICS[1]: 12}
    with AnyReader([tmp_path / "again.bag"]) as reader:
        for number, (connection, time, raw) in enumerate(reader.messages()):
            assert (connection.topic, connection.msgtype) == (TOPICS[1], "sensor_msgs/msg/Image")
            message: Any = reader.deserialize(raw, connection.msgtype)
            assert time == due[number]
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
            assert (message.header.seq, message.header.frame_id) == (number, "GS3_left_L")
            assert (message.encoding, message.width, message.step) == ("bgr8", 64, 3 * 64)
            assert np.array_equal(message.data, frames[number].data.ravel())
    sources = {item.name: item.sha256 for item in load_manifest(dataset / "dataset.yaml").sources}
    assert sources == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in (FIXTURE / "drive.mp4", FIXTURE / "drive.yaml")
    }
    mp4ds.pack(dataset, tmp_path / "copy")
    with mp4ds.open(dataset) as opened, mp4ds.open(tmp_path / "copy") as copied:
        assert copied.streams[0].sidecar.camera_info == opened.streams[0].sidecar.camera_info


def test_bad_pairs_are_refused(tmp_path: Path) -> None:
    video, text = tmp_path / "a.mp4", tmp_path / "b.yaml"
    shutil.copy(FIXTURE / "drive.mp4", video)
    shutil.copy(FIXTURE / "drive.yaml", text)
    output = tmp_path / "ds"

    def fails(code: int, words: str) -> None:
        done = call("import", "ros-mp4", video, text, "-o", output)
        refused(done, code, words)
        assert not [path for path in tmp_path.iterdir() if path not in (video, text)]

    write_text(text, document(STAMPS[:-1]))
    fails(1, "has the times of 11")
    content = document()
    content["camera_info"]["width"] = 66
    write_text(text, content)
    fails(1, "66x48")
    text.write_text("a: 1\n")
    fails(2, "not a complete YAML file of the tool")
    text.write_text("a: [1\n")
    fails(1, "not valid YAML")
    shutil.copy(FIXTURE / "drive.yaml", text)
    video.write_bytes(video.read_bytes()[:1000])
    fails(1, str(video))
    video.unlink()
    fails(2, "no such file")
    shutil.copy(FIXTURE / "drive.yaml", tmp_path / "of äll.yaml")
    mp4ds.import_ros_mp4(FIXTURE / "drive.mp4", tmp_path / "of äll.yaml", output)
    plain(tmp_path / "in", ["a.png", "b.png"])
    mp4ds.pack(tmp_path / "in", tmp_path / "own", folder(rate="2"))
    own = tmp_path / "own" / "camera_image_raw.yaml"
    done = call("import", "ros-mp4", own.with_suffix(".mp4"), own, "-o", tmp_path / "x")
    refused(done, 2, "not a complete YAML file of the tool")
