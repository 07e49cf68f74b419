"""The cameras of what is to be evaluated: recordings, datasets, videos, and folders of images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags import BagReader, open_reader
from mp4ds.dataset import Dataset, open_dataset
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.layouts import ENCODINGS, Pixels
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.remote import location, remote
from mp4ds.sidecar import MANIFEST_NAME
from mp4ds.streams import Frames, Looker, Stream, Unsuited, depends_on_others
from mp4ds.video.stills import STILL_SUFFIXES, read_still
from mp4ds.wire import CodedFields, is_camera, kind_of

_SECOND = 1_000_000_000
_VIDEOS = (".mp4", ".m4v", ".mov", ".yaml", ".yml")
_AT_ONCE = 8  # frames of a dataset that are in memory


@dataclass(frozen=True, slots=True)
class Shot:
    """One image of a camera.

    Attributes:
        encoding: Name of its ROS encoding.
        pixels: Of the encoding.
        width: Columns of the image.
        height: Rows of the image.
        stamp: Header stamp, nanoseconds.
        log_time: When it was recorded, nanoseconds.
    """

    encoding: str
    pixels: Pixels
    width: int
    height: int
    stamp: int
    log_time: int


@dataclass(frozen=True)
class Camera:
    """One camera of a source.

    Attributes:
        topic: Its topic, or the name of a video or folder.
        times: Log times of all its images, nanoseconds, sorted.
        read: Images by number, which increase; those that hold none are left out.
        is_jpeg: Whether its images are recorded as JPEG files, which ``mp4ds pack`` encodes anew
            only if it is told to.
    """

    topic: str
    times: NDArray[np.int64]
    read: Callable[[Sequence[int]], Iterator[Shot]]
    is_jpeg: bool = False

    @property
    def rate(self) -> float | None:
        """Images per second; None below two, or without a time span."""
        span = int(self.times[-1] - self.times[0]) if len(self.times) > 1 else 0
        return (len(self.times) - 1) * _SECOND / span if span > 0 else None


@dataclass
class Source:
    """What is to be evaluated. A context manager.

    Attributes:
        path: Where it is.
        cameras: Those that may be of use.
        left_out: Topics of cameras that are not, and why.
    """

    path: Path
    cameras: list[Camera]
    left_out: dict[str, str]
    _stack: ExitStack

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def open_source(path: Path | str, *, fps: float) -> Source:
    """Open a recording, a dataset, a video, or a folder of images.

    Args:
        path: Where it is, or the URL of one that is no folder of images.
        fps: Frames per second of a folder of images.

    Raises:
        SourceError: It is none of these.
        FormatError: It is a dataset, and breaks a rule of the format.
    """
    place = location(path)
    if not place.exists():
        raise SourceNotFoundError(place)
    with ExitStack() as stack:
        if (place / MANIFEST_NAME).exists() or place.suffix.lower() in _VIDEOS:
            dataset = stack.enter_context(open_dataset(place))
            return Source(place, _of_dataset(dataset), {}, stack.pop_all())
        images = _images_in(place)
        if images:
            camera = _of_images(place, images, fps)
            return Source(place, [camera], {}, stack.pop_all())
        reader = stack.enter_context(open_reader(place))
        cameras, left_out = _of_recording(reader)
        return Source(place, cameras, left_out, stack.pop_all())


# ---------------------------------------------------------------- recordings


def _of_recording(reader: BagReader) -> tuple[list[Camera], dict[str, str]]:
    times = reader.times()
    cameras: list[Camera] = []
    left_out: dict[str, str] = {}
    for channel in filter(is_camera, reader.channels):
        own = times.get(channel.id, np.empty(0, np.int64))
        first = reader.first(channel)
        if first is None or not len(own):
            left_out[channel.topic] = "has no images"
        elif kind_of(channel) is CodedFields and depends_on_others(channel, first):
            left_out[channel.topic] = "holds video packets, which mp4ds pack copies"
        else:
            cameras.append(_of_channel(reader, channel, own, _is_jpeg(first)))
    return cameras, left_out


def _is_jpeg(message: Message) -> bool:
    with suppress(Unsuited):
        return Looker(message.channel).look(message).key.codec == "mjpeg"
    return False


def _of_channel(
    reader: BagReader, channel: Channel, times: NDArray[np.int64], is_jpeg: bool
) -> Camera:
    def read(indices: Sequence[int]) -> Iterator[Shot]:
        wanted = set(indices)
        first, last = int(times[indices[0]]), int(times[indices[-1]])
        number = int(np.searchsorted(times, first))
        excerpt = Excerpt(first, last + 1, frozenset([channel.topic]), others=False)
        looker = Looker(channel, transcode=True)
        for record in reader.records(excerpt):
            if not isinstance(record, Message) or record.channel.id != channel.id:
                continue
            if number in wanted:
                with suppress(Unsuited):
                    seen = looker.look(record)
                    if seen.pixels is not None:
                        key = seen.key
                        yield Shot(
                            key.encoding, seen.pixels, key.width, key.height,
                            seen.parts.stamp, record.log_time,
                        )  # fmt: skip
            number += 1

    return Camera(channel.topic, times, read, is_jpeg)


# ---------------------------------------------------------------- datasets and videos


def _of_dataset(dataset: Dataset) -> list[Camera]:
    return [_of_frames(frames) for frames in dataset]


def _of_frames(frames: Frames) -> Camera:
    # a lossy video has been demosaiced already, and would not be the better for it twice
    is_lossy = isinstance(frames, Stream) and frames.sidecar.profile != "lossless"
    form = "rgb" if is_lossy and ENCODINGS[frames.encoding].mosaic else "native"
    order = np.argsort(frames.log_times, kind="stable")

    def read(indices: Sequence[int]) -> Iterator[Shot]:
        for at in range(0, len(indices), _AT_ONCE):
            numbers = [int(order[index]) for index in indices[at : at + _AT_ONCE]]
            for frame in frames.get(numbers, format=form):
                width, height = frames.image_size
                yield Shot(
                    frame.encoding, frame.data, width, height, frame.stamp_ns, frame.log_time_ns
                )

    is_jpeg = isinstance(frames, Stream) and frames.sidecar.video.codec == "mjpeg"
    return Camera(frames.topic, frames.log_times[order], read, is_jpeg)


# ---------------------------------------------------------------- folders of images


def _images_in(place: Path) -> list[Path]:
    if remote(place) or not place.is_dir():
        return []
    # a rosbag2 folder may hold pictures, too
    if (place / "metadata.yaml").exists():
        return []
    return sorted(path for path in place.iterdir() if path.suffix.lower() in STILL_SUFFIXES)


def _of_images(folder: Path, paths: Sequence[Path], fps: float) -> Camera:
    times = np.array([round(number * _SECOND / fps) for number in range(len(paths))], np.int64)

    def read(indices: Sequence[int]) -> Iterator[Shot]:
        for index in indices:
            encoding, pixels = read_still(paths[index])
            height, width = pixels.shape[:2]
            time = int(times[index])
            yield Shot(encoding, pixels, width, height, time, time)

    if len(paths) > 1 and times[1] == times[0]:
        raise SourceError(folder, f"has no time between its images at {fps:g} frames per second")
    return Camera(folder.resolve().name, times, read)
