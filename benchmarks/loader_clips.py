"""What benchmarks/loader.py reads: a clip of a moving camera, as videos, as stills, as LeRobot's.

The clip is the scenes of clips.py, one after the other, each enlarged to cover a window that moves
over it as a camera that is carried, and exposed anew by a sensor with noise (a standard deviation
of 2.6 of 255 levels in mid grey). A scene that ends begins anew, with other noise and another
path. The same numbers give the same clip.

All is made once, below a folder: the clip as an MCAP file, and of this file a dataset for each
codec and GOP, LeRobot's video, PNG and JPEG files, and for each video its *reference*: of each
frame of one pass in order a digest, and 16 x 16 of its pixels.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import chain, islice
from pathlib import Path
from typing import Any

import av
import numpy as np
import xxhash
from numpy.typing import NDArray

from clips import SCENES, SEED, ClipSpec, Sensor, data_folder, demosaic_bilinear, make
from recordings import START_NS, TOPIC, write_mcap

Pixels = NDArray[Any]

HERTZ = 30
SENSOR = Sensor(full_well=5_000, read_electrons=5)
MARGIN = 48  # pixels that the window moves each way
GRID = 16
CODECS = {"av1": ("crf=30", "4"), "h264": ("crf=23", "medium")}
"""Codec -> quality and preset."""
LEROBOT_OPTIONS = {"g": "2", "crf": "30", "preset": "12"}
"""Of SVT-AV1, as LeRobot 0.4 to 0.6 set them unless asked."""
BATCH, WINDOW = 32, 8
PATTERNS = {
    "single": "single frames",
    "batch": f"{BATCH} random frames",
    "window": f"windows of {WINDOW}",
    "order": "all in order",
}
"""What is measured of each reader."""
STILLS = {"png": ".png", "jpeg": ".jpg"}
JPEG_QUALITY = 95
_PART = 480  # frames of each part of a pack, more than any GOP


# ---------------------------------------------------------------- frames


def moving(count: int, size: tuple[int, int], *, seed: int = 0) -> Iterator[Pixels]:
    """The clip's frames, rgb of 8 bits, shape (H, W, 3)."""
    phases = np.random.default_rng((SEED, seed)).uniform(0, 2 * np.pi, 4)
    periods = np.array([7.0, 2.3, 5.0, 1.7])  # seconds: a slow and a quick swing each way
    for number, scene in enumerate(islice(_scenes(size), count)):
        swing = np.sin(phases + 2 * np.pi * number / HERTZ / periods) * [0.8, 0.2, 0.8, 0.2]
        # even, so that the mosaic keeps its phase
        x, y = (int(MARGIN * (1 + swing[i] + swing[i + 1])) // 2 * 2 for i in (0, 2))
        rng = np.random.default_rng((SEED, seed, number))
        window = scene[y : y + size[1], x : x + size[0]]
        yield demosaic_bilinear(SENSOR.expose(_mosaic(window), 255, rng))


def _scenes(size: tuple[int, int]) -> Iterator[NDArray[np.float32]]:
    """Frames of all scenes without noise, a margin larger than asked, over and over."""
    wide = (size[0] + 2 * MARGIN, size[1] + 2 * MARGIN)
    while True:
        for name in _scene_names():
            spec = ClipSpec(name, "rgb8", "low", 10_000, wide)
            yield from (pixels.astype(np.float32) for pixels in _clean(spec))


def _scene_names() -> list[str]:
    folder = data_folder()
    found = [
        name
        for name, scene in SCENES.items()
        if folder and not scene.encodings and any(folder.glob(scene.pattern))
    ]
    return found or ["demo"]


def _clean(spec: ClipSpec) -> Iterator[Pixels]:
    """A scene as it is on disk, enlarged to cover a size."""
    folder = data_folder()
    if folder is None:
        yield from islice(make(spec), 300)
        return
    width, height = spec.size or (0, 0)
    with av.open(str(folder / SCENES[spec.scene].pattern)) as container:
        for frame in container.decode(video=0):
            scale = max(width / frame.width, height / frame.height)
            scaled = frame.reformat(
                width=max(width, round(frame.width * scale)),
                height=max(height, round(frame.height * scale)),
                format="rgb24",
                interpolation="BICUBIC",
            ).to_ndarray()
            top, left = (scaled.shape[0] - height) // 2, (scaled.shape[1] - width) // 2
            yield scaled[top : top + height, left : left + width]


def _mosaic(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    mosaic = np.empty(rgb.shape[:2], np.float32)
    for row, column, color in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[row::2, column::2] = rgb[row::2, column::2, color]
    return mosaic


# ---------------------------------------------------------------- what is on disk


@dataclass(frozen=True)
class Stored:
    """The clip, stored in one way.

    Attributes:
        name: Of the way, ``av1-30`` or ``png``.
        path: A video, or a folder of stills.
        dataset: The dataset that the video belongs to, if it is one of ours.
        frames: How many are stored.
    """

    name: str
    path: Path
    dataset: Path | None
    frames: int

    @property
    def codec(self) -> str:
        """Of the video, or the kind of the stills."""
        return self.name.partition("-")[0]

    @property
    def gop(self) -> int:
        """Frames from one key frame to the next."""
        return int(self.name.partition("-")[2] or (1 if self.path.is_dir() else 2))

    @property
    def is_stills(self) -> bool:
        """Whether each frame is a file."""
        return self.codec in STILLS

    @cached_property
    def bytes_per_frame(self) -> float:
        """Of the video, or of the files."""
        files = self.path.iterdir() if self.path.is_dir() else [self.path]
        return sum(file.stat().st_size for file in files) / self.frames

    def still(self, number: int) -> str:
        """The file of a frame."""
        return os.fspath(self.path / f"{number:06}{STILLS[self.codec]}")

    @cached_property
    def reference(self) -> dict[str, NDArray[Any]]:
        """What the frames are: ``digests``, ``grids``, and the video's ``pts`` and ``keys``."""
        with np.load(self._reference_path) as arrays:
            return dict(arrays)

    @property
    def _reference_path(self) -> Path:
        folder = self.path.parent if self.is_stills else self.path.parent.parent
        return folder / f"{self.name}.reference.npz"

    def make_reference(self) -> None:
        """Read all frames in order, once."""
        if self._reference_path.exists():
            return
        digests, grids = [], []
        for frame in self._in_order():
            digests.append(digest(frame))
            grids.append(grid(frame))
        pts, keys, ticks = ([], [], 1) if self.is_stills else _index(self.path)
        np.savez(
            self._reference_path,
            digests=np.array(digests, np.uint64),
            grids=np.stack(grids),
            pts=np.array(pts, np.int64),
            keys=np.array(keys, bool),
            ticks=np.array(ticks),
        )

    def _in_order(self) -> Iterator[Pixels]:
        if self.is_stills:
            from PIL import Image

            for number in range(self.frames):
                with Image.open(self.still(number)) as image:
                    yield np.asarray(image)
        elif self.dataset:
            import mp4ds

            with mp4ds.open(self.dataset) as opened:
                yield from (frame.data for frame in opened[TOPIC])
        else:
            with av.open(os.fspath(self.path)) as container:
                for frame in container.decode(video=0):
                    yield frame.to_ndarray(format="rgb24")


def grid(frames: Any) -> Any:
    """Some pixels of frames whose last axes are rows, columns and colours."""
    rows, columns = frames.shape[-3] // GRID, frames.shape[-2] // GRID
    some = frames[..., rows // 2 :: rows, columns // 2 :: columns, :]
    return some[..., :GRID, :GRID, :]


def digest(frame: Pixels) -> int:
    """Of all pixels of a frame."""
    return xxhash.xxh3_64_intdigest(np.ascontiguousarray(frame).data)


def _index(path: Path) -> tuple[list[int], list[bool], int]:
    """Presentation times in order, which are key frames, and ticks of a second."""
    with av.open(os.fspath(path)) as container:
        stream = container.streams.video[0]
        packets = sorted(
            (packet.pts, packet.is_keyframe)
            for packet in container.demux(stream)
            if packet.pts is not None
        )
        base = stream.time_base or Fraction(1, HERTZ)
    return [pts for pts, _ in packets], [key for _, key in packets], round(1 / base)


class Store:
    """All that is made of one clip, below a folder.

    Args:
        folder: Where; made if it is missing.
        frames: Of the clip.
        size: Width and height, both even.
        stills: How many of the frames become PNG and JPEG files, spread over the clip.
    """

    def __init__(self, folder: Path, frames: int, size: tuple[int, int], stills: int = 300) -> None:
        self.frames, self.size, self.stills = frames, size, min(stills, frames)
        self.folder = folder / f"clip-{size[0]}x{size[1]}-{frames}"
        self.folder.mkdir(parents=True, exist_ok=True)

    def stored(self, name: str) -> Stored:
        """The clip, stored as ``CODEC-GOP``, ``lerobot``, ``png`` or ``jpeg``; made if new."""
        if name in STILLS:
            found = Stored(name, self._stills(name), None, self.stills)
        elif name == "lerobot":
            found = Stored(name, self._lerobot(), None, self.frames)
        else:
            dataset = self._dataset(name)
            found = Stored(name, next(dataset.glob("*.mp4")), dataset, self.frames)
        found.make_reference()
        return found

    @cached_property
    def recording(self) -> Path:
        """The clip as a recording without compression."""
        path = self.folder / "clip.mcap"
        if not path.exists():
            part = path.with_suffix(".part")
            frames = moving(self.frames, self.size)
            write_mcap(part, frames, self.frames, "rgb8", compression="none", hertz=HERTZ)
            part.rename(path)
        return path

    def recorded(self) -> Iterator[Pixels]:
        """The frames of the recording."""
        from mcap.reader import make_reader
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        with self.recording.open("rb") as stream:
            for _, _, message in make_reader(stream).iter_messages(topics=[TOPIC]):
                image: Any = store.deserialize_cdr(message.data, "sensor_msgs/msg/Image")
                yield image.data.reshape(image.height, image.width, 3)

    def _dataset(self, name: str) -> Path:
        import mp4ds

        path = self.folder / name
        if not path.exists():
            codec, _, gop = name.partition("-")
            quality, preset = CODECS[codec]
            # parts begin with a key frame
            window = int(gop) * -(-_PART // int(gop))
            options = mp4ds.PackOptions(
                quality=quality, codec=codec, preset=preset, gop=int(gop), window=window
            )
            mp4ds.pack(self.recording, path, options)
        return path

    def _lerobot(self) -> Path:
        path = self.folder / "lerobot" / "lerobot.mp4"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            part = path.with_suffix(".part.mp4")
            write_lerobot_video(part, self.recorded())
            part.rename(path)
        return path

    def _stills(self, kind: str) -> Path:
        from PIL import Image

        path = self.folder / kind
        part = self.folder / f"{kind}.part"
        if not path.exists():
            part.mkdir(exist_ok=True)
            step = self.frames // self.stills
            options: dict[str, Any] = {"quality": JPEG_QUALITY} if kind == "jpeg" else {}
            chosen = islice(self.recorded(), 0, step * self.stills, step)
            for number, frame in enumerate(chosen):
                image = Image.fromarray(frame)
                image.save(part / f"{number:06}{STILLS[kind]}", **options)
            part.rename(path)
        return path


def write_lerobot_video(path: Path, frames: Iterable[Pixels]) -> None:
    """A video with LeRobot's settings, and as LeRobot calls PyAV."""
    with av.open(os.fspath(path), "w") as container:
        stream: Any = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libsvtav1", HERTZ, options=LEROBOT_OPTIONS)
                stream.pix_fmt = "yuv420p"
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def write_cameras(path: Path, cameras: dict[str, Iterable[Pixels]], encoding: str) -> None:
    """A ROS 2 recording of several cameras that are triggered together.

    Args:
        path: The MCAP file to make.
        cameras: Frames by topic; as many of each.
        encoding: ROS image encoding of all.
    """
    from mcap.writer import CompressionType, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    image_type = "sensor_msgs/msg/Image"
    types = store.types
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2", "recorder")
        definition = store.generate_msgdef(image_type, ros_version=2)[0].encode()
        schema = writer.register_schema(image_type, "ros2msg", definition)
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in cameras}
        for number, frames in enumerate(zip(*cameras.values(), strict=True)):
            for place, (topic, frame) in enumerate(zip(cameras, frames, strict=True)):
                stamp = START_NS + number * 10**9 // HERTZ + place * 20_000
                header = types["std_msgs/msg/Header"](
                    types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), topic.strip("/")
                )
                height, width = frame.shape[:2]
                data = np.ascontiguousarray(frame).reshape(-1)
                step = len(data) // height
                image = types[image_type](header, height, width, encoding, 0, step, data)
                payload = bytes(store.serialize_cdr(image, image_type))
                writer.add_message(channels[topic], stamp + 3_000_000, payload, stamp, number)
        writer.finish()  # type: ignore[no-untyped-call]


def ways(codecs: Iterable[str], gops: Iterable[int]) -> list[str]:
    """Names of all ways to store the clip, LeRobot's and the stills included."""
    videos = (f"{codec}-{gop}" for codec in codecs for gop in gops)
    return list(chain(videos, ["lerobot"], STILLS))
