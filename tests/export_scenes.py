"""A recording of three cameras, an IMU, joints, poses and transforms, for exports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mp4ds
from definitions import TF
from pictures import picture
from scenes import PERIOD, START, Record, Scene, scene
from sources import SOURCES

WIDTH, HEIGHT, FRAMES = 64, 48, 8
COLOUR, GREY, DEPTH = "/front/image_raw", "/left/image_raw", "/depth/image_raw"
IMU, JOINTS, ODOMETRY = "/imu", "/joint_states", "/odom"
ENCODINGS_OF = {COLOUR: "rgb8", GREY: "mono16", DEPTH: "16UC1"}
FRAMES_OF = {COLOUR: "front_optical", GREY: "left_optical", DEPTH: "depth_optical"}
ROOT_HALF = 0.5**0.5
# parent, child, translation, rotation x, y, z, w: a quarter turn about z for the left camera
LINKS = [
    ("base", "imu", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)),
    ("base", "front_optical", (0.5, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)),
    ("base", "left_optical", (0.0, 0.25, 1.0), (0.0, 0.0, ROOT_HALF, ROOT_HALF)),
]


def drive() -> Scene:
    """All of it; the depth camera has neither calibration nor a place."""
    messages: list[Record] = []
    for seed, (topic, encoding) in enumerate(ENCODINGS_OF.items()):
        made = scene(
            encoding,
            frames=FRAMES,
            width=WIDTH,
            height=HEIGHT,
            noisy=False,
            seed=seed,
            frame_id=FRAMES_OF[topic],
            with_info=topic != DEPTH,
        )
        for message in made.messages:
            if message.topic.startswith("/cam/"):
                name = message.topic.rpartition("/")[2]
                messages.append(replace(message, topic=f"{topic.rpartition('/')[0]}/{name}"))
            elif seed == 0:
                messages.append(message)
    messages.append(transforms(LINKS, time=START - 1))
    messages += [_joints(n) for n in range(3 * FRAMES)]
    messages += [_odometry(n) for n in range(FRAMES + 1)]
    return Scene(sorted(messages, key=lambda message: message.log_time))


Link = tuple[str, str, tuple[float, ...], tuple[float, ...]]


def transforms(links: Sequence[Link], topic: str = "/tf_static", time: int = START) -> Record:
    """A message of transforms: parent, child, translation and rotation of each."""
    made = [
        {
            "header": {"seq": 0, "stamp": START, "frame_id": parent},
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", translation, strict=True)),
                "rotation": dict(zip("xyzw", rotation, strict=True)),
            },
        }
        for parent, child, translation, rotation in links
    ]
    return Record(topic, TF, time, {"transforms": made})


def joints_at(n: int) -> tuple[int, list[float]]:
    """Stamp and positions of a message."""
    return START + n * PERIOD // 3, [0.1 * n, -0.2 * n]


def _joints(n: int) -> Record:
    stamp, positions = joints_at(n)
    names = ["shoulder", "elbow"]
    values = {"header": {"stamp": stamp, "frame_id": ""}, "name": names, "position": positions}
    return Record(JOINTS, "sensor_msgs/msg/JointState", stamp + 1_000, values)


def pose_at(n: int) -> tuple[int, float]:
    """Stamp and metres along x of a message, half a period before a frame."""
    return START + n * PERIOD - PERIOD // 2, 0.1 * n


def _odometry(n: int) -> Record:
    stamp, along = pose_at(n)
    pose = {"position": {"x": along}, "orientation": {"w": 1.0}}
    values = {
        "header": {"stamp": stamp, "frame_id": "odom"},
        "child_frame_id": "base",
        "pose": {"pose": pose},
    }
    return Record(ODOMETRY, "nav_msgs/msg/Odometry", stamp + 1_000_000, values)


def pixels_of(topic: str, frame: int) -> np.ndarray[Any, Any]:
    """What a camera saw, as it was recorded."""
    made = picture(ENCODINGS_OF[topic], frame=frame, width=WIDTH, height=HEIGHT, rng=None)
    return np.ascontiguousarray(made)


def stamps_of(made: Scene, topic: str) -> list[int]:
    """Stamps of a topic's messages, in the order of the recording."""
    return [m.values["header"]["stamp"] for m in made.messages if m.topic == topic]


def pack_drive(folder: Path, made: Scene, **options: Any) -> Path:
    """A dataset of a scene."""
    paths = SOURCES["mcap-ros2-none"](folder / "source", made)
    mp4ds.pack(paths, folder / "drive", mp4ds.PackOptions(**options))
    return folder / "drive"
