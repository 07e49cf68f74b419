"""Foxglove's messages taken apart and rebuilt, against Foxglove's own generated code."""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

import mp4ds
from coded_tools import mutations
from compare import compare
from foxglove_wire import SERIALIZATIONS
from mp4ds.errors import Refused
from mp4ds.messages.serializations import ProtobufForm
from mp4ds.messages.wire import (
    MAX_BLANK,
    CalibrationFields,
    CodedFields,
    Form,
    ImageFields,
    Parts,
    Slots,
    Template,
    prove,
)
from scenes import Record
from waiting import lines_run

SOURCES = [name for name, source in SERIALIZATIONS.items() if source.encoding == "protobuf"]
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
    return ProtobufForm(name, schema)


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
    return b"".join((head, body, tail))


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
    with pytest.raises(Refused) as caught:
        of.split(memoryview(message))
    return str(caught.value)


# ---------------------------------------------------------------- what libraries write


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("source", SOURCES)
def test_a_message_splits_and_returns(source: str, kind: str) -> None:
    of = form(source, kind)
    for size in SIZES if kind in BODIED else [0]:
        body, blanks = noise(size), set()
        for stamp in (*STAMPS, LAST):
            message = payload(source, kind, stamp, body)
            if kind in BODIED and not size:  # protobuf leaves out what is empty
                assert refused(of, message) == "it has no data"
                continue
            parts = of.split(memoryview(message))
            assert (parts.stamp, parts.seq, parts.pts) == (stamp, None, None)
            assert (parts.frame_id, parts.fields) == (VALUES[kind]["frame_id"], FIELDS[kind])
            assert parts.body == body
            assert kind not in BODIED or len(parts.blank) < 300
            assert rebuilt(of.template(parts.blank), Slots(stamp), body) == message
            assert proven(of, message)
            blanks.add(parts.blank)
        assert len(blanks) <= 1


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


@pytest.mark.parametrize(
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


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (DATA, "it has no timestamp"),
        (STAMP, "it has no data"),
        (STAMP + STAMP + DATA, "it has its timestamp twice"),
        (STAMP + b"\x10\x01", "its field data is not of the declared type"),
        (STAMP + DATA + b"\x22\x01\xff", "not UTF-8"),
        (STAMP + DATA + b"\x00\x00", "it has an invalid tag"),
        (STAMP + DATA + b"\xff" * 9 + b"\x02", "a number in it is cut short"),
        (STAMP + DATA + tag(9, 3) + tag(9, 4), "wire type 3"),
        (STAMP + b"\x12" + varint(2**63) + b"x", "but a field extends to byte"),
        (STAMP + DATA + block(9, bytes(MAX_BLANK)), "bytes besides its data"),
    ],
)
def test_protobuf_refusals_say_why(message: bytes, reason: str) -> None:
    assert reason in refused(form("protobuf", "CompressedImage"), message)


# ---------------------------------------------------------------- hostile bytes


@cache
def whole(source: str, kind: str) -> bytes:
    return payload(source, kind, STAMPS[-1], noise(40))


def harmless(of: Form, message: bytes) -> None:
    """A message splits and is proven or not, or it is refused; nothing else happens."""
    try:
        parts: Parts = of.split(memoryview(message))
        template = of.template(parts.blank)
    except Refused:
        return
    assert len(parts.blank) <= MAX_BLANK
    assert -(2**63) <= parts.stamp < 2**63
    if prove(template, parts, memoryview(message)):
        assert rebuilt(template, Slots(parts.stamp), bytes(parts.body)) == message
    for slots in (Slots(0), Slots(-1), Slots(2**63 - 1)):
        try:
            template.around(slots, 2**31)
        except Refused:
            continue


@pytest.mark.parametrize("kind", ["RawImage", "CompressedVideo", "CameraCalibration"])
@pytest.mark.parametrize("source", ["protobuf", "protobuf-renumbered"])
def test_mutated_messages_are_harmless(source: str, kind: str) -> None:
    for message in mutations(whole(source, kind), 1000):
        harmless(form(source, kind), message)


@pytest.mark.parametrize("kind", ["RawImage", "CameraCalibration"])
def test_mutated_schemas_are_harmless(kind: str) -> None:
    type_name, schema = SERIALIZATIONS["protobuf"].schema(f"foxglove_msgs/msg/{kind}")
    for changed in mutations(schema, 300, head=len(schema)):
        try:
            of = ProtobufForm(type_name, changed)
        except Refused:
            continue
        harmless(of, whole("protobuf", kind))


LARGE = 24 << 20
MANY = {  # what is first, and repeated
    "wrong type": (b"", b"\x08\x01"),
    "unknown": (STAMP + tag(99, 0), b"\x01" + tag(99, 0)),
    "texts": (STAMP, b"\x22\x00"),
    "timestamp": (b"\x0a" + varint(LARGE), b"\x08\x01"),
    "no end": (b"", b"\xff"),
    "text": (b"\x3a" + varint(LARGE), b"x"),
}


@pytest.mark.parametrize("kind", ["RawImage", "CameraCalibration"])
@pytest.mark.parametrize("case", MANY)
def test_large_hostile_messages_take_little_work(case: str, kind: str) -> None:
    first, repeated = MANY[case]
    message = first + repeated * (LARGE // len(repeated))
    of = form("protobuf", kind)
    assert lines_run(lambda: refused(of, message)) < 5_000_000  # some 0.1 s


# ---------------------------------------------------------------- other serializations


@pytest.mark.parametrize("encoding", ["json", "flatbuffer", "cbor"])
def test_other_serializations_are_kept_as_they_are(encoding: str, tmp_path: Path) -> None:
    """Whatever they hold: nobody looks."""
    path = tmp_path / "drive.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "x")
        for topic, kind in (("/image", "RawImage"), ("/info", "CameraCalibration")):
            name = f"foxglove.{kind}"
            schema = writer.register_schema(name, encoding, b"{}") if encoding != "cbor" else 0
            schema = schema or writer.register_schema(name, "", b"")
            channel = writer.register_channel(topic, encoding, schema)
            for number in range(3):
                writer.add_message(channel, number, b'{"data":"AA=="}', number, number)
        writer.finish()  # type: ignore[no-untyped-call]
    summary = mp4ds.pack(path, tmp_path / "dataset")
    image, info = summary.topics
    reason = f"it does not parse: serialization {encoding!r} is not modelled"
    assert image.verbatim == {reason: (3, 0)}
    assert (info.messages, info.frames) == (3, 0)
    mp4ds.unpack(tmp_path / "dataset", "mcap", tmp_path / "again.mcap")
    assert compare([path], tmp_path / "again.mcap") == []
