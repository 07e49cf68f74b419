"""Foxglove's messages taken apart and rebuilt, against Foxglove's own generated code."""

from __future__ import annotations

import base64
import itertools
import json
import struct
import time
import tracemalloc
from collections.abc import Iterator
from functools import cache
from typing import Any

import flatbuffers
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from conftest import real
from each import each
from foxglove_wire import SERIALIZATIONS, flatbuffer_module, message_class
from mp4ds.wire.flatbuffer import FlatbufferForm
from mp4ds.wire.forms import (
    MAX_BLANK,
    CalibrationFields,
    CodedFields,
    Form,
    ImageFields,
    Parts,
    Slots,
    Template,
    WireError,
    prove,
)
from mp4ds.wire.foxglove import TYPES
from mp4ds.wire.jsonform import JsonForm
from mp4ds.wire.protobuf import ProtobufForm
from scenes import Record

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

FORMS = {"protobuf": ProtobufForm, "json": JsonForm, "flatbuffer": FlatbufferForm}
SOURCES = [name for name, source in SERIALIZATIONS.items() if source.encoding in FORMS]
BODIED = ["RawImage", "CompressedImage", "CompressedVideo"]
ALL = [*BODIED, "CameraCalibration"]
SIZES = [0, 1, 2, 3, 4, 127, 128, 129, 16383, 16384, 16385, 2**21 - 1, 2**21]
STAMPS = [0, 1, 999_999_999, 10**9, 1_700_000_000 * 10**9, 1_700_000_000_123_456_789]
LAST = (2**32 - 1) * 10**9 + 999_999_999  # of unsigned 32-bit seconds

IMAGE = {"frame_id": "camera", "width": 640, "height": 480, "encoding": "mono8", "step": 641}
CODED = {"frame_id": "caméra 前", "format": "jpeg; what else"}
MATRICES = {
    "d": [0.25, -0.125, 1e-300, 0.0, 5.0],
    "k": [float(i) for i in range(9)],
    "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    "p": [i / 7 for i in range(12)],
}
CALIBRATION = {"frame_id": "c", "width": 64, "height": 48, "distortion_model": "plumb_bob"}
VALUES: dict[str, dict[str, Any]] = {
    "RawImage": IMAGE,
    "CompressedImage": CODED,
    "CompressedVideo": CODED,
    "CameraCalibration": {**CALIBRATION, **MATRICES},
}
FIELDS = {
    "RawImage": ImageFields("mono8", 640, 480, 641, 0),
    "CompressedImage": CodedFields("jpeg; what else"),
    "CompressedVideo": CodedFields("jpeg; what else"),
    "CameraCalibration": CalibrationFields(
        48, 64, "plumb_bob", *(tuple(MATRICES[name]) for name in "dkrp")
    ),
}


@cache
def form(source: str, kind: str) -> Form:
    """The form that a recording of this source asks for."""
    name, schema = SERIALIZATIONS[source].schema(f"foxglove_msgs/msg/{kind}")
    return FORMS[SERIALIZATIONS[source].encoding](name, schema)


def payload(source: str, kind: str, stamp: int = 0, body: bytes = b"") -> bytes:
    """A message as the library writes it."""
    values = {**VALUES[kind], "timestamp": stamp}
    if kind in BODIED:
        values["data"] = body
    record = Record("/topic", f"foxglove_msgs/msg/{kind}", 0, values)
    return SERIALIZATIONS[source].payload(record)


def noise(size: int, seed: int = 0) -> bytes:
    return np.random.default_rng(seed).bytes(size)


def rebuilt(template: Template, slots: Slots, body: bytes) -> bytes:
    head, tail = template.around(slots, len(body))
    return b"".join((head, template.encode_body(memoryview(body)), tail))


def proven(of: Form, message: bytes) -> bool:
    """Whether a message comes back, by the package's own proof and by comparison."""
    parts = of.split(memoryview(message))
    template = of.template(parts.blank)
    found = prove(template, parts, memoryview(message))
    same = rebuilt(template, Slots(parts.stamp, parts.seq, parts.pts), bytes(parts.body))
    assert found == (same == message)
    return found


def refused(of: Form, message: bytes) -> str:
    """The reason why a message is refused."""
    with pytest.raises(WireError) as caught:
        of.split(memoryview(message))
    return str(caught.value)


def no_body(source: str, size: int) -> bool:
    """Protobuf leaves out what is empty."""
    return size == 0 and source.startswith("protobuf")


# ---------------------------------------------------------------- what libraries write


def test_the_types_are_those_of_the_tables() -> None:
    assert sorted(TYPES) == sorted(f"foxglove.{kind}" for kind in ALL)
    assert {SERIALIZATIONS[source].encoding for source in SOURCES} == set(FORMS)


@each("size", SIZES)
@each("kind", BODIED)
@each("source", SOURCES)
def test_an_image_splits_and_returns(source: str, kind: str, size: int) -> None:
    body, of = noise(size), form(source, kind)
    for stamp in (*STAMPS, LAST):
        message = payload(source, kind, stamp, body)
        if no_body(source, size):
            assert refused(of, message) == "it has no data"
            continue
        parts = of.split(memoryview(message))
        assert (parts.stamp, parts.seq, parts.pts) == (stamp, None, None)
        assert parts.frame_id == VALUES[kind]["frame_id"]
        assert parts.fields == FIELDS[kind]
        assert parts.body == body
        assert len(parts.blank) < 300
        assert proven(of, message)


@each("source", SOURCES)
def test_a_calibration_splits_and_returns(source: str) -> None:
    of = form(source, "CameraCalibration")
    blanks = set()
    for stamp in (*STAMPS, LAST):
        message = payload(source, "CameraCalibration", stamp)
        parts = of.split(memoryview(message))
        assert (parts.stamp, parts.seq, parts.pts, parts.frame_id) == (stamp, None, None, "c")
        assert parts.fields == FIELDS["CameraCalibration"]
        assert len(parts.body) == 0
        assert of.template(parts.blank).around(Slots(stamp), 0) == (message, b"")
        assert proven(of, message)
        blanks.add(parts.blank)
    assert len(blanks) == 1


@each("kind", BODIED)
@each("source", SOURCES)
def test_a_blank_filled_anew_is_what_the_library_writes(source: str, kind: str) -> None:
    of, blanks = form(source, kind), {}
    for size in SIZES:
        if not no_body(source, size):
            parts = of.split(memoryview(payload(source, kind, 5 * 10**9 + size, noise(size))))
            # a flatbuffer's data is padded to four bytes, and its padding is in the blank
            blanks.setdefault(size % 4 if source == "flatbuffer" else 0, set()).add(parts.blank)
    assert [len(found) for found in blanks.values()] == [1] * (4 if source == "flatbuffer" else 1)
    for size, stamp in itertools.product(SIZES[:-2], (*STAMPS, LAST)):
        if not no_body(source, size):
            (blank,) = blanks[size % 4 if source == "flatbuffer" else 0]
            body = noise(size, seed=1)
            found = rebuilt(of.template(blank), Slots(stamp), body)
            assert found == payload(source, kind, stamp, body)


@each("kind", ALL)
@each("source", SOURCES)
def test_a_blank_is_a_blank_message(source: str, kind: str) -> None:
    of = form(source, kind)
    message = payload(source, kind, STAMPS[-1], b"something" * (kind in BODIED))
    blank = of.split(memoryview(message)).blank
    again = of.split(memoryview(blank))
    assert (again.stamp, bytes(again.body), again.blank) == (0, b"", blank)
    assert (again.frame_id, again.fields) == (VALUES[kind]["frame_id"], FIELDS[kind])
    assert of.plain(again.frame_id, again.fields) is None
    if source in ("protobuf", "protobuf-stamp-last"):
        read = message_class(f"x/{kind}").FromString(blank)
        assert read.HasField("timestamp")
        assert read.timestamp.ToNanoseconds() == 0
        assert read.frame_id == VALUES[kind]["frame_id"]
        assert kind not in BODIED or read.data == b""
    elif source == "flatbuffer":
        read = getattr(flatbuffer_module(kind), kind).GetRootAs(blank, 0)
        assert (read.Timestamp().Sec(), read.Timestamp().Nsec()) == (0, 0)
        assert read.FrameId().decode() == VALUES[kind]["frame_id"]
        assert kind not in BODIED or (not read.DataIsNone() and read.DataLength() == 0)
    elif source.startswith("json"):
        read = json.loads(blank)
        assert read["timestamp"] == {"sec": 0, "nsec": 0}
        assert read["frame_id"] == VALUES[kind]["frame_id"]
        assert kind not in BODIED or read["data"] == ""


@each("kind", ALL)
@each("source", SOURCES)
def test_a_message_that_is_not_blank_makes_no_template(source: str, kind: str) -> None:
    of = form(source, kind)
    cases = [payload(source, kind, 7, b"x")]
    if kind in BODIED:
        cases.append(payload(source, kind, 0, b"x"))
    for message in cases:
        with pytest.raises(WireError, match="blank message"):
            of.template(message)


@pytest.mark.parametrize(
    ("source", "more"),
    [
        ("protobuf", b"\xba\x3e\xff\xff\x03" + bytes(MAX_BLANK - 1)),
        ("json", b" " * MAX_BLANK),
        ("flatbuffer", bytes(MAX_BLANK)),
    ],
)
def test_a_blank_is_not_large(source: str, more: bytes) -> None:
    of = form(source, "RawImage")
    blank = of.split(memoryview(payload(source, "RawImage", 1, b"abcd"))).blank
    assert of.template(blank + more[: MAX_BLANK // 2] if source != "protobuf" else blank)
    with pytest.raises(WireError, match="stand around its data"):
        of.template(blank + more)


@each("kind", BODIED)
@each("source", SOURCES)
def test_bodies_are_views_where_they_stand_as_they_are(source: str, kind: str) -> None:
    message = payload(source, kind, 1, noise(99))
    parts = form(source, kind).split(memoryview(message))
    template = form(source, kind).template(parts.blank)
    at = np.frombuffer(parts.body, np.uint8)
    assert np.shares_memory(at, np.frombuffer(message, np.uint8)) == template.keeps_body
    assert template.keeps_body == (not source.startswith("json"))
    assert (template.encode_body(parts.body) is parts.body) == template.keeps_body


@each("kind", ALL)
@each("source", SOURCES)
def test_every_cut_is_refused(source: str, kind: str) -> None:
    message = payload(source, kind, STAMPS[-1], b"something")
    if source == "protobuf-unknown-field":
        message = message[:-7]  # a cut before the unknown field is a whole message
    for end in range(len(message)):
        try:
            parts = form(source, kind).split(memoryview(message)[:end])
        except WireError:
            continue
        # a protobuf message may end after each field, a flatbuffer without its last padding
        padding = 3 if source == "flatbuffer" else 0
        assert source.startswith("protobuf") or end >= len(message) - padding
        assert proven(form(source, kind), message[:end])
        assert parts.stamp == STAMPS[-1]


@each("source", SOURCES)
def test_the_wire_has_the_name_that_sidecars_use(source: str) -> None:
    assert form(source, "RawImage").wire == SERIALIZATIONS[source].encoding


@each("name", FORMS)
@each("type_name", ["foxglove.PointCloud", "RawImage", "", "sensor_msgs/Image"])
def test_other_types_are_refused(name: str, type_name: str) -> None:
    with pytest.raises(WireError, match="is not modelled"):
        FORMS[name](type_name, b"")


@pytest.mark.parametrize("name", FORMS)
def test_calibrations_that_cannot_be_modelled(name: str) -> None:
    of = form(name, "CameraCalibration")
    for key, value, reason in (
        ("k", [1.0] * 8, "8 values in K, not 9"),
        ("r", [], "0 values in R, not 9"),
        ("p", [1.0] * 13, "13 values in P, not 12"),
        ("d", [1.0] * 1025, "1025 distortion parameters"),
        ("d", [float("nan")], "not finite"),
        ("k", [float("inf")] * 9, "not finite"),
    ):
        values = {**VALUES["CameraCalibration"], "timestamp": 1, key: value}
        record = Record("/topic", "foxglove_msgs/msg/CameraCalibration", 0, values)
        assert reason in refused(of, SERIALIZATIONS[name].payload(record))
    none = {**VALUES["CameraCalibration"], "timestamp": 1, "d": []}
    record = Record("/topic", "foxglove_msgs/msg/CameraCalibration", 0, none)
    message = SERIALIZATIONS[name].payload(record)
    assert proven(of, message)
    fields = of.split(memoryview(message)).fields
    assert isinstance(fields, CalibrationFields)
    assert fields.d == ()


# ---------------------------------------------------------------- protobuf


def varint(value: int) -> bytes:
    digits = [value >> shift & 0x7F for shift in range(0, max(value.bit_length(), 1), 7)]
    return bytes([*(digit | 0x80 for digit in digits[:-1]), digits[-1]])


def tag(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


def block(number: int, content: bytes) -> bytes:
    return tag(number, 2) + varint(len(content)) + content


STAMP = block(1, b"\x08\x05\x10\x07")  # of a CompressedImage: 5 s 7 ns
DATA = block(2, b"picture")
REST = [block(3, b"jpeg"), block(4, b"camera")]


def test_protobuf_fields_in_any_order() -> None:
    of = form("protobuf", "CompressedImage")
    for order in itertools.permutations([STAMP, DATA, *REST, tag(77, 0) + b"\x01"]):
        parts = of.split(memoryview(b"".join(order)))
        assert (parts.stamp, parts.frame_id, parts.fields, bytes(parts.body)) == (
            5_000_000_007, "camera", CodedFields("jpeg"), b"picture",
        )  # fmt: skip
        assert proven(of, b"".join(order))
        other = {STAMP: block(1, b"\x10\x01"), DATA: block(2, b"p" * 300)}
        expected = b"".join(other.get(field, field) for field in order)
        assert rebuilt(of.template(parts.blank), Slots(1), b"p" * 300) == expected


@each(
    ("stamp", "content"),
    [
        (-1, b"\x08" + b"\xff" * 9 + b"\x01" + b"\x10" + varint(999_999_999)),
        (-(10**9), b"\x08" + b"\xff" * 9 + b"\x01"),
        (2**63 - 1, b"\x08" + varint(9_223_372_036) + b"\x10" + varint(854_775_807)),
        (
            -(2**63),
            b"\x08" + varint(2**64 - 9_223_372_037) + b"\x10" + varint(145_224_192),
        ),
    ],
)
def test_protobuf_stamps_of_64_bits(stamp: int, content: bytes) -> None:
    of = form("protobuf", "CompressedImage")
    message = block(1, content) + DATA
    assert of.split(memoryview(message)).stamp == stamp
    assert proven(of, message)


@each(
    "content",
    [
        b"\x08" + varint(9_223_372_036) + b"\x10" + varint(854_775_808),
        b"\x08" + varint(2**63 - 1),
        b"\x08" + varint(2**63),
        b"\x10" + varint(10**9),
        b"\x10" + b"\xff" * 9 + b"\x01",
        b"\x0d" + bytes(4),
        b"\x08",
        b"\x08" + b"\xff" * 10,
    ],
)
def test_protobuf_stamps_that_have_no_value(content: bytes) -> None:
    assert refused(form("protobuf", "CompressedImage"), block(1, content) + DATA)


@each(
    "message",
    [
        block(1, b"\x08\x05\x10\x00") + DATA,  # a zero that serializers leave out
        block(1, b"\x10\x07\x08\x05") + DATA,
        block(1, b"\x08\x85\x00\x10\x07") + DATA,
        block(1, b"\x08\x05\x10\x07\x18\x01") + DATA,
        block(1, b"\x08\x05\x08\x05\x10\x07") + DATA,
        b"\x0a\x84\x00\x08\x05\x10\x07" + DATA,
        STAMP + b"\x12\x83\x00abc",
    ],
)
def test_protobuf_that_is_not_as_serializers_write_it_is_not_proven(message: bytes) -> None:
    assert not proven(form("protobuf", "CompressedImage"), message)


@each(
    ("more", "frame_id"),
    [
        (b"\x22\x83\x00cam", "cam"),  # its length in two bytes
        (b"\xa2\x00\x03cam", "cam"),  # its tag in two
        (b"\x22\x03cam\x22\x03map", "map"),  # twice: the last one counts
        (tag(50, 1) + bytes(8), ""),
        (tag(50, 5) + bytes(4), ""),
        (tag(50, 0) + b"\xff" * 9 + b"\x01", ""),
        (tag(2**29 - 1, 2) + b"\x00", ""),
        (block(51, b"\x0a" * 2000), ""),
    ],
)
def test_protobuf_that_is_odd_elsewhere_is_proven(more: bytes, frame_id: str) -> None:
    of = form("protobuf", "CompressedImage")
    for message in (more + STAMP + DATA, STAMP + more + DATA, STAMP + DATA + more):
        assert proven(of, message)
        assert of.split(memoryview(message)).frame_id == frame_id


@each(
    ("message", "reason"),
    [
        (DATA, "it has no timestamp"),
        (STAMP, "it has no data"),
        (b"", "it has no timestamp"),
        (STAMP + STAMP + DATA, "it has its timestamp twice"),
        (STAMP + DATA + DATA, "it has its data twice"),
        (STAMP + b"\x10\x01", "its field data is not of the declared type"),
        (STAMP + DATA + b"\x20\x01", "its field frame_id is not of the declared type"),
        (STAMP + DATA + b"\x22\x01\xff", "not UTF-8"),
        (STAMP + DATA + b"\x00\x00", "a tag in it"),
        (STAMP + DATA + varint(2**32) + b"\x00", "a tag in it"),
        (STAMP + DATA + b"\xff" * 9 + b"\x02", "a number in it does not end"),
        (STAMP + DATA + tag(9, 3) + tag(9, 4), "wire type 3"),
        (STAMP + DATA + tag(9, 7), "wire type 7"),
        (STAMP + b"\x12" + varint(2**63) + b"x", "where a field needs"),
        (STAMP + DATA + block(9, bytes(MAX_BLANK)), "bytes stand around its data"),
    ],
)
def test_protobuf_refusals_say_why(message: bytes, reason: str) -> None:
    assert reason in refused(form("protobuf", "CompressedImage"), message)


def test_protobuf_lists_packed_or_not() -> None:
    of = form("protobuf", "CameraCalibration")
    message = payload("protobuf", "CameraCalibration", 1)
    packed = block(6, struct.pack("<9d", *MATRICES["k"]))
    assert packed in message
    loose = b"".join(tag(6, 1) + struct.pack("<d", value) for value in MATRICES["k"])
    halves = block(6, packed[2:34]) + block(6, packed[34:])
    for other in (loose, halves):
        assert (
            of.split(memoryview(message.replace(packed, other))).fields
            == FIELDS["CameraCalibration"]
        )
        assert proven(of, message.replace(packed, other))
    assert "inside of one" in refused(of, message + block(5, bytes(7)))


def image_schema() -> tuple[FileDescriptorSet, dict[str, FieldDescriptorProto]]:
    """Foxglove's schema of RawImage, to be changed."""
    described = FileDescriptorSet.FromString(
        SERIALIZATIONS["protobuf"].schema("foxglove_msgs/msg/RawImage")[1]
    )
    (message,) = (m for file in described.file for m in file.message_type if m.name == "RawImage")
    return described, {field.name: field for field in message.field}


@each(
    ("name", "change"),
    [
        ("timestamp", {"type": FieldDescriptorProto.TYPE_INT64}),
        ("timestamp", {"type_name": ".google.protobuf.Duration"}),
        ("data", {"type": FieldDescriptorProto.TYPE_STRING}),
        ("data", {"label": FieldDescriptorProto.LABEL_REPEATED}),
        ("width", {"type": FieldDescriptorProto.TYPE_DOUBLE}),
        ("encoding", {"type": FieldDescriptorProto.TYPE_ENUM}),
        ("step", {"name": "row_step"}),
        ("timestamp", {"name": "time"}),
    ],
)
def test_protobuf_schemas_of_other_types_are_refused(name: str, change: dict[str, Any]) -> None:
    described, fields = image_schema()
    for key, value in change.items():
        setattr(fields[name], key, value)
    with pytest.raises(WireError, match=f"field '{name}'"):
        ProtobufForm("foxglove.RawImage", described.SerializeToString())


def test_protobuf_schemas_that_do_not_declare_the_type() -> None:
    described, _ = image_schema()
    for type_name, schema in (
        ("foxglove.CompressedImage", described.SerializeToString()),
        ("foxglove.RawImage", described.SerializeToString() * 2),
        ("foxglove.RawImage", b""),
        ("foxglove.RawImage", b"\xff\xff"),
        ("foxglove.RawImage", b"syntax"),
    ):
        with pytest.raises(WireError, match="its schema"):
            ProtobufForm(type_name, schema)


def test_protobuf_numbers_may_be_varints_and_a_frame_absent() -> None:
    described, fields = image_schema()
    fields["width"].type = FieldDescriptorProto.TYPE_UINT32
    fields["frame_id"].name = "frame"
    of = ProtobufForm("foxglove.RawImage", described.SerializeToString())
    # 320 and a bit beyond the 32 that count
    message = (
        STAMP
        + b"\x10"
        + varint(2**32 + 320)
        + block(4, b"rgb8")
        + block(6, b"x")
        + block(7, b"\xff")
    )
    parts = of.split(memoryview(message))
    assert parts.fields == ImageFields("rgb8", 320, 0, 0, 0)
    assert parts.frame_id == ""
    assert proven(of, message)


def test_a_real_protobuf_schema_without_a_timestamp() -> None:
    with real("mcap/mcap_explorer_demo_protobuf_image.mcap").open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()  # type: ignore[union-attr]
    (schema,) = (item for item in schemas if item.name == "foxglove.CompressedImage")
    with pytest.raises(WireError, match="no field 'timestamp'"):
        ProtobufForm(schema.name, schema.data)


# ---------------------------------------------------------------- JSON


def coded(body: bytes) -> str:
    return base64.b64encode(body).decode()


MEMBERS = [
    '"timestamp": {"sec": 5, "nsec": 7}',
    '"frame_id": "camera"',
    '"format": "jpeg"',
    f'"data": "{coded(b"picture")}"',
    '"more": [{"data": "x", "timestamp": {"sec": "]}"}}, null, 1e5]',
]


def test_json_members_in_any_order() -> None:
    of = form("json", "CompressedImage")
    for order in itertools.permutations(MEMBERS):
        message = "{" + ", ".join(order) + "}"
        parts = of.split(memoryview(message.encode()))
        assert (parts.stamp, parts.frame_id, parts.fields, bytes(parts.body)) == (
            5_000_000_007, "camera", CodedFields("jpeg"), b"picture",
        )  # fmt: skip
        assert proven(of, message.encode())
        other = message.replace('"sec": 5, "nsec": 7', '"sec": -12, "nsec": 123456789')
        other = other.replace(coded(b"picture"), coded(b"p" * 301))
        found = rebuilt(of.template(parts.blank), Slots(-12 * 10**9 + 123456789), b"p" * 301)
        assert found == other.encode()


@each(
    "message",
    [
        ' \r\n\t{ "timestamp"\t:\n{ "nsec" : 7 , "sec" : 5 } ,"format":"","data" : "" }\n\n',
        '{"timestamp":{"sec":5,"more":{"sec":1},"nsec":7},"format":"j\\u0070g","data":"AAA="}',
        '{"time\\u0073tamp":{"s\\u0065c":5,"nsec":7},"format":"","d\\u0061ta":"AA=="}',
        '{"timestamp":{"sec":5,"nsec":7},"format":"前","data":"AAAA","frame_id":"é\\"}{\\\\"}',
        '{"timestamp":{"sec":5,"nsec":7},"format":"","data":"","sec":1,"x":NaN,"":""}',
        '{"timestamp":{"sec":5,"nsec":7},"format":"","data":"+/+/"}',
    ],
)
def test_json_keeps_its_spelling(message: str) -> None:
    of = form("json", "CompressedImage")
    parts = of.split(memoryview(message.encode()))
    assert parts.stamp == 5_000_000_007
    assert parts.fields == CodedFields(json.loads(message)["format"])
    assert parts.frame_id == json.loads(message).get("frame_id", "")
    assert bytes(parts.body) == base64.b64decode(json.loads(message)["data"])
    assert proven(of, message.encode())


def json_image(**changes: str) -> bytes:
    """A RawImage with some members spelled otherwise, or left out where empty."""
    members = {
        "timestamp": '{"sec":5,"nsec":7}', "frame_id": '"c"', "width": "1", "height": "1",
        "encoding": '"mono8"', "step": "1", "data": '"AA=="', **changes,
    }  # fmt: skip
    spelled = (f'"{name}":{value}' for name, value in members.items() if value)
    return ("{" + ",".join(spelled) + "}").encode()


@each(
    "changes",
    [
        {"timestamp": '{"sec":-0,"nsec":7}'},
        {"timestamp": '{"sec":5,"nsec":-0}'},
        {"data": '"AB=="'},  # bits that no encoder sets
        {"data": '"AAB="'},
    ],
)
def test_json_that_is_not_as_serializers_write_it_is_not_proven(changes: dict[str, str]) -> None:
    assert proven(form("json", "RawImage"), json_image())
    assert not proven(form("json", "RawImage"), json_image(**changes))


@each(
    ("changes", "reason"),
    [
        ({"timestamp": ""}, "no member timestamp"),
        ({"data": ""}, "no member data"),
        ({"width": ""}, "no member width"),
        ({"encoding": ""}, "no member encoding"),
        ({"timestamp": "5"}, "member timestamp"),
        ({"timestamp": '{"sec":5}'}, "member timestamp"),
        ({"timestamp": '{"sec":5,"nsec":7.0}'}, "member timestamp"),
        ({"timestamp": '{"sec":true,"nsec":7}'}, "member timestamp"),
        ({"timestamp": '{"sec":"5","nsec":7}'}, "member timestamp"),
        ({"timestamp": '{"sec":5,"nsec":1000000000}'}, "its stamp"),
        ({"timestamp": '{"sec":5,"nsec":-1}'}, "its stamp"),
        ({"timestamp": '{"sec":9223372036,"nsec":854775808}'}, "its stamp"),
        ({"timestamp": '{"sec":' + "9" * 5000 + ',"nsec":0}'}, ""),
        ({"timestamp": '{"sec":5,"nsec":7,"sec":6}'}, "have one name"),
        ({"width": '1,"width":1'}, "have one name"),
        ({"data": '"","d\\u0061ta":""'}, "have one name"),
        ({"frame_id": "null"}, "member frame_id"),
        ({"frame_id": '"\\ud800"'}, "member frame_id"),
        ({"width": "-1"}, "member width"),
        ({"width": "4294967296"}, "member width"),
        ({"width": "1.0"}, "member width"),
        ({"width": "true"}, "member width"),
        ({"data": "[1, 2]"}, "its data is no string"),
        ({"data": "null"}, "its data is no string"),
        ({"data": '"AA="'}, "base64"),
        ({"data": '"AAAAA"'}, "base64"),
        ({"data": '"AA\\nAA"'}, "base64"),
        ({"data": '"AA\\/A"'}, "base64"),
        ({"data": '"AA-_"'}, "base64"),
        ({"data": '"AA==AA=="'}, "base64"),
        ({"data": '"===="'}, "base64"),
        ({"data": '"A é"'}, "base64"),
        ({"data": '"AA==\\"'}, "base64"),
        ({"data": '"AA=="]'}, "JSON"),
        ({"data": '"AA=='}, "no string"),
        ({"encoding": '"' + "x" * MAX_BLANK + '"'}, "no member data"),
        ({"more": '"' + "x" * MAX_BLANK + '"'}, "bytes stand around its data"),
        ({"more": "[" * 9000}, "JSON"),
        ({"more": '"' + "\\" * 9001 + '"'}, "JSON"),
        ({"more": "01"}, "JSON"),
        ({"frame_id": "nul"}, "JSON"),
    ],
)
def test_json_refusals_say_why(changes: dict[str, str], reason: str) -> None:
    assert reason in refused(form("json", "RawImage"), json_image(**changes))


@each(
    ("message", "reason"),
    [
        (b"", "no member data"),
        (b"[]", "no member data"),
        (b"null", "no member data"),
        (b'"data"', "no member data"),
        (b"\xef\xbb\xbf" + json_image(), "no member data"),
        (json_image() + b"x", "JSON"),
        (json_image(more='"\xff"').replace("\xff".encode(), b"\xff"), "UTF-8"),
        (json_image().decode().encode("utf-16"), "no member data"),
        (json_image()[:-1], "JSON"),
        (json_image() * 2, "JSON"),
    ],
)
def test_what_is_no_json_object_is_refused(message: bytes, reason: str) -> None:
    assert reason in refused(form("json", "RawImage"), message)
    assert refused(form("json", "CameraCalibration"), message)


@each("d", ["[NaN]", "[-Infinity]", "[1e999]", "[" + "9" * 400 + "]", '["1"]', "[true]", "{}", "1"])
def test_json_lists_that_cannot_be_modelled(d: str) -> None:
    message = payload("json", "CameraCalibration", 1)
    at = message.index(b'"D":') + 4
    end = message.index(b"]", at) + 1
    assert refused(
        form("json", "CameraCalibration"), message[:at] + d.encode() + message[end:]
    ).startswith(("a calibration value", "its member D"))


@pytest.mark.parametrize("blank", [b'"x"', b'"AA=="', b'"\\u0041"'])
def test_a_json_blank_has_no_data(blank: bytes) -> None:
    message = json_image(timestamp='{"sec":0,"nsec":0}')
    of = form("json", "RawImage")
    assert of.template(message.replace(b'"AA=="', b'""'))
    with pytest.raises(WireError):
        of.template(message.replace(b'"AA=="', blank))
    with pytest.raises(WireError):
        of.template(message.replace(b'"AA=="', b'""').replace(b'"sec":0', b'"sec":-0'))


# ---------------------------------------------------------------- flatbuffers


def built(kind: str, order: tuple[str, ...], stamp: int, body: bytes) -> bytes:
    """A flatbuffer whose strings and data are written in this order, the first one last in it."""
    module, builder = flatbuffer_module(kind), flatbuffers.Builder(0)
    values = {**VALUES[kind], "data": body}
    children = {
        name: builder.CreateByteVector(body)
        if name == "data"
        else builder.CreateString(values[name])
        for name in order
    }
    module.Start(builder)
    for name, child in children.items():
        getattr(module, "Add" + name.title().replace("_", ""))(builder, child)
    for name in ("width", "height", "step"):
        if name in values:
            getattr(module, f"Add{name.title()}")(builder, values[name])
    create = flatbuffer_module("Time").CreateTime
    module.AddTimestamp(builder, create(builder, *divmod(stamp, 10**9)))
    builder.Finish(module.End(builder))
    return bytes(builder.Output())


ORDERS = [
    (kind, names)
    for kind in BODIED
    for names in itertools.permutations(
        ("frame_id", "encoding" if kind == "RawImage" else "format", "data")
    )
]


@each(("kind", "order"), ORDERS)
def test_flatbuffers_built_in_any_order(kind: str, order: tuple[str, ...]) -> None:
    of, blanks = form("flatbuffer", kind), {}
    for size in SIZES:
        message = built(kind, order, STAMPS[-1], noise(size))
        parts = of.split(memoryview(message))
        assert (parts.frame_id, parts.fields) == (VALUES[kind]["frame_id"], FIELDS[kind])
        assert parts.body == noise(size)
        assert proven(of, message)
        assert blanks.setdefault(size % 4, parts.blank) == parts.blank
    for size in SIZES:
        found = rebuilt(of.template(blanks[size % 4]), Slots(LAST), noise(size, seed=2))
        assert found == built(kind, order, LAST, noise(size, seed=2))


def test_a_flatbuffer_without_strings_or_numbers() -> None:
    of = form("flatbuffer", "CompressedImage")
    message = built("CompressedImage", ("data",), 5, b"abc")
    parts = of.split(memoryview(message))
    assert (parts.frame_id, parts.fields) == ("", CodedFields(""))
    assert proven(of, message)
    without = built("CompressedImage", ("format",), 5, b"")
    assert refused(of, without) == "it has no data"
    builder = flatbuffers.Builder(0)
    module = flatbuffer_module("CompressedImage")
    data = builder.CreateByteVector(b"abc")
    module.Start(builder)
    module.AddData(builder, data)
    builder.Finish(module.End(builder))
    assert refused(of, bytes(builder.Output())) == "it has no timestamp"


@pytest.mark.parametrize("stamp", [-1, 2**32 * 10**9])
def test_a_flatbuffer_has_unsigned_seconds(stamp: int) -> None:
    of = form("flatbuffer", "RawImage")
    blank = of.split(memoryview(payload("flatbuffer", "RawImage", 1, b"abcd"))).blank
    with pytest.raises(WireError, match="has bits for"):
        of.template(blank).around(Slots(stamp), 4)
    with pytest.raises(WireError, match="has bits for"):
        of.template(blank).around(Slots(0), 2**32)


def test_a_protobuf_has_signed_64_bit_seconds() -> None:
    of = form("protobuf", "RawImage")
    blank = of.split(memoryview(payload("protobuf", "RawImage", 1, b"abcd"))).blank
    with pytest.raises(WireError, match="has bits for"):
        of.template(blank).around(Slots(2**63 * 10**9), 4)


def table_at(message: bytes | bytearray) -> tuple[int, int]:
    """Places of a flatbuffer's root table and its vtable."""
    (at,) = struct.unpack_from("<I", message, 0)
    return at, at - struct.unpack_from("<i", message, at)[0]


def test_flatbuffers_that_are_unusual_are_refused() -> None:
    of = form("flatbuffer", "CompressedImage")
    whole = built("CompressedImage", ("frame_id", "data", "format"), 5, noise(64))
    at, vtable = table_at(whole)
    entries = struct.unpack_from("<4H", whole, vtable + 4)  # timestamp, frame_id, data, format
    start = whole.index(noise(64))
    places = [at + entry for entry in entries]
    cases = [
        ("<I", 0, len(whole), "where a field needs"),  # no root table
        ("<I", 0, 2**32 - 1, "where a field needs"),
        ("<i", at, at + 1, "before its first byte"),  # vtable before the start
        ("<i", at, -len(whole), "where a field needs"),
        ("<i", at, at - start, "not"),  # vtable in the data
        ("<H", vtable, 2, "not one"),
        ("<H", vtable, 13, "not one"),
        ("<H", vtable, 65534, "where a field needs"),
        ("<H", vtable + 2, 2, "not one"),
        ("<H", vtable + 2, 65535, "where a field needs"),
        ("<H", vtable + 2, 8, "outside of its table"),
        ("<H", vtable + 4, 2, "outside of its table"),
        ("<H", vtable + 4, 65535, "outside of its table"),
        ("<I", places[2], 2**32 - 1, "where a field needs"),  # data
        ("<I", places[2], 1, ""),
        ("<I", places[2], places[1] - places[2], "does not stand before its data"),
        ("<I", start - 4, len(whole), "where a field needs"),
        ("<I", places[1], 2**31, "where a field needs"),  # frame_id
        ("<I", places[1], start + 4 - places[1], ""),  # in the data
        ("<I", places[3], start - 4 - places[3], "within its data"),  # format is the data
        ("<I", places[0] + 4, 10**9, "its stamp"),
    ]
    for code, place, value, reason in cases:
        broken = bytearray(whole)
        struct.pack_into(code, broken, place, value)
        assert reason in refused(of, bytes(broken)), (code, place, value)
    behind = bytearray(whole) + whole[vtable:at]
    struct.pack_into("<i", behind, at, at - len(whole))
    assert refused(of, bytes(behind)) == "its table does not stand before its data"


def test_a_flatbuffer_with_too_much_around_its_data() -> None:
    of = form("flatbuffer", "CompressedImage")
    message = built("CompressedImage", ("data",), 5, noise(64))
    assert proven(of, message + bytes(60000))
    assert "stand around its data" in refused(of, message + bytes(MAX_BLANK))


def schema_fields(schema: bytes | bytearray, type_name: str) -> dict[str, flatbuffers.table.Table]:
    """The declared fields of a type in a binary schema, by flatbuffers' own reader."""
    root = flatbuffers.table.Table(schema, struct.unpack_from("<I", schema, 0)[0])

    def tables(table: flatbuffers.table.Table, slot: int) -> Iterator[flatbuffers.table.Table]:
        offset = table.Offset(slot)
        for index in range(table.VectorLen(offset)):
            place = table.Vector(offset) + 4 * index
            yield flatbuffers.table.Table(schema, table.Indirect(place))

    def name(table: flatbuffers.table.Table) -> str:
        return table.String(table.Offset(4) + table.Pos).decode()

    (declared,) = (item for item in tables(root, 4) if name(item) == type_name)
    return {name(field): field for field in tables(declared, 6)}


def image_bfbs() -> tuple[bytearray, dict[str, flatbuffers.table.Table]]:
    """Foxglove's schema of RawImage, to be changed."""
    schema = bytearray(SERIALIZATIONS["flatbuffer"].schema("foxglove_msgs/msg/RawImage")[1])
    return schema, schema_fields(schema, "foxglove.RawImage")


def test_flatbuffer_ids_are_those_of_the_schema() -> None:
    schema, fields = image_bfbs()
    for name, other in (("frame_id", 4), ("encoding", 1), ("width", 5), ("step", 2)):
        field = fields[name]
        struct.pack_into("<H", schema, field.Pos + field.Offset(8), other)
    of = FlatbufferForm("foxglove.RawImage", bytes(schema))
    message = payload("flatbuffer", "RawImage", 9, b"some")
    parts = of.split(memoryview(message))
    assert (parts.frame_id, parts.fields) == ("mono8", ImageFields("camera", 641, 480, 640, 0))
    assert proven(of, message)


@each("name", TYPES["foxglove.RawImage"])
def test_flatbuffer_schemas_of_other_types_are_refused(name: str) -> None:
    schema, fields = image_bfbs()
    field = fields[name]
    kind = flatbuffers.table.Table(schema, field.Indirect(field.Pos + field.Offset(6)))
    struct.pack_into("<B", schema, kind.Pos + kind.Offset(4), 2)  # bool
    with pytest.raises(WireError, match=f"field '{name}' of its schema is of another type"):
        FlatbufferForm("foxglove.RawImage", bytes(schema))


@pytest.mark.parametrize("name", ["timestamp", "data", "width"])
def test_flatbuffer_schemas_without_a_field_are_refused(name: str) -> None:
    schema, _ = image_bfbs()
    renamed = bytes(schema).replace(name.encode() + b"\0", name[::-1].encode() + b"\0")
    with pytest.raises(WireError, match=f"no field '{name}'"):
        FlatbufferForm("foxglove.RawImage", renamed)


@pytest.mark.parametrize("change", [(b"nsec\0", b"usec\0"), (b"BFBS", b"BFBT"), (b"Raw", b"Row")])
def test_flatbuffer_schemas_that_are_none_are_refused(change: tuple[bytes, bytes]) -> None:
    schema, _ = image_bfbs()
    assert change[0] in schema
    with pytest.raises(WireError, match="its schema"):
        FlatbufferForm("foxglove.RawImage", bytes(schema).replace(*change))
    with pytest.raises(WireError):
        FlatbufferForm("foxglove.CompressedImage", bytes(schema))


# ---------------------------------------------------------------- hostile bytes


@cache
def whole(source: str, kind: str) -> bytes:
    return payload(source, kind, STAMPS[-1], noise(40))


def harmless(of: Form, message: bytes) -> None:
    """A message splits and is proven or not, or it is refused; nothing else happens."""
    try:
        parts: Parts = of.split(memoryview(message))
        template = of.template(parts.blank)
    except WireError:
        return
    assert len(parts.blank) <= MAX_BLANK
    assert -(2**63) <= parts.stamp < 2**63
    if prove(template, parts, memoryview(message)):
        assert rebuilt(template, Slots(parts.stamp), bytes(parts.body)) == message
    for slots in (Slots(0), Slots(-1), Slots(2**63 - 1)):
        try:
            template.around(slots, 2**31)
        except WireError:
            continue


Numbers = st.integers(0, 255) | st.sampled_from([0, 1, 0x22, 0x2C, 0x5B, 0x7B, 0x7F, 0x80, 0xFF])


@st.composite
def mutations(draw: st.DrawFn, message: bytes) -> bytes:
    """A message with some bytes changed, cut, doubled or put in."""
    found = bytearray(message)
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, len(found)))
        end = min(len(found), at + draw(st.integers(0, 9)))
        action = draw(st.sampled_from(["set", "word", "cut", "double", "put"]))
        if action == "set":
            found[at : at + 1] = bytes([draw(Numbers)])
        elif action == "word":
            near = draw(st.integers(-9, 99) | st.sampled_from([2**31 - 1, -(2**31), -1]))
            found[at // 4 * 4 : at // 4 * 4 + 4] = struct.pack("<i", near)
        elif action == "cut":
            del found[at:end]
        elif action == "double":
            found[at:at] = found[at:end]
        else:
            found[at:at] = draw(st.binary(max_size=6))
    return bytes(found)


@each("kind", ["RawImage", "CompressedVideo", "CameraCalibration"], one_in=4)
@each("source", ["protobuf", "protobuf-renumbered", "json", "flatbuffer"])
@settings(steady, max_examples=400)
@given(st.data())
def test_mutated_messages_are_harmless(source: str, kind: str, data: st.DataObject) -> None:
    harmless(form(source, kind), data.draw(mutations(whole(source, kind))))


@settings(steady, max_examples=200)
@given(st.data())
@pytest.mark.parametrize("source", ["protobuf", "json", "flatbuffer"])
def test_mutated_blanks_are_harmless(source: str, data: st.DataObject) -> None:
    of = form(source, "RawImage")
    blank = of.split(memoryview(whole(source, "RawImage"))).blank
    try:
        template = of.template(data.draw(mutations(blank)))
        head, tail = template.around(Slots(STAMPS[-1]), 12)
    except WireError:
        return
    assert isinstance(head + tail, bytes)


@each("kind", ALL)
@each("source", ["protobuf", "json", "flatbuffer"])
@settings(steady, max_examples=200)
@given(st.binary(max_size=200))
def test_noise_is_harmless(source: str, kind: str, noise: bytes) -> None:
    harmless(form(source, kind), noise)


@each("kind", ["RawImage", "CameraCalibration"], one_in=2)
@each("name", ["protobuf", "flatbuffer"])
@settings(steady, max_examples=300)
@given(st.data())
def test_mutated_schemas_are_harmless(name: str, kind: str, data: st.DataObject) -> None:
    type_name, schema = SERIALIZATIONS[name].schema(f"foxglove_msgs/msg/{kind}")
    try:
        of = FORMS[name](type_name, data.draw(mutations(schema)))
    except WireError:
        return
    harmless(of, whole(name, kind))


LARGE = 24 << 20
MANY: dict[str, dict[str, tuple[bytes, bytes, bytes]]] = {  # what is first, repeated, and last
    "protobuf": {
        "wrong type": (b"", b"\x08\x01", b""),
        "unknown": (STAMP + tag(99, 0), b"\x01" + tag(99, 0), b""),
        "texts": (STAMP, b"\x22\x00", b""),
        "timestamp": (b"\x0a" + varint(LARGE), b"\x08\x01", b""),
        "no end": (b"", b"\xff", b""),
        "text": (b"\x3a" + varint(LARGE), b"x", b""),
    },
    "json": {
        "no end": (b'{"data":"', b"A", b""),
        "data": (b'{"data":"', b"A", b'",'),
        "members": (b'{"data":"AAAA",', b'"x":1, ', b""),
        "member": (b'{"x":', b"[", b""),
        "lists": (b"", b"[", b""),
        "objects": (b"", b'{"a":1,', b""),
        "escapes": (b'{"data":"', b"\\", b'"}'),
        "spaces": (b"", b" ", b""),
    },
    "flatbuffer": {
        "zeros": (b"", b"\0", b""),
        "ones": (b"", b"\xff", b""),
        "fours": (b"", b"\x04\0\0\0", b""),
    },
}


@each("kind", ["RawImage", "CameraCalibration"])
@each(("name", "case"), [(name, case) for name, cases in MANY.items() for case in cases])
def test_large_hostile_messages_take_little_time(name: str, case: str, kind: str) -> None:
    first, repeated, last = MANY[name][case]
    message = first + repeated * (LARGE // len(repeated)) + last
    of, start = form(name, kind), time.process_time()
    assert refused(of, message)
    assert time.process_time() - start < 2


@pytest.mark.parametrize("source", ["protobuf", "json-python", "flatbuffer"])
def test_a_large_message_takes_few_copies(source: str) -> None:
    of, body = form(source, "RawImage"), noise(LARGE)
    message = payload(source, "RawImage", STAMPS[-1], body)
    tracemalloc.start()
    try:
        parts = of.split(memoryview(message))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert parts.body == body
    assert peak < (3.2 * len(message) if source.startswith("json") else 1 << 20)
    assert prove(of.template(parts.blank), parts, memoryview(message))


def test_a_hostile_binary_schema_takes_little_time() -> None:
    schema, _ = image_bfbs()
    at, _ = table_at(schema)
    root = flatbuffers.table.Table(schema, at)
    objects = root.Vector(root.Offset(4)) - 4
    struct.pack_into("<I", schema, objects, 2**20)
    start = time.process_time()
    with pytest.raises(WireError, match="declares 1048576 things"):
        FlatbufferForm("foxglove.RawImage", bytes(schema) + bytes(2**23))
    struct.pack_into("<I", schema, objects, 4096)
    with pytest.raises(WireError):
        FlatbufferForm("foxglove.RawImage", bytes(schema) + bytes(2**23))
    assert time.process_time() - start < 2
