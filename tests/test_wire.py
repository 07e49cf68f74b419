"""Messages taken apart and rebuilt, against the serializers of rosbags."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mp4ds.errors import Refused
from mp4ds.messages.serializations import form_of, wire_of
from mp4ds.messages.wire import (
    CalibrationFields,
    Form,
    ImageFields,
    Parts,
    Slots,
    prove,
)
from sources import IMAGE, INFO, build, image_cdr, typestore

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

NAMES = ["ros1", "cdr-le", "cdr-be"]
PREFIX = {"ros1": b"", "cdr-le": b"\x00\x01\x00\x00", "cdr-be": bytes(4)}
OTHERS = [
    "sensor_msgs/msg/CompressedImage",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "foxglove_msgs/msg/RawImage",
    "foxglove_msgs/msg/CompressedImage",
    "foxglove_msgs/msg/CompressedVideo",
]
ENCODING = {"ros1": "ros1", "cdr-le": "cdr", "cdr-be": "cdr"}

Uint8 = st.integers(0, 2**8 - 1)
Uint32 = st.integers(0, 2**32 - 1)
Texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
Floats = st.floats(allow_nan=False, allow_infinity=False)


def form(name: str, msgtype: str) -> Form:
    return form_of(name, msgtype, b"")


def split(name: str, msgtype: str, payload: bytes) -> Parts:
    """The parts of a message, of which it is proven that they give it again."""
    made = form(name, msgtype)
    parts = made.split(memoryview(payload))
    assert prove(made.template(parts.blank), parts, memoryview(payload))
    return parts


def serialize(name: str, msgtype: str, values: dict[str, Any]) -> bytes:
    """The message as rosbags writes it."""
    store, message = typestore(ENCODING[name]), build(ENCODING[name], msgtype, values)
    if name == "ros1":
        return bytes(store.serialize_ros1(message, msgtype))
    return bytes(store.serialize_cdr(message, msgtype, little_endian=name == "cdr-le"))


@st.composite
def headers(draw: st.DrawFn) -> tuple[str, dict[str, Any], int]:
    """Name of a wire, values of a std_msgs/Header, its stamp in nanoseconds."""
    name = draw(st.sampled_from(NAMES))
    low, high = (0, 2**32 - 1) if name == "ros1" else (-(2**31), 2**31 - 1)
    sec = draw(st.integers(low, high) | st.sampled_from([0, low, high]))
    nanosec = draw(st.integers(0, 10**9 - 1))
    stamp = sec * 10**9 + nanosec
    # rosbags has the signed seconds of ROS 2 in both: the same four bytes
    signed = sec - 2**32 if sec >= 2**31 else sec
    header = {"seq": draw(Uint32), "stamp": {"sec": signed, "nanosec": nanosec}}
    return name, {**header, "frame_id": draw(Texts)}, stamp


@st.composite
def image_values(draw: st.DrawFn) -> dict[str, Any]:
    return {
        "height": draw(Uint32),
        "width": draw(Uint32),
        "encoding": draw(st.sampled_from(["mono8", "rgb8", "bayer_rggb8", ""]) | Texts),
        "is_bigendian": draw(Uint8),
        "step": draw(Uint32),
        "data": np.frombuffer(draw(st.binary(max_size=40)), np.uint8),
    }


@st.composite
def info_values(draw: st.DrawFn) -> dict[str, Any]:
    matrix = {
        name: draw(st.lists(Floats, min_size=size, max_size=size))
        for name, size in (("k", 9), ("r", 9), ("p", 12))
    }
    roi = {name: draw(Uint32) for name in ("x_offset", "y_offset", "height", "width")}
    return {
        "height": draw(Uint32),
        "width": draw(Uint32),
        "distortion_model": draw(st.sampled_from(["plumb_bob", "", "equidistant"]) | Texts),
        "d": draw(st.lists(Floats, max_size=8)),
        **matrix,
        "binning_x": draw(Uint32),
        "binning_y": draw(Uint32),
        "roi": {**roi, "do_rectify": draw(st.booleans())},
    }


# ---------------------------------------------------------------- images


@steady
@given(headers(), st.data(), st.binary(max_size=8))
def test_an_image_of_rosbags_splits_and_returns(
    head: tuple[str, dict[str, Any], int], data: st.DataObject, tail: bytes
) -> None:
    name, header, stamp = head
    values = data.draw(image_values())
    payload = serialize(name, IMAGE, {"header": header, **values}) + tail
    assert wire_of(ENCODING[name], memoryview(payload)) == name
    parts = split(name, IMAGE, payload)
    fields = parts.fields
    assert isinstance(fields, ImageFields)
    assert parts.stamp == stamp
    assert parts.seq == (header["seq"] if name == "ros1" else None)
    assert parts.frame_id == header["frame_id"]
    for field in ("height", "width", "encoding", "is_bigendian", "step"):
        assert getattr(fields, field) == values[field]
    body = values["data"].tobytes()
    assert bytes(parts.body) == body
    zero = {**header, "seq": 0, "stamp": {}}
    blank = serialize(name, IMAGE, {"header": zero, **values, "data": np.zeros(0, np.uint8)})
    assert parts.blank == blank + tail
    assert form(name, IMAGE).plain(parts.frame_id, fields) == blank
    slots = Slots(parts.stamp, parts.seq)
    head, end = form(name, IMAGE).template(parts.blank).around(slots, len(body))
    assert head + body + end == payload


@steady
@given(st.sampled_from(NAMES), st.binary(max_size=120))
@example("ros1", b"\xff" * 60)
@example("cdr-le", b"\xff" * 60)
def test_noise_splits_or_is_refused_as_a_whole(name: str, noise: bytes) -> None:
    payload = PREFIX[name] + noise
    for msgtype in (IMAGE, INFO, *OTHERS):
        with suppress(Refused):
            split(name, msgtype, payload)


@pytest.mark.parametrize("padding", [b"\0", b"\x61"])
@pytest.mark.parametrize("little", [True, False])
def test_garbage_in_the_padding_of_cdr_is_in_the_template(padding: bytes, little: bool) -> None:
    payload = image_cdr(
        width=3, height=2, encoding="mono8", data=b"abcdef", frame_id="ab",
        little_endian=little, padding=padding, stamp=(-5, 7),
    )  # fmt: skip
    name = "cdr-le" if little else "cdr-be"
    parts = split(name, IMAGE, payload)
    assert parts.stamp == -5 * 10**9 + 7
    plain = form(name, IMAGE).plain(parts.frame_id, parts.fields)
    assert (plain == parts.blank) == (padding == b"\0")


# ---------------------------------------------------------------- CameraInfo


@steady
@given(headers(), st.data(), st.binary(max_size=3))
def test_a_camera_info_of_rosbags_splits_and_returns(
    head: tuple[str, dict[str, Any], int], data: st.DataObject, tail: bytes
) -> None:
    name, header, stamp = head
    values = data.draw(info_values())
    payload = serialize(name, INFO, {"header": header, **values})
    found = split(name, INFO, payload + tail)
    fields = found.fields
    assert isinstance(fields, CalibrationFields)
    seq = header["seq"] if name == "ros1" else None
    assert (found.stamp, found.seq, found.frame_id) == (stamp, seq, header["frame_id"])
    for field in ("height", "width", "distortion_model", "binning_x", "binning_y"):
        assert getattr(fields, field) == values[field]
    for field in ("d", "k", "r", "p"):
        assert list(map(exact, getattr(fields, field))) == list(map(exact, values[field]))
    roi = values["roi"]
    assert fields.roi == (roi["x_offset"], roi["y_offset"], roi["height"], roi["width"])
    assert fields.roi_do_rectify == roi["do_rectify"]
    plain = form(name, INFO).plain(found.frame_id, fields)
    assert plain is not None
    assert plain + tail == found.blank
    head, end = form(name, INFO).template(plain).around(Slots(found.stamp, found.seq), 0)
    assert (head, end) == (payload, b"")


def exact(value: float) -> tuple[float, float]:
    return float(value), math.copysign(1, value)


# ---------------------------------------------------------------- coded images


def coded(name: str, msgtype: str, body: bytes, *, stamp: int = 0, seq: int = 0) -> bytes:
    """A message of `OTHERS`."""
    values = {
        "header": {"seq": seq, "stamp": stamp, "frame_id": "cam"},
        "timestamp": stamp,
        "frame_id": "cam",
        "data": body,
        "pts": 2**40 + 7,
        "flags": 1,
        "width": 640,
        "height": 480,
        "step": 640,
        "encoding": "mono8",
        "format": "h264",
    }
    return serialize(name, msgtype, values)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("msgtype", OTHERS)
def test_coded_images_return_for_every_size(name: str, msgtype: str) -> None:
    made = form(name, msgtype)
    blanks = set()
    for size in (0, 1, 2, 3, 4, 5, 7, 8, 1000):
        stamp = (1_700_000_000 + size) * 10**9 + size
        payload = coded(name, msgtype, bytes(range(256))[:size] * 4, stamp=stamp, seq=size)
        parts = split(name, msgtype, payload)
        blanks.add(parts.blank)
        assert parts.stamp == stamp
        assert parts.frame_id == "cam"
        assert parts.pts == (2**40 + 7 if "FFMPEG" in msgtype else None)
        assert bytes(parts.body) == bytes(range(256))[:size] * 4
        plain = made.plain(parts.frame_id, parts.fields)
        assert plain in (None, parts.blank)
    assert len(blanks) <= 4  # what follows the data is aligned by its size
