"""``unpack --images ffmpeg``: packets as the subscriber of ffmpeg_image_transport takes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from definitions import PACKET
from mp4ds.dataset.dataset import Dataset
from mp4ds.format.fields import Choice, DecodedColumns, everything
from mp4ds.packing.options import PackOptions
from mp4ds.records import Message
from mp4ds.unpacking.republish import Republisher
from pictures import picture
from republished import SMOOTH, Read, psnr
from scenes import scene
from test_republish import Packed

FRAMES = 20
TOPIC = "/cam/image_raw/ffmpeg"
SINGLE = {"codec": "h264", "view": "none"}
# encoding of the images, options of the pack, what ROS 2 and ROS 1 call it
CASES: dict[str, tuple[str, dict[str, Any], str, str]] = {
    "lossless-rgb8": ("rgb8", SINGLE, "h264;gbrp;bgr8;rgb8", "libx264"),
    "lossless-bgr8": ("bgr8", SINGLE, "h264;gbrp;bgr8;bgr8", "libx264"),
    "lossless-mono8": ("mono8", SINGLE, "h264;yuv420p;mono8;mono8", "libx264"),
    "lossy-rgb8": (
        "rgb8",
        {"codec": "h265", "quality": "crf=12"},
        "hevc;yuv420p;bgr8;rgb8",
        "hevc_nvenc",
    ),
    "lossy-bayer": (
        "bayer_rggb8",
        {"codec": "h264", "quality": "crf=12"},
        "h264;yuv420p;bgr8;bgr8",
        "libx264",
    ),
    "lossy-av1": (
        "bgr8",
        {"codec": "av1", "quality": "crf=12"},
        "av1;yuv420p;bgr8;bgr8",
        "av1",
    ),
}
FORMATS = {"rgb8": "rgb24", "bgr8": "bgr24", "mono8": "gray"}


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Packed]]:
    """Packs a case once."""
    found: dict[str, Packed] = {}

    def pack(name: str) -> Packed:
        if name not in found:
            encoding, options, _, _ = CASES[name]
            made = scene(encoding, frames=FRAMES, noisy=False)
            folder = tmp_path_factory.mktemp("packed")
            found[name] = Packed(folder, made, "bag-none", PackOptions(gop=6, **options))
        return found[name]

    yield pack
    found.clear()


def subscribed(values: Sequence[Any], *, ros1: bool) -> dict[int, NDArray[Any]]:
    """The images by pts: begins with the first key frame, decodes by what the encoding tells."""
    context: Any = None
    told = ""
    frames = []
    for value in values:
        if context is None:
            if not value.flags:
                continue
            told = value.encoding
            names = {"libx264": "h264", "hevc_nvenc": "hevc", "av1": "libdav1d"}
            name = told.partition(";")[0]
            context = av.CodecContext.create(names.get(name, name), "r")
            context.thread_count = 1
        assert value.encoding == told  # it may not change on the way
        packet = av.Packet(value.data.tobytes())
        packet.pts = packet.dts = value.pts
        frames += context.decode(packet)
    frames += context.decode(None)
    output = "bgr8" if ros1 else told.split(";")[3]
    convert = VideoReformatter().reformat
    smooth: Any = SMOOTH
    made = ((f.pts, convert(f, format=FORMATS[output], interpolation=smooth)) for f in frames)
    return {pts: frame.to_ndarray() for pts, frame in made}


def original(encoding: str, number: int, shown: str) -> NDArray[Any]:
    if encoding == "mono8" and shown == "mono8":
        return picture("mono8", frame=number, width=64, height=48, rng=None)
    grey = encoding == "mono8"
    made = picture("mono8" if grey else "bgr8", frame=number, width=64, height=48, rng=None)
    made = np.repeat(made[..., None], 3, axis=2) if grey else made
    return made[..., ::-1] if shown == "rgb8" else made


def check(found: Sequence[Read], name: str, *, ros1: bool) -> None:
    encoding, _, ros2_name, ros1_name = CASES[name]
    values = [message.value for message in found]
    told = ros1_name if ros1 else ros2_name
    assert {value.encoding for value in values} == {told}
    assert [value.pts for value in values] == list(range(FRAMES))
    keys = [value.pts for value in values if value.flags]
    assert keys[0] == 0
    assert len(keys) > 1
    assert {value.flags for value in values} == {0, 1}
    shown = "bgr8" if ros1 else told.split(";")[3]
    for first in (0, 1, keys[-1]):  # a subscriber may come late
        images = subscribed(values[first:], ros1=ros1)
        begun = next(key for key in keys if key >= first)
        assert sorted(images) == list(range(begun, FRAMES))
        for number, image in images.items():
            expected = original(encoding, number, shown)
            if name.startswith("lossless"):
                assert np.array_equal(image, expected)
            else:
                assert psnr(image[2:-2, 2:-2], expected[2:-2, 2:-2]) > 18


@pytest.mark.parametrize("to", ["rosbag2", "bag"])
@pytest.mark.parametrize("name", CASES)
def test_a_subscriber_sees_the_images(packed: Callable[[str], Packed], name: str, to: str) -> None:
    made = packed(name)
    summary, messages = made.unpack(to, "ffmpeg")
    now = summary.republished[made.topic]
    assert (now.topic, now.type_name.replace("/msg/", "/")) == (TOPIC, PACKET.replace("/msg", ""))
    found = [message for message in messages if message.topic == TOPIC]
    assert {message.type_name for message in found} == {PACKET}
    for message, record in zip(found, made.cameras, strict=True):
        header = record.values["header"]
        assert (message.stamp, message.frame_id) == (header["stamp"], header["frame_id"])
        value = message.value
        if to == "bag":
            assert (value.img_width, value.img_height) == (64, 48)
            assert value.header.seq == header["seq"]
        else:
            assert (value.width, value.height, value.is_bigendian) == (64, 48, False)
    check(found, name, ros1=to == "bag")


# ffmpeg_image_transport_msgs, msg/FFMPEGPacket.msg: of ROS 2, and of the package for ROS 1
DEFINITIONS = {
    "rosbag2": (
        Stores.ROS2_HUMBLE,
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n"
        "uint8 flags\nbool is_bigendian\nuint8[] data\n",
    ),
    "bag": (
        Stores.ROS1_NOETIC,
        "Header header\nuint8[] data\nint32 img_width\nint32 img_height\nstring encoding\n"
        "uint64 pts\nuint8 flags\n",
    ),
}


@pytest.mark.parametrize("to", DEFINITIONS)
def test_the_messages_are_those_of_a_public_library(
    packed: Callable[[str], Packed], to: str
) -> None:
    """To the byte, and so are the hashes of the type."""
    kind, text = DEFINITIONS[to]
    store = get_typestore(kind)
    store.register(get_types_from_msg(text, PACKET))
    found = [m for m in packed("lossless-rgb8").unpack(to, "ffmpeg")[1] if m.topic == TOPIC]
    for message in found:
        if to == "bag":
            again = store.serialize_ros1(store.deserialize_ros1(message.payload, PACKET), PACKET)
        else:
            again = store.serialize_cdr(store.deserialize_cdr(message.payload, PACKET), PACKET)
        assert bytes(again) == message.payload
    ros1, ros2 = (store.generate_msgdef, store.hash_rihs01)
    digest = ros1(PACKET, ros_version=1)[1] if to == "bag" else ros2(PACKET)
    assert {message.metadata["digest"] for message in found} == {digest}


@pytest.mark.parametrize(
    ("first", "skipped", "expected"),
    [
        (8, (), range(6, FRAMES)),
        (12, (), range(12, FRAMES)),
        (0, range(2, 4), range(FRAMES)),
        (1, range(3, 13), [*range(3), *range(12, FRAMES)]),
    ],
)
def test_a_video_is_joined_at_a_key_frame(
    packed: Callable[[str], Packed],
    first: int,
    skipped: Sequence[int],
    expected: Sequence[int],
) -> None:
    """What is wanted comes with the packets that it refers to."""

    def chosen(columns: DecodedColumns) -> Iterator[int]:
        return (index for index in everything(columns) if index not in skipped)

    choose: Choice = chosen if skipped else everything
    with Dataset(packed("lossless-mono8").folder / "dataset") as dataset:
        republisher = Republisher(
            dataset, "ros2", selected=lambda topic: True, converts_all=False, kind="ffmpeg"
        )
        (stream,) = dataset.streams
        start = int(stream.log_times[first])
        records = dataset.records(republisher.sources, start=start, choose=choose)
        images = [
            record
            for record in records
            if isinstance(record, Message) and republisher.makes(record.channel)
        ]
        times = {int(time): number for number, time in enumerate(stream.log_times)}
    assert [times[record.log_time] for record in images] == list(expected)
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DEFINITIONS["rosbag2"][1], PACKET))
    values = [store.deserialize_cdr(bytes(record.data), PACKET) for record in images]
    for number, image in subscribed(values, ros1=False).items():
        assert np.array_equal(image, original("mono8", number, "mono8"))
