"""Messages taken apart and rebuilt, against the serializers of rosbags."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mp4ds.wire import CameraInfoFields, ImageParts, Wire, WireError, wire_for
from mp4ds.wire.base import join_stamp
from mp4ds.wire.formats import WIRES
from sources import IMAGE, INFO, build, image_cdr, image_ros1, typestore

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

NAMES = ["ros1", "cdr-le", "cdr-be"]
ENCODING = {"ros1": "ros1", "cdr-le": "cdr", "cdr-be": "cdr"}

Uint8 = st.integers(0, 2**8 - 1)
Uint32 = st.integers(0, 2**32 - 1)
Texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
Floats = st.floats(allow_nan=False, allow_infinity=False)


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
    wire = wire_for(ENCODING[name], memoryview(payload))
    assert wire.name == name
    parts = wire.split_image(memoryview(payload))
    assert parts.stamp == stamp
    assert parts.seq == (header["seq"] if name == "ros1" else None)
    assert parts.frame_id == header["frame_id"]
    for field in ("height", "width", "encoding", "is_bigendian", "step"):
        assert getattr(parts, field) == values[field]
    assert bytes(parts.pixels) == values["data"].tobytes()
    assert parts.size == len(values["data"])
    assert bytes(parts.tail) == tail
    assert bytes(parts.head) + bytes(parts.pixels) + bytes(parts.tail) == payload
    assert wire.image_head(parts) == parts.head
    blank = wire.patch_head(bytes(parts.head), 0, 0)
    assert len(blank) == len(parts.head)
    assert wire.patch_head(blank, stamp, parts.seq) == parts.head
    zero = {**header, "seq": 0, "stamp": {}}
    assert serialize(name, IMAGE, {"header": zero, **values}).startswith(blank)


@pytest.mark.parametrize("name", NAMES)
def test_views_and_no_copies(name: str) -> None:
    payload = memoryview(serialize(name, IMAGE, {"data": np.arange(30, dtype=np.uint8)}))
    parts = WIRES[name].split_image(payload)
    buffer = np.frombuffer(payload, np.uint8)
    assert np.shares_memory(np.frombuffer(parts.pixels, np.uint8), buffer)


@pytest.mark.parametrize("name", NAMES)
def test_every_cut_is_refused(name: str) -> None:
    values = {"header": {"frame_id": "camera"}, "encoding": "mono8", "data": np.zeros(9)}
    payload = serialize(name, IMAGE, values)
    for end in range(len(payload)):
        with pytest.raises(WireError) as caught:
            WIRES[name].split_image(memoryview(payload)[:end])
        assert str(caught.value)


@steady
@given(st.sampled_from(NAMES), st.binary(max_size=120))
@example("ros1", b"\xff" * 60)
@example("cdr-le", b"\xff" * 60)
def test_noise_splits_or_is_refused_as_a_whole(name: str, noise: bytes) -> None:
    payload = memoryview(WIRES[name].prefix + noise)  # type: ignore[attr-defined]
    for split in (WIRES[name].split_image, WIRES[name].split_camera_info):
        try:
            parts = split(payload)
        except WireError:
            continue
        if isinstance(parts, ImageParts):
            assert bytes(parts.head) + bytes(parts.pixels) + bytes(parts.tail) == payload


@pytest.mark.parametrize("padding", [b"\0", b"\x61"])
@pytest.mark.parametrize("little", [True, False])
def test_garbage_in_the_padding_of_cdr_is_in_the_template(padding: bytes, little: bool) -> None:
    payload = image_cdr(
        width=3, height=2, encoding="mono8", data=b"abcdef", frame_id="ab",
        little_endian=little, padding=padding, stamp=(-5, 7),
    )  # fmt: skip
    wire = wire_for("cdr", memoryview(payload))
    parts = wire.split_image(memoryview(payload))
    assert parts.stamp == -5 * 10**9 + 7
    assert (wire.image_head(parts) == parts.head) == (padding == b"\0")
    blank = wire.patch_head(bytes(parts.head), 0, None)
    assert wire.patch_head(blank, parts.stamp, None) == parts.head


@pytest.mark.parametrize("stamp", [(1, 10**9), (2**32 - 1, 2**32 - 1), (0, 3_999_999_999)])
def test_impossible_nanoseconds_have_no_stamp(stamp: tuple[int, int]) -> None:
    for encoding, payload in (
        ("ros1", image_ros1(width=1, height=1, encoding="mono8", data=b"a", stamp=stamp)),
        ("cdr", image_cdr(width=1, height=1, encoding="mono8", data=b"a", stamp=stamp)),
    ):
        view = memoryview(payload)
        assert wire_for(encoding, view).split_image(view).stamp is None


def test_joined_stamps() -> None:
    assert join_stamp(-1, 999_999_999) == -1
    assert join_stamp(2**32 - 1, 10**9 - 1) == 2**32 * 10**9 - 1
    assert join_stamp(0, 10**9) is None
    assert join_stamp(0, -1) is None


@pytest.mark.parametrize(
    ("encoding", "start", "name"),
    [
        ("ros1", b"", "ros1"),
        ("cdr", b"\x00\x01\x00\x00", "cdr-le"),
        ("cdr", b"\x00\x00\x00\x00", "cdr-be"),
    ],
)
def test_wires_by_encapsulation(encoding: str, start: bytes, name: str) -> None:
    assert wire_for(encoding, memoryview(start + b"rest")).name == name


@pytest.mark.parametrize(
    ("encoding", "start"),
    [
        *(("cdr", bytes.fromhex(text)) for text in ("", "00", "000100", "00010003", "00070000")),
        *(("cdr", bytes.fromhex(text)) for text in ("00030000", "01000000", "ffffffff")),
        *((name, b"\x00\x01\x00\x00") for name in ("json", "protobuf", "", "CDR", "cdr ")),
    ],
)
def test_other_serializations_are_refused(encoding: str, start: bytes) -> None:
    with pytest.raises(WireError) as caught:
        wire_for(encoding, memoryview(start))
    assert str(caught.value)


@pytest.mark.parametrize("name", NAMES)
def test_strings_that_are_none(name: str) -> None:
    payload = bytearray(
        image_ros1(width=1, height=1, encoding="mono8", data=b"a", frame_id="cam")
        if name == "ros1"
        else image_cdr(
            width=1, height=1, encoding="mono8", data=b"a", frame_id="cam",
            little_endian=name == "cdr-le",
        )
    )  # fmt: skip
    at = payload.index(b"cam")
    payload[at] = 0xFF
    with pytest.raises(WireError, match="UTF-8"):
        WIRES[name].split_image(memoryview(payload))
    if name != "ros1":
        payload[at : at + 4] = b"camx"  # no NUL at its end
        with pytest.raises(WireError, match="NUL"):
            WIRES[name].split_image(memoryview(payload))


# ---------------------------------------------------------------- CameraInfo


@steady
@given(headers(), st.data(), st.binary(max_size=3))
def test_a_camera_info_of_rosbags_splits_and_returns(
    head: tuple[str, dict[str, Any], int], data: st.DataObject, tail: bytes
) -> None:
    name, header, stamp = head
    values = data.draw(info_values())
    payload = serialize(name, INFO, {"header": header, **values})
    wire = WIRES[name]
    found = wire.split_camera_info(memoryview(payload + tail))
    fields = found[3]
    assert found[:3] == (stamp, header["seq"] if name == "ros1" else None, header["frame_id"])
    for field in ("height", "width", "distortion_model", "binning_x", "binning_y"):
        assert getattr(fields, field) == values[field]
    for field in ("d", "k", "r", "p"):
        assert list(map(exact, getattr(fields, field))) == list(map(exact, values[field]))
    roi = values["roi"]
    assert fields.roi == (roi["x_offset"], roi["y_offset"], roi["height"], roi["width"])
    assert fields.roi_do_rectify == roi["do_rectify"]
    assert wire.camera_info(*found) == payload
    blank = wire.camera_info(0, 0, found[2], fields)
    assert wire.patch_head(blank, stamp, found[1]) == payload


def exact(value: float) -> tuple[float, float]:
    return float(value), math.copysign(1, value)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("field", ["d", "k", "r", "p"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_yaml_cannot_hold_are_refused(name: str, field: str, value: float) -> None:
    size = {"d": 5, "k": 9, "r": 9, "p": 12}[field]
    payload = serialize(name, INFO, {field: [0.0] * (size - 1) + [value]})
    with pytest.raises(WireError, match="not finite"):
        WIRES[name].split_camera_info(memoryview(payload))


@pytest.mark.parametrize("name", NAMES)
def test_every_cut_of_a_camera_info_is_refused(name: str) -> None:
    payload = serialize(name, INFO, {"distortion_model": "plumb_bob", "d": [1.0] * 5})
    for end in range(len(payload)):
        with pytest.raises(WireError):
            WIRES[name].split_camera_info(memoryview(payload)[:end])


@pytest.mark.parametrize("name", NAMES)
def test_too_many_distortion_parameters(name: str) -> None:
    fits = serialize(name, INFO, {"d": [0.5] * 1024})
    assert len(WIRES[name].split_camera_info(memoryview(fits))[3].d) == 1024
    with pytest.raises(WireError, match="1025"):
        WIRES[name].split_camera_info(memoryview(serialize(name, INFO, {"d": [0.5] * 1025})))


def test_an_impossible_stamp_of_a_camera_info() -> None:
    payload = serialize("ros1", INFO, {"header": {"stamp": {"sec": 1, "nanosec": 10**9}}})
    with pytest.raises(WireError, match="stamp"):
        WIRES["ros1"].split_camera_info(memoryview(payload))


def test_a_wire_refuses_the_payload_of_another() -> None:
    empty = CameraInfoFields(0, 0, "", (), (0.0,) * 9, (0.0,) * 9, (0.0,) * 12, 0, 0, (0,) * 4, 0)
    wires: list[Wire] = [WIRES["cdr-le"], WIRES["cdr-be"]]
    for wire, other in (wires, wires[::-1]):
        payload = wire.camera_info(0, None, "", empty)
        with pytest.raises(WireError):
            other.split_camera_info(memoryview(payload))
        with pytest.raises(WireError):
            other.split_image(memoryview(payload))
