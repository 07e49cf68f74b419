"""Clips whose motion is known: a picture on a plane, before a camera that moves.

A frame shows the plane through a homography that is a smooth function of time, so where a point of
one frame is in another one is known to a fraction of a pixel, whatever a codec does to the frames.

    plane      a real scene: a photograph, or the first frame of a video; for `TAGS`, AprilTags
               (36h11) of two sizes on it
    motion     one of `MOTIONS`, none of whole pixels
    lens       samples 4 x 4 to a pixel, blurred by a Gaussian of 0.5 pixels, averaged
    sensor     that of clips.py: mosaic, noise, rounding, demosaicing

Coordinates are OpenCV's: the middle of the first pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import clips

Points = NDArray[np.float64]  # shape (..., 2): x, y
Matrix = NDArray[np.float64]  # shape (3, 3)

TAGS = "tags"
MOTIONS = {"cups": "hand", "lane": "drive", "people": "pan", "aloe": "turn", TAGS: "hand"}
"""Scene -> how the camera moves before it."""

_STILLS = {"aloe": "images/stereo_image_proc/aloe-L.png"}
_NOISELESS = clips.Sensor(full_well=np.inf, read_electrons=0)
_SAMPLES = 4  # of a pixel's side
_LENS = 0.5  # pixels
_SHOWN = 0.8  # of the plane's smaller side, in the first frame
_BOARD = (1600, 1200)
_TAG_PIXELS, _GAP = (128, 64), 0.25  # sides on the board, of which two make a pixel of a frame
_BLACK, _WHITE = 25.0, 190.0  # grey levels of ink and paper
DICTIONARY = cv2.aruco.DICT_APRILTAG_36h11


@dataclass(frozen=True)
class PlaneClip:
    """Frames of a plane, and where each of them shows it.

    Attributes:
        name: Scene, motion and noise.
        frames: Shape (frames, H, W, 3), rgb8 as a driver publishes it.
        clean: The same without the sensor's noise.
        poses: Shape (frames, 3, 3): from the plane's pixels to the frame's.
        tags: Id -> corners on the plane, shape (4, 2), clockwise from the tag's upper left.
    """

    name: str
    frames: NDArray[np.uint8]
    clean: NDArray[np.uint8]
    poses: NDArray[np.float64]
    tags: dict[int, Points]

    def between(self, first: int, second: int) -> Matrix:
        """The homography from one frame to another."""
        matrix: Matrix = self.poses[second] @ np.linalg.inv(self.poses[first])
        return matrix


def moved(matrix: Matrix, points: Points) -> Points:
    """Points, shape (N, 2), where a homography has them."""
    found = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return np.asarray(found[:, :2] / found[:, 2:])


def load(
    scene: str, noise: str, frames: int, size: tuple[int, int], cache: Path | None = None
) -> PlaneClip:
    """A clip, the same each time.

    Args:
        scene: One of `MOTIONS`.
        noise: One of `clips.SENSORS`.
        frames: How many.
        size: Width and height, even.
        cache: Folder to keep its frames in.
    """
    plane, tags = _board() if scene == TAGS else (_picture(scene), {})
    motion = MOTIONS[scene]
    poses = np.stack([_pose(motion, number, plane.shape, size) for number in range(frames)])
    name = f"{scene}, {motion}, {noise}"
    kept = cache / f"{name.replace(', ', '-')}-{frames}-{size[0]}x{size[1]}.npy" if cache else None
    if kept and kept.is_file():
        pictures = np.load(kept)
    else:
        pictures = np.stack([*_exposed(plane, poses, noise, size)])
        if kept:
            part = kept.with_suffix(".part.npy")
            np.save(part, pictures)
            part.rename(kept)
    return PlaneClip(name, pictures[:, 0], pictures[:, 1], poses, tags)


def _picture(scene: str) -> clips.Signal:
    folder = clips.data_folder()
    if folder is None or scene not in _STILLS:
        return clips.first_picture(scene)
    picture: Any = cv2.imread(str(folder / _STILLS[scene]), cv2.IMREAD_COLOR_RGB)
    return np.asarray(picture, np.float32)


def _exposed(
    plane: clips.Signal, poses: NDArray[np.float64], noise: str, size: tuple[int, int]
) -> Iterator[clips.Pixels]:
    """Each frame with noise and without, shape (2, H, W, 3)."""
    width, height = size
    centre = (_SAMPLES - 1) / 2
    finer = np.array([[_SAMPLES, 0, centre], [0, _SAMPLES, centre], [0, 0, 1]])
    for number, pose in enumerate(poses):
        seen: Any = cv2.warpPerspective(
            plane,
            finer @ pose,
            (width * _SAMPLES, height * _SAMPLES),
            flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REFLECT,
        )
        seen = cv2.GaussianBlur(seen, None, _LENS * _SAMPLES)
        pixels = seen.reshape(height, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))
        signal = np.clip(pixels, 0, 255)
        rng = clips.noise_of(noise, number)
        sensors = clips.SENSORS[noise], _NOISELESS
        yield np.stack([clips.expose("rgb8", signal, sensor, rng) for sensor in sensors])


# ---------------------------------------------------------------- motion


def _pose(motion: str, number: int, plane: tuple[int, ...], size: tuple[int, int]) -> Matrix:
    """From the plane's pixels to those of a frame."""
    rows, columns = plane[:2]
    width, height = size
    scale = max(width / columns, height / rows) / _SHOWN
    x, y, angle, zoom, tilt_x, tilt_y = _PATHS[motion](number)
    sine, cosine = np.sin(angle) * scale * zoom, np.cos(angle) * scale * zoom
    to_middle = _shift(-(columns - 1) / 2, -(rows - 1) / 2)
    turned = np.array([[cosine, -sine, x], [sine, cosine, y], [0, 0, 1]])
    tilted = np.array([[1, 0, 0], [0, 1, 0], [tilt_x, tilt_y, 1]])
    matrix: Matrix = _shift((width - 1) / 2, (height - 1) / 2) @ tilted @ turned @ to_middle
    return matrix


def _shift(x: float, y: float) -> Matrix:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1]], np.float64)


def _wave(number: int, size: float, period: float, phase: float = 0.0) -> float:
    return float(size * np.sin(2 * np.pi * (number / period + phase)))


def _hand(t: int) -> tuple[float, ...]:
    """A camera in a hand: up to 3 pixels a frame."""
    return (
        *(_wave(t, 15, 37), _wave(t, 9, 23.3, 0.2), _wave(t, 0.03, 41.7, 0.1)),
        *(1 + _wave(t, 0.03, 53.9), _wave(t, 6e-5, 47.1), _wave(t, 5e-5, 61.3, 0.4)),
    )


def _drive(t: int) -> tuple[float, ...]:
    """A camera that drives forward over a rough floor."""
    return (_wave(t, 2, 31.7), _wave(t, 3, 9.7), _wave(t, 0.004, 13.3), 1.006**t, 0.0, 0.0)


def _pan(t: int) -> tuple[float, ...]:
    """A camera that pans by 3.7 pixels a frame."""
    return (3.7 * (t - 12), 0.21 * (t - 12), 0.0, 1.02, 2e-6 * (t - 12), 0.0)


def _turn(t: int) -> tuple[float, ...]:
    """A camera on an arm that turns by half a degree a frame."""
    return (_wave(t, 6, 29.3), 0.4 * t, 0.0087 * t, 1.1, 0.0, _wave(t, 8e-5, 43.7))


_PATHS = {"hand": _hand, "drive": _drive, "pan": _pan, "turn": _turn}


# ---------------------------------------------------------------- tags


def _board() -> tuple[clips.Signal, dict[int, Points]]:
    """A picture with tags on white paper, and where their corners are."""
    picture: Any = cv2.resize(clips.first_picture("cups"), _BOARD, interpolation=cv2.INTER_CUBIC)
    plane = np.clip(picture, 0, 255).astype(np.float32)
    known = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    tags: dict[int, Points] = {}
    places = [(x, y, _TAG_PIXELS[0]) for y, x in product((240, 700), (260, 720, 1180))]
    places += [(x, y, _TAG_PIXELS[1]) for y, x in product((300, 520, 760), (480, 590, 910, 1040))]
    for number, (left, top, side) in enumerate(places):
        margin = int(side * _GAP)
        tag: Any = cv2.aruco.generateImageMarker(known, number, side)
        ink = np.where(tag > 0, _WHITE, _BLACK).astype(np.float32)[..., None]
        plane[top - margin : top + side + margin, left - margin : left + side + margin] = _WHITE
        plane[top : top + side, left : left + side] = ink
        low, far_x, far_y = -0.5, left + side - 0.5, top + side - 0.5
        near_x, near_y = left + low, top + low
        tags[number] = np.array(
            [[near_x, near_y], [far_x, near_y], [far_x, far_y], [near_x, far_y]]
        )
    return plane, tags
