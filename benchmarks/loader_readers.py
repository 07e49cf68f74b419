"""What benchmarks/loader.py reads, and who reads it.

The clip is the scenes of clips.py, one after the other, each enlarged to cover a window that moves
over it as a camera that is carried, and exposed anew by a sensor with noise (a standard deviation
of 2.6 of 255 levels in mid grey). A scene that ends begins anew, with other noise and another
path. The same numbers give the same clip.

All is made once, below a folder: the clip as an MCAP file, and of this file a dataset for each
codec and GOP, LeRobot's video, PNG and JPEG files, and for each video its *reference*: 16 x 16
pixels of each frame of one pass in order.

Each reader is used as its documentation shows, with its defaults, and is kept open between reads.
All give RGB of 8 bits.

- mp4ds: `Stream.read` with ``format="rgb"``; in order, iteration.
- pyav: seeks to the key frame before each wanted frame, unless the frames up to it can be had by
  decoding on, and decodes up to it. The presentation times are known beforehand.
- torchcodec: `get_frames_at` with exact seeking, and with custom frame mappings, which are the
  file's own index, made beforehand.
- lerobot, uint8 (emulated): a torchcodec decoder of the mode that LeRobot 0.6 uses, which stacks
  what it picks.
- pil: one file per frame.
- FrameDataset, FrameStream: those of `mp4ds.torch`, through a DataLoader without workers.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import mp4ds
from clips import SCENES, SEED, ClipSpec, Sensor, data_folder, expose, rgb_frames
from measure import size_of
from recordings import HERTZ, TOPIC, write_mcap

Pixels = NDArray[Any]

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
    "epoch": f"a shuffled epoch, batches of {BATCH}",
}
"""What is measured of each reader."""
LOSSLESS = {"lossless": "none", "exact": None, "view": None}
"""What is read of a lossless dataset -> its view; `exact` and `view` are of the same one."""
STILLS = {"png": ".png", "jpeg": ".jpg"}
JPEG_QUALITY = 95
_PART = 480  # frames of each part of a pack, more than any GOP


# ---------------------------------------------------------------- frames


def moving(count: int, size: tuple[int, int]) -> Iterator[Pixels]:
    """The clip's frames, rgb of 8 bits, shape (H, W, 3)."""
    phases = np.random.default_rng((SEED, 0)).uniform(0, 2 * np.pi, 4)
    periods = np.array([7.0, 2.3, 5.0, 1.7])  # seconds: a slow and a quick swing each way
    for number, scene in enumerate(islice(_scenes(size), count)):
        swing = np.sin(phases + 2 * np.pi * number / HERTZ / periods) * [0.8, 0.2, 0.8, 0.2]
        # even, so that the mosaic keeps its phase
        x, y = (int(MARGIN * (1 + swing[i] + swing[i + 1])) // 2 * 2 for i in (0, 2))
        rng = np.random.default_rng((SEED, 0, number))
        yield expose("rgb8", scene[y : y + size[1], x : x + size[0]], SENSOR, rng)


def _scenes(size: tuple[int, int]) -> Iterator[NDArray[np.float32]]:
    """Frames of all scenes without noise, a margin larger than asked, over and over."""
    folder = data_folder()
    wide = (size[0] + 2 * MARGIN, size[1] + 2 * MARGIN)
    found = [
        name
        for name, (pattern, encodings) in SCENES.items()
        if folder and not encodings and any(folder.glob(pattern))
    ]
    while True:
        for name in found or ["demo"]:
            yield from rgb_frames(ClipSpec(name, "rgb8", "low", 300, wide))


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
    def is_stills(self) -> bool:
        """Whether each frame is a file."""
        return self.name in STILLS

    @cached_property
    def bytes_per_frame(self) -> float:
        """Of the video, or of the files; of what is exact, of all videos."""
        paths = self.path.parent.glob("*.mp4") if self.name == "exact" else [self.path]
        return sum(map(size_of, paths)) / self.frames

    def still(self, number: int) -> str:
        """The file of a frame."""
        return os.fspath(self.path / f"{number:06}{STILLS[self.name]}")

    @cached_property
    def reference(self) -> dict[str, NDArray[Any]]:
        """What the frames are: ``grids``, and the video's ``pts`` and ``keys``."""
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
        grids = [grid(frame) for frame in self._in_order()]
        pts, keys, ticks = ([], [], 1) if self.is_stills else _index(self.path)
        np.savez(
            self._reference_path,
            grids=np.stack(grids),
            pts=np.array(pts, np.int64),
            keys=np.array(keys, bool),
            ticks=np.array(ticks),
        )

    def _in_order(self) -> Iterator[Pixels]:
        if self.is_stills:
            yield from PilStills(self).in_order()
        elif self.dataset:
            yield from Mp4ds(self).in_order()
        else:
            with av.open(os.fspath(self.path)) as container:
                for frame in container.decode(video=0):
                    yield frame.to_ndarray(format="rgb24")


def grid(frames: Any) -> Any:
    """Some pixels of frames whose last axes are rows, columns and colours."""
    rows, columns = frames.shape[-3] // GRID, frames.shape[-2] // GRID
    some = frames[..., rows // 2 :: rows, columns // 2 :: columns, :]
    return some[..., :GRID, :GRID, :]


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
        """The clip, stored as ``CODEC-GOP`` or one of the other ways; made if new."""
        if name in STILLS:
            found = Stored(name, self._stills(name), None, self.stills)
        elif name == "lerobot":
            found = Stored(name, self._lerobot(), None, self.frames)
        else:
            dataset = self._lossless(name) if name in LOSSLESS else self._dataset(name)
            with mp4ds.open(dataset, layer="view" if name == "view" else "exact") as opened:
                found = Stored(name, opened.streams[0].video_path, dataset, self.frames)
        found.make_reference()
        return found

    @cached_property
    def recording(self) -> Path:
        """The clip as a recording without compression."""
        path = self.folder / "clip.mcap"
        if not path.exists():
            part = path.with_suffix(".part")
            frames = moving(self.frames, self.size)
            write_mcap(part, frames, "rgb8", compression="none")
            part.rename(path)
        return path

    def _dataset(self, name: str) -> Path:
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

    def _lossless(self, name: str) -> Path:
        path = self.folder / ("lossless" if LOSSLESS[name] else "layers")
        if not path.exists():
            mp4ds.pack(self.recording, path, mp4ds.PackOptions(view=LOSSLESS[name]))
        return path

    def _lerobot(self) -> Path:
        path = self.folder / "lerobot" / "lerobot.mp4"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            part = path.with_suffix(".part.mp4")
            write_video(part, moving(self.frames, self.size))
            part.rename(path)
        return path

    def _stills(self, kind: str) -> Path:
        path = self.folder / kind
        part = self.folder / f"{kind}.part"
        if not path.exists():
            part.mkdir(exist_ok=True)
            step = self.frames // self.stills
            options: dict[str, Any] = {"quality": JPEG_QUALITY} if kind == "jpeg" else {}
            chosen = islice(moving(self.frames, self.size), 0, step * self.stills, step)
            for number, frame in enumerate(chosen):
                image = Image.fromarray(frame)
                image.save(part / f"{number:06}{STILLS[kind]}", **options)
            part.rename(path)
        return path


def write_video(
    path: Path,
    frames: Iterable[Pixels],
    encoder: str = "libsvtav1",
    options: dict[str, str] = LEROBOT_OPTIONS,
) -> None:
    """A video with settings, LeRobot's by default, made as LeRobot calls PyAV."""
    with av.open(os.fspath(path), "w") as container:
        stream: Any = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream(encoder, HERTZ, options=options)
                stream.pix_fmt = "yuv420p"
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


# ---------------------------------------------------------------- readers

Size = tuple[int, int]
"""Width and height, pixels."""

# each reads frames by number, in an array or tensor of shape (count, H, W, 3), and all in order


class Mp4ds:
    """Our own."""

    def __init__(self, stored: Stored, size: Size | None = None) -> None:
        self._size = size
        layer = "view" if stored.name == "view" else "exact"
        self._dataset = mp4ds.open(stored.dataset or stored.path, layer=layer)
        self._stream: Any = self._dataset[TOPIC if stored.dataset else stored.path.stem]

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return self._stream.read(numbers, format="rgb", resize=self._size)

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        for frame in self._stream:
            yield frame.data


class PyAv:
    """PyAV."""

    def __init__(self, stored: Stored, size: Size | None = None) -> None:
        self._made = {"width": size[0], "height": size[1]} if size else {}
        self._container = av.open(str(stored.path))
        self._stream = self._container.streams.video[0]
        self._pts = stored.reference["pts"]
        # of each frame the key frame that it is decoded from
        self._keys = np.maximum.accumulate(
            np.where(stored.reference["keys"], np.arange(len(self._pts)), 0)
        )
        self._decoded: Iterator[Any] = iter(())
        self._next = len(self._pts)

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        found = {number: self._one(number) for number in sorted(set(numbers))}
        return np.stack([found[number] for number in numbers])

    def _one(self, number: int) -> Any:
        if not self._keys[number] <= self._next <= number:
            self._container.seek(int(self._pts[number]), stream=self._stream)
            self._decoded = self._container.decode(self._stream)
        for frame in self._decoded:
            if frame.pts is not None and frame.pts >= self._pts[number]:
                self._next = number + 1
                return frame.to_ndarray(format="rgb24", **self._made)
        raise ValueError(f"frame {number} does not come")

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        self._container.seek(0, stream=self._stream)
        for frame in self._container.decode(self._stream):
            yield frame.to_ndarray(format="rgb24")


class TorchCodec:
    """torchcodec.

    Args:
        stored: What to read.
        size: Width and height to make, by its Resize.
        mode: ``exact`` or ``mappings``.
    """

    def __init__(self, stored: Stored, size: Size | None = None, *, mode: str) -> None:
        from torchcodec.decoders import VideoDecoder

        how: dict[str, Any] = {"seek_mode": mode}
        if mode == "mappings":
            how = {"custom_frame_mappings": _mappings(stored)}
        if size:
            from torchcodec.transforms import Resize

            how["transforms"] = [Resize((size[1], size[0]))]
        self._decoder: Any = VideoDecoder(str(stored.path), dimension_order="NHWC", **how)

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return self._decoder.get_frames_at(list(numbers)).data

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        yield from self._decoder


def _mappings(stored: Stored) -> str:
    pts, keys = stored.reference["pts"].tolist(), stored.reference["keys"].tolist()
    last = int(stored.reference["ticks"]) // HERTZ
    frames = [
        {"pts": start, "duration": end - start, "key_frame": int(key)}
        for start, end, key in zip(pts, [*pts[1:], pts[-1] + last], keys, strict=True)
    ]
    return json.dumps({"frames": frames})


class EmulatedLeRobot:
    """What LeRobot does with torchcodec, without LeRobot."""

    def __init__(self, stored: Stored, _: Size | None = None) -> None:
        from torchcodec.decoders import VideoDecoder

        self._decoder: Any = VideoDecoder(str(stored.path), seek_mode="approximate")

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        import torch

        found = self._decoder.get_frames_at(list(numbers)).data
        return torch.stack(list(found)).permute(0, 2, 3, 1)  # it stacks what it picks by time

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        for number in range(len(self._decoder)):
            yield self.read([number])[0]


class PilStills:
    """Pillow."""

    def __init__(self, stored: Stored, _: Size | None = None) -> None:
        self._stored = stored

    def _one(self, number: int) -> Any:
        with Image.open(self._stored.still(number)) as image:
            return np.asarray(image)

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return np.stack([self._one(number) for number in numbers])

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        yield from map(self._one, range(self._stored.frames))


class Loader:
    """Our datasets for PyTorch, each frame once, in batches as a DataLoader's worker reads them.

    Args:
        stored: What to read.
        size: Width and height to make.
        kind: ``FrameDataset`` or ``FrameStream``.
    """

    def __init__(self, stored: Stored, size: Size | None = None, *, kind: str) -> None:
        from mp4ds import torch as ours

        path = stored.dataset or stored.path
        layer = "exact" if stored.name == "exact" else "view"
        given: dict[str, Any] = {"resize": size, "layer": layer, "channels_first": False}
        if kind == "FrameStream":
            given |= STREAM
        self._frames: Any = getattr(ours, kind)(path, **given)
        self._key = self._frames.topics[0]

    def batches(self) -> Iterator[tuple[list[int], Any]]:
        """Numbers of the frames, and what is read."""
        from torch.utils.data import DataLoader

        how: dict[str, Any] = {"batch_size": BATCH}
        if not hasattr(self._frames, "set_epoch"):
            how |= {"shuffle": True, "collate_fn": self._frames.collate}
        for batch in DataLoader(self._frames, **how):
            yield batch["index"].tolist(), batch[self._key].numpy()


STREAM = {"window": 120, "buffer": 240}
"""What the stream keeps together, and mixes: frames."""
OURS = "mp4ds"
LOADERS = ("FrameDataset", "FrameStream")
Opener = Callable[[Stored, Size | None], Any]
OWN_PEERS: dict[str, Opener] = {
    OURS: Mp4ds,
    **{kind: partial(Loader, kind=kind) for kind in LOADERS},
}
VIDEO_PEERS: dict[str, Opener] = {
    **OWN_PEERS,
    "pyav": PyAv,
    **{f"torchcodec {mode}": partial(TorchCodec, mode=mode) for mode in ("exact", "mappings")},
}
LEROBOT_PEERS: dict[str, Opener] = {
    "lerobot, uint8 (emulated)": EmulatedLeRobot,
    OURS: Mp4ds,
}
STILL_PEERS: dict[str, Opener] = {"pil": PilStills}


def peers_for(name: str) -> dict[str, Opener]:
    """Who reads what is stored in a way."""
    if name == "lerobot":
        return LEROBOT_PEERS
    if name in ("lossless", "exact"):  # whose planes no other reader puts together
        return OWN_PEERS
    return STILL_PEERS if name in STILLS else VIDEO_PEERS
