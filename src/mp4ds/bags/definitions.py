"""Standard message definitions, for recordings that are made and not read."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mp4ds.bags.convert import LATCHED_QOS
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Schema


def ros1_channel(channel_id: int, topic: str, type_name: str, callerid: str) -> Channel:
    """A channel of a standard ROS 1 type, with its definition and md5sum.

    Args:
        channel_id: Unique in the recording.
        topic: Topic name.
        type_name: Such as ``sensor_msgs/Image``.
        callerid: Name of the publishing node.
    """
    package, name = type_name.split("/")
    definition, md5sum = _store().generate_msgdef(f"{package}/msg/{name}", ros_version=1)
    return Channel(
        channel_id,
        topic,
        "ros1",
        Schema(type_name, "ros1msg", definition.encode()),
        {"md5sum": md5sum, "callerid": callerid},
    )


def ros2_channel(channel_id: int, topic: str, type_name: str) -> Channel:
    """A channel of a standard ROS 2 type, with its definition and type hash.

    Args:
        channel_id: Unique in the recording.
        topic: Topic name.
        type_name: Such as ``sensor_msgs/msg/Image``.
    """
    store = _ros2_store()
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return Channel(
        channel_id,
        topic,
        "cdr",
        Schema(type_name, "ros2msg", definition.encode()),
        {QOS_KEY: "", HASH_KEY: store.hash_rihs01(type_name)},
    )


def latched(channel: Channel) -> Channel:
    """The same ROS 2 channel, which gives those that subscribe late its last message."""
    return replace(channel, metadata={**channel.metadata, QOS_KEY: LATCHED_QOS})


@lru_cache(maxsize=1)
def _ros2_store() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


@lru_cache(maxsize=1)
def _store() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(
        get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
    )
    return store
