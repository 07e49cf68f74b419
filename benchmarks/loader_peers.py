"""The ways to read frames that benchmarks/loader.py compares.

Each is used as its documentation shows, with its defaults, and is kept open between reads. All give
RGB of 8 bits, rows, columns, colours, but for LeRobot's own loader, which gives floats.

- mp4ds: `Stream.read` with ``format="rgb"``; in order, iteration.
- pyav: seeks to the key frame before each wanted frame, unless the frames up to it can be had by
  decoding on, and decodes up to it. The presentation times are known beforehand.
- torchcodec: `get_frames_at` with each of its seek modes; custom frame mappings are the file's own
  index, made beforehand.
- decord: `get_batch`.
- opencv: sets the position, and reads.
- lerobot: LeRobot's own `decode_video_frames`, torchcodec below it. Without LeRobot: a torchcodec
  decoder of the mode that it uses, and its conversion to floats, marked as emulated.
- lerobot, uint8: the same without the conversion, as LeRobot 0.6 reads on request.
- pil, opencv: one file per frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol

import numpy as np

from loader_clips import HERTZ, Stored
from recordings import TOPIC

Size = tuple[int, int]
"""Width and height, pixels."""


class Peer(Protocol):
    """An opened video, or folder of stills."""

    def read(self, numbers: Sequence[int]) -> Any:
        """Frames, shape (len(numbers), H, W, 3), a numpy array or tensor."""

    def in_order(self) -> Iterator[Any]:
        """All frames, each of shape (H, W, 3)."""


class Mp4ds:
    """Our own."""

    def __init__(self, stored: Stored, *, size: Size | None = None) -> None:
        import mp4ds

        self._size = size
        self._dataset = mp4ds.open(stored.dataset or stored.path)
        self._stream: Any = self._dataset[TOPIC if stored.dataset else stored.path.stem]

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return self._stream.read(numbers, format="rgb", resize=self._size)

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        for frame in self._stream:
            yield frame.data


class PyAv:
    """PyAV."""

    def __init__(self, stored: Stored, *, size: Size | None = None) -> None:
        import av

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
        mode: ``exact``, ``approximate`` or ``mappings``.
        size: Width and height to make, by its Resize.
    """

    def __init__(self, stored: Stored, mode: str, *, size: Size | None = None) -> None:
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


class Decord:
    """decord."""

    def __init__(self, stored: Stored) -> None:
        import decord

        decord.logging.set_level(decord.logging.QUIET)
        self._reader: Any = decord.VideoReader(str(stored.path))

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return self._reader.get_batch(list(numbers)).asnumpy()

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        self._reader.seek(0)
        for _ in range(len(self._reader)):
            yield self._reader.next().asnumpy()


class OpenCv:
    """OpenCV's VideoCapture."""

    def __init__(self, stored: Stored) -> None:
        import cv2

        self._cv2: Any = cv2
        self._capture: Any = cv2.VideoCapture(str(stored.path))

    def _frame(self) -> Any:
        there, frame = self._capture.read()
        if not there:
            raise ValueError("OpenCV reads no frame")
        return self._cv2.cvtColor(frame, self._cv2.COLOR_BGR2RGB)

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        found = {}
        for number in sorted(set(numbers)):
            if self._capture.get(self._cv2.CAP_PROP_POS_FRAMES) != number:
                self._capture.set(self._cv2.CAP_PROP_POS_FRAMES, number)
            found[number] = self._frame()
        return np.stack([found[number] for number in numbers])

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        self._capture.set(self._cv2.CAP_PROP_POS_FRAMES, 0)
        for _ in range(int(self._capture.get(self._cv2.CAP_PROP_FRAME_COUNT))):
            yield self._frame()


class LeRobot:
    """The function that LeRobot's dataset reads videos with."""

    def __init__(self, stored: Stored) -> None:
        self._operators = allow_lerobot()
        from lerobot.datasets.video_utils import decode_video_frames

        self._decode: Any = decode_video_frames
        self._path, self._count = stored.path, stored.frames

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        times = [number / HERTZ for number in numbers]
        frames = self._decode(self._path, times, tolerance_s=1e-4, backend="torchcodec")
        return frames.permute(0, 2, 3, 1)

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        for number in range(self._count):
            yield self.read([number])[0]


class EmulatedLeRobot:
    """What LeRobot does with torchcodec, without LeRobot.

    Args:
        stored: What to read.
        floats: Whether to convert to 0 to 1.
    """

    def __init__(self, stored: Stored, *, floats: bool) -> None:
        from torchcodec.decoders import VideoDecoder

        self._decoder: Any = VideoDecoder(str(stored.path), seek_mode="approximate")
        self._floats = floats

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        import torch

        found = self._decoder.get_frames_at(list(numbers)).data
        frames = torch.stack(list(found))  # it stacks what it picks by time
        if self._floats:
            frames = (frames / 255.0).type(torch.float32)
        return frames.permute(0, 2, 3, 1)

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        for number in range(len(self._decoder)):
            yield self.read([number])[0]


def allow_lerobot() -> Any:
    """Let torchvision, which LeRobot imports, load beside a torch of another build.

    Its compiled operators cannot load there, and describing two of them fails. LeRobot's loader
    uses none of them.

    Returns:
        What has to be kept as long as torchvision is used.
    """
    import torch

    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        library = torch.library.Library("torchvision", "FRAGMENT")
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor dets, Tensor scores, float iou) -> Tensor")
        return library
    return None


class PilStills:
    """Pillow."""

    def __init__(self, stored: Stored) -> None:
        from PIL import Image

        self._open: Any = Image.open
        self._stored = stored

    def _one(self, number: int) -> Any:
        with self._open(self._stored.still(number)) as image:
            return np.asarray(image)

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return np.stack([self._one(number) for number in numbers])

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        yield from map(self._one, range(self._stored.frames))


class OpenCvStills:
    """OpenCV's imread."""

    def __init__(self, stored: Stored) -> None:
        import cv2

        self._cv2: Any = cv2
        self._stored = stored

    def _one(self, number: int) -> Any:
        image = self._cv2.imread(self._stored.still(number))
        return self._cv2.cvtColor(image, self._cv2.COLOR_BGR2RGB)

    def read(self, numbers: Sequence[int]) -> Any:  # noqa: D102
        return np.stack([self._one(number) for number in numbers])

    def in_order(self) -> Iterator[Any]:  # noqa: D102
        yield from map(self._one, range(self._stored.frames))


@dataclass(frozen=True, slots=True)
class Kind:
    """A way to read.

    Attributes:
        opener: Opens what is stored.
        packages: What it needs, the one to tell the version of first.
    """

    opener: Callable[[Stored], Peer]
    packages: tuple[str, ...]


OURS = "mp4ds"
VIDEO_PEERS = {
    OURS: Kind(Mp4ds, ("mp4ds",)),
    "pyav": Kind(PyAv, ("av",)),
    "torchcodec exact": Kind(lambda s: TorchCodec(s, "exact"), ("torchcodec", "torch")),
    "torchcodec approximate": Kind(lambda s: TorchCodec(s, "approximate"), ("torchcodec", "torch")),
    "torchcodec mappings": Kind(lambda s: TorchCodec(s, "mappings"), ("torchcodec", "torch")),
    "decord": Kind(Decord, ("decord",)),
    "opencv": Kind(OpenCv, ("opencv-python-headless",)),
}
LEROBOT_PEERS = {
    "lerobot": Kind(LeRobot, ("lerobot", "torchcodec", "torch")),
    "lerobot, uint8 (emulated)": Kind(
        lambda s: EmulatedLeRobot(s, floats=False), ("torchcodec", "torch")
    ),
    "lerobot (emulated)": Kind(lambda s: EmulatedLeRobot(s, floats=True), ("torchcodec", "torch")),
}
STILL_PEERS = {
    "pil": Kind(PilStills, ("pillow",)),
    "opencv": Kind(OpenCvStills, ("opencv-python-headless",)),
}


def peers_for(name: str) -> dict[str, Kind]:
    """Who reads what is stored in a way."""
    if name == "lerobot":
        return LEROBOT_PEERS | {OURS: VIDEO_PEERS[OURS]}
    return STILL_PEERS if name in ("png", "jpeg") else VIDEO_PEERS


def versions() -> str:
    """Of all peers, and which are missing."""
    kinds = [*VIDEO_PEERS.values(), *LEROBOT_PEERS.values(), *STILL_PEERS.values()]
    names = dict.fromkeys(package for kind in kinds for package in kind.packages)
    return ", ".join(f"{name} {installed(name) or 'missing'}" for name in names)


def installed(package: str) -> str | None:
    """Version of a package, None where it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
