"""Standard ROS 1 message definitions, for recordings that are made and not read."""

from __future__ import annotations

from functools import lru_cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mp4ds.records import Channel, Schema


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


@lru_cache(maxsize=1)
def _store() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(
        get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
    )
    return store
