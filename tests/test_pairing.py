"""Which calibrations belong to which images: by choice, by name, by stamp."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mp4ds.errors import OptionError
from mp4ds.messages.wire import CalibrationFields, CodedFields, Fields, ImageFields, Parts
from mp4ds.packing.calibrations import (
    IMAGE_WINDOW,
    INFO_WINDOW,
    StampPairing,
    choose_pairs,
    pair_camera_infos,
)
from mp4ds.records import Channel, Schema

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
        (["/chat=/x_info"], "'/chat' holds std_msgs/String, not images"),
        (["/a=/chat"], "'/chat' holds std_msgs/String, not calibrations"),
        (["/a=/x_info", "/b=/x_info"], "pairs /x_info with /a, so /b=/x_info cannot"),
        (["/a=/x_info", "/a=/y_info"], "pairs /a with /x_info, so /a=/y_info cannot"),
    ],
)
def test_choices_that_cannot_be(choices: list[str], sentence: str) -> None:
    with pytest.raises(OptionError, match=sentence):
        choose_pairs(choices, channels("/a", "/b", "/x_info", "/y_info", "/chat"))


# ---------------------------------------------------------------- by stamp

EMPTY = memoryview(b"")
START = 1_700_000_000_000_000_000
STAMPS = [START + n * 33_333_333 for n in range(40)]
MATRICES = {"distortion_model": "plumb_bob", "d": (), "k": (0.0,) * 9, "r": (0.0,) * 9,
            "p": (0.0,) * 12}  # fmt: skip


def message(stamp: int, fields: Fields, frame_id: str = "") -> Parts:
    return Parts(stamp, None, None, frame_id, fields, EMPTY, b"")


def raw(width: int = 640, height: int = 480) -> Fields:
    return ImageFields("mono8", width, height, width, 0)


def info(
    width: int = 640,
    height: int = 480,
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int] = (0, 0),
) -> Fields:
    return CalibrationFields(
        height, width, **MATRICES, binning_x=binning[0], binning_y=binning[1],
        roi=(4, 4, roi[1], roi[0]),
    )  # fmt: skip


Track = tuple[str, Iterable[int], Fields, str]
"""A topic, the stamps of its messages, what they hold, and their frame_id."""


def paired(
    *tracks: Track,
    held: Mapping[str, str] | None = None,
    final: bool = True,
    in_order: bool = False,
) -> dict[str, str]:
    """What is paired, calibration topic -> image topic.

    Args:
        tracks: Recorded in the order of their stamps.
        held: Existing pairs.
        final: Whether the recording has ended.
        in_order: One track after the other, instead.
    """
    found, messages = [], []
    for number, (topic, stamps, fields, frame_id) in enumerate(tracks):
        kind = INFO if isinstance(fields, CalibrationFields) else RAW
        kind = CODED if isinstance(fields, CodedFields) else kind
        found.append(channel(number, topic, kind[0]))
        messages += [(number, message(stamp, fields, frame_id)) for stamp in stamps]
    if not in_order:
        messages.sort(key=lambda item: item[1].stamp)
    pairing = StampPairing()
    for number, parts in messages:
        pairing.add(found[number], parts)
    number_of = {own.topic: own.id for own in found}
    known = {number_of[info]: number_of[image] for info, image in (held or {}).items()}
    pairs = pairing.decide(known, final=final)
    assert pairing.decide(known, final=final) == pairs
    return {found[i].topic: found[j].topic for i, j in pairs.items()}


def eye(stamps: Iterable[int] = STAMPS, name: str = "/eye", frame_id: str = "") -> Track:
    return name, stamps, raw(), frame_id


def eye_info(stamps: Iterable[int] = STAMPS, name: str = "/eye_info", frame_id: str = "") -> Track:
    return name, stamps, info(), frame_id


def test_equal_stamps_pair() -> None:
    for order in ({}, {"final": False}, {"in_order": True}):
        assert paired(eye(), eye_info(), **order) == {"/eye_info": "/eye"}


@pytest.mark.parametrize(
    ("image_stamps", "info_stamps", "pairs"),
    [
        ([stamp + (n % 5 == 0) for n, stamp in enumerate(STAMPS)], STAMPS[1:-1], True),
        ([stamp + (n % 4 == 0) for n, stamp in enumerate(STAMPS)], STAMPS[1:-1], False),
        (STAMPS, STAMPS[::10], True),  # frequent images and rare calibrations
        (STAMPS[::10], STAMPS, False),  # one stamp of ten is an image's
        (STAMPS[20:], STAMPS, True),  # only the time of both counts
        (STAMPS[:20], STAMPS[20:], False),
        (STAMPS[:1], STAMPS[:1], True),
        (STAMPS[:40], STAMPS[7:10], True),
        (STAMPS[:40], [*STAMPS[7:10], STAMPS[10] + 1], False),  # three of four
        (STAMPS[:40], STAMPS[4:5], True),  # a single calibration
        (STAMPS[:40], [STAMPS[4]] * 9, False),  # nine messages, one stamp
        (STAMPS[:1], STAMPS[:9], True),
        ([0] * 9, [0] * 9, False),
        (STAMPS[:9], [0] * 9, False),
        (STAMPS[:9], [0, *STAMPS[1:9]], True),
        (STAMPS[:9], [stamp + 1 for stamp in STAMPS[:9]], False),
        ([-5, -4, -3], [-5, -4, -3], True),
    ],
)
def test_stamps_that_agree_or_not(
    image_stamps: list[int], info_stamps: list[int], pairs: bool
) -> None:
    assert bool(paired(eye(image_stamps), eye_info(info_stamps))) == pairs


SIZES: list[tuple[Fields, tuple[int, int], bool]] = [
    (info(640, 480), (640, 480), True),
    (info(640, 480), (480, 640), False),
    (info(640, 480, binning=(2, 2)), (320, 240), True),
    (info(640, 480, binning=(2, 1)), (320, 240), False),
    (info(641, 481, binning=(2, 2)), (320, 240), True),
    (info(641, 481, binning=(2, 2)), (322, 241), False),
    (info(640, 480, roi=(200, 100)), (200, 100), True),
    (info(640, 480, roi=(200, 100), binning=(2, 2)), (100, 50), True),
    (info(0, 0), (640, 480), True),  # not calibrated
]


@pytest.mark.parametrize(("calibration", "size", "pairs"), SIZES)
def test_sizes_must_not_contradict(calibration: Fields, size: tuple[int, int], pairs: bool) -> None:
    image = ("/eye", STAMPS, raw(*size), "")
    assert bool(paired(image, ("/eye_info", STAMPS, calibration, ""))) == pairs


RIGS: dict[str, tuple[list[Track], dict[str, str]]] = {
    "own stamps": (
        [
            track
            for n in range(5)
            for stamps in [[stamp + n for stamp in STAMPS]]
            for track in (eye(stamps, f"/eye{n}"), eye_info(stamps, f"/info{4 - n}"))
        ],
        {f"/info{4 - n}": f"/eye{n}" for n in range(5)},
    ),
    "triggered together, by size": (
        [
            track
            for name, size in (("a", (640, 480)), ("b", (320, 240)))
            for track in (
                (f"/{name}", STAMPS, raw(*size), ""),
                (f"/{name}_info", STAMPS, info(*size), ""),
            )
        ],
        {"/a_info": "/a", "/b_info": "/b"},
    ),
    "triggered together, by frame_id": (
        [
            *(eye(name=f"/{name}", frame_id=f"/{name}_frame") for name in "ab"),
            *(eye_info(name=f"/{name}_info", frame_id=f"{name}_frame") for name in "ab"),
        ],
        {"/a_info": "/a", "/b_info": "/b"},
    ),
    **{
        f"cannot be told apart {frame_id}": (
            [
                *(eye(name=f"/{name}", frame_id=frame_id) for name in "ab"),
                *(eye_info(name=f"/{name}_info", frame_id=frame_id) for name in "ab"),
            ],
            {},
        )
        for frame_id in ("", "rig")
    },
    "a dropped frame tells nothing": (
        [eye(name="/a"), eye(STAMPS[:5] + STAMPS[6:], "/b"), eye_info()],
        {},
    ),
    "views of one camera": (
        [
            ("/cam/image_raw/compressed", STAMPS, CodedFields("jpeg"), ""),
            *(eye(name=f"/cam/{name}") for name in ("image_rect", "image_raw")),
            eye_info(name="/calibs/cam_info"),
        ],
        {"/calibs/cam_info": "/cam/image_raw"},
    ),
    "the largest of coded views": (
        [
            ("/cam/image_color/compressed", STAMPS, CodedFields("jpeg", 320, 240), ""),
            ("/cam/image_mono/compressed", STAMPS, CodedFields("jpeg", 640, 480), ""),
            ("/info", STAMPS, info(0, 0), ""),
        ],
        {"/info": "/cam/image_mono/compressed"},
    ),
    "two calibrations": ([eye(), eye_info(name="/a_info"), eye_info(name="/b_info")], {}),
}


@pytest.mark.parametrize("name", RIGS)
def test_rigs_of_cameras(name: str) -> None:
    tracks, pairs = RIGS[name]
    assert paired(*tracks) == pairs


def test_what_is_paired_stays_and_is_a_rival() -> None:
    two = [eye(name="/a"), eye(name="/b"), eye_info(name="/a_info"), eye_info(name="/b_info")]
    assert paired(*two, held={"/a_info": "/a"}) == {}  # /b_info may be of a third camera
    one = [eye(name="/a"), eye_info(name="/a_info"), eye_info(name="/other_info")]
    assert paired(*one, held={"/a_info": "/a"}) == {}
    assert paired(*one, held={"/a_info": "/a", "/other_info": "/a"}) == {}


def test_memory_is_bounded_and_a_late_start_is_found() -> None:
    image, calibration = channels("/eye", "/eye_info")
    pairing = StampPairing()
    for n in range(5 * IMAGE_WINDOW):
        pairing.add(calibration, message(n + 1, info()))
    for n in range(5 * IMAGE_WINDOW, 5 * IMAGE_WINDOW + INFO_WINDOW):
        pairing.add(image, message(n + 1, raw()))
        pairing.add(calibration, message(n + 1, info()))
    assert pairing.decide({}) == {1: 0}
    for n in range(IMAGE_WINDOW):  # images go on, their calibration does not
        pairing.add(image, message(10**9 + n, raw()))
    assert pairing.decide({}) == {}
