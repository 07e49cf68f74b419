"""Clips of range images and of other pictures that are no camera's, made when they are needed.

    kinect     five frames of a structured-light camera, as recorded (millimetres)
    realsense  two frames of an active stereo camera, as recorded (millimetres)
    tof        the kinect's frames under a slowly moving view, each exposed anew with a
               time-of-flight camera's noise: deviation in proportion to the distance
    tof10      the same scaled to 10 bits: the farthest point is 1023; holes are 0
    tof12      to 12 bits
    tof16      to 16 bits
    aloe       a disparity map, moved a little from frame to frame, matched anew each time:
               noise before the matcher's steps of 1/16 pixel, pixels lost at random
               16UC1 millimetres, 32FC1 metres (focal length * baseline / disparity)
    waves      32FC1 that follow from no integer: a smooth surface with noise in every pixel
    wide       16UC1 over the full range: a noisy camera of 16 bits

The noise is independent from pixel to pixel and from frame to frame. The same seed gives the
same clip.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]

MARGIN = 32  # pixels by which a view moves to and fro
TOF_DEVIATION = 0.0015  # of the distance: 3 mm at 2 m
STEPS = 16  # of a matcher in one pixel of disparity
FOCAL_TIMES_BASELINE = 40.0  # metres * pixels: 0.3 m to 10 m for the map's disparities
MATCHER_DEVIATION = 0.08  # pixels
LOST = 0.005  # of all pixels of a matcher
SEED = 20240410

KINECT, ALOE = "depth/slambook2_rgbd/depth/*.pgm", "images/stereo_image_proc/aloe-disp.png"
REALSENSE = "bags/librealsense_depth_color.bag"


def read_pnm(path: Path) -> Pixels:
    """A binary PGM or PPM file without comments, 8 or 16 bits."""
    data = path.read_bytes()
    header = re.match(rb"P([56])\s+(\d+)\s+(\d+)\s+(\d+)\s", data)
    if header is None:
        raise SystemExit(f"{path} is no binary PGM or PPM file.")
    kind, width, height, levels = map(int, header.groups())
    dtype = np.dtype(np.uint8) if levels < 256 else np.dtype(">u2")
    shape = (height, width) if kind == 5 else (height, width, 3)
    pixels = np.frombuffer(data, dtype, offset=header.end()).reshape(shape)
    return pixels.astype(dtype.newbyteorder("="))


def metres(depth: Pixels) -> Pixels:
    """Millimetres as the usual conversion makes metres of them: NaN where 0."""
    scaled: Pixels = depth.astype(np.float32) * np.float32(0.001)
    scaled[depth == 0] = np.nan
    return scaled


def kinect(folder: Path, encoding: str, count: int) -> Iterator[Pixels]:
    """As recorded; 32FC1 is converted."""
    for path in sorted(folder.glob(KINECT))[:count]:
        depth = read_pnm(path)
        yield depth if encoding == "16UC1" else metres(depth)


def realsense(folder: Path, encoding: str, count: int) -> Iterator[Pixels]:
    """As recorded; 32FC1 is converted."""
    from rosbags.rosbag1 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(folder / REALSENSE) as reader:
        topics = [c for c in reader.connections if c.topic.endswith("Depth_0/image/data")]
        for number, (connection, _, data) in enumerate(reader.messages(topics)):
            if number == count:
                return
            image: Any = store.deserialize_ros1(data, connection.msgtype)
            depth = image.data.view("<u2").reshape(image.height, image.width)
            yield depth.copy() if encoding == "16UC1" else metres(depth)


def tof(bits: int | None = None) -> Callable[[Path, str, int], Iterator[Pixels]]:
    """Every view for as many frames as make the clip full; if asked, its views fill so many bits.

    They are scaled before the noise.
    """

    def make(folder: Path, encoding: str, count: int) -> Iterator[Pixels]:
        views = [read_pnm(path) for path in sorted(folder.glob(KINECT))]
        least, top, scale = 0, 2**16 - 1, np.float32(1)
        if bits is not None:
            least, top = 1, 2**bits - 1
            scale = np.float32(top) / np.float32(max(view.max() for view in views))
        for number in range(count):
            rng = np.random.default_rng((SEED, number))
            view = _moved(views[number * len(views) // count], number)
            distance = view.astype(np.float32) * scale
            noise = rng.standard_normal(distance.shape, np.float32) * (TOF_DEVIATION * distance)
            depth = np.clip(np.rint(distance + noise), least, top)
            found = np.where(distance > 0, depth, 0).astype(np.uint16)
            yield found if encoding == "16UC1" else metres(found)

    return make


def aloe(folder: Path, encoding: str, count: int) -> Iterator[Pixels]:
    """What a stereo matcher gives."""
    from PIL import Image

    with Image.open(folder / ALOE) as image:
        scene = np.asarray(image)
    for number in range(count):
        rng = np.random.default_rng((SEED, number))
        true = _moved(scene, number).astype(np.float32)
        noise = rng.standard_normal(true.shape, np.float32) * np.float32(MATCHER_DEVIATION)
        steps = np.rint((true + noise) * STEPS).astype(np.int16)
        known = (true > 0) & (steps > 0) & (rng.random(true.shape, np.float32) > LOST)
        steps[~known] = -STEPS
        disparity = np.where(known, steps, STEPS).astype(np.float32) / np.float32(STEPS)
        distance = np.float32(FOCAL_TIMES_BASELINE) / disparity
        if encoding == "32FC1":
            yield np.where(known, distance, np.float32(np.nan))
        else:
            yield np.where(known, np.rint(distance * 1000), 0).astype(np.uint16)


def waves(folder: Path, encoding: str, count: int) -> Iterator[Pixels]:
    """A surface of 640x480, from 1 m to 5 m, with 2 mm of noise."""
    rows, columns = np.mgrid[:480, :640].astype(np.float32)
    for number in range(count):
        rng = np.random.default_rng((SEED, number))
        smooth = 3 + np.sin((columns + 2 * number) / 60) + np.cos(rows / 45)
        yield smooth + rng.standard_normal(smooth.shape, np.float32) * np.float32(0.002)


def _moved(scene: Pixels, number: int) -> Pixels:
    """A view of a scene, `MARGIN` smaller, that moves to and fro by a pixel at a time."""
    height, width = ((side - MARGIN) // 2 * 2 for side in scene.shape)
    left = MARGIN - abs(number % (2 * MARGIN) - MARGIN)
    return scene[left // 2 : left // 2 + height, left : left + width]


MAKERS: dict[tuple[str, str], Callable[[Path, str, int], Iterator[Pixels]]] = {
    ("kinect", "16UC1"): kinect,
    ("realsense", "16UC1"): realsense,
    ("tof", "16UC1"): tof(),
    ("tof10", "16UC1"): tof(10),
    ("tof12", "16UC1"): tof(12),
    ("tof16", "16UC1"): tof(16),
    ("aloe", "16UC1"): aloe,
    ("kinect", "32FC1"): kinect,
    ("realsense", "32FC1"): realsense,
    ("tof", "32FC1"): tof(),
    ("aloe", "32FC1"): aloe,
    ("waves", "32FC1"): waves,
}
"""(scene, encoding) -> what makes the frames, in order."""

RECORDED = ("kinect", "realsense")
"""The scenes that have their own camera's noise."""

NEEDS = {"kinect": KINECT, "realsense": REALSENSE, "aloe": ALOE} | dict.fromkeys(
    ("tof", "tof10", "tof12", "tof16"), KINECT
)
"""What a scene needs below the data folder; the others need nothing."""
