"""The recordings and open streams of a worker, and how frames become tensors."""

from __future__ import annotations

import gc
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mp4ds.dataset.collections import datasets_in
from mp4ds.dataset.dataset import open_dataset
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.views import FORMATS, size_after
from mp4ds.errors import FormatError, Mp4dsError, OptionError, Refused, SampleError, VideoError
from mp4ds.files.urls import location, spelled
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.times import nearest, synchronize
from mp4ds.torch.torchcodec import TorchcodecReader
from mp4ds.video.mp4 import read_sample_table

Resize = float | tuple[int, int]
Crop = tuple[int, int, int, int]
Dtype = Literal["native", "uint8", "float32"]
Backend = Literal["mp4ds", "torchcodec"]

_T = TypeVar("_T")
_DTYPES = ("native", "uint8", "float32")
_BACKENDS = ("mp4ds", "torchcodec")

# A worker must not free what its parent left to the garbage collector: a PyAV container is always
# in a reference cycle, and freeing its decoder waits for threads that a fork does not copy.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=gc.freeze)


@dataclass(frozen=True, slots=True)
class TensorView:
    """How a camera's frames are wanted.

    Attributes:
        format: One of `mp4ds.dataset.views.FORMATS`.
        resize: Factor, or width and height, pixels.
        crop: x, y, width, height, pixels, applied before it.
    """

    format: str = "rgb"
    resize: Resize | None = None
    crop: Crop | None = None


@dataclass(frozen=True, slots=True)
class Pictures:
    """How the frames of all cameras become tensors.

    Attributes:
        views: The view of each camera, in the order of the topics.
        dtype: ``native``, ``uint8`` or ``float32``.
        channels_first: (C, H, W) instead of (H, W, C).
        backend: The decoding backend.
        device: Where the tensors are.
    """

    views: tuple[TensorView, ...]
    dtype: str
    channels_first: bool
    backend: str
    device: str

    def tensor(self, pixels: Tensor, topic: str, format_name: str) -> Tensor:
        """The tensor of frames: a view if no computation is needed.

        Args:
            pixels: Shape (N, H, W) or (N, H, W, C).
            topic: For errors.
            format_name: Format of the pixels.

        Returns:
            Shape (N, C, H, W), or (N, H, W, C).

        Raises:
            OptionError: They are not bytes, but ``uint8`` was requested.
        """
        if pixels.ndim == 3:
            pixels = pixels.unsqueeze(-1)
        self.check(pixels.dtype, topic)
        if self.dtype == "float32":
            pixels = _floats(pixels, scaled=format_name != "native")
        return self.arranged(pixels)

    def check(self, dtype: torch.dtype, topic: str) -> None:
        """Refuse pixels that are not bytes, if ``uint8`` was requested.

        Raises:
            OptionError: They are not.
        """
        if self.dtype == "uint8" and dtype != torch.uint8:
            kind = str(dtype).removeprefix("torch.")
            raise OptionError(
                f"topic {topic}: has frames of {kind}, not uint8. Give dtype='native' to get them "
                "as stored, or dtype='float32'."
            )

    def arranged(self, pixels: Tensor) -> Tensor:
        """Pixels of shape (..., H, W, C) with the channels in the requested place; a view."""
        return pixels.movedim(-1, -3) if self.channels_first else pixels


def _floats(pixels: Tensor, *, scaled: bool, out: Tensor | None = None) -> Tensor:
    """Pixels as float32, in a new tensor or in `out`."""
    if out is None:
        out = torch.empty(pixels.shape, dtype=torch.float32)
    if not scaled or pixels.dtype.is_floating_point:
        return out.copy_(pixels)
    return torch.div(pixels, torch.iinfo(pixels.dtype).max, out=out)


def pictures_from(
    topics: Sequence[str],
    *,
    format_: str | Mapping[str, str],
    resize: Resize | Mapping[str, Resize] | None,
    crop: Crop | Mapping[str, Crop] | None,
    dtype: str,
    channels_first: bool,
    backend: str,
    device: str,
) -> Pictures:
    """The user's choices.

    Raises:
        OptionError: One is unknown, or for a topic that does not exist.
    """
    dtype = str(dtype).removeprefix("torch.")
    _one_of("dtype", dtype, _DTYPES)
    _one_of("backend", backend, _BACKENDS)
    formats = _each("format", format_, topics, "rgb")
    sizes = _each("resize", resize, topics, None)
    crops = _each("crop", crop, topics, None)
    for name in formats:
        _one_of("format", name, FORMATS)
    for topic, size in zip(topics, sizes, strict=True):
        if size is not None:  # now, rather than in a worker
            size_after(topic, (1, 1), size)
    views = tuple(map(TensorView, formats, sizes, crops))
    if backend == "mp4ds" and device != "cpu":
        raise OptionError(f"device={device!r} needs backend='torchcodec'.")
    if backend == "torchcodec":
        for view in views:
            if view.format != "rgb" or view.resize is not None:
                raise OptionError(
                    "backend='torchcodec' only gives format='rgb' without resize; use a transform."
                )
    return Pictures(views, dtype, channels_first, backend, device)


def _one_of(name: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise OptionError(f"{name} is {value!r}, not one of {', '.join(known)}.")


def _each(name: str, given: _T | Mapping[str, _T], topics: Sequence[str], default: _T) -> list[_T]:
    """A value for each topic, from one for all or a mapping."""
    if not isinstance(given, Mapping):
        return [given] * len(topics)
    unknown = [topic for topic in given if topic not in topics]
    if unknown:
        raise OptionError(
            f"{name} is given for {unknown[0]!r}, which is not among the topics: "
            f"{', '.join(topics)}."
        )
    return [given.get(topic, default) for topic in topics]


# ---------------------------------------------------------------- recordings

Paths = Path | str | Sequence[Path | str]
"""Datasets: folders, videos next to their sidecars, or URLs of these."""

RESERVED = ("stamp_ns", "index", "dataset")
"""Sample keys that cannot be topic names."""


@dataclass(frozen=True, slots=True)
class CameraSource:
    """A camera of a recording.

    Attributes:
        topic: Of its images.
        name: Of its file, without extension.
        place: Path or URL of the sidecar, or of a video without one.
        frames: Number of its frames.
    """

    topic: str
    name: str
    place: str
    frames: int


@dataclass(frozen=True, slots=True)
class Recording:
    """The samples of one dataset, in order: its rows.

    Attributes:
        path: As given by the user.
        sources: Its cameras, in the order of the topics.
        matches: Frame numbers, int64 of shape (rows, cameras); None: row n is frame n of the only
            camera.
        unmatched: Frame numbers that are not in any row, by topic.
    """

    path: str
    sources: tuple[CameraSource, ...]
    matches: NDArray[np.int64] | None
    unmatched: dict[str, NDArray[np.int64]]

    @property
    def rows(self) -> int:
        """Number of its samples."""
        return self.sources[0].frames if self.matches is None else len(self.matches)

    def frames(self, rows: NDArray[np.int64], camera: int) -> NDArray[np.int64]:
        """A camera's frame numbers for rows; the same shape."""
        return rows if self.matches is None else self.matches[rows, camera]


class Collection:
    """The samples of several datasets, one after another.

    For a dataset with one camera only the manifest is read; to match several cameras, also their
    stamps.

    Args:
        paths: The datasets, or folders of them.
        topics: Topics or names of streams; None: those of the first dataset. All must have them.
        sync_tolerance_ns: Maximum distance of the header stamps of a match, nanoseconds.

    Raises:
        OptionError: A topic does not exist, or there are no samples.
        FormatError: A manifest or sidecar breaks a rule of the format.
        SourceError: A path is not a dataset.
    """

    def __init__(
        self, paths: Paths, *, topics: Sequence[str] | None, sync_tolerance_ns: int
    ) -> None:
        if not isinstance(paths, (str, Path)) and not list(paths):
            raise OptionError("There are no datasets: the list of paths is empty.")
        if isinstance(topics, str):
            raise OptionError(f"topics is a list of topics, such as [{topics!r}].")
        if sync_tolerance_ns < 0:
            raise OptionError(
                f"sync_tolerance_ns is {sync_tolerance_ns}, but must not be negative."
            )
        if topics is not None and not topics:
            raise OptionError("topics is empty; use None for all cameras of the first dataset.")
        given = datasets_in(paths)
        known = _sources(given[0])
        self.topics = tuple(topics) if topics is not None else tuple(s.topic for s in known)
        _check_topics(self.topics, given[0])
        self.recordings = [
            self._recording(path, known if number == 0 else _sources(path), sync_tolerance_ns)
            for number, path in enumerate(given)
        ]
        if not self.starts[-1]:
            raise OptionError(
                f"{given[0]}: no frames of {', '.join(self.topics)} have header stamps within "
                f"{sync_tolerance_ns} ns of each other. Use a larger sync_tolerance_ns, or one "
                f"camera: topics=[{self.topics[0]!r}]."
            )

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """Number of the first sample of each recording, and of the end; int64."""
        return np.cumsum([0, *(recording.rows for recording in self.recordings)], dtype=np.int64)

    def locate(self, samples: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Recording and row of each sample number, 0 <= number < ``starts[-1]``."""
        recordings = np.searchsorted(self.starts, samples, side="right") - 1
        return recordings.astype(np.int64), samples - self.starts[recordings]

    def _recording(
        self, path: Path | str, sources: list[CameraSource], tolerance_ns: int
    ) -> Recording:
        chosen = tuple(_choose(sources, topic, path) for topic in self.topics)
        if len(chosen) == 1:
            return Recording(str(path), chosen, None, {chosen[0].topic: np.empty(0, np.int64)})
        stamps = {}
        for topic, source in zip(self.topics, chosen, strict=True):
            stream = open_source(source)
            stamps[topic] = stream.stamps
            stream.close()
        sync = synchronize(stamps, tolerance_ns=tolerance_ns)
        return Recording(str(path), chosen, sync.indices, sync.unmatched)


def open_source(source: CameraSource) -> Topic:
    """The frames of a camera; others of its dataset are not touched.

    Args:
        source: Which.

    Raises:
        FormatError: It breaks a rule of the format.
    """
    path = location(source.place)
    if path.suffix == ".yaml":
        return Topic([Stream(path)])
    return Topic(open_dataset(path).parts)


def _sources(path: Path | str) -> list[CameraSource]:
    """The cameras of a dataset, from its manifest, without reading the sidecars."""
    folder = location(path)
    if folder.name == MANIFEST_NAME:
        folder = folder.parent
    if (folder / MANIFEST_NAME).exists():
        entries = load_manifest(folder / MANIFEST_NAME).streams
        places = [folder / entry.sidecar for entry in entries]
        return [
            CameraSource(entry.topic, place.stem, spelled(place), entry.frames)
            for entry, place in zip(entries, places, strict=True)
        ]
    with open_dataset(path) as dataset:
        parts = dataset.parts
        return [
            CameraSource(one.topic, one.path.stem, spelled(one.path), len(one)) for one in parts
        ]


def _check_topics(topics: Sequence[str], path: Path | str) -> None:
    if not topics:
        raise OptionError(f"{path}: has no camera; without topics, the first dataset needs one.")
    twice = [topic for topic in topics if topics.count(topic) > 1]
    if twice:
        raise OptionError(
            f"{path}: {twice[0]} is given twice among the topics. If it has several streams, "
            "choose one by its file name."
        )
    taken = [topic for topic in topics if topic in RESERVED]
    if taken:
        raise OptionError(f"{path}: a topic named {taken[0]!r} cannot be a key of a sample.")


def _choose(sources: list[CameraSource], topic: str, path: Path | str) -> CameraSource:
    found = [s for s in sources if topic in (s.topic, s.name)]
    if not found:
        known = ", ".join(dict.fromkeys(s.topic for s in sources)) or "none"
        raise OptionError(f"{path}: has no topic {topic!r}; there are: {known}.")
    if len(found) > 1:
        names = ", ".join(s.name for s in found)
        raise OptionError(
            f"{path}: {topic} changes its size or encoding and has {len(found)} streams; choose "
            f"one of {names}."
        )
    return found[0]


# ---------------------------------------------------------------- cameras


class OpenCamera:
    """An open camera: its frames as tensors, and its stamps.

    Args:
        source: Which.
        view: How its frames are wanted.
        pictures: How they become tensors.

    Raises:
        FormatError: The stream breaks a rule of the format.
    """

    def __init__(self, source: CameraSource, view: TensorView, pictures: Pictures) -> None:
        self.source = source
        self._view = view
        self._pictures = pictures
        self.topic = open_source(source)
        if len(self.topic) != source.frames:
            raise FormatError(
                "frame-count",
                source.place,
                f"has {len(self.topic)} frames, not {source.frames}",
            )
        self._torchcodec = None
        if pictures.backend == "torchcodec":
            self._torchcodec = TorchcodecReader(self.topic, view.crop, pictures.device)
        self._options: dict[str, Any] = {
            "format": view.format,
            "resize": view.resize,
            "crop": view.crop,
        }

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, by frame."""
        return self.topic.stamps

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        return np.argsort(self.stamps, kind="stable")

    @cached_property
    def period_ns(self) -> int:
        """Median time between frames, nanoseconds; 0 for a single frame."""
        gaps = np.diff(self.stamps[self._order])
        return int(np.median(gaps)) if len(gaps) else 0

    def nearest(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames whose stamps are nearest to times; the first of several."""
        stamps = self.stamps[self._order]
        return self._order[nearest(stamps, times)].astype(np.int64)

    @cached_property
    def key_frames(self) -> NDArray[np.int64]:
        """Numbers of the frames at which decoding can begin, in order; all if unknown.

        Raises:
            VideoError: The video's index is damaged.
        """
        path = self.topic.parts[0].video_path
        try:
            with path.open("rb") as file:
                table = read_sample_table(file, path.stat().st_size, str(path))
        except Refused:
            return np.arange(len(self.topic), dtype=np.int64)
        except OSError as error:
            raise VideoError("file-missing", path, f"cannot be read: {error.strerror}") from None
        keys = np.flatnonzero(table.sync[table.order])
        return np.union1d(0, keys).astype(np.int64)  # a slice may begin between two

    def read(self, frames: NDArray[np.int64]) -> Tensor:
        """Frames as a tensor, decoded in one pass.

        Args:
            frames: Numbers, shape (N,), in any order.

        Returns:
            Shape (N, C, H, W) or (N, H, W, C); its own memory.

        Raises:
            SampleError: One of them cannot be decoded.
            OptionError: They cannot be returned as requested.
        """
        numbers: list[int] = frames.tolist()
        pixels = self._decoded(numbers, lambda: self._read(numbers))
        return self._pictures.tensor(pixels, self.source.topic, self._view.format)

    def _read(self, numbers: list[int]) -> Tensor:
        """Pixels of frames, shape (N, H, W) or (N, H, W, C)."""
        if self._torchcodec is not None:
            return self._torchcodec.read(numbers)
        return torch.from_numpy(self.topic.read(numbers, **self._options))  # shares the memory

    def empty(self, shape: tuple[int, ...]) -> Tensor | None:
        """A tensor for frames, such as `read_into` takes.

        Args:
            shape: Leading dimensions.

        Returns:
            Shape (*shape, H, W, C); None if frames cannot be decoded into existing tensors.

        Raises:
            OptionError: The frames cannot be returned as requested.
        """
        if self._torchcodec is not None:
            return None
        row = self._read([])
        self._pictures.check(row.dtype, self.source.topic)
        dtype = torch.float32 if self._pictures.dtype == "float32" else row.dtype
        channels = row.shape[3:] or (1,)
        return torch.empty((*shape, *row.shape[1:3], *channels), dtype=dtype)

    def read_into(self, frames: NDArray[np.int64], outs: Sequence[Tensor]) -> None:
        """Decode frames into existing tensors in one pass.

        Args:
            frames: Numbers, shape (N,), in any order.
            outs: For each frame a row of a tensor from `empty`, shape (H, W, C).

        Raises:
            SampleError: One of them cannot be decoded.
        """
        numbers: list[int] = frames.tolist()
        if self._pictures.dtype == "float32":
            pixels = self._decoded(numbers, lambda: self._read(numbers))
            for row, out in zip(pixels, outs, strict=True):
                _floats(row.view(out.shape), scaled=self._view.format != "native", out=out)
            return
        is_grey = outs[0].shape[-1] == 1
        # arrays share the memory of tensors
        rows = [(out.squeeze(-1) if is_grey else out).numpy() for out in outs]
        self._decoded(numbers, lambda: self.topic.read_into(numbers, rows, **self._options))

    def _decoded(self, numbers: list[int], decode: Callable[[], _T]) -> _T:
        try:
            return decode()
        except OptionError:
            raise
        except Mp4dsError as error:
            raise self._first_failure(numbers, error) from None

    def _first_failure(self, numbers: list[int], error: Mp4dsError) -> Mp4dsError:
        """Which frame failed, since an error about many does not always say."""
        for number in sorted(set(numbers)):
            try:
                self._read([number])
            except Mp4dsError as its:
                return SampleError(f"frame {number}: {its}")
        return SampleError(f"one of {len(numbers)} frames: {error}")

    def close(self) -> None:
        """Close the video."""
        self._torchcodec = None
        self.topic.close()


@dataclass(slots=True)
class _Cameras:
    """The open cameras of one process by place, used by one thread at a time."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    by_place: OrderedDict[str, OpenCamera] = field(default_factory=OrderedDict)


class OpenCameras:
    """The open cameras of one process; the least recently used are closed.

    A copy, by pickling or forking, has none open: a decoder's threads do not exist in another
    process, and it would wait for them.

    Args:
        most: Maximum number of open cameras.
        pictures: How their frames become tensors.

    Raises:
        OptionError: `most` is less than one.
    """

    def __init__(self, most: int, pictures: Pictures) -> None:
        self._most = most
        self._pictures = pictures
        # what a parent opened is kept as it is: closing or freeing its decoders could hang
        self._processes: dict[int, _Cameras] = {}
        if most < 1:
            raise OptionError(f"cache_files is {most}, but must be at least 1.")

    @property
    def _own(self) -> _Cameras:
        process = os.getpid()
        return self._processes.get(process) or self._processes.setdefault(process, _Cameras())

    def __len__(self) -> int:
        return len(self._own.by_place)

    @contextmanager
    def using(self, recording: Recording, camera: int) -> Iterator[OpenCamera]:
        """A camera of a recording, opened if needed; other threads wait until it is left.

        Raises:
            FormatError: It breaks a rule of the format.
        """
        own = self._own
        with own.lock:
            source = recording.sources[camera]
            found = own.by_place.pop(source.place, None)
            if found is None:
                while len(own.by_place) >= self._most:
                    own.by_place.popitem(last=False)[1].close()
                found = OpenCamera(source, self._pictures.views[camera], self._pictures)
            own.by_place[source.place] = found
            yield found

    def close(self) -> None:
        """Close the cameras of this process."""
        own = self._processes.get(os.getpid())
        if own is not None:
            with own.lock:
                while own.by_place:
                    own.by_place.popitem()[1].close()

    def __del__(self) -> None:
        # a decoder left to the garbage collector may be collected in a forked process
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_processes": {}}
