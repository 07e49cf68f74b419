"""Small recordings of every source format, written with the public libraries alone.

`SOURCES` names a writer for every variant of every format, `ENCODINGS` every image encoding
(`COMMON` a few of them, for tests that multiply), and `TRAITS` the oddities of real recordings::

    paths = SOURCES["rosbag2-mcap-v9"](folder, scene("bayer_rggb8"))
    paths = SOURCES["bag-lz4"](folder, odd_scene("row-padding-garbage"))

Nothing here uses mp4ds, so that its tests have an independent source.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as BagWriter

from definitions import IMAGE, INFO, PICTURES
from pictures import COMMON, ENCODINGS, picture
from scenes import (
    PERIOD,
    START,
    TRAITS,
    Record,
    Scene,
    build,
    image_cdr,
    image_ros1,
    odd_scene,
    raw_scene,
    scene,
    typestore,
)
from source_rosbag2 import qos_text, write_rosbag2

__all__ = [
    "COMMON",
    "ENCODINGS",
    "IMAGE",
    "INFO",
    "PERIOD",
    "SOURCES",
    "START",
    "TRAITS",
    "Record",
    "Scene",
    "build",
    "image_cdr",
    "image_ros1",
    "odd_scene",
    "picture",
    "raw_scene",
    "scene",
    "typestore",
    "write_bag",
    "write_mcap",
    "write_rosbag2",
    "write_split_bags",
]

# callerid and latching of a topic's publishers: not latched, latched, and told by neither.
PUBLISHERS: list[tuple[str | None, int | None]] = [("/first", 0), ("/second", 1), (None, None)]


# ---------------------------------------------------------------- ROS 1 bag


def write_bag(
    path: Path, scene: Scene, compression: str = "none", *, chunk_size: int = 1 << 15
) -> None:
    """A ROS 1 bag with a connection for each publisher.

    Args:
        path: The file to write.
        scene: What to write.
        compression: ``none``, ``bz2`` or ``lz4``.
        chunk_size: Bytes after which a chunk ends; small, so that there are several.
    """
    writer = BagWriter(path)
    if compression != "none":
        writer.set_compression(BagWriter.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk_size
    connections: dict[tuple[str, int], Any] = {}

    def connect(topic: str, msgtype: str, publisher: int) -> Any:
        callerid, latching = PUBLISHERS[publisher]
        return writer.add_connection(
            topic, msgtype, typestore=typestore("ros1"), callerid=callerid, latching=latching
        )

    with writer:
        for message in scene.messages:
            key = message.topic, message.publisher
            if key not in connections:
                connections[key] = connect(message.topic, message.msgtype, message.publisher)
            writer.write(connections[key], message.log_time, message.payload("ros1"))
        for topic, msgtype in scene.silent.items():
            connect(topic, msgtype, 0)


def write_split_bags(folder: Path, scene: Scene, n: int) -> list[Path]:
    """The scene as `n` bags, one after the other, as ``rosbag record --split`` leaves them."""
    size = -(-len(scene.messages) // n)
    paths = []
    for i in range(n):
        paths.append(folder / f"drive_{i}.bag")
        part = scene.messages[i * size : (i + 1) * size]
        write_bag(paths[-1], Scene(part, scene.silent if i == n - 1 else {}))
    return paths


# ---------------------------------------------------------------- MCAP


def write_mcap(
    path: Path,
    scene: Scene,
    profile: str = "ros2",
    compression: str = "zstd",
    *,
    chunked: bool = True,
    indexed: bool = True,
    attachments: bool = True,
    metadata: bool = True,
    publish_delay_ns: int = 1_500_000,
) -> None:
    """An MCAP file with a channel for each publisher.

    Args:
        path: The file to write.
        scene: What to write.
        profile: ``ros1``, ``ros2``, or empty: images of any kind as CDR, all else as JSON,
            the third publisher's messages without a schema.
        compression: ``none``, ``lz4`` or ``zstd``.
        chunked: Group messages into compressed chunks.
        indexed: Write the indexes.
        attachments: Add a text and a binary attachment.
        metadata: Add metadata records, two of them with the same name.
        publish_delay_ns: How long before its log time a message was published.
    """
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            chunk_size=1 << 15,
            compression=CompressionType[compression.upper()],
            use_chunking=chunked,
            index_types=IndexType.ALL if indexed else IndexType.NONE,
            repeat_channels=indexed,
        )
        writer.start(profile, "recorder 1.0")
        if metadata:
            writer.add_metadata("session", {"operator": "kim", "weather": "r\u00e4in", "note": ""})
        for topic, msgtype in scene.silent.items():
            _register(writer, Record(topic, msgtype, 0), profile)
        ids: dict[tuple[str, int], int] = {}
        sequences: dict[int, int] = defaultdict(int)
        for i, message in enumerate(scene.messages):
            key = message.topic, message.publisher
            if key not in ids:
                ids[key] = _register(writer, message, profile)
            time, payload = message.log_time, _mcap_payload(message, profile)
            publish = max(0, time - publish_delay_ns)
            sequences[ids[key]] += 1
            writer.add_message(ids[key], time, payload, publish, sequences[ids[key]])
            if attachments and i == len(scene.messages) // 2:
                writer.add_attachment(START, time, "notes.txt", "text/plain", b"windy\n")
                writer.add_attachment(
                    0, 0, "map.bin", "application/octet-stream", bytes(range(256))
                )
        if metadata:
            writer.add_metadata("session", {"part": "2"})
        writer.finish()  # type: ignore[no-untyped-call]


def _encoding(message: Record, profile: str) -> str:
    if profile:
        return "ros1" if profile == "ros1" else "cdr"
    return "cdr" if message.msgtype in PICTURES else "json"


def _register(writer: Writer, message: Record, profile: str) -> int:
    encoding, msgtype = _encoding(message, profile), message.msgtype
    store = typestore("ros1" if encoding == "ros1" else "cdr")
    metadata: dict[str, str] = {}
    if encoding == "ros1":
        definition, md5sum = store.generate_msgdef(msgtype, ros_version=1)
        callerid, latching = PUBLISHERS[message.publisher]
        header = {"md5sum": md5sum, "topic": message.topic, "callerid": callerid}
        header["latching"] = None if latching is None else str(latching)
        metadata = {key: value for key, value in header.items() if value is not None}
        name = msgtype.replace("/msg/", "/")
        schema = writer.register_schema(name, "ros1msg", definition.encode())
    elif encoding == "cdr":
        definition = store.generate_msgdef(msgtype, ros_version=2)[0].encode()
        schema = writer.register_schema(msgtype, "ros2msg", definition)
        version = 9 if message.publisher else 8  # so that publishers of one topic differ
        metadata["offered_qos_profiles"] = qos_text(message.topic, version)
        metadata["topic_type_hash"] = store.hash_rihs01(msgtype)
        if message.publisher:
            metadata["publisher"] = str(message.publisher)
    elif message.publisher == 2:
        schema = 0
    else:
        rules = json.dumps({"type": "object", "title": msgtype}).encode()
        schema = writer.register_schema(msgtype, "jsonschema", rules)
    return writer.register_channel(message.topic, encoding, schema, metadata)


def _mcap_payload(message: Record, profile: str) -> bytes:
    encoding = _encoding(message, profile)
    if encoding != "json":
        return message.payload(encoding)
    return json.dumps(message.values, default=lambda value: np.asarray(value).tolist()).encode()


# ---------------------------------------------------------------- all variants

Source = Callable[[Path, Scene], list[Path]]


def _bag(folder: Path, scene: Scene, *, compression: str) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    write_bag(folder / "drive.bag", scene, compression)
    return [folder / "drive.bag"]


def _split(folder: Path, scene: Scene) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    return write_split_bags(folder, scene, 3)


def _rosbag2(folder: Path, scene: Scene, **options: Any) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    write_rosbag2(folder / "drive", scene, **options)
    return [folder / "drive"]


def _mcap(folder: Path, scene: Scene, **options: Any) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    write_mcap(folder / "drive.mcap", scene, **options)
    return [folder / "drive.mcap"]


# Each writes into a folder, which it makes, and returns the paths that make up the recording.
SOURCES: dict[str, Source] = {
    **{f"bag-{c}": partial(_bag, compression=c) for c in ("none", "bz2", "lz4")},
    "bag-split": _split,
    **{f"rosbag2-sqlite3-v{v}": partial(_rosbag2, version=v) for v in range(4, 10)},
    "rosbag2-sqlite3-split": partial(_rosbag2, files=3),
    "rosbag2-mcap-v5": partial(_rosbag2, storage="mcap", version=5),
    "rosbag2-mcap-v9": partial(_rosbag2, storage="mcap"),
    "rosbag2-mcap-split": partial(_rosbag2, storage="mcap", files=3),
    **{
        f"rosbag2-{s}-zstd-{c}": partial(_rosbag2, storage=s, compression=c)
        for s in ("sqlite3", "mcap")
        for c in ("file", "message")
    },
    "mcap-ros1-zstd": partial(_mcap, profile="ros1"),
    **{f"mcap-ros2-{c}": partial(_mcap, compression=c) for c in ("none", "lz4", "zstd")},
    "mcap-none-profile": partial(_mcap, profile=""),
    "mcap-unchunked": partial(_mcap, compression="none", chunked=False),
    "mcap-unindexed": partial(_mcap, indexed=False),
}
