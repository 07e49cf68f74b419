"""The demonstration: one scene in each format, as ROS itself would have recorded it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag1 import Reader as BagReader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import Stores, get_typestore

import compare
import mp4ds
from mp4ds.bags.convert import is_latched
from mp4ds.bags.formats import open_reader
from mp4ds.bags.rosbag2_metadata import read_bag_info
from mp4ds.plugins.demo import demo
from sources import typestore

KINDS = ("drive.mcap", "drive.bag", "drive")
COUNTS = {
    "/tf_static": 1,
    "/imu": 50,
    "/tf": 10,
    **{f"/{side}/{name}": 7 for side in ("left", "right") for name in ("image_raw", "camera_info")},
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    for name in KINDS:
        assert demo(folder / name, seconds=0.5) == sum(COUNTS.values())
    assert sorted(path.name for path in folder.iterdir()) == sorted(KINDS)
    return folder


def test_an_mcap_of_ros2(made: Path) -> None:
    """Read by others: every message decodes, and topics have their QoS and type hash."""
    with (made / "drive.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert reader.get_header().profile == "ros2"
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        durabilities = {}
        for channel in summary.channels.values():
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_"), channel.topic
            durabilities[channel.topic] = channel.metadata["offered_qos_profiles"].split(
                "durability: "
            )[1][0]
        assert durabilities == dict.fromkeys(COUNTS, "2") | {"/tf_static": "1"}
        counts: Counter[str] = Counter()
        for _, channel, message, decoded in reader.iter_decoded_messages():
            assert message.sequence == counts[channel.topic]
            counts[channel.topic] += 1
            if channel.topic == "/right/image_raw":
                assert len(decoded.data) == decoded.height * decoded.step == 480 * 360 * 3
            elif channel.topic == "/tf_static":
                assert [part.child_frame_id for part in decoded.transforms] == [
                    "left_optical",
                    "right_optical",
                    "imu",
                ]
        assert counts == COUNTS


def test_the_folder_of_rosbag2_holds_the_same(made: Path) -> None:
    assert compare.main([str(made / "drive.mcap"), str(made / "drive")]) == 0
    info = read_bag_info(made / "drive" / "metadata.yaml")
    assert {topic.name for topic in info.topics} == set(COUNTS)
    with Rosbag2Reader(made / "drive") as reader:
        assert reader.message_count == sum(COUNTS.values())
    with open_reader(made / "drive") as opened:
        latched = {channel.topic for channel in opened.channels if is_latched(channel)}
    assert latched == {"/tf_static"}


def test_the_bag_shows_the_same_scene(made: Path) -> None:
    """The same times and values; as in any bag, headers are counted, and publishers named."""
    store, ros2 = typestore("ros1"), get_typestore(Stores.ROS2_HUMBLE)
    with open_reader(made / "drive.mcap") as reader:
        expected: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in COUNTS}
        for record in reader.records():
            assert hasattr(record, "channel")
            decoded = ros2.deserialize_cdr(record.data, record.channel.type_name)
            expected[record.channel.topic].append((record.log_time, decoded))
    with BagReader(made / "drive.bag") as bag:
        for topic, messages in expected.items():
            connections = [one for one in bag.connections if one.topic == topic]
            (extra,) = {(one.ext.callerid, one.ext.latching) for one in connections}
            assert extra[0].startswith("/")
            assert bool(extra[1]) == (topic == "/tf_static")
            found = list(bag.messages(connections))
            assert [time for _, time, _ in found] == [time for time, _ in messages], topic
            for number, ((connection, _, data), (_, due)) in enumerate(
                zip(found, messages, strict=True)
            ):
                message = store.deserialize_ros1(data, connection.msgtype)
                if hasattr(message, "header"):
                    assert message.header.seq == number
                    assert message.header.frame_id == due.header.frame_id
                    assert message.header.stamp.nanosec == due.header.stamp.nanosec
                if topic.endswith("image_raw"):
                    assert bytes(message.data) == bytes(due.data)
                elif topic.endswith("camera_info"):
                    assert message.P.tolist() == due.p.tolist()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", KINDS)
def test_each_kind_is_packed_and_comes_back(name: str, made: Path, tmp_path: Path) -> None:
    mp4ds.pack(made / name, tmp_path / "packed")
    mp4ds.unpack(tmp_path / "packed", output=tmp_path / f"again_{name}")
    assert compare.main([str(made / name), str(tmp_path / f"again_{name}")]) == 0
