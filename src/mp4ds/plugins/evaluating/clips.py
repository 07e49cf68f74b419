"""The cameras to evaluate, and their clips as encoder input."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import xxhash
from numpy.typing import NDArray

from mp4ds.bags.formats import open_reader
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.dataset import Dataset, open_dataset
from mp4ds.dataset.frames import Frames
from mp4ds.dataset.stream import Stream
from mp4ds.errors import Refused, SourceError, SourceNotFoundError
from mp4ds.files.outputs import write_synced
from mp4ds.files.urls import location, remote
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.messages.layouts import Layout, layout_for
from mp4ds.messages.serializations import is_camera, kind_of
from mp4ds.messages.wire import CodedFields
from mp4ds.packing.look import Looker, depends_on_others
from mp4ds.plan import LOSSLESS
from mp4ds.plugins.evaluating.options import EvaluateOptions
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.times import NS_PER_TICK, PresentationClock, nearest
from mp4ds.video.images import STILL_SUFFIXES, read_still
from mp4ds.video.planes import PlaneMaker, Planes, planes_in

_SECOND = 1_000_000_000
_VIDEOS = (".mp4", ".m4v", ".mov", ".yaml", ".yml")
_AT_ONCE = 8  # frames of a dataset in memory at once


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
class EvaluatedCamera:
    """One camera of a source.

    Attributes:
        topic: Its topic, or the name of a video or folder.
        times: Log times of all its images, nanoseconds, sorted.
        read: Yields images by increasing number, without messages that hold none.
        is_jpeg: Whether its images are recorded as JPEG files, which ``mp4ds pack`` re-encodes only
            on request.
        lossy: The lossy encoding they already went through, if known.
    """

    topic: str
    times: NDArray[np.int64]
    read: Callable[[Sequence[int]], Iterator[Shot]]
    is_jpeg: bool = False
    lossy: str = ""

    @property
    def rate(self) -> float | None:
        """Images per second; None below two, or without a time span."""
        span = int(self.times[-1] - self.times[0]) if len(self.times) > 1 else 0
        return (len(self.times) - 1) * _SECOND / span if span > 0 else None


@dataclass
class EvaluatedSource:
    """A source to evaluate. A context manager.

    Attributes:
        path: Where it is.
        cameras: Its usable cameras.
        left_out: Topics of unusable cameras, and why.
    """

    path: Path
    cameras: list[EvaluatedCamera]
    left_out: dict[str, str]
    _stack: ExitStack

    def __enter__(self) -> EvaluatedSource:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def open_source(path: Path | str, *, fps: float) -> EvaluatedSource:
    """Open a recording, a dataset, a video, or a folder of images.

    Args:
        path: Where it is, or the URL of one that is not a folder of images.
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
            return EvaluatedSource(place, _of_dataset(dataset), {}, stack.pop_all())
        images = _images_in(place)
        if images:
            camera = _of_images(place, images, fps)
            return EvaluatedSource(place, [camera], {}, stack.pop_all())
        reader = stack.enter_context(open_reader(place))
        cameras, left_out = _of_recording(reader)
        return EvaluatedSource(place, cameras, left_out, stack.pop_all())


# ---------------------------------------------------------------- recordings


def _of_recording(reader: BagReader) -> tuple[list[EvaluatedCamera], dict[str, str]]:
    times = reader.times()
    cameras: list[EvaluatedCamera] = []
    left_out: dict[str, str] = {}
    for channel in filter(is_camera, reader.channels):
        own = times.get(channel.id, np.empty(0, np.int64))
        first = reader.first(channel)
        if first is None or not len(own):
            left_out[channel.topic] = "has no images"
        elif kind_of(channel) is CodedFields and depends_on_others(channel, first):
            left_out[channel.topic] = "has video packets, which `mp4ds pack` copies"
        else:
            cameras.append(_of_channel(reader, channel, own, _is_jpeg(first)))
    return cameras, left_out


def _is_jpeg(message: Message) -> bool:
    with suppress(Refused):
        return Looker(message.channel).look(message).key.codec == "mjpeg"
    return False


def _of_channel(
    reader: BagReader, channel: Channel, times: NDArray[np.int64], is_jpeg: bool
) -> EvaluatedCamera:
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
                with suppress(Refused):
                    seen = looker.look(record)
                    if seen.pixels is not None:
                        key = seen.key
                        yield Shot(
                            key.encoding, seen.pixels, key.width, key.height,
                            seen.parts.stamp, record.log_time,
                        )  # fmt: skip
            number += 1

    return EvaluatedCamera(channel.topic, times, read, is_jpeg, "JPEG" if is_jpeg else "")


# ---------------------------------------------------------------- datasets and videos


def _of_dataset(dataset: Dataset) -> list[EvaluatedCamera]:
    return [_of_frames(frames) for frames in dataset]


def _of_frames(frames: Frames) -> EvaluatedCamera:
    # a lossy video has already been demosaiced; doing it again would not help
    is_lossy = isinstance(frames, Stream) and frames.sidecar.profile != LOSSLESS
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
    lossy = "JPEG" if is_jpeg else ""
    if isinstance(frames, Stream) and is_lossy:
        lossy = f"a dataset of {frames.sidecar.profile}"
    return EvaluatedCamera(frames.topic, frames.log_times[order], read, is_jpeg, lossy)


# ---------------------------------------------------------------- folders of images


def _images_in(place: Path) -> list[Path]:
    if remote(place) or not place.is_dir():
        return []
    # a rosbag2 folder may hold pictures, too
    if (place / "metadata.yaml").exists():
        return []
    return sorted(path for path in place.iterdir() if path.suffix.lower() in STILL_SUFFIXES)


def _of_images(folder: Path, paths: Sequence[Path], fps: float) -> EvaluatedCamera:
    times = np.array([round(number * _SECOND / fps) for number in range(len(paths))], np.int64)

    def read(indices: Sequence[int]) -> Iterator[Shot]:
        for index in indices:
            encoding, pixels = read_still(paths[index])
            height, width = pixels.shape[:2]
            time = int(times[index])
            yield Shot(encoding, pixels, width, height, time, time)

    if len(paths) > 1 and times[1] == times[0]:
        raise SourceError(folder, f"leaves no time between its images at {fps:g} frames per second")
    return EvaluatedCamera(folder.resolve().name, times, read)


# ---------------------------------------------------------------- clips

_BLOCK = 2**20
_DETAIL = (128, 96)  # columns and rows shown side by side
_MOST_PIXELS = 16  # samples: smaller frames are not scored


@dataclass(frozen=True)
class Clip:
    """Frames of a camera as encoder input, in a separate file.

    Attributes:
        topic: Of the camera.
        encoding: ROS encoding of its images.
        picture_format: Pixel format of their pictures, which determines their tags.
        image_size: Width and height of an image.
        width: Columns of a frame, even.
        height: Rows of a frame, even.
        ticks: When each frame is shown, as in a packed video.
        rate: Frames per second of the camera, or of the clip if lower.
        digest: Of the frames and ticks.
        detail: x, y, width and height of the detail shown.
        detail_frame: Number of the frame shown.
        start: Log time of the first frame, seconds from the camera's first one.
        source_frames: Total number of the camera's images.
        other_frames: Images in between with another size or encoding, or unreadable.
    """

    topic: str
    encoding: str
    picture_format: str
    image_size: tuple[int, int]
    width: int
    height: int
    ticks: tuple[int, ...]
    rate: float | None
    digest: str
    detail: tuple[int, int, int, int]
    detail_frame: int
    start: float
    source_frames: int
    other_frames: int

    @property
    def frames(self) -> int:
        """Frames of the clip."""
        return len(self.ticks)

    @property
    def raw_bytes(self) -> int:
        """Bytes of an image as recorded, without padding."""
        encoding = ENCODINGS[self.encoding]
        width, height = self.image_size
        return int(encoding.size(width * encoding.pixel_bytes, height))


def clip_to_json(clip: Clip) -> str:
    """A clip except for its frames, as text."""
    return json.dumps(asdict(clip))


def clip_from_json(text: str) -> Clip:
    """The inverse of `clip_to_json`."""
    values = json.loads(text)
    for name in ("image_size", "ticks", "detail"):
        values[name] = tuple(values[name])
    return Clip(**values)


# ---------------------------------------------------------------- which frames


def chosen(times: NDArray[np.int64], origin: int, options: EvaluateOptions) -> list[int]:
    """The images of a representative clip, or of the requested one.

    Args:
        times: Of a camera's images, nanoseconds, sorted.
        origin: Log time at which the source begins, nanoseconds.
        options: Of the evaluation.

    Raises:
        Refused: There are none.
    """
    count = len(times)
    if options.start is None and options.duration is None:
        first = max(0, (count - options.frames) // 2)
        return list(range(first, min(count, first + options.frames)))
    if options.start is None:
        middle = (int(times[0]) + int(times[-1])) // 2
        begin = middle - round((options.duration or 0) * _SECOND / 2)
    else:
        begin = origin + round(options.start * _SECOND)
    first = int(np.searchsorted(times, begin))
    last = first + options.frames
    if options.duration is not None:
        last = int(np.searchsorted(times, begin + round(options.duration * _SECOND)))
    found = list(range(first, min(count, last)))
    if not found:
        raise Refused("has no images in the requested time")
    return found


def chosen_at_rate(times: NDArray[np.int64], rate: float, frames: int) -> list[int]:
    """Images from the middle of a camera's recording, at a lower rate.

    Args:
        times: Nanoseconds, sorted, at least one.
        rate: Per second.
        frames: Maximum number.
    """
    period = _SECOND / rate
    start, end = int(times[0]), int(times[-1])
    count = min(frames, int((end - start) / period) + 1)
    begin = (start + end - (count - 1) * period) / 2
    due = np.rint(begin + period * np.arange(count)).astype(np.int64)
    return [int(index) for index in np.unique(nearest(times, due))]


# ---------------------------------------------------------------- the frames


def make_clip(camera: EvaluatedCamera, indices: list[int], rate: float | None, path: Path) -> Clip:
    """Read frames, and write them as planes, one after another.

    Args:
        camera: The camera.
        indices: Numbers of the images, increasing.
        rate: Frames per second.
        path: The file to make of the planes; the clip's description goes next to it.

    Raises:
        Refused: The camera's images are not usable.
        SourceError: The source is damaged.
        OSError: It cannot be written.
    """
    digest = xxhash.xxh3_128()
    clock = PresentationClock()
    ticks: list[int] = []
    first: Shot | None = None
    middle: Planes | None = None
    others = 0
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            for shot in camera.read(indices):
                if first is None:
                    layout = _layout_of(shot)
                    first, maker = shot, PlaneMaker(layout.pixel_format)
                if _kind(shot) != _kind(first):
                    others += 1
                    continue
                planes = maker.make(layout.to_picture(shot.pixels))
                for plane in planes:
                    file.write(plane.data)
                    digest.update(plane.data)
                ticks.append(clock.tick(shot.stamp, shot.log_time))
                if len(ticks) <= max(1, len(indices) // 2):
                    middle, number = planes, len(ticks) - 1
        if first is None or middle is None:
            raise Refused("has no readable images in its clip")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    digest.update(json.dumps(ticks).encode())
    height, width = middle[0].shape
    clip = Clip(
        topic=camera.topic,
        encoding=first.encoding,
        picture_format=layout.pixel_format,
        image_size=(first.width, first.height),
        width=width,
        height=height,
        ticks=tuple(ticks),
        rate=rate,
        digest=digest.hexdigest(),
        detail=_detail(middle[0]),
        detail_frame=number,
        start=(int(camera.times[indices[0]]) - int(camera.times[0])) / _SECOND,
        source_frames=len(camera.times),
        other_frames=len(indices) - len(ticks),
    )
    write_synced(path.with_suffix(".json"), clip_to_json(clip).encode())
    return clip


def _kind(shot: Shot) -> tuple[str, int, int]:
    return shot.encoding, shot.width, shot.height


def _layout_of(shot: Shot) -> Layout:
    encoding = ENCODINGS[shot.encoding]
    if encoding.lossy is None:
        raise Refused(
            f"has {encoding.name} images, which are not 8-bit images: `mp4ds pack` keeps them "
            "lossless"
        )
    if min(shot.width, shot.height) < _MOST_PIXELS:
        raise Refused(f"has images of {shot.width}x{shot.height}, too small to score")
    return layout_for(encoding, lossless=False)


def _detail(luma: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """The part of a frame with the most detail, at even coordinates."""
    rows, columns = luma.shape
    width, height = min(_DETAIL[0], columns), min(_DETAIL[1], rows)
    best, place = -1.0, (0, 0)
    for top in range(0, rows - height + 1, max(2, height // 4 * 2)):
        for left in range(0, columns - width + 1, max(2, width // 4 * 2)):
            part = luma[top : top + height, left : left + width].astype(np.int32)
            # roots of the gradients: a broad texture counts more than one sharp edge
            score = float(
                np.sqrt(np.abs(np.diff(part, axis=0))).mean()
                + np.sqrt(np.abs(np.diff(part, axis=1))).mean()
            )
            if score > best:
                best, place = score, (left, top)
    return place[0], place[1], width // 2 * 2, height // 2 * 2


class ClipFile:
    """The frames of a clip.

    Args:
        path: The file that `make_clip` made.

    Raises:
        SourceError: It is incomplete.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.clip = clip_from_json(path.with_suffix(".json").read_text())
        clip = self.clip
        size = clip.width * clip.height * 3 // 2
        if path.stat().st_size != size * clip.frames:
            raise SourceError(path, "is incomplete", "Remove the folder and evaluate again.")
        self._frames = np.memmap(path, np.uint8, "r", shape=(clip.frames, size))

    def fetch(self) -> None:
        """Read everything once, so that later reads do not wait for a disk or network."""
        with self._path.open("rb") as file:
            while file.read(_BLOCK):
                pass

    def __iter__(self) -> Iterator[Planes]:
        return map(self.planes, range(self.clip.frames))

    def planes(self, number: int) -> Planes:
        """The planes of one frame, as views."""
        return planes_in(np.asarray(self._frames[number]), self.clip.width, self.clip.height)


def detail_of(planes: Planes, clip: Clip) -> Planes:
    """The detail of a frame."""
    x, y, width, height = clip.detail
    luma = planes[0][y : y + height, x : x + width]
    u, v = (plane[y // 2 : (y + height) // 2, x // 2 : (x + width) // 2] for plane in planes[1:])
    return luma, u, v


def clip_seconds(clip: Clip) -> float:
    """Duration of the clip, its last frame as long as the others."""
    if clip.frames < 2:
        return 1 / (clip.rate or 1.0)
    ticks_per_second = _SECOND / NS_PER_TICK
    return (clip.ticks[-1] - clip.ticks[0]) / ticks_per_second * clip.frames / (clip.frames - 1)
