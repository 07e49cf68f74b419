"""The open cameras of a worker, how frames become tensors, and where these are kept."""

from __future__ import annotations

import gc
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cached_property
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import xxhash
from numpy.typing import NDArray
from torch import Tensor

from mp4ds._version import __version__
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.vectors import Statistics, sampled_statistics
from mp4ds.dataset.views import FORMATS, Crop, Resize, size_after
from mp4ds.errors import FormatError, Mp4dsError, OptionError, SampleError, VideoError
from mp4ds.files.urls import remote
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.messages.layouts import LAYOUTS
from mp4ds.times import nearest, sound_times
from mp4ds.torch.recordings import CameraSource, Recording, at_least, each, one_of, open_source
from mp4ds.video.media import Media

Dtype = Literal["native", "uint8", "float32"]
Backend = Literal["mp4ds", "torchcodec"]

# A worker must not free what its parent left to the garbage collector: a PyAV container is always
# in a reference cycle, and freeing its decoder waits for threads that a fork does not copy.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=gc.freeze)


# ---------------------------------------------------------------- torchcodec


_SCANNED = 32 * 2**20
"""Bytes of a video that torchcodec scans as quickly as it reads our index."""


class TorchcodecReader:
    """Decodes a stream's video by ``torchcodec.decoders.VideoDecoder``.

    Args:
        topic: The stream's frames.
        crop: x, y, width, height, pixels; None: all.
        device: Such as ``cpu`` or ``cuda``.

    Raises:
        OptionError: torchcodec is missing or misinterprets the video's range or beginning, or the
            video's pictures are not the images.
        VideoError: It cannot open the video.
    """

    def __init__(self, topic: Topic, crop: Crop, device: str) -> None:
        self._path = topic.parts[0].video_path
        for stream in topic.streams:
            image, video = stream.sidecar.image, stream.sidecar.video
            if stream.sidecar.is_predicted:
                raise OptionError(
                    f"topic {stream.topic}: its exact frames are made of two videos, which "
                    "torchcodec cannot do. Use backend='mp4ds', or layer='view'."
                )
            is_deep = ENCODINGS[image.encoding].bytes_per_sample > 1
            if is_deep or not LAYOUTS[video.layout].is_shown:
                raise OptionError(
                    f"topic {stream.topic}: {image.encoding} images are stored in the layout "
                    f"{video.layout}, which torchcodec cannot convert to colour. Use "
                    "backend='mp4ds'."
                )
            if stream.hides_frames:
                raise OptionError(
                    f"topic {stream.topic}: torchcodec returns wrong frames at the beginning of a "
                    "video cut out of another. Use backend='mp4ds', or a dataset packed with a "
                    "`codec`."
                )
        if remote(self._path):
            raise OptionError(f"{self._path}: backend='torchcodec' only reads local files.")
        columns, rows = topic.image_size
        x, y, width, height = crop or (0, 0, columns, rows)
        if not (0 <= x < x + width <= columns and 0 <= y < y + height <= rows):
            raise OptionError(f"topic {topic.topic}: crop {crop} is not inside {columns}x{rows}.")
        self._rows, self._columns = slice(y, y + height), slice(x, x + width)
        self._device = device
        if find_spec("torchcodec") is None:
            raise OptionError(
                "backend='torchcodec' needs torchcodec. Install it with: pip install torchcodec"
            )
        try:
            module = import_module("torchcodec.decoders")
        except (ImportError, OSError, RuntimeError) as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise OptionError(
                f"torchcodec is installed but cannot be used: {reason} If it finds no FFmpeg, "
                "install that."
            ) from None
        # either way, frame n is the n-th shown, whatever its presentation time
        how: dict[str, Any] = {"seek_mode": "exact"}  # which reads the whole file
        if topic.streams and self._path.stat().st_size > _SCANNED:
            how = {"custom_frame_mappings": topic.streams[0].frame_mappings()}
        how |= {"dimension_order": "NHWC", "device": device}
        try:
            self._decoder = module.VideoDecoder(str(self._path), **how)
        except (RuntimeError, ValueError) as error:
            raise self._refused(error) from None
        self._check_range(topic)

    def _check_range(self, topic: Topic) -> None:
        """Refuse a video whose range torchcodec misinterprets.

        On a CPU, torchcodec 0.13 treats full-range AV1 as limited (0.17 does not): contrast is then
        too high by 255 / 219, and dark and bright details are clipped.
        """
        with closing(topic):  # it reopens its video when needed
            first = topic.read([0], format="rgb")[0]
        ours = first[self._rows, self._columns].astype(np.int16)
        mistaken = ((ours - 16) * (255 / 219)).clip(0, 255)
        theirs = self.read([0])[0].cpu().numpy()
        if np.abs(theirs - mistaken).mean() < np.abs(theirs - ours).mean():
            raise OptionError(
                f"topic {topic.topic}: torchcodec decodes its full-range video as limited-range, "
                "so the contrast would be wrong. Use backend='mp4ds', or a dataset packed with "
                "`codec` h264."
            )

    def _refused(self, error: Exception) -> VideoError:
        reason = " ".join(str(error).split()[:40])
        return VideoError("decode-failed", self._path, f"torchcodec cannot decode it: {reason}")

    def read(self, frames: Sequence[int]) -> Tensor:
        """Frames in the requested order, with repetitions; shape (N, H, W, 3), uint8.

        Raises:
            VideoError: One cannot be decoded.
        """
        if not frames:
            height, width = (part.stop - part.start for part in (self._rows, self._columns))
            return torch.empty((0, height, width, 3), dtype=torch.uint8, device=self._device)
        try:
            pixels: Tensor = self._decoder.get_frames_at(list(frames)).data
        except (RuntimeError, IndexError, ValueError) as error:
            raise self._refused(error) from None
        return pixels[:, self._rows, self._columns]


# ---------------------------------------------------------------- frames kept for later

CACHE_BYTES = 8 << 30
"""What a cache may take unless told otherwise."""

_SUM_BYTES = 8


class FrameCache:
    """A folder with a file for each camera and way to return its frames.

    A file has a place for each frame, with a checksum of its pixels. So processes need no lock, and
    what a killed one wrote half counts as missing, as does what a crash of the machine took.

    Args:
        where: A folder, which is made.
        most: Maximum of bytes, over all cameras.
        frames: Of all cameras: a camera gets a share for each of its frames.

    Raises:
        OptionError: The folder cannot be used, or `most` is not positive.
    """

    def __init__(self, where: str | Path, most: int, frames: int) -> None:
        at_least(1, cache_bytes=most)
        if not hasattr(os, "preadv"):
            raise OptionError("cache needs Linux, a BSD or macOS 11.")
        self._most, self._frames = most, frames
        self._folder = Path(where).absolute()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(f"cache {self._folder} cannot be used: {error.strerror}.") from None

    def camera(self, topic: Topic, view: dict[str, Any], like: Pixels) -> CachedFrames:
        """The frames of a camera, as they are returned.

        Args:
            topic: The camera.
            view: Format, size and crop.
            like: An array of no frames, but of their shape and type.

        Raises:
            OptionError: The file cannot be opened.
            VideoError: A video is missing.
        """
        # decoders of other versions may round differently where they resize
        told = [__version__, version("av"), view, like.shape, like.dtype.str, len(topic)]
        try:
            told += [fact for part in topic.parts for fact in _facts(part)]
        except OSError as error:
            place = topic.parts[0].video_path
            raise VideoError("file-missing", place, f"cannot be read: {error.strerror}") from None
        path = self._folder / f"{sha256(repr(told).encode()).hexdigest()[:32]}.frames"
        size = int(np.prod(like.shape[1:])) * like.itemsize
        places = self._most * len(topic) // self._frames // (size + _SUM_BYTES)
        try:
            return CachedFrames(path, size, min(places, len(topic)))
        except OSError as error:
            raise OptionError(f"cache {path} cannot be opened: {error.strerror}.") from None


def _facts(part: Any) -> list[object]:
    """What tells the images of a part from all others: digests, else what a change alters."""
    if not isinstance(part, Stream):
        return _state(part.path)
    found: list[object] = [part.layer, sha256(part.path.read_bytes()).hexdigest()]
    for path, video in part.videos:  # the sidecar has the digests
        found += [path.stat().st_size] if video.sha256 else _state(path)
    return found


def _state(path: Path) -> list[object]:
    found = path.stat()
    return [str(path), found.st_size, found.st_mtime_ns]


class CachedFrames:
    """The frames of one camera that are in the cache. One thread at a time may use it.

    Args:
        path: The file; made if it is missing.
        size: Bytes of a frame.
        places: How many frames may be in it: the first ones.

    Raises:
        OSError: The file cannot be opened.
    """

    def __init__(self, path: Path, size: int, places: int) -> None:
        self._path, self._size, self._places = path, size, places
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._sum = np.zeros(1, np.uint64)

    def load(self, number: int, out: Pixels) -> bool:
        """Whether a frame is there; it is written to `out`, contiguous, which else has anything."""
        if number >= self._places:
            return False
        place = number * (self._size + _SUM_BYTES)
        if os.preadv(self._file, [out.data, self._sum.data], place) < self._size + _SUM_BYTES:
            return False
        return bool(self._sum[0]) and xxhash.xxh3_64_intdigest(out.data) == self._sum[0]

    def store(self, number: int, pixels: Pixels) -> None:
        """Keep a frame, contiguous, if it has a place."""
        if number >= self._places:
            return
        self._sum[0] = xxhash.xxh3_64_intdigest(pixels.data)
        try:
            place = number * (self._size + _SUM_BYTES)
            os.pwritev(self._file, [pixels.data, self._sum.data], place)
        except OSError as error:  # what was written in part counts as missing
            self._places = 0
            reason = f"the cache {self._path} cannot be written: {error.strerror}"
            warnings.warn(f"{reason}; frames are decoded instead", stacklevel=2)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


# ---------------------------------------------------------------- cameras


class OpenCamera:
    """An open camera: its frames as tensors, and its stamps.

    Args:
        source: Which.
        view: How its frames are wanted, as `Topic.read` takes it.
        cameras: How they become tensors, and where they are kept.

    Raises:
        FormatError: The stream breaks a rule of the format.
    """

    def __init__(self, source: CameraSource, view: dict[str, Any], cameras: OpenCameras) -> None:
        self._source = source
        self._view = view
        self._dtype = cameras.dtype
        self._topic = open_source(source)
        if len(self._topic) != source.frames:
            problem = f"has {len(self._topic)} frames, not {source.frames}"
            raise FormatError("frame-count", source.place, problem)
        self._torchcodec = None
        if cameras.backend == "torchcodec":
            self._torchcodec = TorchcodecReader(self._topic, view["crop"], cameras.device)
        self._cached = None
        if cameras.cache is not None:
            self._cached = cameras.cache.camera(self._topic, view, self._topic.read([], **view))

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, by frame."""
        return self._topic.stamps

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """The stamps, or the log times where most stamps do not increase."""
        return sound_times(self.stamps, self._topic.log_times)

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        return np.argsort(self.times, kind="stable")

    @cached_property
    def period_ns(self) -> int:
        """Median time between frames, nanoseconds; 0 for a single frame."""
        gaps = np.diff(self.times[self._order])
        return int(np.median(gaps)) if len(gaps) else 0

    def nearest(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames nearest to times; the first of several."""
        return self._order[nearest(self.times[self._order], times)].astype(np.int64)

    @cached_property
    def key_frames(self) -> NDArray[np.int64]:
        """Numbers of the frames at which decoding can begin, in order.

        Raises:
            VideoError: The video's index is damaged.
        """
        with closing(Media(self._topic.parts[0].video_path)) as media:
            table = media.table
        keys = np.flatnonzero(table.sync[table.order])
        return np.union1d(0, keys).astype(np.int64)  # a slice may begin between two

    @cached_property
    def none(self) -> Tensor:
        """No frames, shape (0, H, W, C).

        Raises:
            OptionError: The frames cannot be returned as requested.
        """
        like = self._pixels([])
        if self._dtype == "uint8" and like.dtype != torch.uint8:
            kind = str(like.dtype).removeprefix("torch.")
            raise OptionError(
                f"topic {self._source.topic}: has frames of {kind}, not uint8. Give "
                "dtype='native' to get them as stored, or dtype='float32'."
            )
        dtype = torch.float32 if self._dtype == "float32" else like.dtype
        return like.new_empty((0, *like.shape[1:3], *(like.shape[3:] or (1,))), dtype=dtype)

    def read(self, frames: Sequence[int], outs: Sequence[Tensor]) -> None:
        """Decode frames in one pass.

        Args:
            frames: Numbers, in any order.
            outs: Where each goes: of the type of `none`, shape (H, W, C).

        Raises:
            VideoError: One of them cannot be decoded.
            OptionError: They cannot be returned as requested.
        """
        if self._torchcodec is None and self._dtype != "float32":
            # arrays share the memory of tensors; those of grey images have no channels
            rows = [(out.squeeze(-1) if out.shape[-1] == 1 else out).numpy() for out in outs]
            self._fill(frames, rows)
            return
        pixels = self._pixels(frames)
        is_scaled = self._dtype == "float32" and self._view["format"] != "native"
        is_scaled = is_scaled and not pixels.dtype.is_floating_point
        for frame, out in zip(pixels, outs, strict=True):
            shaped = frame.view(out.shape)
            if is_scaled:
                torch.div(shaped, torch.iinfo(frame.dtype).max, out=out)
            else:
                out.copy_(shaped)

    def _pixels(self, frames: Sequence[int]) -> Tensor:
        """Frames as decoded, shape (N, H, W) or (N, H, W, C)."""
        if self._torchcodec is not None:
            return self._torchcodec.read(frames)
        like = self._topic.read([], **self._view)
        pixels = np.empty((len(frames), *like.shape[1:]), like.dtype)
        self._fill(frames, list(pixels))
        return torch.from_numpy(pixels)  # shares the memory

    def _fill(self, frames: Sequence[int], rows: Sequence[Pixels]) -> None:
        """Write frames, each into its own array: those in the cache, and all others decoded."""
        cached, missing = self._cached, list(zip(frames, rows, strict=True))
        if cached is not None:
            missing = [pair for pair in missing if not cached.load(*pair)]
        if missing:
            numbers, others = zip(*missing, strict=True)
            self._topic.read_into(numbers, others, **self._view)
        if cached is not None:
            for number, row in missing:
                cached.store(number, row)

    def statistics(self, frames: NDArray[np.int64], most: int) -> Statistics:
        """Those of the colours of some of the frames, at most so many."""
        return sampled_statistics(self._topic, frames, most, **self._view)

    def close(self) -> None:
        """Close the video."""
        self._torchcodec = None
        self._topic.close()
        if self._cached:
            self._cached.close()


class OpenCameras:
    """The open cameras of one process; the least recently used are closed.

    A copy, by pickling or forking, has none open: a decoder's threads do not exist in another
    process, and it would wait for them.

    Args:
        topics: The cameras of a sample.
        most: Maximum number of open cameras.
        format: Of the frames; like `resize` and `crop` one for all, or a mapping by topic.
        resize: Factor, or width and height.
        crop: x, y, width, height.
        dtype: ``native``, ``uint8`` or ``float32``.
        backend: The decoding backend.
        device: Where the tensors are.

    Attributes:
        views: Format, size and crop of each camera, as `Topic.read` takes them.
        cache: Where frames are kept; None: nowhere.

    Raises:
        OptionError: An option is unknown, or for a topic that does not exist.
    """

    def __init__(
        self,
        topics: Sequence[str],
        most: int,
        *,
        format: str | Mapping[str, str],  # noqa: A002 - as of Topic.read
        resize: Resize | Mapping[str, Resize],
        crop: Crop | Mapping[str, Crop],
        dtype: str,
        backend: str,
        device: str,
    ) -> None:
        # by process: what a parent opened is kept as it is, since closing or freeing its decoders
        # could hang, and its lock may be held by a thread that a fork did not copy
        self._opened: dict[int, tuple[threading.RLock, OrderedDict[str, OpenCamera]]] = {}
        self._most = most
        self.cache: FrameCache | None = None
        self.dtype = str(dtype).removeprefix("torch.")
        self.backend, self.device = backend, device
        one_of("dtype", self.dtype, get_args(Dtype))
        one_of("backend", backend, get_args(Backend))
        self.views: list[dict[str, Any]] = [
            {"format": name, "resize": size, "crop": area}
            for name, size, area in zip(
                each("format", format, topics, "rgb"),
                each("resize", resize, topics, None),
                each("crop", crop, topics, None),
                strict=True,
            )
        ]
        for topic, view in zip(topics, self.views, strict=True):
            one_of("format", view["format"], FORMATS)
            if view["resize"] is not None:  # now, rather than in a worker
                size_after(topic, (1, 1), view["resize"])
        if backend == "mp4ds" and device != "cpu":
            raise OptionError(f"device={device!r} needs backend='torchcodec'.")
        is_changed = any(view["format"] != "rgb" or view["resize"] for view in self.views)
        if backend == "torchcodec" and is_changed:
            raise OptionError(
                "backend='torchcodec' only gives format='rgb' without resize; use a transform."
            )
        at_least(1, cache_files=most)

    @contextmanager
    def using(self, recording: Recording, camera: int) -> Iterator[OpenCamera]:
        """A camera of a recording, opened if needed; other threads wait until it is left.

        Raises:
            SampleError: It breaks a rule of the format, or a frame cannot be read; names the
                dataset and topic.
        """
        lock, opened = self._opened.setdefault(os.getpid(), (threading.RLock(), OrderedDict()))
        source = recording.sources[camera]
        where = f"{recording.path}, topic {source.topic}"
        try:
            with lock:
                found = opened.pop(source.place, None)
                if found is None:
                    while len(opened) >= self._most:
                        opened.popitem(last=False)[1].close()
                    found = OpenCamera(source, self.views[camera], self)
                opened[source.place] = found
                yield found
        except OptionError:
            raise
        except Mp4dsError as error:
            raise SampleError(f"{where}: {error}") from None

    def close(self) -> None:
        """Close the cameras of this process."""
        if os.getpid() in self._opened:
            lock, opened = self._opened[os.getpid()]
            with lock:
                while opened:
                    opened.popitem()[1].close()

    def __del__(self) -> None:
        # a decoder left to the garbage collector may be collected in a forked process
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}
