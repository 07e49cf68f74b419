"""A process of its own in DDS, as a robot's would be: it subscribes, publishes and calls services.

It shares no code with the package; its types are declared by hand. Commands come as lines of JSON
on stdin, and each is answered by a line on stdout.
"""

import base64
import json
import sys
import threading
import time
from typing import Any

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import (
    array,
    bounded_str,
    float64,
    int32,
    int64,
    sequence,
    uint8,
    uint32,
    uint64,
)
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from waiting import WATCHDOG_S


def raw(kind: Any) -> Any:
    """A type whose messages are the bytes that they came as; `parse` makes one to be published."""

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        message = cls.__new__(cls)
        message.raw = bytes(data)
        return message

    kind.parse = kind.deserialize
    kind.deserialize = classmethod(deserialize)
    return kind


def struct(name: str, /, **fields: Any) -> Any:
    """A type of ROS: ``std_msgs/msg/String`` is ``std_msgs.msg.dds_.String_`` in DDS."""
    package, kind, short = name.split("/")
    return make_idl_struct(f"{short}_", f"{package}.{kind}.dds_.{short}_", fields)


Time = struct("builtin_interfaces/msg/Time", sec=int32, nanosec=uint32)
Duration = struct("builtin_interfaces/msg/Duration", sec=int32, nanosec=uint32)
Header = struct("std_msgs/msg/Header", stamp=Time, frame_id=str)
Vector3 = struct("geometry_msgs/msg/Vector3", x=float64, y=float64, z=float64)
Quaternion = struct("geometry_msgs/msg/Quaternion", x=float64, y=float64, z=float64, w=float64)
Transform = struct("geometry_msgs/msg/Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = struct(
    "geometry_msgs/msg/TransformStamped", header=Header, child_frame_id=str, transform=Transform
)
TYPES: dict[str, Any] = {
    "std_msgs/msg/Header": raw(Header),
    "std_msgs/msg/String": raw(struct("std_msgs/msg/String", data=str)),
    "rosgraph_msgs/msg/Clock": raw(struct("rosgraph_msgs/msg/Clock", clock=Time)),
    "sensor_msgs/msg/Image": raw(
        struct(
            "sensor_msgs/msg/Image",
            header=Header,
            height=uint32,
            width=uint32,
            encoding=str,
            is_bigendian=uint8,
            step=uint32,
            data=sequence[uint8],
        )
    ),
    "sensor_msgs/msg/Imu": raw(
        struct(
            "sensor_msgs/msg/Imu",
            header=Header,
            orientation=Quaternion,
            orientation_covariance=array[float64, 9],
            angular_velocity=Vector3,
            angular_velocity_covariance=array[float64, 9],
            linear_acceleration=Vector3,
            linear_acceleration_covariance=array[float64, 9],
        )
    ),
    "tf2_msgs/msg/TFMessage": raw(
        struct("tf2_msgs/msg/TFMessage", transforms=sequence[TransformStamped])
    ),
}
_DESCRIBED = "type_description_interfaces/msg"
FieldType = struct(
    f"{_DESCRIBED}/FieldType",
    type_id=uint8,
    capacity=uint64,
    string_capacity=uint64,
    nested_type_name=bounded_str[255],
)
Field = struct(f"{_DESCRIBED}/Field", name=str, type=FieldType, default_value=str)
Individual = struct(
    f"{_DESCRIBED}/IndividualTypeDescription",
    type_name=bounded_str[255],
    fields=sequence[Field],
)
TypeDescription = struct(
    f"{_DESCRIBED}/TypeDescription",
    type_description=Individual,
    referenced_type_descriptions=sequence[Individual],
)
TypeSource = struct(f"{_DESCRIBED}/TypeSource", type_name=str, encoding=str, raw_file_contents=str)
KeyValue = struct(f"{_DESCRIBED}/KeyValue", key=str, value=str)
_CALL = {"client_guid": uint64, "sequence_number": int64}
DescriptionRequest = struct(
    "type_description_interfaces/srv/GetTypeDescription_Request",
    **_CALL,
    type_name=str,
    type_hash=str,
    include_type_sources=bool,
)
DescriptionResponse = struct(
    "type_description_interfaces/srv/GetTypeDescription_Response",
    **_CALL,
    successful=bool,
    failure_reason=str,
    type_description=TypeDescription,
    type_sources=sequence[TypeSource],
    extra_information=sequence[KeyValue],
)
_NOTHING = {"structure_needs_at_least_one_member": uint8}
_SUCCESS = {"success": bool}
SERVICES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    **dict.fromkeys(("Pause", "Resume", "TogglePaused", "Stop", "SplitBagfile"), (_NOTHING,) * 2),
    "IsPaused": (_NOTHING, {"paused": bool}),
    "GetRate": (_NOTHING, {"rate": float64}),
    "SetRate": ({"rate": float64}, _SUCCESS),
    "PlayNext": (_NOTHING, _SUCCESS),
    "Snapshot": (_NOTHING, _SUCCESS),
    "Burst": ({"num_messages": uint64}, {"actually_burst": uint64}),
    "Play": (
        {"start_offset": Time, "playback_duration": Duration, "playback_until_timestamp": Time},
        _SUCCESS,
    ),
    "Seek": ({"time": Time}, _SUCCESS),
}


class Peer:
    def __init__(self, domain: int) -> None:
        self._participant = DomainParticipant(domain)
        self._readers: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._kinds: dict[str, Any] = {}
        self._seen: dict[str, list[Any]] = {}
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._subscriptions = BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription)

    def subscribe(self, topic: str, kind: str, **qos: Any) -> bool:
        """Subscribe with a type that was declared by hand."""
        dds = Topic(self._participant, topic, TYPES[kind])
        self._readers[topic] = DataReader(self._participant, dds, qos=_qos(**qos))
        self._seen[topic] = []
        return True

    def received(self, topic: str, count: int, seconds: float = WATCHDOG_S) -> list[Any]:
        """Messages so far, when there are as many as asked for or time is up."""
        reader, seen = self._readers[topic], self._seen[topic]
        end = time.monotonic() + seconds
        while True:
            for sample in reader.take(1000):
                if sample.sample_info.valid_data:
                    seen.append(base64.b64encode(sample.raw).decode())
            if len(seen) >= count or time.monotonic() > end:
                return seen
            time.sleep(0.005)

    def forget(self, topic: str) -> bool:
        """Forget what was received so far."""
        self._seen[topic].clear()
        return True

    def connected(self, topic: str, count: int, seconds: float = WATCHDOG_S) -> int:
        """How many publishers a subscription has, waiting for as many as asked for."""
        end = time.monotonic() + seconds
        while True:
            found = len(self._readers[topic].get_matched_publications())
            if found == count or time.monotonic() > end:
                return found
            time.sleep(0.005)

    def publications(self, topic: str) -> list[Any]:
        """What a publisher tells of itself."""
        return _endpoints(self._publications, topic)

    def subscriptions(self, topic: str) -> list[Any]:
        """What a subscriber tells of itself."""
        return _endpoints(self._subscriptions, topic)

    def publish(self, topic: str, kind: str, message: str, **qos: Any) -> bool:
        """Publish a message, CDR in base64, when there is a subscriber."""
        if topic not in self._writers:
            dds = Topic(self._participant, topic, TYPES[kind])
            self._writers[topic] = DataWriter(self._participant, dds, qos=_qos(**qos))
            end = time.monotonic() + WATCHDOG_S
            while not self._writers[topic].matched_sub and time.monotonic() < end:
                time.sleep(0.005)
        writer = self._writers[topic]
        writer.write(TYPES[kind].parse(base64.b64decode(message)))
        return True

    def publish_opaque(self, topic: str, typename: str, type_hash: str, message: str) -> bool:
        """Publish a message of a type of which only the name and hash are announced."""
        data = base64.b64decode(message)
        if topic not in self._writers:
            kind = make_idl_struct(typename.rpartition(".")[2], typename, {}, dataclassify=False)
            kind.serialize = lambda *_, **__: data
            qos = Qos(Policy.Userdata(f"typehash={type_hash};".encode()), base=_qos())
            dds = Topic(self._participant, topic, kind)
            self._kinds[topic] = kind
            self._writers[topic] = DataWriter(self._participant, dds, qos=qos)
        self._writers[topic].write(self._kinds[topic]())
        return True

    def describe(self, node: str, sources: dict[str, str]) -> bool:
        """Answer for the types that a node knows, as `rclcpp` and `rclpy` do."""
        name = f"{node}/get_type_description"
        asked = Topic(self._participant, f"rq/{name}Request", DescriptionRequest)
        replies = Topic(self._participant, f"rr/{name}Reply", DescriptionResponse)
        reader = DataReader(self._participant, asked, qos=_qos())
        writer = DataWriter(self._participant, replies, qos=_qos())
        threading.Thread(target=_describe, args=(reader, writer, sources), daemon=True).start()
        return True

    def call(self, name: str, kind: str, request: list[Any]) -> Any:
        """Call a service as rmw_cyclonedds does; returns the fields of the reply."""
        asked, replied = SERVICES[kind]
        client = f"clientid={name}.1;".encode()
        out = struct(f"rosbag2_interfaces/srv/{kind}_Request", **_CALL, **asked)
        back = struct(f"rosbag2_interfaces/srv/{kind}_Response", **_CALL, **replied)
        qos = Qos(Policy.Userdata(client), base=_qos(reliable=True))
        writer = DataWriter(
            self._participant, Topic(self._participant, f"rq{name}Request", out), qos=qos
        )
        reader = DataReader(
            self._participant, Topic(self._participant, f"rr{name}Reply", back), qos=qos
        )
        end = time.monotonic() + WATCHDOG_S
        while time.monotonic() < end:
            if writer.get_matched_subscriptions() and reader.get_matched_publications():
                break
            time.sleep(0.005)
        fields = [
            field(*value) if isinstance(value, list) else value
            for field, value in zip(asked.values(), request, strict=False)
        ]
        writer.write(out(0x1234, 77, *(fields or [0])))
        while time.monotonic() < end:
            for reply in reader.take(10):
                if reply.sample_info.valid_data and reply.client_guid == 0x1234:
                    return [reply.sequence_number, {key: getattr(reply, key) for key in replied}]
            time.sleep(0.005)
        return None


def _endpoints(reader: Any, topic: str) -> list[Any]:
    end = time.monotonic() + WATCHDOG_S
    while time.monotonic() < end:
        found = [one for one in reader.read(1000) if one.topic_name == topic]
        if found:
            return [_told(one) for one in found]
        time.sleep(0.005)
    return []


def _describe(reader: Any, writer: Any, sources: dict[str, str]) -> None:
    while True:
        for request in reader.take(10):
            if request.sample_info.valid_data:
                is_known = request.type_name in sources
                found = [TypeSource(name, "msg", text) for name, text in sources.items()]
                header = request.client_guid, request.sequence_number
                told = TypeDescription(Individual(request.type_name, []), [])
                sent = found if is_known and request.include_type_sources else []
                reason = "" if is_known else "Type not registered"
                writer.write(DescriptionResponse(*header, is_known, reason, told, sent, []))
        time.sleep(0.005)


def _qos(*, reliable: bool = True, latched: bool = False, depth: int = 1000) -> Qos:
    return Qos(
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Reliability.Reliable(10**9) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
    )


def _told(endpoint: Any) -> dict[str, Any]:
    qos = endpoint.qos
    deadline = qos[Policy.Deadline].deadline if Policy.Deadline in qos else None
    return {
        "type": endpoint.type_name,
        "user_data": qos[Policy.Userdata].data.decode() if Policy.Userdata in qos else "",
        "reliable": Policy.Reliability.BestEffort not in qos,
        "latched": Policy.Durability.TransientLocal in qos,
        "deadline": deadline,
    }


def _say(value: Any) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def main() -> None:
    peer = Peer(int(sys.argv[1]))
    _say("ready")
    for line in sys.stdin:
        command, arguments, options = json.loads(line)
        _say(getattr(peer, command)(*arguments, **options))


if __name__ == "__main__":
    main()
