"""``unpack --images``: cameras as raw images, files or video packets, decoded by public libraries.

Each kind of source is given as each kind of message in each format of recording; `republished`
reads what came out and shares no code with the package.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

import mp4ds
from coded_scenes import CODED, MakeScene
from commands import call
from definitions import CODED_VIDEO, COMPRESSED, IMAGE, PACKET
from edits import agreed
from encoders import cv, nal_units
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES, foxglove_scene
from mp4ds.errors import ConversionError, FormatError
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.pictures import KINDS
from mp4ds.unpacking.republish import Republished, republished_topic
from mp4ds.unpacking.unpack import UnpackOptions, UnpackSummary
from pictures import YUV, picture, sample_format
from republished import (
    CAMERAS,
    Array,
    Read,
    decoded,
    file_picture,
    halved,
    psnr,
    read,
    shown,
    subscribed,
    truth,
)
from scenes import Record, Scene, instant, scene, together
from sources import SOURCES

TARGETS = {"bag": ".bag", "rosbag2": "", "mcap": ".mcap"}
TYPES = {
    "raw": IMAGE,
    "jpeg": COMPRESSED,
    "png": COMPRESSED,
    "compressed-video": CODED_VIDEO,
    "ffmpeg": PACKET,
}
ALREADY = {
    "raw": "they are already raw images",
    "jpeg": "they are already JPEG files",
    "png": "they are already PNG files",
    "compressed-video": "they are already CompressedVideo",
    "ffmpeg": "they are already FFMPEGPackets",
}
NO_CODEC = "CompressedVideo supports the codecs h264, h265, av1, vp9, but this video is {}"


H264 = PackOptions(codec="h264")
CODED_AS_H264 = (
    "raw-mono8",
    "raw-padded",
    "raw-rgb8",
    "raw-bgr8",
    "raw-bayer",
    "raw-nv12",
    "png-rgb",
    "png-gray",
)


class Packed:
    """A scene, its recording, and the dataset made of it."""

    def __init__(
        self, folder: Path, made: Scene, source: str, options: PackOptions | None = None
    ) -> None:
        write = SOURCES.get(source) or FOXGLOVE_SOURCES[source]
        self.folder = folder
        self.scene = made
        self.paths = write(folder / "source", made)
        self.summary = mp4ds.pack(self.paths, folder / "dataset", options or PackOptions())
        self.cameras = sorted(
            (record for record in made.messages if record.msgtype in CAMERAS),
            key=lambda record: record.log_time,
        )
        self.topic = self.cameras[0].topic

    def unpack(self, to: str, kind: str | None, **options: Any) -> tuple[UnpackSummary, list[Read]]:
        output = self.folder / f"again{TARGETS[to]}"
        chosen = UnpackOptions(images=kind, force=True, **options)
        summary = mp4ds.unpack(self.folder / "dataset", to, output, chosen)
        found = read(output)
        assert sum(summary.messages.values()) == len(found)
        return summary, found


Pack = Callable[..., Packed]


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pack]:
    """Packs a scene of a source once: scene, name of the source, options of packing."""
    found: dict[tuple[Any, ...], Packed] = {}

    def pack(name: str, source: str, options: PackOptions | None = None) -> Packed:
        key = (name, source, repr(options))
        if key not in found:
            folder = tmp_path_factory.mktemp("packed")
            best = H264 if any(part in name for part in CODED_AS_H264) else PackOptions()
            found[key] = Packed(folder, SCENES[name](), source, options or best)
        return found[key]

    yield pack
    found.clear()


def still(
    encoding: str, told: str, extension: str = ".png", *, frames: int = 6, topic: str = "compressed"
) -> Scene:
    """Files of one picture, so that a video of them is small."""
    rng = np.random.default_rng(5)
    groups = []
    for n in range(frames):
        stamp, log = instant(n, rng)
        data = cv(picture(encoding, frame=0, width=64, height=48, rng=None), extension)
        header = {"seq": 3 * n, "stamp": stamp, "frame_id": "cam"}
        values = {"header": header, "format": told, "data": data}
        groups.append([Record(f"/cam/image_raw/{topic}", COMPRESSED, log, values)])
    return together(groups)


def both(first: Scene, second: Scene) -> Scene:
    """Two scenes at once."""
    messages = [*first.messages, *second.messages]
    return Scene(sorted(messages, key=lambda message: message.log_time))


def on(topic: str, made: Scene) -> Scene:
    """The cameras of a scene alone, on another topic."""
    cameras = [record for record in made.messages if record.msgtype in CAMERAS]
    return Scene(
        [Record(topic, r.msgtype, r.log_time, r.values, publisher=r.publisher) for r in cameras]
    )


SCENES: dict[str, MakeScene | Callable[[], Scene]] = {
    **{f"raw-{name}": partial(scene, name) for name in ("mono8", "bgr8", "16UC1", "32FC1")},
    "raw-padded": partial(scene, "mono8", pad=5),
    "raw-big-endian": partial(scene, "mono16", big_endian=True),
    "raw-bayer_gbrg8": partial(scene, "bayer_gbrg8"),
    "raw-nv12": partial(scene, "nv12"),
    "png-rgb": partial(still, "bgr8", "rgb8; png compressed bgr8"),
    **{name: CODED[name] for name in CODED},
    **{f"foxglove-{name}": FOXGLOVE[name] for name in FOXGLOVE},
}

# name of a scene -> what is to become of it: given, already, or why it stays
RAW = {"raw": ALREADY["raw"], "jpeg": "given", "png": "given"}
FILE = {"raw": "given", "jpeg": "given", "png": "given"}
DEPTH = FILE | {"jpeg": "JPEG files cannot hold 16UC1 images"}
METRES = {
    "raw": "given",
    "jpeg": "JPEG files cannot hold 32FC1 images",
    "png": "PNG files cannot hold 32FC1 images",
}
VIDEO = FILE | {"compressed-video": "given"}
FFV1, MJPEG = ({"compressed-video": NO_CODEC.format(codec)} for codec in ("ffv1", "mjpeg"))
SHOWN = {"compressed-video": "given"}
MOSAIC = {"compressed-video": "its video does not show the images as they look (layout mosaic8)"}
DONE = {kind: {kind: reason} for kind, reason in ALREADY.items()}
FATES: dict[str, dict[str, str]] = {
    "raw-mono8": RAW | SHOWN,
    "raw-padded": RAW | SHOWN,
    "raw-bgr8": RAW | SHOWN,
    "raw-16UC1": RAW | DEPTH | DONE["raw"] | FFV1,
    "raw-big-endian": RAW | {"jpeg": "JPEG files cannot hold mono16 images"} | SHOWN,
    "raw-32FC1": METRES | DONE["raw"] | FFV1,
    "raw-bayer_gbrg8": RAW | MOSAIC,
    "raw-nv12": RAW | SHOWN,
    "jpeg-rgb": FILE | DONE["jpeg"] | MJPEG,
    "jpeg-gray": FILE | DONE["jpeg"] | MJPEG,
    "jpeg-420": FILE | DONE["jpeg"] | MJPEG,
    "jpeg-progressive": FILE | DONE["jpeg"] | MJPEG,
    "png-rgb": FILE | DONE["png"] | SHOWN,
    "png-gray-cv2": FILE | DONE["png"] | SHOWN,
    "png-16-bit-pillow": FILE | DONE["png"] | FFV1 | {
        "jpeg": "JPEG files cannot hold 16UC1 images"
    },
    "png-rgba-cv2": FILE | DONE["png"] | FFV1,
    "depth-16UC1-png": DEPTH | FFV1,
    "depth-16UC1-rvl": DEPTH | FFV1,
    "depth-16UC1-unnamed": DEPTH | FFV1,
    "depth-32FC1-png": METRES | FFV1,
    "depth-32FC1-rvl": METRES | FFV1,
    **{
        f"video-{name}": VIDEO | DONE["compressed-video"]
        for name in ("h264", "h264-slices", "h264-headers-once", "h265", "av1")
    },
    "ffmpeg-libx264": VIDEO,
    "ffmpeg-hevc-yuv420p-bgr8-rgb8": VIDEO,
    "ffmpeg-av1-yuv420p-bgr8-bayer_rggb8": VIDEO,
    "ffmpeg-mjpeg-yuvj420p-bgr8-bgr8": FILE | MJPEG,
    "foxglove-raw-mono8": VIDEO,
    "foxglove-raw-padded": VIDEO,
    "foxglove-raw-rgb8": VIDEO,
    "foxglove-raw-16UC1": DEPTH | FFV1,
    "foxglove-jpeg-rgb": FILE | MJPEG,
    "foxglove-jpeg-progressive": FILE | MJPEG,
    "foxglove-video-h264": VIDEO,
    "foxglove-video-h265": VIDEO,
    "foxglove-video-av1": VIDEO,
}  # fmt: skip


def fate_of(fates: dict[str, str], name: str, kind: str, to: str = "") -> str:
    """What is to become of a scene; FFMPEGPackets are as CompressedVideo but for their type."""
    if kind != "ffmpeg":
        return fates[kind]
    if name.startswith("ffmpeg") and to == "mcap":  # the other targets are of the other ROS
        return ALREADY["ffmpeg"]
    fate = fates["compressed-video"].replace("CompressedVideo supports", "FFMPEGPacket supports")
    return "given" if fate == ALREADY["compressed-video"] else fate


SOURCE_OF = {"bag": "mcap-ros2-zstd", "rosbag2": "bag-lz4", "mcap": "rosbag2-sqlite3-v9"}
"""Targets, each with a source of another format."""


def kept(made: Packed, found: Sequence[Read]) -> list[Read]:
    """Messages on the recorded topic."""
    return [message for message in found if message.topic == made.topic]


def check_times(made: Packed, found: Sequence[Read], to: str) -> None:
    """Stamps, frame ids and log times are those of the scene, in order."""
    assert len(found) == len(made.cameras)
    for message, record in zip(found, made.cameras, strict=True):
        header = record.values.get("header") or {
            "stamp": record.values["timestamp"],
            "frame_id": record.values["frame_id"],
        }
        assert message.stamp == header["stamp"]
        assert message.frame_id == header["frame_id"]
        assert message.log_time == record.log_time
        assert message.encoding == ("ros1" if to == "bag" else "cdr")


def check_pictures(name: str, kind: str, found: list[Array], expected: list[Array]) -> None:
    """Equal where nothing is lost, else near."""
    assert len(found) == len(expected)
    is_jpeg = kind == "jpeg" or name.startswith(("jpeg", "foxglove-jpeg", "ffmpeg-mjpeg"))
    for picture_, original in zip(found, expected, strict=True):
        if original.dtype.kind == "f":
            assert picture_.dtype == np.float32
            assert np.array_equal(np.isnan(picture_), np.isnan(original))
            assert np.allclose(picture_, original, rtol=1e-5, equal_nan=True)
        elif is_jpeg:
            assert picture_.shape[:2] == original.shape[:2]
            assert psnr(halved(picture_), halved(original)) > 31
        else:
            same = original if picture_.ndim == original.ndim else as_colour(original)
            assert picture_.dtype == original.dtype
            assert np.array_equal(picture_, same)


def as_colour(grey: Array) -> Array:
    return np.repeat(grey[..., None], 3, axis=2)


COMPARED = [name for name in FATES if "bayer" not in name and "nv12" not in name]


def in_turn(*tables: Sequence[str]) -> list[Any]:
    """Every combination; a part of them covers all pairs, and the others are slow."""
    turns = len(tables[-1])
    found = []
    for places in product(*(range(len(table)) for table in tables)):
        values = [table[place] for table, place in zip(tables, places, strict=True)]
        is_due = places[-1] == sum(places[:-1]) % turns
        found.append(pytest.param(*values, marks=[] if is_due else pytest.mark.slow))
    return found


@pytest.mark.one_in(20)
@pytest.mark.parametrize(("name", "kind", "to"), in_turn([*FATES], [*KINDS], [*TARGETS]))
def test_every_camera_as_every_kind(packed: Pack, name: str, kind: str, to: str) -> None:
    is_foxglove = name.startswith("foxglove")
    made = packed(name, "mcap-protobuf" if is_foxglove else SOURCE_OF[to])
    fate = fate_of(FATES[name], name, kind, to)
    topics = [made.topic] if is_foxglove else []  # the others of which no ROS can hold
    if is_foxglove and fate != "given" and to != "mcap":
        with pytest.raises(ConversionError, match=made.topic):
            made.unpack(to, kind, topics=topics)
        return
    summary, messages = made.unpack(to, kind, topics=topics)
    if fate != "given":
        assert summary.republished == {}
        assert summary.as_recorded == {made.topic: {fate: len(made.cameras)}}
        same = kept(made, messages)
        assert len(same) == len(made.cameras)
        if to == "mcap":  # of a source with the same serialization
            payloads = [record.payload("cdr") for record in made.cameras]
            is_ros = made.paths[0].suffix != ".mcap"
            assert not is_ros or [message.payload for message in same] == payloads
        return
    assert list(summary.republished) == [made.topic]
    assert summary.as_recorded == {}
    now = summary.republished[made.topic]
    assert now.instead_of == ""
    assert now.type_name == (TYPES[kind].replace("/msg/", "/") if to == "bag" else TYPES[kind])
    if now.topic != made.topic:
        assert not kept(made, messages)
    found = [message for message in messages if message.topic == now.topic]
    assert summary.messages[now.topic] == len(found)
    assert {message.type_name for message in found} == {TYPES[kind]}
    check_times(made, found, to)
    if name in COMPARED:
        is_view = any("those of its view" in note for note in summary.notes)
        if is_view:
            check_view(made, shown(found))
        else:
            check_pictures(name, kind, shown(found), truth(rvl_as_png(name, made.cameras)))


def check_view(made: Packed, found: list[Array]) -> None:
    """Pictures are those of the view, by another decoder, and look like the images."""
    with mp4ds.open(made.folder / "dataset", layer="view") as dataset:
        frames = dataset[made.topic].get(range(len(found)), format="rgb")
    assert len(found) == len(made.cameras)
    for picture_, frame, original in zip(found, frames, truth(made.cameras), strict=True):
        if original.itemsize == 2:  # which the view shows by a curve
            assert np.corrcoef(picture_[..., 1].ravel(), original.ravel())[0, 1] > 0.98
        else:
            assert psnr(halved(picture_), halved(frame.data)) > 40
            # the noise of so small a scene costs a view more than a JPEG file
            assert psnr(halved(picture_), halved(original)) > 30


def rvl_as_png(name: str, records: Sequence[Record]) -> Sequence[Record]:
    """The same depths coded as PNG, which OpenCV decodes."""
    if not name.endswith("-rvl"):
        return records
    scene_ = CODED[name.replace("-rvl", "-png")]()
    return [record for record in scene_.messages if record.msgtype == COMPRESSED]


@pytest.mark.parametrize("kind", ["compressed-video", "ffmpeg"])
@pytest.mark.parametrize("options", [{}, {"duration": 0.5}], ids=["whole", "slice"])
def test_packets_are_those_of_the_view(
    kind: str, options: dict[str, Any], with_views: Path, tmp_path: Path
) -> None:
    """Byte for byte, of a mosaic too, and what is said is that they are not what was recorded."""
    output = tmp_path / "out.mcap"
    summary = mp4ds.unpack(with_views, "mcap", output, UnpackOptions(images=kind, **options))
    assert summary.as_recorded == {}
    for topic, name in (("/left/image_raw", "left"), ("/right/image_raw", "right")):
        assert f"{topic}: its pixels differ from those recorded: they are those of its view" in (
            summary.notes
        )
        now = summary.republished[topic].topic
        found = [bytes(m.value.data) for m in read(output) if m.topic == now]
        with av.open(str(with_views / f"{name}_image_raw.mp4")) as video:
            packets = [bytes(packet) for packet in video.demux(video=0) if packet.size]
        assert 0 < len(found) <= len(packets)
        assert sum(map(len, found)) > 1000
        # key frames come with the headers that a file has in its index
        assert all(map(bytes.endswith, found, packets))


def test_jpeg_files_with_a_view_become_its_packets(packed: Pack) -> None:
    """Without one, no packets can be made of them."""
    made = packed("jpeg-rgb", "mcap-ros2-zstd", PackOptions(view="av1"))
    summary, messages = made.unpack("mcap", "compressed-video")
    assert summary.notes == [
        f"{made.topic}: its pixels differ from those recorded: they are those of its view"
    ]
    now = summary.republished[made.topic].topic
    found = shown([message for message in messages if message.topic == now])
    for picture_, original in zip(found, truth(made.cameras), strict=True):
        assert psnr(halved(picture_), halved(original)) > 31
    summary, messages = made.unpack("mcap", None)
    assert [m.payload for m in kept(made, messages)] == [r.payload("cdr") for r in made.cameras]


# ---------------------------------------------------------------- raw images as files


def files(encoding: str) -> bool:
    dtype, samples = sample_format(encoding)
    return dtype.kind == "u" and dtype.itemsize < 4 and (samples != 2 or encoding in YUV)


ENCODINGS = [
    *("mono8", "8UC1", "rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "8UC4", "mono16", "16UC1"),
    *("rgb16", "bgra16", "16UC3", "bayer_rggb8", "bayer_grbg16", "yuv422", "nv21"),
    *("8UC2", "16UC2", "8SC1", "16SC1", "32FC3"),
]


@pytest.mark.one_in(8)
@pytest.mark.parametrize("target", ["bag", "mcap"])
@pytest.mark.parametrize("kind", ["png", "jpeg"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_files_of_every_encoding(encoding: str, kind: str, target: str, tmp_path: Path) -> None:
    """A subscriber is given what was recorded, or something that looks like it."""
    made = Packed(tmp_path, scene(encoding, noisy=False, frames=3), "mcap-ros2-none")
    summary, messages = made.unpack(target, kind)
    itemsize = sample_format(encoding)[0].itemsize
    if not files(encoding) or (kind == "jpeg" and itemsize == 2):
        reason = f"{kind.upper()} files cannot hold {encoding} images"
        assert summary.as_recorded == {"/cam/image_raw": {reason: 3}}
        return
    found = [message for message in messages if message.type_name == COMPRESSED]
    assert len(found) == 3
    for number, (message, record) in enumerate(zip(found, made.cameras, strict=True)):
        told, data = message.value.format, message.value.data.tobytes()
        assert data.startswith(b"\x89PNG" if kind == "png" else b"\xff\xd8")
        assert f"; {kind} compressed " in told
        given, image = subscribed(told, data)
        original = truth([record])[0]
        if kind == "png" and encoding not in YUV:
            assert given == encoding
            raw = picture(encoding, frame=number, width=64, height=48, rng=None)
            assert image.dtype == raw.dtype
            assert np.array_equal(image, raw)
            continue
        colour = picture("rgb8", frame=number, width=64, height=48, rng=None)
        if "bayer" in encoding or encoding in YUV:
            assert given == "rgb8"
            # chroma of half the resolution, or a mosaic's colours guessed
            inner = (slice(2, -2), slice(2, -2))
            assert psnr(image[inner], colour[inner]) > 18
        else:
            assert given == encoding.replace("8UC4", "8UC3")
            assert psnr(file_picture(data), original) > 33


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_the_encoding_in_a_format_tells_a_mosaic(extension: str, tmp_path: Path) -> None:
    """As in compressed_image_transport, whose files of a mosaic are grey."""
    own = "png" if extension == ".png" else "jpeg"
    told = f"bayer_rggb8; {own} compressed "
    made = Packed(tmp_path, still("bayer_rggb8", told, extension), "bag-none")
    raw = [m for m in made.unpack("bag", "raw")[1] if m.type_name == IMAGE]
    assert {message.value.encoding for message in raw} == {"bayer_rggb8"}
    other = "jpeg" if own == "png" else "png"
    files_ = [m for m in made.unpack("bag", other)[1] if m.type_name == COMPRESSED]
    new = "rgb8; jpeg compressed bgr8" if other == "jpeg" else "bayer_rggb8; png compressed "
    assert {message.value.format for message in files_} == {new}
    for image, original in zip(shown(raw), truth(made.cameras), strict=True):
        assert np.array_equal(image, original) or (own == "jpeg" and psnr(image, original) > 45)
    if other == "jpeg":
        colour = picture("rgb8", frame=0, width=64, height=48, rng=None)
        assert psnr(shown(files_)[0][2:-2, 2:-2], colour[2:-2, 2:-2]) > 18
    else:
        assert all(map(np.array_equal, shown(files_), shown(raw)))


# ---------------------------------------------------------------- files stay as they are


@pytest.mark.one_in(3)
@pytest.mark.parametrize("to", ["bag", "mcap"])
@pytest.mark.parametrize(
    ("name", "source", "kind"),
    [
        ("foxglove-jpeg-progressive", "mcap-protobuf", "jpeg"),
        ("foxglove-jpeg-rgb", "mcap-protobuf-stamp-last", "jpeg"),
        ("ffmpeg-mjpeg-yuvj420p-bgr8-bgr8", "mcap-ros2-zstd", "jpeg"),
        ("jpeg-exif-trailing", "mcap-ros2-zstd", "jpeg"),
        ("png-gray-pillow", "mcap-ros2-zstd", "png"),
    ],
)
def test_files_stay_byte_for_byte(packed: Pack, name: str, source: str, kind: str, to: str) -> None:
    made = packed(name, source)
    messages = made.unpack(to, kind, topics=[made.topic])[1]
    assert {message.type_name for message in messages} == {COMPRESSED}
    found = [message.value.data.tobytes() for message in messages]
    assert found == [record.values["data"] for record in made.cameras]


JPEG_KINDS = [
    *("jpeg-rgb", "jpeg-420", "jpeg-422", "jpeg-444", "jpeg-gray", "jpeg-progressive"),
    *("jpeg-restart", "jpeg-no-huffman-tables", "jpeg-exif-trailing"),
    "ffmpeg-mjpeg-yuvj420p-bgr8-bgr8",
]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", JPEG_KINDS)
def test_jpeg_pixels_are_those_of_opencv(packed: Pack, name: str) -> None:
    """By number, in order, as raw messages and as PNG: what cv2.imdecode gives."""
    made = packed(name, "mcap-ros2-zstd")
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    due = [
        cv2.imdecode(np.frombuffer(record.values["data"], np.uint8), flags)
        for record in made.cameras
    ]
    rgb = [image if image.ndim == 2 else image[:, :, ::-1] for image in due]
    with mp4ds.open(made.folder / "dataset") as dataset:
        stream = dataset[made.topic]
        assert np.array_equal(stream[3].data, rgb[3])
        shown = stream.read([5, 0, 1])[1]
        assert np.array_equal(shown, np.broadcast_to(rgb[0].T, shown.T.shape).T)
        assert all(np.array_equal(frame.data, rgb[frame.index]) for frame in stream)
    raw = made.unpack("mcap", "raw", topics=[made.topic])[1]
    assert [bytes(message.value.data) for message in raw] == [image.tobytes() for image in rgb]
    target = made.folder / "as_png"
    mp4ds.export(made.folder / "dataset", "euroc", target, mp4ds.ExportOptions(force=True))
    for path, image in zip(sorted(target.rglob("*.png")), due, strict=True):
        assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), image)


# ---------------------------------------------------------------- transcoded JPEG

TRANSCODED = PackOptions(transcode=True, quality="crf=20")


@pytest.mark.parametrize("name", ["jpeg-rgb", "jpeg-gray"])
def test_transcoded_jpeg_returns_as_jpeg(packed: Pack, name: str) -> None:
    made = packed(name, "mcap-ros2-zstd", TRANSCODED)
    sizes = {}
    for quality in (30, 95):
        summary, messages = made.unpack("mcap", None, jpeg_quality=quality)
        found = kept(made, messages)
        check_times(made, found, "mcap")
        assert [m.value.format for m in found] == [r.values["format"] for r in made.cameras]
        assert summary.republished == summary.as_recorded == {}
        for image, original in zip(shown(found), truth(made.cameras), strict=True):
            assert image.shape == original.shape  # of as many components
            assert psnr(image, original) > 22
        sizes[quality] = sum(len(message.payload) for message in found)
        again = kept(made, made.unpack("mcap", "jpeg", jpeg_quality=quality)[1])
        assert [m.payload for m in again] == [m.payload for m in found]
    assert sizes[30] < 0.8 * sizes[95]


# ---------------------------------------------------------------- video without decoding


@pytest.mark.parametrize("codec", ["h264", "h265", "av1"])
@pytest.mark.parametrize("encoding", ["rgb8", "bayer_rggb8"])
def test_lossy_video(encoding: str, codec: str, tmp_path: Path) -> None:
    options = PackOptions(quality="crf=18", codec=codec, gop=3)
    made = Packed(tmp_path, scene(encoding, noisy=False), "bag-none", options)
    found = made.unpack("rosbag2", "compressed-video", topics=["/cam/image_raw"])[1]
    assert {message.value.format for message in found} == {codec}
    check_times(made, found, "rosbag2")
    for number, image in enumerate(shown(found)):
        original = picture("rgb8", frame=number, width=64, height=48, rng=None)
        assert psnr(image[2:-2, 2:-2], original[2:-2, 2:-2]) > 18
    check_stand_alone(codec, found)


def check_stand_alone(codec: str, found: Sequence[Read]) -> None:
    """Key frames hold what a decoder needs: it can begin at any of them."""
    data = [message.value.data.tobytes() for message in found]
    if codec in ("h264", "h265"):
        assert all(packet.startswith(b"\0\0\0\1") for packet in data)
        kinds = [
            {unit[0] & 31 if codec == "h264" else unit[0] >> 1 & 63 for _, unit in nal_units(p)}
            for p in data
        ]
        keys = [
            n for n, kind in enumerate(kinds) if kind & ({5} if codec == "h264" else {19, 20, 21})
        ]
        needed = {7, 8} if codec == "h264" else {32, 33, 34}
        assert all(needed <= kinds[n] for n in keys)
    else:
        assert all(packet.startswith(b"\x12\0") for packet in data)
        keys = [n for n, packet in enumerate(data) if packet[2] >> 3 & 15 == 1]
    assert keys[0] == 0
    assert len(keys) > 1
    name = {"h265": "hevc", "av1": "libdav1d"}.get(codec, codec)
    whole, tail = decoded(name, data), decoded(name, data[keys[-1] :])
    assert all(map(np.array_equal, whole[keys[-1] :], tail))


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("ffmpeg-libx264", "h264"),
        ("ffmpeg-hevc-yuv420p-bgr8-rgb8", "h265"),
        ("ffmpeg-av1-yuv420p-bgr8-bayer_rggb8", "av1"),
        ("foxglove-video-h264", "h264"),
    ],
)
def test_recorded_packets_stand_alone(packed: Pack, name: str, codec: str) -> None:
    made = packed(name, "mcap-protobuf" if "foxglove" in name else "mcap-ros2-zstd")
    found = made.unpack("mcap", "compressed-video", topics=[made.topic])[1]
    assert {message.value.format for message in found} == {codec}
    check_stand_alone(codec, found)
    for message, record in zip(found, made.cameras, strict=True):
        data, recorded = message.value.data.tobytes(), record.values["data"]
        if codec == "av1":
            assert data == recorded
        else:  # start codes have four bytes now
            assert [unit for _, unit in nal_units(data)] == [u for _, u in nal_units(recorded)]


def test_parameters_sent_once_are_repeated(tmp_path: Path) -> None:
    """As Foxglove wants it; a recorded CompressedVideo of ROS stays as it is."""
    made = Packed(tmp_path, foxglove_scene(CODED["video-h264-headers-once"]), "mcap-protobuf")
    found = made.unpack("mcap", "compressed-video", topics=[made.topic])[1]
    check_stand_alone("h264", found)


# ---------------------------------------------------------------- what stays


def test_verbatim_messages_stay_and_are_counted(packed: Pack) -> None:
    made = packed("jpeg-cut-one", "mcap-ros2-zstd")
    summary, messages = made.unpack("mcap", "raw")
    assert summary.republished == {made.topic: Republished("/cam/image_raw", IMAGE)}
    (reason,) = summary.as_recorded[made.topic]
    assert reason.startswith("stored verbatim: its JPEG is cut short")
    assert summary.as_recorded == {made.topic: {reason: 1}}
    assert summary.messages[made.topic] == 1
    assert summary.messages["/cam/image_raw"] == len(made.cameras) - 1
    (stayed,) = kept(made, messages)
    assert stayed.payload == made.cameras[3].payload("cdr")
    order = [m.stamp for m in messages if m.topic in (made.topic, "/cam/image_raw")]
    assert order == [record.values["header"]["stamp"] for record in made.cameras]


def test_packets_that_do_not_decode_stay(packed: Pack, tmp_path: Path) -> None:
    """Those that refer to a lost one."""
    made = packed("video-h265-lost", "mcap-ros2-zstd")
    summary, messages = made.unpack("mcap", "raw")
    reason = "its picture cannot be decoded"
    count = summary.as_recorded[made.topic][reason]
    assert 0 < count < len(made.cameras)
    stayed = kept(made, messages)
    payloads = {record.values["timestamp"]: record.payload("cdr") for record in made.cameras}
    assert len(stayed) == count
    assert all(message.payload == payloads[message.stamp] for message in stayed)
    raw = [message for message in messages if message.type_name == IMAGE]
    stamps = [message.stamp for message in sorted([*raw, *stayed], key=lambda m: m.log_time)]
    assert stamps == [record.values["timestamp"] for record in made.cameras]
    assert summary.messages == {
        topic: len([m for m in messages if m.topic == topic]) for topic in summary.messages
    }
    told = mp4ds.export(made.folder / "dataset", "images", tmp_path / "images")
    assert told.left_out[made.topic] == {reason: count}
    (path,) = tmp_path.rglob("stamps.csv")
    times = [int(row.split(",")[1]) for row in path.read_text().splitlines()[1:]]
    assert times == [time for time in stamps if time not in {one.stamp for one in stayed}]
    assert len([*tmp_path.rglob("*.png")]) == len(made.cameras) - count


def test_a_camera_that_changes(packed: Pack, tmp_path: Path) -> None:
    """Streams of one topic come in the recorded order; each becomes what it can."""
    made = packed("jpeg-mixed-sizes", "bag-none")
    messages = made.unpack("bag", "raw")[1]
    found = [message for message in messages if message.type_name == IMAGE]
    check_times(made, found, "bag")
    assert len({message.value.width for message in found}) == 2
    assert [image.shape for image in shown(found)] == [t.shape for t in truth(made.cameras)]
    for image, original in zip(shown(found), truth(made.cameras), strict=True):
        assert psnr(halved(image), halved(original)) > 31
    first, then = scene("mono8", frames=4), scene("16UC1", frames=8)
    late = Scene([r for r in then.messages if r.log_time > first.messages[-1].log_time])
    changing = Packed(tmp_path, both(first, late), "mcap-ros2-zstd")
    summary, messages = changing.unpack("mcap", "jpeg")
    count = len([r for r in late.messages if r.msgtype == IMAGE])
    assert summary.as_recorded == {"/cam/image_raw": {"JPEG files cannot hold 16UC1 images": count}}
    assert summary.messages["/cam/image_raw"] == count > 1
    assert summary.messages["/cam/image_raw/compressed"] == 4


def test_other_topics_stay_byte_for_byte(packed: Pack) -> None:
    made = packed("raw-mono8", "mcap-ros2-zstd")
    found = [made.unpack("mcap", None)[1], made.unpack("mcap", "png")[1]]
    others = [
        [
            (m.topic, m.type_name, m.log_time, m.publish_time, m.sequence, m.payload, m.metadata)
            for m in messages
            if "image_raw" not in m.topic
        ]
        for messages in found
    ]
    assert others[0] == others[1] != []
    assert len(found[1]) == len(found[0])


@pytest.mark.parametrize(
    ("name", "suffix", "every"),
    [
        ("raw-mono8", "", 2),
        ("ffmpeg-libx264", "", 1),
        ("jpeg-exif-trailing", "jpg", 2),
        ("jpeg-mixed-sizes", "jpg", 1),
        ("ffmpeg-mjpeg-yuvj420p-bgr8-bgr8", "jpg", 1),
        ("png-rgb", "png", 2),
        ("depth-16UC1-png", "png", 1),
        ("depth-32FC1-png", "png", 1),
    ],
)
def test_folders_of_images(
    packed: Pack, name: str, suffix: str, every: int, tmp_path: Path
) -> None:
    """Files are those recorded, whose suffix is given; others have the exact pixels."""
    made = packed(name, "mcap-ros2-zstd")
    chosen = mp4ds.ExportOptions(topics=[made.topic], every=every)
    summary = mp4ds.export(made.folder / "dataset", "images", tmp_path / "out", chosen)
    with mp4ds.open(made.folder / "dataset") as dataset:
        frames = list(dataset[made.topic])[::every]
    assert summary.messages == {made.topic: len(frames)}
    assert any("quantised" in note for note in summary.notes) == ("32FC1" in name)
    ((place, topic),) = summary.places.items()
    folder = tmp_path / "out" / place
    with (folder / "stamps.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, frame in zip(rows, frames, strict=True):
        record = made.cameras[frame.index]
        times = (record.values["header"]["stamp"], record.log_time)
        assert (int(row["stamp_ns"]), int(row["log_time_ns"])) == times
        assert (topic, row["frame_id"]) == (made.topic, "cam")
        assert row["file"] == f"{frame.index:0{len(str(len(made.cameras) - 1))}d}.{suffix or 'png'}"
        data = (folder / row["file"]).read_bytes()
        if suffix:
            assert bytes(record.values["data"]).endswith(data)
        if suffix != "jpg":
            assert np.array_equal(file_picture(data), frame.data)


# ---------------------------------------------------------------- channels


def md5sum(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


MD5SUMS = {
    "raw": "060021388200f6f0f447d0fcd9c64743",  # as ROS 1 has them
    "jpeg": "8f7a12909da2c9d3332d540a0977563f",
    "compressed-video": md5sum("time timestamp\nstring frame_id\nuint8[] data\nstring format"),
    "ffmpeg": md5sum(
        "2176decaecbce78abc3b96ef049fabed header\nuint8[] data\nint32 img_width\n"
        "int32 img_height\nstring encoding\nuint64 pts\nuint8 flags"
    ),
}
CHANGES = [
    ("jpeg-rgb", "raw"),
    ("raw-mono8", "jpeg"),
    ("raw-mono8", "compressed-video"),
    ("raw-mono8", "ffmpeg"),
]


@pytest.mark.parametrize("source", ["bag-none", "mcap-ros1-zstd", "mcap-ros2-zstd"])
@pytest.mark.parametrize(("name", "kind"), CHANGES)
def test_channels_of_ros1(packed: Pack, name: str, kind: str, source: str) -> None:
    made = packed(name, source)
    for to in ("bag", "mcap") if source != "mcap-ros2-zstd" else ("bag",):
        _, messages = made.unpack(to, kind)
        found = [message for message in messages if message.type_name == TYPES[kind]]
        assert {message.encoding for message in found} == {"ros1"}
        metadata = found[0].metadata
        assert MD5SUMS[kind] in (metadata.get("digest"), metadata.get("md5sum"))
        if source != "mcap-ros2-zstd":
            assert metadata["callerid"] == "/first"
            assert metadata.get("topic", found[0].topic) == found[0].topic
        if kind != "compressed-video":
            seqs = [record.values["header"]["seq"] for record in made.cameras]
            expected = [0] * len(seqs) if source == "mcap-ros2-zstd" else seqs
            assert [message.value.header.seq for message in found] == expected


# ---------------------------------------------------------------- topics


@pytest.mark.parametrize(
    ("topic", "type_name", "kind", "expected"),
    [
        ("/cam/image_raw", "sensor_msgs/Image", "jpeg", "/cam/image_raw/compressed"),
        ("/cam", "foxglove.RawImage", "compressed-video", "/cam/compressed_video"),
        ("/cam/compressed", "sensor_msgs/Image", "jpeg", "/cam/compressed/compressed"),
        ("/cam/compressed", "sensor_msgs/CompressedImage", "raw", "/cam"),
        ("/cam/compressedDepth", "sensor_msgs/CompressedImage", "png", "/cam/compressed"),
        ("/cam/jpg", "sensor_msgs/CompressedImage", "raw", "/cam/jpg/raw"),
        ("/cam/ffmpeg", "x/msg/FFMPEGPacket", "compressed-video", "/cam/compressed_video"),
        ("/video", "foxglove.CompressedVideo", "compressed-video", "/video"),
        ("/compressed", "sensor_msgs/CompressedImage", "raw", "/compressed/raw"),
        ("", "sensor_msgs/Image", "jpeg", "/compressed"),
    ],
)
def test_topics_are_those_of_image_transport(
    topic: str, type_name: str, kind: str, expected: str
) -> None:
    assert republished_topic(topic, type_name, kind) == expected


# ---------------------------------------------------------------- options, errors, command line


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("raw-mono8", "compressed-video"),
        ("raw-mono8", "jpeg"),
        ("ffmpeg-libx264", "compressed-video"),
        ("video-h264", "raw"),
        ("jpeg-rgb", "raw"),
        ("depth-16UC1-png", "raw"),
        ("depth-16UC1-png", "png"),
        ("raw-bgr8", "files"),
        ("raw-bgr8", "export"),
    ],
)
@pytest.mark.parametrize("with_sum", [True, False])
def test_a_damaged_video_is_refused(name: str, kind: str, with_sum: bool, tmp_path: Path) -> None:
    """Before anything is made of it, whether its hash tells of the damage or its messages do."""
    made = Packed(tmp_path, SCENES[name](), "mcap-ros2-zstd")
    video = min((tmp_path / "dataset").glob("*.mp4"), key=lambda path: len(path.name))
    with av.open(str(video)) as opened:
        entry = opened.streams.video[0].index_entries[3]
    data = bytearray(video.read_bytes())
    data[entry.pos + entry.size * 2 // 3] ^= 0x10
    video.write_bytes(data)
    if not with_sum:
        without_sum(video.with_suffix(".yaml"))
        agreed(tmp_path / "dataset")
    makes: dict[str, Callable[[], Any]] = {
        "files": lambda: mp4ds.export(tmp_path / "dataset", "images", tmp_path / "again"),
        "export": lambda: mp4ds.export(tmp_path / "dataset", "euroc", tmp_path / "again"),
    }
    with pytest.raises(FormatError) as caught:
        makes.get(kind, lambda: made.unpack("mcap", kind))()
    assert not with_sum or caught.value.code in REFUSED
    assert {path.name for path in tmp_path.iterdir()} == {"dataset", "source"}


REFUSED = ("hash-mismatch", "digest-mismatch", "decode-failed")


def without_sum(sidecar: Path) -> None:
    lines = sidecar.read_text("utf-8").splitlines(keepends=True)
    kept_ = [line for line in lines if not line.startswith(("  sha256:", "  size:", "checksum:"))]
    sidecar.write_text("".join(kept_), "utf-8")


def test_the_command_line(packed: Pack, tmp_path: Path) -> None:
    made = packed("jpeg-cut-one", "mcap-ros2-zstd")
    arguments = ["unpack", made.folder / "dataset", "--to", "mcap", "--images", "png"]
    done = call(*arguments, "--jpeg-quality", "80", "-o", tmp_path / "a.mcap")
    assert done.code == 0, done.err
    now = "/cam/image_raw/compressed_png, sensor_msgs/msg/CompressedImage"
    assert f"/cam/image_raw/compressed: written as {now}" in done.out
    assert "(the name /cam/image_raw/compressed is taken)" in done.out
    assert "/cam/image_raw/compressed: 1 message as recorded: stored verbatim" in done.out
    done = call(*arguments, "--json", "-o", tmp_path / "b.mcap")
    told = json.loads(done.out)
    assert told["republished"]["/cam/image_raw/compressed"]["topic"].endswith("compressed_png")
    assert list(told["as_recorded"]["/cam/image_raw/compressed"].values()) == [1]
