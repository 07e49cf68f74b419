"""Foxglove's recordings are decoded again by public libraries, with the schema in the file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder

from definitions import CODED_VIDEO, RAW_IMAGE
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from foxglove_wire import SERIALIZATIONS, as_bytes, message_class
from pictures import picture, pixels
from scenes import Record, instant
from sources import SOURCES

SCENES = ["raw-rgb8", "raw-32FC1", "jpeg-rgb", "video-h264"]


def written(folder: Path, source: str, name: str) -> Iterator[tuple[Record, Any, bytes, Any]]:
    """Each record of a scene, and schema, payload and decoded message of what was written."""
    made = FOXGLOVE[name](frames=4)
    (path,) = FOXGLOVE_SOURCES[source](folder, made)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[ProtobufDecoder(), Ros2Decoder()])
        found = list(reader.iter_messages(log_time_order=False))
        assert len(found) == len(made.messages) == 20
        for record, (schema, channel, message) in zip(made.messages, found, strict=True):
            assert (channel.topic, message.log_time) == (record.topic, record.log_time)
            assert schema is not None
            decoder = None
            for factory in (ProtobufDecoder(), Ros2Decoder()):
                decoder = decoder or factory.decoder_for(channel.message_encoding, schema)
            decoded = decoder(message.data) if decoder else None
            yield record, schema, message.data, decoded


def nanoseconds(stamp: Any) -> int:
    """Of a protobuf or ROS 2 time."""
    seconds = stamp.seconds if hasattr(stamp, "seconds") else stamp.sec
    return int(seconds) * 10**9 + (stamp.nanos if hasattr(stamp, "nanos") else stamp.nanosec)


def same(given: Any, found: Any) -> bool:
    """Whether a field holds what the record says, however it is represented."""
    if hasattr(found, "seconds") or hasattr(found, "sec"):
        return nanoseconds(found) == given
    if isinstance(given, dict):
        return all(same(value, getattr(found, key)) for key, value in given.items())
    if isinstance(given, str | int | float):
        return bool(given == found)
    if isinstance(given, bytes) or np.asarray(given).dtype == np.uint8:
        return bytes(found) == as_bytes(given)
    return np.array_equal(np.asarray(given, float), np.asarray(found, float))


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(
    "source", [s for s in FOXGLOVE_SOURCES if s.startswith(("mcap-protobuf", "mcap-foxglove"))]
)
def test_protobuf_and_ros2(source: str, name: str, tmp_path: Path) -> None:
    for record, schema, _, decoded in written(tmp_path, source, name):
        kind = record.msgtype.rpartition("/")[2]
        ros2 = source == "mcap-foxglove-ros2"
        assert schema.name == (f"foxglove_msgs/msg/{kind}" if ros2 else f"foxglove.{kind}")
        fields = {key: key for key in record.values}
        if not ros2:
            fields |= {key: key.upper() for key in "dkrp" if key in fields}
        if record.msgtype == RAW_IMAGE:
            fields.pop("is_bigendian")  # Foxglove's images are little-endian
        for key, field in fields.items():
            assert same(record.values[key], getattr(decoded, field)), field


def test_protobuf_fields_stand_where_they_should(tmp_path: Path) -> None:
    for variant in ("protobuf", "protobuf-stamp-last", "protobuf-renumbered"):
        (tmp_path / variant).mkdir()
        for record, _, data, _ in written(tmp_path / variant, f"mcap-{variant}", "video-h264"):
            if record.msgtype != CODED_VIDEO:
                continue
            packet = record.values["data"]
            stamp = message_class(CODED_VIDEO)().timestamp
            stamp.FromNanoseconds(record.values["timestamp"])
            place, body = data.index(stamp.SerializeToString()), data.index(packet)
            assert (place < body) == (variant == "protobuf")
            standard = message_class(CODED_VIDEO)
            if variant == "protobuf-renumbered":
                assert standard.FromString(data).data != packet
                assert data[:2] != b"\x0a\x0c"
            else:
                assert standard.FromString(data).data == packet


@pytest.mark.parametrize("name", FOXGLOVE)
def test_every_scene_is_the_same_in_every_serialization(name: str) -> None:
    made = FOXGLOVE[name](frames=3, width=32, height=16)
    for record in made.messages:
        sizes = {key: len(how.payload(record)) for key, how in SERIALIZATIONS.items()}
        assert sizes["protobuf"] == sizes["protobuf-stamp-last"] <= sizes["protobuf-renumbered"]
        assert sizes["protobuf-unknown-field"] == sizes["protobuf"] + 7
        for how in SERIALIZATIONS.values():
            assert how.payload(record) == how.payload(record)
            schema_name, data = how.schema(record.msgtype)
            assert schema_name.endswith(record.msgtype.rpartition("/")[2])
            assert data


def test_raw_images_hold_their_pictures() -> None:
    rng = np.random.default_rng([0, 1])
    for number, record in enumerate(
        record for record in FOXGLOVE["raw-rgb8"]().messages if record.msgtype == RAW_IMAGE
    ):
        instant(number, rng)
        expected = picture("rgb8", frame=number, width=64, height=48, rng=rng)
        assert np.array_equal(pixels(record.values), expected)


@pytest.mark.parametrize("source", ["bag-none", "rosbag2-mcap-v9", "mcap-ros1-zstd"])
def test_foxglove_messages_in_ros_recordings(source: str, tmp_path: Path) -> None:
    paths = SOURCES[source](tmp_path, FOXGLOVE["video-h264"](frames=3))
    assert all(path.exists() for path in paths)
