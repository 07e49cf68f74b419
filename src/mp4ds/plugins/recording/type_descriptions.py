"""Asks the nodes that publish a type for its definition, over DDS."""

from __future__ import annotations

import secrets
import time
from typing import Any

from mp4ds.bags.types import RosVersion, by_library, make_store
from mp4ds.plugins.publishing.dds import dds_qos, service_types
from mp4ds.plugins.publishing.dds_domain import as_is, make_struct
from mp4ds.plugins.publishing.ros2_writers import Qos
from mp4ds.plugins.recording.ros2_channels import described_definition

REPLIES = ("rr/", "/get_type_descriptionReply")
"""DDS topic of a node's replies: what precedes and follows the node's name."""

_PACKAGE = "type_description_interfaces"
_SERVICE = f"{_PACKAGE}/srv/GetTypeDescription"
_REQUEST = "string type_name\nstring type_hash\nbool include_type_sources"
_RESPONSE = f"""bool successful
string failure_reason
{_PACKAGE}/TypeDescription type_description
{_PACKAGE}/TypeSource[] type_sources
{_PACKAGE}/KeyValue[] extra_information"""
_PATIENCE_S = 2.0  # some middlewares reply in another way, and nodes may be gone
_WAIT_S = 0.01


def ask_for_definition(
    participant: Any, node: str, type_name: str, type_hash: str, version: RosVersion
) -> str:
    """The definition of a type, from the `get_type_description` service of a node.

    Args:
        participant: The DDS participant.
        node: Full name of the node without the leading slash, such as ``robot/camera``.
        type_name: Such as ``sensor_msgs/msg/Image``.
        type_hash: As announced by the publisher, which the definition must have.
        version: The types of ROS 2.

    Returns:
        The text, with the definitions of its parts; empty if no reply comes in time, or the one
        that comes is not proven by the hash.
    """
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    guid = secrets.randbits(63)
    types, _ = service_types(f"{_SERVICE}_Request", _REQUEST, version)
    replies, _ = service_types(f"{_SERVICE}_Response", _RESPONSE, version)
    kind = as_is(make_struct(types, f"{_SERVICE}_Request"))
    reply_kind = as_is(make_struct(replies, f"{_SERVICE}_Response"))
    name = f"{node}/get_type_description"
    # a server replies once it has discovered the reader with the same client id
    qos = dds_qos(Qos(), user_data=f"clientid={guid:x};")
    writer = DataWriter(participant, Topic(participant, f"rq/{name}Request", kind), qos=qos)
    reader = DataReader(participant, Topic(participant, f"rr/{name}Reply", reply_kind), qos=qos)
    end = time.monotonic() + _PATIENCE_S
    while not (writer.get_matched_subscriptions() and reader.get_matched_publications()):
        if time.monotonic() > end:
            return ""
        time.sleep(_WAIT_S)
    store: Any = make_store(types, version)
    request = store.types[f"{_SERVICE}_Request"](
        client_guid=guid,
        sequence_number=1,
        type_name=type_name,
        type_hash=type_hash,
        include_type_sources=True,
    )
    writer.write(kind(bytes(store.serialize_cdr(request, f"{_SERVICE}_Request"))))
    parse: Any = make_store(replies, version).deserialize_cdr
    while time.monotonic() < end:
        for sample in reader.take(1):
            if sample.sample_info.valid_data:
                reply = by_library("", parse, sample.payload, f"{_SERVICE}_Response")
                if reply.client_guid == guid:
                    sources = reply.type_sources if reply.successful else ()
                    texts = {one.type_name: one.raw_file_contents for one in sources}
                    return described_definition(texts, type_name, type_hash)
        time.sleep(_WAIT_S)
    return ""
