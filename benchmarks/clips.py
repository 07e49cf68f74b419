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
camera's 12 bits, right-aligned, ``bayer_rggb16`` its mosaic of 12 bits, ``rgb16`` that mosaic
demosaiced. ``rgba8`` is ``rgb8`` with an alpha of 255, ``yuv422`` and ``nv12`` are ``rgb8``
converted (BT.601, full range). The same seed gives the same clip.

Range images, and pictures that are no camera's, are in depth_clips.py.

    python benchmarks/clips.py SCENE ENCODING CLIP.bag [--noise N] [--frames N] [--size WxH]

records one as a ROS 1 bag. The scenes are in the folder ``../shared/data`` beside the project, or
in $MP4DS_DATA. Where that is missing, the scene of ``mp4ds demo`` is used.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

import depth_clips
import mp4ds
from depth_clips import read_pnm
from measure import parse_size, parser_of
from mp4ds.plugins.demo import CAMERA_HZ, demo
from recordings import write_bag

Pixels = NDArray[Any]  # shape (H, W) or (H, W, C); nv12: (H * 3 / 2, W)
Signal = NDArray[np.float32]

FAMILIES = (
    *("bayer_rggb8", "mono8", "rgb8", "mono16", "bayer_rggb16", "rgb16", "rgba8"),
    *("yuv422", "nv12", "16UC1", "32FC1"),
)
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

    def expose(self, signal: Signal, levels: int, rng: np.random.Generator) -> Pixels:
        """Pixels of a signal in grey levels, 0 to ``levels``."""
        gain = levels / self.full_well  # levels of an electron
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
AS_MADE = "own"
"""Instead of a sensor: depth_clips.py has the noise of its scenes."""


SCENES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cups": ("video/sam2_02_cups.mp4", ()),  # 1280x720, hand-held
    "cars": ("video/intel_car-detection.mp4", ()),  # 768x432, camera at rest
    "people": ("video/vtest.avi", ()),  # 768x576, camera at rest
    "stereo": ("images/image_pipeline_wide_stereo_pgm/left*.pgm", ("rgb8",)),
    "openisp": ("images/openISP_bayer_rggb12_1920x1080.raw", ("bayer_rggb16",)),
}
"""A video, or images, below the data folder; and what single images are published as."""
MOVING = {
    **{name: SCENES[name] for name in ("cups", "cars", "people")},
    "lane": ("video/carnd_solidWhiteRight.mp4", ()),  # 960x540, from a car
    "arm": ("video/lerobot_aloha_insertion_human_yuv444.mp4", ()),  # 640x480, over a table
}
"""The scenes that are videos, for lossy codecs."""
DEMO = "demo"
WIDE = "wide"
"""16UC1 that is a camera's picture of 16 bits."""


@dataclass(frozen=True, slots=True)
class ClipSpec:
    """Which clip.

    Attributes:
        scene: One of `SCENES`, or `DEMO`.
        encoding: ROS image encoding, one of `FAMILIES`.
        noise: One of `SENSORS`, `AS_RECORDED` or `AS_MADE`.
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
    found = []
    if family in _CAMERA:
        scenes = {DEMO: ("", ())} if folder is None else SCENES
        for name, (pattern, encodings) in scenes.items():
            if folder and not any(folder.glob(pattern)):
                continue
            if not encodings:
                found += [ClipSpec(name, family, noise, frames, size) for noise in noises]
            elif family in encodings:
                found.append(ClipSpec(name, family, AS_RECORDED, frames))
    for scene_name, encoding in depth_clips.MAKERS:
        needs = depth_clips.NEEDS.get(scene_name)
        if encoding == family and (needs is None or (folder and any(folder.glob(needs)))):
            recorded = scene_name in depth_clips.RECORDED
            found.append(ClipSpec(scene_name, family, AS_RECORDED if recorded else AS_MADE, frames))
    if family == "16UC1":
        found.append(ClipSpec(WIDE, family, "low", frames, size))
    return found


def make(spec: ClipSpec) -> Iterator[Pixels]:
    """The frames of a clip, one after the other."""
    folder = data_folder()
    maker = depth_clips.MAKERS.get((spec.scene, spec.encoding))
    if maker:
        yield from maker(folder or Path(), spec.encoding, spec.frames)
        return
    if spec.noise == AS_RECORDED:
        if folder is None:
            raise SystemExit(f"{spec.scene}: set MP4DS_DATA to the folder of recordings.")
        paths = sorted(folder.glob(SCENES[spec.scene][0]))
        yield from (_read_still(path) for path in paths[: spec.frames])
        return
    for number, rgb in enumerate(islice(rgb_frames(spec), spec.frames)):
        rng = np.random.default_rng((SEED, list(SENSORS).index(spec.noise), number))
        camera = _GRAY16 if spec.scene == WIDE else _CAMERA[spec.encoding]
        yield camera(rgb, SENSORS[spec.noise], rng)


def expose(encoding: str, rgb: Signal, sensor: Sensor, rng: np.random.Generator) -> Pixels:
    """What a camera publishes of a picture of a scene, given in grey levels, 0 to 255."""
    return _CAMERA[encoding](rgb, sensor, rng)


def load(spec: ClipSpec) -> Pixels:
    """A whole clip, shape (frames, H, W) or (frames, H, W, 3)."""
    return np.stack(list(make(spec)))


def _mono(levels: int) -> Callable[[Signal, Sensor, np.random.Generator], Pixels]:
    def expose(rgb: Signal, sensor: Sensor, rng: np.random.Generator) -> Pixels:
        return sensor.expose((rgb @ _LUMINANCE) * np.float32(levels / 255), levels, rng)

    return expose


def _mosaic(levels: int) -> Callable[[Signal, Sensor, np.random.Generator], Pixels]:
    def expose(rgb: Signal, sensor: Sensor, rng: np.random.Generator) -> Pixels:
        return sensor.expose(_sample_rggb(rgb) * np.float32(levels / 255), levels, rng)

    return expose


_GRAY8, _GRAY12, _GRAY16 = _mono(255), _mono(4095), _mono(65535)
_BAYER8, _BAYER12 = _mosaic(255), _mosaic(4095)

_CAMERA: dict[str, Callable[[Signal, Sensor, np.random.Generator], Pixels]] = {
    "mono8": _GRAY8,
    "mono16": _GRAY12,
    "bayer_rggb8": _BAYER8,
    "bayer_rggb16": _BAYER12,
    "rgb8": lambda *scene: demosaic_bilinear(_BAYER8(*scene)),
    "rgb16": lambda *scene: demosaic_bilinear(_BAYER12(*scene)),
    "rgba8": lambda *scene: _opaque(demosaic_bilinear(_BAYER8(*scene))),
    "yuv422": lambda *scene: uyvy(demosaic_bilinear(_BAYER8(*scene))),
    "nv12": lambda *scene: nv12(demosaic_bilinear(_BAYER8(*scene))),
}
"""Encoding -> what a camera publishes of a scene, given in grey levels of 8 bits."""


_RGGB = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))  # row, column, colour


def _sample_rggb(rgb: Signal) -> Signal:
    mosaic = np.empty(rgb.shape[:2], np.float32)
    for row, column, color in _RGGB:
        mosaic[row::2, column::2] = rgb[row::2, column::2, color]
    return mosaic


def demosaic_bilinear(mosaic: Pixels) -> Pixels:
    """An rggb mosaic of even size, up to 12 bits, as rgb, with the edges of OpenCV."""
    height, width = mosaic.shape
    padded = np.pad(mosaic.astype(np.uint16), 1, mode="reflect")  # keeps the pattern's phase
    rgb = np.empty((height, width, 3), mosaic.dtype)
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
    rgb[:, 0], rgb[:, -1] = rgb[:, 1], rgb[:, -2]
    rgb[0], rgb[-1] = rgb[1], rgb[-2]
    return rgb


def _opaque(rgb: Pixels) -> Pixels:
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])


_YCBCR = np.array(  # BT.601, full range
    [[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], np.float32
)


def _ycbcr(rgb: Pixels) -> Signal:
    signal: Signal = rgb.astype(np.float32) @ _YCBCR.T
    signal[..., 1:] += 128
    return signal


def _round8(signal: NDArray[Any]) -> Pixels:
    pixels: Pixels = np.clip(np.rint(signal), 0, 255).astype(np.uint8)
    return pixels


def uyvy(rgb: Pixels) -> Pixels:
    """4:2:2 of an rgb picture of even width, shape (H, W, 2): chroma, then luma."""
    signal = _ycbcr(rgb)
    pairs = (signal[:, ::2, 1:] + signal[:, 1::2, 1:]) / 2
    return np.stack([_round8(pairs).reshape(rgb.shape[:2]), _round8(signal[..., 0])], axis=-1)


def nv12(rgb: Pixels) -> Pixels:
    """4:2:0 of an rgb picture of even size, shape (H * 3 / 2, W): luma over chroma pairs."""
    height, width = rgb.shape[:2]
    signal = _ycbcr(rgb)
    blocks = signal[..., 1:].reshape(height // 2, 2, width // 2, 2, 2).mean(axis=(1, 3))
    return np.vstack([_round8(signal[..., 0]), _round8(blocks).reshape(height // 2, width)])


# ---------------------------------------------------------------- scenes


def rgb_frames(spec: ClipSpec) -> Iterator[Signal]:
    """The frames of a scene without noise, 0 to 255, fitted to the clip's size."""
    folder = data_folder()
    if spec.scene == DEMO or folder is None:
        frames = _demo_frames(spec.frames)
    else:
        scene = "cups" if spec.scene == WIDE else spec.scene
        frames = _video_frames(folder / {**SCENES, **MOVING}[scene][0])
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
    with tempfile.TemporaryDirectory() as folder:
        bag, dataset = Path(folder) / "demo.bag", Path(folder) / "demo"
        demo(bag, seconds=(count + 1) / CAMERA_HZ)
        mp4ds.pack(bag, dataset)
        with mp4ds.open(dataset) as opened:
            for frame in opened["/right/image_raw"]:
                yield av.VideoFrame.from_ndarray(frame.data, format="rgb24")


def _read_still(path: Path) -> Pixels:
    if path.suffix == ".raw":  # 16 bits without a header, as its name says
        return np.fromfile(path, "<u2").reshape(1080, 1920)
    return read_pnm(path)


def main() -> None:
    """Record a clip."""
    parser = parser_of(__doc__)
    parser.add_argument("scene", choices=MOVING)
    parser.add_argument("encoding", choices=_CAMERA)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--noise", choices=SENSORS, default="low")
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    options = parser.parse_args()
    check_data()
    spec = ClipSpec(options.scene, options.encoding, options.noise, options.frames, options.size)
    write_bag(options.bag, make(spec), spec.encoding)


if __name__ == "__main__":
    main()
