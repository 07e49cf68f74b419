"""Which calibrations belong to which images: by choice, by name."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mp4ds
from mp4ds.errors import OptionError
from mp4ds.packing.inspection import (
    choose_pairs,
    pair_camera_infos,
)
from mp4ds.records import Channel, Schema
from scenes import Scene, scene
from sources import write_bag

RAW = ("sensor_msgs/Image", "sensor_msgs/msg/Image", "foxglove.RawImage", "foxglove_msgs/RawImage")
CODED = (
    *("sensor_msgs/CompressedImage", "sensor_msgs/msg/CompressedImage"),
    *("foxglove.CompressedImage", "foxglove_msgs/msg/CompressedImage"),
    *("foxglove.CompressedVideo", "foxglove_msgs/msg/CompressedVideo"),
    *("ffmpeg_image_transport_msgs/FFMPEGPacket", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"),
)
INFO = (
    *("sensor_msgs/CameraInfo", "sensor_msgs/msg/CameraInfo"),
    *("foxglove.CameraCalibration", "foxglove_msgs/msg/CameraCalibration"),
)
CODED_NAMES = ("compressed", "compressedDepth", "ffmpeg", "foxglove", "video", "jpeg")


def channel(number: int, topic: str, type_name: str) -> Channel:
    encoding = "ros1" if type_name.count("/") == 1 else "cdr" if "/" in type_name else "protobuf"
    return Channel(number, topic, encoding, Schema(type_name, "", b""))


def channels(*topics: str) -> list[Channel]:
    """Channels by topic, numbered; the last part tells what they hold."""
    found = []
    for number, topic in enumerate(topics):
        leaf = topic.strip("/").split("/")[-1]
        kind = INFO if "info" in leaf or "calib" in leaf else CODED if leaf in CODED_NAMES else RAW
        found.append(channel(number, topic, "std_msgs/String" if leaf == "chat" else kind[0]))
    return found


# ---------------------------------------------------------------- by name

BY_NAME: list[tuple[list[str], dict[int, int]]] = [
    (["/cam/image_raw", "/cam/camera_info"], {1: 0}),
    (["/cam/camera_info", "/cam/image_raw"], {0: 1}),
    (["/cam/image_color", "/cam/image_raw", "/cam/camera_info"], {2: 1}),
    (["/l/image_raw", "/r/image_raw", "/r/camera_info", "/l/camera_info"], {2: 1, 3: 0}),
    (["/cam/image_raw", "/other/camera_info"], {}),
    (["/cam/image_raw", "/cam/left_info"], {}),
    (["/cam/deep/image_raw", "/cam/camera_info"], {}),
    (["/camera_info", "/image_raw"], {0: 1}),
    (["image_raw", "/camera_info"], {1: 0}),
    (["/cam/image_raw", "/cam/camera_info", "/cam/camera_info"], {}),  # several publishers
    (["/cam/image_raw", "/cam/image_raw", "/cam/camera_info"], {2: 0}),
    # transports have the calibration of the image that they carry
    *((["/cam/image_raw/" + name, "/cam/camera_info"], {1: 0}) for name in CODED_NAMES[:4]),
    (["/cam/image_raw/video", "/cam/image_raw/camera_info"], {1: 0}),
    (["/cam/image_raw/compressed", "/cam/image_raw/camera_info"], {1: 0}),
    (["/cam/compressed", "/cam/camera_info"], {1: 0}),
    (["/cam/compressed", "/cam/image_raw/compressed", "/cam/camera_info"], {2: 1}),
    (["compressed", "camera_info"], {1: 0}),
    (["/cam/image_raw/compressed", "/cam/image_mono", "/cam/camera_info"], {2: 1}),  # raw first
    (["/cam/image_raw/ffmpeg", "/cam/image_raw/compressed", "/cam/camera_info"], {2: 1}),
    # librealsense's
    (["/d/s0/Depth_0/image/data", "/d/s0/Depth_0/info/camera_info",
      "/d/s1/Color_0/info/camera_info", "/d/s1/Color_0/image/data"], {1: 0, 2: 3}),
    (["/d/data", "/d/info/camera_info"], {}),
    # Foxglove's name
    (["/cam/video", "/cam/calibration"], {1: 0}),
    (["/cam/image_raw", "/cam/image_raw/compressed", "/cam/calibration", "/cam/camera_info"],
     {3: 0, 2: 1}),
    (["/cam/image_raw", "/cam/calib"], {}),
]  # fmt: skip


@pytest.mark.parametrize(("topics", "pairs"), BY_NAME)
def test_calibrations_belong_to_the_image_beside_them(
    topics: list[str], pairs: dict[int, int]
) -> None:
    assert pair_camera_infos(channels(*topics)) == pairs
    assert pair_camera_infos(channels(*topics)[::-1]) == pairs


Topics = st.lists(
    st.sampled_from(["cam", "l", "image_raw", "image", "compressed", "camera_info", "calibration"]),
    min_size=1,
    max_size=4,
).map("/".join)


@settings(deadline=None)
@given(
    st.lists(st.tuples(Topics, st.sampled_from([RAW[0], CODED[0], INFO[0]])), max_size=12),
    st.randoms(),
)
def test_pairs_are_of_one_to_one_whatever_the_order(
    topics: list[tuple[str, str]], order: random.Random
) -> None:
    found = [channel(n, topic, type_name) for n, (topic, type_name) in enumerate(topics)]
    pairs = pair_camera_infos(found)
    assert len(set(pairs.values())) == len(pairs)
    assert all(topics[info][1] == INFO[0] and topics[image][1] != INFO[0]
               for info, image in pairs.items())  # fmt: skip
    order.shuffle(found)
    assert pair_camera_infos(found) == pairs


# ---------------------------------------------------------------- by choice


def test_chosen_pairs() -> None:
    found = channels("/a", "/b/compressed", "/x_info", "/y_info", "/chat")
    assert choose_pairs([], found) == {}
    assert choose_pairs(["/a=/y_info", "/b/compressed=/x_info"], found) == {3: 0, 2: 1}
    assert choose_pairs(["/a=/y_info", "/a=/y_info"], found) == {3: 0}


@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        (["/a"], "'/a' is not of the form IMAGE=INFO"),
        (["/z=/x_info"], r"'/z' is not among .* Topics of images: /a, /b\."),
        (["/a=/z"], r"'/z' is not among .* Topics of calibrations: /x_info, /y_info\."),
        (["/chat=/x_info"], "'/chat' is not among the packed topics of images"),
        (["/a=/chat"], "'/chat' is not among the packed topics of calib"),
        (["/a=/x_info", "/b=/x_info"], "pairs /x_info with /a, so /b=/x_info cannot"),
        (["/a=/x_info", "/a=/y_info"], "pairs /a with /x_info, so /a=/y_info cannot"),
    ],
)
def test_choices_that_cannot_be(choices: list[str], sentence: str) -> None:
    with pytest.raises(OptionError, match=sentence):
        choose_pairs(choices, channels("/a", "/b", "/x_info", "/y_info", "/chat"))


def test_names_that_tell_nothing_are_paired_on_request(tmp_path: Path) -> None:
    names = {"/cam/image_raw": "/eye", "/cam/camera_info": "/lens"}
    made = scene("mono8")
    renamed = [replace(one, topic=names.get(one.topic, one.topic)) for one in made.messages]
    write_bag(tmp_path / "drive.bag", Scene(renamed, made.silent))
    summary = mp4ds.pack(tmp_path / "drive.bag", tmp_path / "alone")
    (note,) = next(topic.notes for topic in summary.topics if topic.topic == "/lens")
    assert "no images are known to be its own" in note
    options = mp4ds.PackOptions(camera_info=["/eye=/lens"])
    mp4ds.pack(tmp_path / "drive.bag", tmp_path / "dataset", options)
    with mp4ds.open(tmp_path / "dataset") as dataset:
        found = dataset["/eye"].intrinsics_at(0)
    (first, *_) = (one for one in renamed if one.topic == "/lens")
    assert found is not None
    assert found.k == first.values["k"]
