"""Cameras that publish Foxglove's schemas, as protobuf and ROS 2 messages.

`FOXGLOVE` names scenes, `FOXGLOVE_SOURCES` writes any of them as an MCAP file::

    paths = FOXGLOVE_SOURCES["mcap-protobuf"](folder, FOXGLOVE["raw-bgr8"](frames=10))
    made = foxglove_scene(partial(scene, "bgr8", pad=3))
    paths = FOXGLOVE_SOURCES["mcap-foxglove-ros2"](folder, made)

Nothing here uses mp4ds, so that its tests have an independent source.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from mcap.writer import CompressionType, Writer

from coded_scenes import CODED, FRAMES, HEIGHT, WIDTH, MakeScene
from definitions import (
    CALIBRATION,
    CODED_IMAGE,
    CODED_VIDEO,
    COMPRESSED,
    IMAGE,
    INFO,
    LOG,
    POSE,
    RAW_IMAGE,
    TF,
    TRANSFORM,
)
from foxglove_wire import SERIALIZATIONS
from pictures import BAYER
from scenes import Record, Scene, scene

# ---------------------------------------------------------------- scenes


CAMERA_TYPES = {IMAGE: RAW_IMAGE, COMPRESSED: CODED_IMAGE, CODED_VIDEO: CODED_VIDEO}


def foxglove_scene(
    make: Callable[..., Scene],
    *,
    told: str | None = None,
    frames: int = FRAMES,
    width: int = WIDTH,
    height: int = HEIGHT,
    seed: int = 0,
) -> Scene:
    """A camera of another scene, its messages as those of foxglove_msgs, amid other topics.

    Topics are ``/camera/image``, ``/camera/calibration``, ``/tf``, ``/pose`` and ``/log``.

    Args:
        make: The scene.
        told: The field ``format``, if it is another one.
        frames: Number of images.
        width: Pixels.
        height: Pixels.
        seed: Of the noise and the jitter of the times.
    """
    records: list[Record] = []
    for record in make(frames=frames, width=width, height=height, seed=seed).messages:
        values, time = dict(record.values), record.log_time
        if header := values.pop("header", None):
            values |= {"timestamp": header["stamp"], "frame_id": header["frame_id"]}
        if record.msgtype in CAMERA_TYPES:
            values |= {"format": told} if told else {}
            records.append(Record("/camera/image", CAMERA_TYPES[record.msgtype], time, values))
        elif record.msgtype == INFO:
            records.append(Record("/camera/calibration", CALIBRATION, time, values))
        elif record.msgtype == TF:
            records += _others(len(records), time)
    return Scene(records)


def _others(n: int, time: int) -> list[Record]:
    turned = {"rotation": {"x": 0.5, "y": -0.5, "z": 0.5, "w": -0.5}}
    link = {"parent_frame_id": "base", "child_frame_id": "cam", "timestamp": time, **turned}
    link["translation"] = {"x": 0.1, "y": 0.0, "z": 1.0}
    pose = {"position": {"x": 0.25 * n}, "orientation": {"w": 1.0}}
    said = {"level": 2, "message": f"message {n // 3} \u00fc", "name": "node", "line": n}
    return [
        Record("/tf", TRANSFORM, time, link),
        Record("/pose", POSE, time, {"timestamp": time, "frame_id": "map", "pose": pose}),
        Record("/log", LOG, time, {"timestamp": time, **said}),
    ]


# Encodings that foxglove.RawImage names.
RAW_ENCODINGS = [
    *("mono8", "8UC1", "mono16", "16UC1", "32FC1", "rgb8", "rgba8", "bgr8", "8UC3", "bgra8"),
    *("yuv422", "uyvy", "yuyv", "yuv422_yuy2", "nv12", *BAYER),
]
FOXGLOVE: Mapping[str, MakeScene] = {
    **{f"raw-{name}": partial(foxglove_scene, partial(scene, name)) for name in RAW_ENCODINGS},
    "raw-padded": partial(foxglove_scene, partial(scene, "bgr8", pad=6)),
    **{
        name: partial(foxglove_scene, CODED[name], told=name.split("-")[0])
        for name in ("jpeg-rgb", "jpeg-progressive", "jpeg-cut-one", "png-rgb-pillow", "webp")
    },
    **{
        name: partial(foxglove_scene, CODED[name])
        for name in (
            *("video-h264", "video-h264-mid-gop", "video-h264-bframes", "video-h265"),
            *("video-av1", "video-empty"),
        )
    },
}

# ---------------------------------------------------------------- MCAP files


def _source(folder: Path, scene: Scene, *, serialization: str) -> list[Path]:
    """An MCAP file of a scene whose messages are of foxglove_msgs."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "drive.mcap"
    how, ids = SERIALIZATIONS[serialization], dict[str, int]()
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 15, compression=CompressionType.ZSTD)
        writer.start("ros2" if how.encoding == "cdr" else "", "foxglove-sdk 1.0")
        for number, record in enumerate(scene.messages):
            if record.topic not in ids:
                name, data = how.schema(record.msgtype)
                schema = writer.register_schema(name, how.schema_encoding, data)
                ids[record.topic] = writer.register_channel(record.topic, how.encoding, schema)
            payload, time = how.payload(record), record.log_time
            writer.add_message(ids[record.topic], time, payload, time - 500_000, number)
        writer.finish()  # type: ignore[no-untyped-call]
    return [path]


# Each writes into a folder, which it makes, and returns the paths that make up the recording.
FOXGLOVE_SOURCES: dict[str, Callable[[Path, Scene], list[Path]]] = {
    f"mcap-{name}": partial(_source, serialization=name) for name in SERIALIZATIONS
}
