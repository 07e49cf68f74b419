"""The services of `ros2 bag play` over DDS, in the way of rmw_cyclonedds.

A request is a message on ``rq/NAMERequest`` that begins with who asks and a number, and its
reply one on ``rr/NAMEReply`` that begins with the same 16 bytes. Other middlewares of ROS 2 do
it in other ways: clients have to use rmw_cyclonedds (``RMW_IMPLEMENTATION=rmw_cyclonedds_cpp``).
"""

from __future__ import annotations

import re
import time
from typing import Any

from mp4ds.bags.typedefs import World, make_store, types_of
from mp4ds.publishers.dds_ears import Ears
from mp4ds.publishers.dds_types import make_struct
from mp4ds.publishers.dds_writer import dds_qos
from mp4ds.publishers.protocol import Controls
from mp4ds.publishers.qos import Qos
from mp4ds.publishers.services import PLAYER_SERVICES, Service
from mp4ds.records import Schema

_PATIENCE = 0.1  # seconds until the reader of who asks has to be known, as in ROS
_HEADER = "uint64 client_guid\nint64 sequence_number\n"
_FILLER = "structure_needs_at_least_one_member"
_CLIENT = re.compile(rb"(?:^|;)clientid=([^;]*);")


def serve(participant: Any, ears: Ears, node: str, controls: Controls, world: World) -> list[Any]:
    """Offer the services of a player.

    Args:
        participant: Who offers them.
        ears: Hears the requests; they are answered on its thread.
        node: Name of the node that they belong to.
        controls: The player.
        world: The types of ROS 2.

    Returns:
        What has to be kept while they are offered.
    """
    return [
        _Server(participant, ears, f"/{node}/{service.name}", service, controls, number, world)
        for number, service in enumerate(PLAYER_SERVICES, 1)
    ]


class _Server:
    def __init__(
        self,
        participant: Any,
        ears: Ears,
        name: str,
        service: Service,
        controls: Controls,
        number: int,
        world: World,
    ) -> None:
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        self._service = service
        self._controls = controls
        request, request_hash = message_class(f"{service.kind}_Request", service.request, world)
        self._reply, reply_hash = message_class(f"{service.kind}_Response", service.response, world)
        # tells clients which reader and which writer are one service
        own = f"serviceid={_identity(participant, number)};"
        self._reader = DataReader(
            participant,
            Topic(participant, f"rq{name}Request", request),
            qos=dds_qos(Qos(), user_data=f"{own}typehash={request_hash};"),
        )
        self._writer = DataWriter(
            participant,
            Topic(participant, f"rr{name}Reply", self._reply),
            qos=dds_qos(Qos(), user_data=f"{own}typehash={reply_hash};"),
        )
        ears.hear(self._reader, self._on_request)

    def _on_request(self, request: Any) -> None:
        fields = dict(self._service.answer(self._controls, request))
        reply = self._reply(
            client_guid=request.client_guid,
            sequence_number=request.sequence_number,
            **(fields or {_FILLER: 0}),
        )
        self._wait_for_reader(request.sample_info.publication_handle)
        self._writer.write(reply)

    def _wait_for_reader(self, asking: int) -> None:
        """Wait until the reader of who asked is connected, so that it gets the reply."""
        endpoint = self._reader.get_matched_publication_data(asking)
        client = _client_of(endpoint)
        end = time.monotonic() + _PATIENCE
        while client and client not in self._connected() and time.monotonic() < end:
            time.sleep(0.01)

    def _connected(self) -> set[bytes]:
        writer = self._writer
        readers = writer.get_matched_subscriptions()
        return {_client_of(writer.get_matched_subscription_data(reader)) for reader in readers}


def message_class(kind: str, definition: str, world: World) -> tuple[Any, str]:
    """The class of a request or response with what goes before it, and its type hash.

    Args:
        kind: Its type, such as ``Seek_Request``.
        definition: Its fields, as of a message.
        world: The types of ROS 2.
    """
    short, name = f"rosbag2_interfaces/msg/{kind}", f"rosbag2_interfaces/srv/{kind}"
    types = types_of(Schema(short, "ros2msg", definition.encode()), world)
    types[name] = types.pop(short)
    type_hash = make_store(types, world).hash_rihs01(name)
    whole = types_of(Schema(short, "ros2msg", (_HEADER + definition).encode()), world)
    whole[name] = whole.pop(short)
    return make_struct(whole, name, has_fields=True), type_hash


def _identity(participant: Any, number: int) -> str:
    """Tells services apart: the participant, and a number within it."""
    return ".".join(f"{byte:x}" for byte in participant.guid.bytes[:12] + number.to_bytes(4, "big"))


def _client_of(endpoint: Any) -> bytes:
    from cyclonedds.core import Policy

    if endpoint is None or Policy.Userdata not in endpoint.qos:
        return b""
    found = _CLIENT.search(endpoint.qos[Policy.Userdata].data)
    return found[1] if found else b""
