"""A recording of two cameras whose times have a gap, a repeated stamp and an offset."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mp4ds
from mp4ds.packing.options import PackOptions
from scenes import Record, Scene
from sources import SOURCES, scene

WIDTH, HEIGHT, FRAMES = 96, 66, 30
LOST, REPEATED = 12, 20  # numbers of the second camera
LATE = 3_000_000  # ns by which its stamps are later
COLOUR, DEPTH = "/front/image_raw", "/depth/image_raw"


def two_cameras(*, second: str = "16UC1", names: tuple[str, str] = (COLOUR, DEPTH)) -> Scene:
    """A colour camera with calibrations, and another one; of it a frame is lost, one repeated."""
    size: dict[str, Any] = {"frames": FRAMES, "width": WIDTH, "height": HEIGHT, "noisy": False}
    first = [_moved(m, "/cam/image_raw", names[0]) for m in scene("rgb8", **size).messages]
    first = [_moved(m, "/cam/camera_info", "/front/camera_info") for m in first]
    images = [
        m
        for m in scene(second, **size, with_info=False, seed=1).messages
        if m.topic == "/cam/image_raw"
    ]
    others = [
        _moved(_later(images, number), "/cam/image_raw", names[1])
        for number in range(FRAMES)
        if number != LOST
    ]
    return Scene(sorted([*first, *others], key=lambda message: message.log_time))


def _moved(message: Record, topic: str, to: str) -> Record:
    return replace(message, topic=to) if message.topic == topic else message


def _later(images: list[Record], number: int) -> Record:
    header = images[number].values["header"]
    stamp = images[number - 1].values["header"]["stamp"] if number == REPEATED else header["stamp"]
    values = {**images[number].values, "header": {**header, "stamp": stamp + LATE}}
    return replace(images[number], values=values)


def pack_cameras(folder: Path, made: Scene, **options: Any) -> Path:
    """A dataset of a scene, in a folder that is there."""
    paths = SOURCES["bag-none"](folder / "source", made)
    mp4ds.pack(paths, folder / "drive", PackOptions(**{"quality": "visual", **options}))
    return folder / "drive"


def blocks(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Mean colours of a grid of 8 x 6 parts of a picture of any size."""
    rows = pairwise(np.linspace(0, picture.shape[0], 7).astype(int))
    columns = list(pairwise(np.linspace(0, picture.shape[1], 9).astype(int)))
    means = [[picture[a:b, c:d].mean(axis=(0, 1)) for c, d in columns] for a, b in rows]
    return np.array(means, np.float64)
