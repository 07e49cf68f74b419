"""Channels of ROS 2 as rosbag2 records them: definitions, type hashes, QoS profiles."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, get_args

from mp4ds.bags.rosbag2_metadata import dump_yaml
from mp4ds.bags.types import RosVersion, by_library, make_store, ros2_version, types_of
from mp4ds.errors import Refused
from mp4ds.plugins.publishing.names import SERVICE_EVENTS
from mp4ds.plugins.publishing.ros2_writers import (
    NOTHING,
    Qos,
    Service,
    is_paused,
    pause,
    resume,
)
from mp4ds.plugins.recording.source import RecorderControls
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Schema

DISTRIBUTION = "jazzy"
_ENCODING = "ros2msg"
_SEPARATOR = "=" * 80
_MAX_TEXT = 2**22
_NS = 10**9
_INFINITE = {"sec": 2**63 // _NS, "nsec": 2**63 % _NS - 1}
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w+")
_PRIMITIVE = re.compile(r"bool|byte|char|u?int(?:8|16|32|64)|float(?:32|64)|w?string")
_DDS_NAME = re.compile(r"(?:\w+(?:::|\.))+dds_(?:::|\.)\w+_")


def qos_text(profiles: Sequence[Qos]) -> str:
    """QoS profiles as rosbag2 writes them from metadata version 9 on."""
    return dump_yaml(
        [
            {
                "history": profile.history,
                "depth": profile.depth,
                "reliability": profile.reliability,
                "durability": profile.durability,
                "deadline": _duration(profile.deadline_ns),
                "lifespan": _duration(profile.lifespan_ns),
                "liveliness": profile.liveliness,
                "liveliness_lease_duration": _duration(profile.lease_ns),
                "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
            }
            for profile in profiles
        ]
    )


def _duration(nanoseconds: int | None) -> dict[str, int]:
    if nanoseconds is None:
        return dict(_INFINITE)
    return dict(zip(("sec", "nsec"), divmod(nanoseconds, _NS), strict=True))


def asked_qos(profiles: Sequence[Qos], depth: int) -> Qos:
    """The QoS that matches all publishers, chosen as rosbag2 does.

    Args:
        profiles: What the publishers offer.
        depth: Depth of the subscription.
    """
    is_reliable = bool(profiles) and all(profile.is_reliable for profile in profiles)
    is_latched = bool(profiles) and all(profile.is_latched for profile in profiles)
    return Qos(
        depth=depth,
        reliability="reliable" if is_reliable else "best_effort",
        durability="transient_local" if is_latched else "volatile",
        avoid_ros_namespace_conventions=any(
            profile.avoid_ros_namespace_conventions for profile in profiles
        ),
    )


def is_hidden(topic: str) -> bool:
    """Whether ROS 2 hides a topic: a part of its name begins with an underscore.

    For recorders, service events are not hidden.
    """
    return not topic.endswith(SERVICE_EVENTS) and any(
        part.startswith("_") for part in topic.split("/")
    )


def channel_of(
    number: int, topic: str, type_name: str, definition: str, type_hash: str, qos: Sequence[Qos]
) -> Channel:
    """A channel as rosbag2 records it.

    Args:
        number: Its id.
        topic: Its topic.
        type_name: Such as ``sensor_msgs/msg/Image``.
        definition: Its definition, with those of its parts; empty if unknown.
        type_hash: ``RIHS01_...``; empty if unknown.
        qos: What its publishers offer.
    """
    schema = Schema(type_name, _ENCODING if definition else "", definition.encode())
    metadata = {QOS_KEY: qos_text(qos), **({HASH_KEY: type_hash} if type_hash else {})}
    return Channel(number, topic, "cdr", schema, metadata)


def time_of(clock: bytes | memoryview) -> int:
    """The time in a message of /clock (CDR), nanoseconds."""
    sec, nanosec = struct.unpack_from("<iI" if clock[1] & 1 else ">iI", clock, 4)
    return int(sec) * _NS + int(nanosec)


# ---------------------------------------------------------------- services


def _split(controls: RecorderControls, _: Any) -> Mapping[str, Any]:
    controls.split()
    return {}


def _stop(controls: RecorderControls, _: Any) -> Mapping[str, Any]:
    controls.stop()
    return {}


RECORDER_SERVICES = (
    Service("pause", "Pause", NOTHING, NOTHING, pause),
    Service("resume", "Resume", NOTHING, NOTHING, resume),
    Service("is_paused", "IsPaused", NOTHING, "bool paused", is_paused),
    Service("split_bagfile", "SplitBagfile", NOTHING, NOTHING, _split),
    Service("stop", "Stop", NOTHING, NOTHING, _stop),
)
"""Those of `ros2 bag record`, except for snapshots."""


# ---------------------------------------------------------------- definitions


@cache
def _version() -> RosVersion:
    return ros2_version(DISTRIBUTION)


def standard_definition(type_name: str, type_hash: str) -> str:
    """The definition of a standard type; empty if it is not one, or its hash differs.

    Args:
        type_name: Such as ``sensor_msgs/msg/Image``.
        type_hash: As announced by the publisher; empty if it announced none.
    """
    if type_name not in _version().standard:
        return ""
    return _proven(Schema(type_name, _ENCODING, b""), type_hash)


def _proven(schema: Schema, type_hash: str) -> str:
    """A definition with those of its parts; empty if its hash is not the one announced."""
    try:
        store: Any = make_store(types_of(schema, _version()), _version())
        if type_hash and by_library("", store.hash_rihs01, schema.name) != type_hash:
            return ""
        text: str = by_library("", store.generate_msgdef, schema.name)[0]
        return text
    except Refused:
        return ""


def installed_definition(type_name: str, share: Sequence[Path]) -> str:
    """The installed definition of a type, with those of its parts, as rosbag2 stores it.

    Args:
        type_name: Such as ``sensor_msgs/msg/Image``.
        share: The ``share`` folders of all workspaces.

    Returns:
        The text; empty if a part is not installed as a ``.msg`` file.
    """
    found: dict[str, str] = {}
    todo = [type_name]
    while todo:
        name = todo.pop(0)
        if name in found:
            continue
        package, _, short = name.partition("/msg/")
        paths = [folder / package / "msg" / f"{short}.msg" for folder in share]
        text = next((path.read_text() for path in paths if path.is_file()), None)
        if text is None:
            return ""
        found[name] = text
        todo += _parts(text, package)
    return _with_parts(found)


def _with_parts(texts: Mapping[str, str]) -> str:
    """A definition followed by those of its parts; the first text is the type's own."""
    main, *parts = texts.items()
    rest = (f"\n{_SEPARATOR}\nMSG: {name.replace('/msg/', '/')}\n{text}" for name, text in parts)
    return "".join((main[1], *rest))


def _parts(text: str, package: str) -> Iterator[str]:
    """Types of a definition's fields, except for built-in ones."""
    for line in text.splitlines():
        match = _FIELD.match(line.partition("#")[0])
        if match and not _PRIMITIVE.fullmatch(match[1]):
            rooms = match[1].split("/")
            yield f"{rooms[0] if len(rooms) > 1 else package}/msg/{rooms[-1]}"


def described_definition(texts: Mapping[str, str], type_name: str, type_hash: str) -> str:
    """The definition of a type as described by a node.

    Args:
        texts: Definitions of the type and its parts, by type.
        type_name: The type.
        type_hash: As announced by the publisher, which the definition must have.

    Returns:
        The text, with the definitions of its parts; empty if it is not proven by the hash.
    """
    if not type_hash or type_name not in texts or sum(map(len, texts.values())) > _MAX_TEXT:
        return ""
    text = _with_parts({type_name: texts[type_name], **texts})
    return text if _proven(Schema(type_name, _ENCODING, text.encode()), type_hash) else ""


# ---------------------------------------------------------------- DDS


def ros_type(dds_name: str) -> str:
    """The ROS name of a DDS type such as ``std_msgs::msg::dds_::String_``; empty for others."""
    if not _DDS_NAME.fullmatch(dds_name):
        return ""
    *rooms, _, name = dds_name.replace("::", ".").split(".")
    return "/".join((*rooms, name.removesuffix("_")))


def announced_definition(kind: Any, type_hash: str) -> str:
    """The definition of a type as announced by a publisher over DDS.

    Args:
        kind: Its class, an IDL structure.
        type_hash: As announced by the publisher, which the definition must have.

    Returns:
        The text, with the definitions of its parts; empty if it is not proven by the hash.
    """
    if not type_hash:
        return ""
    try:
        texts = dict(_structures(kind))
    except (Refused, AttributeError, TypeError, ValueError):
        return ""
    name = next(iter(texts))
    return _proven(Schema(name, _ENCODING, _with_parts(texts).encode()), type_hash)


def _structures(kind: Any) -> Iterator[tuple[str, str]]:
    """Name and fields of a structure, then those of its parts."""
    parts: list[Any] = []
    lines = [f"{_spelled(hint, parts)} {name}" for name, hint in kind.__annotations__.items()]
    yield ros_type(kind.__idl_typename__), "\n".join(lines) + "\n"
    for part in parts:
        yield from _structures(part)


def _spelled(hint: Any, parts: list[Any]) -> str:
    """A field's type as written in a ``.msg`` file."""
    from cyclonedds.idl import types

    inner, *notes = get_args(hint) or (hint,)
    note = notes[0] if notes else None
    if isinstance(note, types.array):
        return f"{_spelled(note.subtype, parts)}[{note.length}]"
    if isinstance(note, types.sequence):
        bound = f"<={note.max_length}" if note.max_length else ""
        return f"{_spelled(note.subtype, parts)}[{bound}]"
    if isinstance(note, types.bounded_str):
        return f"string<={note.max_length}"
    if isinstance(note, str):
        return note
    if inner in (str, bool):
        return {str: "string", bool: "bool"}[inner]
    name = ros_type(inner.__idl_typename__)
    if not name:
        raise Refused("it has a part that is not a message of ROS")
    parts.append(inner)
    return name.replace("/msg/", "/")
