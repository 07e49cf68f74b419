"""The metadata.yaml of rosbag2, versions 1 to 9."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import yaml

from mp4ds import yamlio
from mp4ds.bags.files import SALVAGE, SALVAGE_REMEDY
from mp4ds.errors import SourceError
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Schema

METADATA_FILE = "metadata.yaml"
NEWEST_VERSION = 9
NATIVE_QOS_VERSION = 9
"""From this version on, QoS profiles are YAML; before, a string of YAML with other enums."""

RECORD = "mp4ds:rosbag2"
"""Metadata record with the content of a rosbag2 recording besides topics and messages."""

TABLES_RECORD = "mp4ds:rosbag2:tables"
"""Metadata record with the small tables of a storage file that is not open at first."""

MCAP_RECORD = "rosbag2"
"""Metadata record in which an MCAP storage file keeps a metadata.yaml."""

_TOP_KEY = "rosbag2_bagfile_information"
_MAX_BYTES = 64 * 2**20
_STORAGES = {"db3": "sqlite3", "mcap": "mcap"}
_INTEGER = re.compile(r"-?(?:0|[1-9][0-9]*)")


class _Dumper(yamlio.PlainDumper):
    """Writes texts as rosbag2 does."""


def _represent_str(dumper: _Dumper, text: str) -> Any:
    style = '"' if "\n" in text or not text else None  # as rosbag2 writes its QoS strings
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _represent_str)


@dataclass(frozen=True)
class TopicMetadata:
    """A topic as metadata.yaml lists it.

    Attributes:
        name: Topic name.
        type_name: Type name.
        serialization_format: Usually ``cdr``.
        qos: Offered QoS profiles as YAML text, None if the version has none.
        type_hash: Type description hash, None if the version has none.
        count: Number of messages.
    """

    name: str
    type_name: str
    serialization_format: str
    qos: str | None
    type_hash: str | None
    count: int = 0

    @classmethod
    def of(cls, channel: Channel) -> TopicMetadata:
        """The topic that a channel is; channels that do not differ in this are one."""
        qos, type_hash = (channel.metadata.get(key, "") for key in (QOS_KEY, HASH_KEY))
        encoding = channel.message_encoding
        return cls(channel.topic, channel.type_name, encoding, qos, type_hash)

    def to_channel(self, channel_id: int) -> Channel:
        """The channel of a topic that is not in the storage."""
        metadata = {QOS_KEY: self.qos, HASH_KEY: self.type_hash}
        known = {key: value for key, value in metadata.items() if value is not None}
        schema = Schema(self.type_name, "", b"")
        return Channel(channel_id, self.name, self.serialization_format, schema, known)


@dataclass(frozen=True)
class BagInfo:
    """The parts of a metadata.yaml that mp4ds needs.

    Attributes:
        text: The file, verbatim.
        version: 1 to 9.
        storage: ``sqlite3`` or ``mcap``; empty without files.
        file_names: Names of the storage files within the folder, in reading order.
        compression: ``file``, ``message`` or empty.
        ros_distro: Name of the ROS distribution; empty if not stated.
        custom_data: The user's own entries.
        topics: All topics.
        counts: Number of messages of each storage file, by its name; empty if not stated.
    """

    text: str
    version: int
    storage: str
    file_names: tuple[str, ...]
    compression: str
    ros_distro: str
    custom_data: Mapping[str, str]
    topics: tuple[TopicMetadata, ...]
    counts: Mapping[str, int]


def read_bag_info(path: Path) -> BagInfo:
    """Read a metadata.yaml.

    Raises:
        SourceError: It cannot be read or understood.
    """
    try:
        if not path.is_file():
            raise SourceError(path, "is not a regular file")
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError(path, f"is larger than {_MAX_BYTES} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
    if not data.strip():
        raise SourceError(path, "is empty", f"Recreate it with `ros2 bag reindex`, or {SALVAGE}")
    try:
        return parse_bag_info(data.decode(), path)
    except UnicodeDecodeError:
        raise SourceError(path, "is not UTF-8 text", SALVAGE_REMEDY) from None


def parse_bag_info(text: str, path: Path) -> BagInfo:
    """Parse a metadata.yaml, or its form without the top key in storage files.

    Args:
        text: The YAML.
        path: Its place, for errors.

    Raises:
        SourceError: It cannot be understood.
    """
    try:
        document = yamlio.build(text, _scalar)
    except ValueError as error:
        raise SourceError(path, f"is not valid YAML: {error}", SALVAGE_REMEDY) from None
    info = document.get(_TOP_KEY, document) if isinstance(document, dict) else None
    if not isinstance(info, dict) or "version" not in info:
        problem = f"is not rosbag2 metadata: it has no {_TOP_KEY}"
        raise SourceError(path, problem, SALVAGE_REMEDY)
    try:
        version = int(info["version"])
        if version > NEWEST_VERSION:
            reads = f"this mp4ds reads versions up to {NEWEST_VERSION}"
            problem = f"has rosbag2 metadata version {version}; {reads}"
            raise SourceError(path, problem, "Install a newer mp4ds.")
        if version < 1:
            problem = f"has rosbag2 metadata version {version}; the first is 1"
            raise SourceError(path, problem, SALVAGE_REMEDY)
        names = tuple(_base_name(name, path) for name in info.get("relative_file_paths") or [])
        topics = tuple(_topic(item) for item in info.get("topics_with_message_count") or [])
        return BagInfo(
            text=text,
            version=version,
            storage=_storage(_text(info.get("storage_identifier")), names, path),
            file_names=names,
            compression=_compression(info, path),
            ros_distro=_text(info.get("ros_distro")),
            custom_data={
                _text(key): _text(value) for key, value in (info.get("custom_data") or {}).items()
            },
            topics=topics,
            counts=_counts(info, names, topics),
        )
    except SourceError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"is not rosbag2 metadata as expected: {error!r}"
        raise SourceError(path, problem, SALVAGE_REMEDY) from None


def _scalar(event: Any) -> Any:
    """Reads scalars as rosbag2 does: a topic named ``on`` or ``12:30`` stays a string."""
    text: str = event.value
    if event.style not in (None, ""):
        return text
    if text in yamlio.WORDS:
        return yamlio.WORDS[text]
    return int(text) if _INTEGER.fullmatch(text) else text


def _text(value: Any) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _base_name(name: Any, path: Path) -> str:
    # Before version 4, names include the bag's folder; nothing outside it is read.
    base = PureWindowsPath(_text(name)).name
    if base in ("", ".", ".."):
        raise SourceError(path, f"lists {name!r} as a file of the recording")
    return base


def _counts(
    info: Mapping[str, Any], names: Sequence[str], topics: Sequence[TopicMetadata]
) -> Mapping[str, int]:
    if len(names) == 1:
        return {names[0]: sum(topic.count for topic in topics)}
    try:
        return {Path(str(item["path"])).name: int(item["message_count"]) for item in info["files"]}
    except (KeyError, TypeError, ValueError):
        return {}


def _storage(identifier: str, names: tuple[str, ...], path: Path) -> str:
    if identifier in _STORAGES.values():
        return identifier
    suffixes = {_STORAGES.get(name.removesuffix(".zstd").rpartition(".")[2], "") for name in names}
    if identifier == "" and len(suffixes) <= 1 and "" not in suffixes:
        return suffixes.pop() if suffixes else ""
    problem = f"names the storage {identifier!r}; only sqlite3 and mcap are supported"
    raise SourceError(path, problem)


def _compression(info: Mapping[str, Any], path: Path) -> str:
    mode = _text(info.get("compression_mode")).lower()
    if mode in ("", "none"):
        return ""
    scheme = _text(info.get("compression_format"))
    if mode not in ("file", "message") or scheme != "zstd":
        known = "only zstd of files or messages is supported"
        raise SourceError(path, f"names the compression {scheme!r} of mode {mode!r}; {known}")
    return mode


def _topic(item: Mapping[str, Any]) -> TopicMetadata:
    topic = item["topic_metadata"]
    qos = topic.get("offered_qos_profiles")
    qos_text = (dump_yaml(qos) if qos else "") if isinstance(qos, list) else _text(qos)
    has_qos, has_hash = "offered_qos_profiles" in topic, "type_description_hash" in topic
    return TopicMetadata(
        name=_text(topic["name"]),
        type_name=_text(topic["type"]),
        serialization_format=_text(topic["serialization_format"]),
        qos=qos_text if has_qos else None,
        type_hash=_text(topic["type_description_hash"]) if has_hash else None,
        count=int(item.get("message_count") or 0),
    )


def dump_yaml(value: Any) -> str:
    """Write YAML as rosbag2 does, without a line break at the end."""
    text: str = yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=2**31)
    return text.rstrip("\n")


def dump_bag_info(info: Mapping[str, Any]) -> str:
    """Write a metadata.yaml from the content below its top key."""
    return dump_yaml({_TOP_KEY: info}) + "\n"


# the names of policies, by their numbers before `NATIVE_QOS_VERSION`
_POLICIES = {
    "history": "system_default keep_last keep_all unknown",
    "reliability": "system_default reliable best_effort unknown best_available",
    "durability": "system_default transient_local volatile unknown best_available",
    "liveliness": "system_default automatic manual_by_node manual_by_topic unknown best_available",
}


def parse_qos(text: str) -> list[dict[str, Any]]:
    """The QoS profiles of a topic as YAML values; none if the text is not a list of them."""
    try:
        profiles = yamlio.build(text, _scalar) if text.strip() else []
    except ValueError:
        return []
    if isinstance(profiles, list) and all(isinstance(profile, dict) for profile in profiles):
        return profiles
    return []


def has_numeric_qos(text: str) -> bool:
    """Whether QoS policies are numbers, as before metadata version 9."""
    return any(isinstance(profile.get("reliability"), int) for profile in parse_qos(text))


def native_qos(text: str) -> list[dict[str, Any]]:
    """QoS profiles as metadata version 9 lists them: the policies by name."""
    return [
        {key: _policy(key, value) for key, value in profile.items()} for profile in parse_qos(text)
    ]


def _policy(key: str, value: Any) -> Any:
    names = _POLICIES.get(key, "").split()
    if not names or not isinstance(value, int) or isinstance(value, bool):
        return value
    return names[value] if 0 <= value < len(names) else "unknown"
