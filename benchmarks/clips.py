"""Clips for the benchmarks, made when they are needed: real scenes through a modelled camera.

Videos on disk have had their noise removed by a codec, and noise is what a lossless codec spends
its bits on. So each frame is exposed anew, as a sensor does it, *before* it is quantised:

    signal    the frame's values with their fractions (rgb of 16 bits), taken as the linear
              response of the sensor, in grey levels
    mosaic    one colour per pixel, rggb (mono cameras: luminance)
    variance  = read^2 + gain * signal      grey levels squared; read noise and shot noise
    pixels    = round(signal + noise), clipped to the sensor's range

The noise is independent from pixel to pixel and from frame to frame. ``rgb8`` is what a camera
driver publishes: the noisy, quantised mosaic, demosaiced bilinearly. ``mono16`` has the same
camera's 12 bits, right-aligned. The same seed gives the same clip.

The scenes are in the folder ``../shared/data`` beside the project, or in $MP4DS_DATA. Where that
is missing, the scene of ``mp4ds demo`` is used.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]  # uint8 or uint16, shape (H, W) or (H, W, 3)
Signal = NDArray[np.float32]

FAMILIES = ("bayer_rggb8", "mono8", "rgb8", "mono16", "16UC1")
SEED = 20240409
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera's noise, from two figures of its data sheet.

    Attributes:
        full_well: Electrons of a pixel at full scale.
        read_electrons: Read noise, electrons RMS.
    """

    full_well: float
    read_electrons: float

    def gain(self, levels: int) -> float:
        """Grey levels per electron, where ``levels`` is full scale."""
        return levels / self.full_well

    def deviation(self, signal: float, levels: int) -> float:
        """Standard deviation in grey levels at a signal in grey levels."""
        gain = self.gain(levels)
        return float(((self.read_electrons * gain) ** 2 + gain * signal) ** 0.5)

    def expose(self, signal: Signal, levels: int, rng: np.random.Generator) -> Pixels:
        """Pixels of a signal in grey levels, 0 to ``levels``."""
        gain = self.gain(levels)
        variance = (self.read_electrons * gain) ** 2 + gain * signal
        noise = np.sqrt(variance) * rng.standard_normal(signal.shape, np.float32)
        dtype = np.uint8 if levels < 256 else np.uint16
        pixels: Pixels = np.clip(np.rint(signal + noise), 0, levels).astype(dtype)
        return pixels


SENSORS = {
    "low": Sensor(full_well=20_000, read_electrons=5),  # daylight, large pixels
    "high": Sensor(full_well=2_500, read_electrons=5),  # 10,000 electrons at 12 dB: indoors
}
AS_RECORDED = "recorded"
"""Instead of a sensor: frames that no codec has touched have their own camera's noise."""


@dataclass(frozen=True, slots=True)
class _Scene:
    pattern: str  # a video, or single images, below the data folder
    encodings: tuple[str, ...] = ()  # of single images only: what they are published as


SCENES = {
    "cups": _Scene("video/sam2_02_cups.mp4"),  # 1280x720, hand-held
    "cars": _Scene("video/intel_car-detection.mp4"),  # 768x432, camera at rest
    "people": _Scene("video/vtest.avi"),  # 768x576, camera at rest
    "stereo": _Scene("images/image_pipeline_wide_stereo_pgm/left*.pgm", ("rgb8",)),
    "kinect": _Scene("depth/slambook2_rgbd/depth/*.pgm", ("16UC1",)),
}
DEMO = "demo"


@dataclass(frozen=True, slots=True)
class ClipSpec:
    """Which clip.

    Attributes:
        scene: One of `SCENES`, or `DEMO`.
        encoding: ROS image encoding, one of `FAMILIES`.
        noise: One of `SENSORS`, or `AS_RECORDED`.
        frames: How many; a scene that is shorter gives fewer.
        size: Width and height to crop and resize to, both even; None for the scene's own.
    """

    scene: str
    encoding: str
    noise: str
    frames: int
    size: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """A name for files."""
        size = f"{self.size[0]}x{self.size[1]}" if self.size else "native"
        return f"{self.scene}-{self.encoding}-{self.noise}-{size}-{self.frames}"


def data_folder() -> Path | None:
    """The folder of recordings and videos, or None where there is none."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MP4DS_DATA") or beside)
    return folder if (folder / "video").is_dir() else None


def check_data() -> None:
    """Tell on stderr that the real scenes are missing, if they are."""
    if data_folder() is None:
        print(
            "The folder ../shared/data beside the project, or in $MP4DS_DATA, is not there: the "
            "scene of `mp4ds demo` is used. Figures differ from those of RESULTS.md.",
            file=sys.stderr,
        )


def specs(
    family: str, frames: int, size: tuple[int, int] | None, noises: tuple[str, ...] = tuple(SENSORS)
) -> list[ClipSpec]:
    """All clips of a family that can be made here."""
    folder = data_folder()
    if folder is None:
        scenes = {} if family == "16UC1" else {DEMO: _Scene("")}
    else:
        scenes = {name: scene for name, scene in SCENES.items() if any(folder.glob(scene.pattern))}
    found = []
    for name, scene in scenes.items():
        if scene.encodings:
            if family in scene.encodings:
                found.append(ClipSpec(name, family, AS_RECORDED, frames))
        elif family != "16UC1":
            found += [ClipSpec(name, family, noise, frames, size) for noise in noises]
    return found


def make(spec: ClipSpec) -> Iterator[Pixels]:
    """The frames of a clip, one after the other."""
    folder = data_folder()
    if spec.noise == AS_RECORDED:
        if folder is None:
            raise SystemExit(f"{spec.scene}: set MP4DS_DATA to the folder of recordings.")
        paths = sorted(folder.glob(SCENES[spec.scene].pattern))
        yield from (read_pnm(path) for path in paths[: spec.frames])
        return
    sensor = SENSORS[spec.noise]
    for number, rgb in enumerate(islice(_rgb_frames(spec), spec.frames)):
        rng = np.random.default_rng((SEED, list(SENSORS).index(spec.noise), number))
        yield _camera(rgb, spec.encoding, sensor, rng)


def load(spec: ClipSpec, cache: Path | None = None) -> Pixels:
    """A whole clip, shape (frames, H, W) or (frames, H, W, 3).

    Args:
        spec: Which.
        cache: Folder to keep it in as .npy, mapped into memory; None makes it in memory.
    """
    if cache is None:
        return np.stack(list(make(spec)))
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / f"{spec.name}.npy"
    if not path.exists():
        part = path.with_suffix(".part.npy")
        np.save(part, np.stack(list(make(spec))))
        part.rename(path)
    clip: Pixels = np.load(path, mmap_mode="r")
    return clip


def _camera(rgb: Signal, encoding: str, sensor: Sensor, rng: np.random.Generator) -> Pixels:
    """What a camera with that sensor publishes of a scene, given in grey levels of 8 bits."""
    if encoding == "mono8":
        return sensor.expose(rgb @ _LUMINANCE, 255, rng)
    if encoding == "mono16":
        return sensor.expose((rgb @ _LUMINANCE) * np.float32(4095 / 255), 4095, rng)
    mosaic = sensor.expose(_sample_rggb(rgb), 255, rng)
    if encoding == "bayer_rggb8":
        return mosaic
    if encoding == "rgb8":
        return demosaic_bilinear(mosaic)
    raise ValueError(f"no camera for {encoding}")


_RGGB = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))  # row, column, colour


def _sample_rggb(rgb: Signal) -> Signal:
    mosaic = np.empty(rgb.shape[:2], np.float32)
    for row, column, color in _RGGB:
        mosaic[row::2, column::2] = rgb[row::2, column::2, color]
    return mosaic


def demosaic_bilinear(mosaic: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An rggb mosaic of even size as rgb; samples that are there stay as they are."""
    height, width = mosaic.shape
    padded = np.pad(mosaic.astype(np.uint16), 1, mode="reflect")  # keeps the pattern's phase
    rgb = np.empty((height, width, 3), np.uint8)
    for color in range(3):
        plane = np.zeros_like(padded)
        for row, column, sampled in _RGGB:
            if sampled == color:
                # the padding moves the pattern by one
                plane[1 - row :: 2, 1 - column :: 2] = padded[1 - row :: 2, 1 - column :: 2]
        if color == 1:
            total = plane[:-2, 1:-1] + plane[2:, 1:-1] + plane[1:-1, :-2] + plane[1:-1, 2:]
            total += 4 * plane[1:-1, 1:-1]
        else:
            rows = plane[:-2] + 2 * plane[1:-1] + plane[2:]
            total = rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]
        rgb[..., color] = (total + 2) // 4
    return rgb


# ---------------------------------------------------------------- scenes


def _rgb_frames(spec: ClipSpec) -> Iterator[Signal]:
    folder = data_folder()
    if spec.scene == DEMO or folder is None:
        frames = _demo_frames(spec.frames)
    else:
        frames = _video_frames(folder / SCENES[spec.scene].pattern)
    for frame in frames:
        yield _fit(frame, spec.size)


def _video_frames(path: Path) -> Iterator[av.VideoFrame]:
    with av.open(str(path)) as container:
        yield from container.decode(container.streams.video[0])


def _fit(frame: av.VideoFrame, size: tuple[int, int] | None) -> Signal:
    """The frame as rgb, 0 to 255, scaled to cover a size and cropped to it around its middle."""
    width, height = size or (frame.width // 2 * 2, frame.height // 2 * 2)
    scale = max(width / frame.width, height / frame.height) if size else 1.0
    scaled = frame.reformat(
        width=max(width, round(frame.width * scale)),
        height=max(height, round(frame.height * scale)),
        format="rgb48le",
        interpolation="BICUBIC",
        threads=1,
    )
    rgb: Signal = scaled.to_ndarray().astype(np.float32) / np.float32(257)
    top, left = (rgb.shape[0] - height) // 2, (rgb.shape[1] - width) // 2
    return rgb[top : top + height, left : left + width]


def _demo_frames(count: int) -> Iterator[av.VideoFrame]:
    """The demo's rgb camera, which has a little noise of its own."""
    from rosbags.rosbag1 import Reader
    from rosbags.typesys import Stores, get_typestore

    from mp4ds.demo import CAMERA_HZ, demo

    store = get_typestore(Stores.ROS1_NOETIC)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "demo.bag"
        demo(bag, seconds=(count + 1) / CAMERA_HZ)
        with Reader(bag) as reader:
            images = [c for c in reader.connections if c.topic == "/right/image_raw"]
            for connection, _, data in reader.messages(images):
                image: Any = store.deserialize_ros1(data, connection.msgtype)
                rgb = image.data.reshape(image.height, image.width, 3)
                yield av.VideoFrame.from_ndarray(rgb, format="rgb24")


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
