"""The basis of an export: its cameras, and the account of what is kept and left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.rebuild import marked
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.views import Placement, View, view_of
from mp4ds.errors import OptionError
from mp4ds.format.models import Calibration
from mp4ds.messages.encodings import ENCODINGS, Encoding, Pixels
from mp4ds.messages.serializations import is_camera
from mp4ds.options import WHAT, Parsed, SliceOptions, force, option
from mp4ds.records import Channel
from mp4ds.times import intervals, synchronize, usual_interval
from mp4ds.unpacking.pictures import ReductionOptions, is_inverse_depth, times_of
from mp4ds.video.codecs import MAX_CRF
from mp4ds.video.images import ImageFile, encoding_as

PIXELS = ("seen", "native", "rgb", "gray")
_CODECS = ("av1", "h264", "h265")
_NS_PER_MS = 1_000_000


def _nanoseconds(value: str | int) -> int:
    """Nanoseconds of milliseconds as text."""
    if not isinstance(value, str):
        return value
    try:
        return round(float(value) * _NS_PER_MS)
    except (ValueError, OverflowError):
        raise OptionError(f"{value!r} is not a number of milliseconds.") from None


@dataclass(frozen=True, kw_only=True)
class ExportOptions(SliceOptions, ReductionOptions):
    """How to export."""

    pixels: str = option(
        "seen: as recorded, but Bayer and YUV as RGB; native: keep Bayer mosaics; rgb; gray.",
        "seen",
        metavar="KIND",
    )
    tolerance_ns: Parsed[int | None] = option(
        "Keep only frames that all cameras have within this time of each other.",
        None,
        "--sync",
        panel=WHAT,
        metavar="MS",
        least=0,
        parse=_nanoseconds,
    )
    poses: str | None = option(
        "Topic with poses, for euroc, tum and colmap.", panel=WHAT, metavar="TOPIC"
    )
    fps: int | None = option(
        "Frame rate for lerobot; default: that of the first camera.", least=1, most=1000
    )
    state: str | None = option(
        "Topic for lerobot's observation.state.", panel=WHAT, metavar="TOPIC"
    )
    action: str | None = option("Topic for lerobot's action.", panel=WHAT, metavar="TOPIC")
    task: str = option("Task description, for lerobot.", "", panel=WHAT, metavar="TEXT")
    codec: str = option("Video codec for lerobot: av1, h264 or h265.", "av1")
    crf: int = option("Quality of lerobot's videos; lower is better.", 30, least=0, most=63)
    force: bool = force()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pixels not in PIXELS:
            raise OptionError(f"`pixels` {self.pixels!r} is not known. Use {', '.join(PIXELS)}.")
        if self.codec not in _CODECS:
            raise OptionError(f"`codec` {self.codec!r} is not known. Use {', '.join(_CODECS)}.")
        most = MAX_CRF[self.codec]
        if not 0 <= self.crf <= most:
            raise OptionError(f"`crf` {self.crf} is not from 0 to {most}, as {self.codec} has it.")

    def chosen(self, topic: str) -> bool:
        """Whether a topic was selected, by a glob or by name."""
        return self.selected(topic) or topic in (self.poses, self.state, self.action)

    def uses(self, topic: str) -> bool:
        """Whether messages of a topic may be read: static transforms always are."""
        return self.chosen(topic) or topic.endswith("tf_static")


@dataclass(frozen=True)
class ExportSummary:
    """The result of an export.

    Every message of the datasets is counted once, either as kept or by the reason why it is left
    out.

    Attributes:
        output: The folder or file made.
        format: Its format.
        places: Part of the output -> the topic that is in it.
        messages: Kept messages, by topic.
        left_out: Topic -> reason -> messages left out.
        notes: Other deviations from the recording.
    """

    output: Path
    format: str
    places: dict[str, str] = field(default_factory=dict)
    messages: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, dict[str, int]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


# ---------------------------------------------------------------- stats

AS_RECORDED = "stored as recorded in messages.mcap, not as video"
NOT_CHOSEN = "not selected"


class ExportStats:
    """Counts the messages of a dataset, by topic.

    Attributes:
        exported: Messages exported, by topic.
        left_out: Topic -> reason -> messages.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._totals: Counter[str] = Counter()
        counts = dataset.counts()
        self._channels: dict[str, Channel] = {}
        for channel in dataset.channels:
            self._channels[channel.topic] = channel
            self._totals[channel.topic] += counts.get(channel.id, 0)
        self.exported: dict[str, int] = {}
        self.left_out: dict[str, dict[str, int]] = {}

    def total(self, topic: str) -> int:
        """Number of the dataset's messages on a topic."""
        return self._totals[topic]

    def add_exported(self, topic: str, count: int = 1) -> None:
        """Count kept messages."""
        self.exported[topic] = self.exported.get(topic, 0) + count

    def add_left_out(self, topic: str, reason: str, count: int) -> None:
        """Count messages that are left out."""
        if count:
            reasons = self.left_out.setdefault(topic, {})
            reasons[reason] = reasons.get(reason, 0) + count

    def add_rest(self, chosen: Callable[[str], bool], name: str) -> None:
        """Count the remaining messages with their reason.

        Args:
            chosen: Whether a topic was selected.
            name: Of the format.
        """
        for topic, total in self._totals.items():
            told = self.exported.get(topic, 0) + sum(self.left_out.get(topic, {}).values())
            channel = self._channels[topic]
            if not chosen(topic):
                reason = NOT_CHOSEN
            elif is_camera(channel):
                reason = AS_RECORDED
            else:
                reason = f"{name} has no place for {channel.type_name or 'such messages'}"
            self.add_left_out(topic, reason, total - told)


# ---------------------------------------------------------------- cameras

_THINNED = "left out on request (--every, --max-rate)"
_INVERSE = "quantised inverse depths; `mp4ds unpack --images raw` converts them to depths"

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class ExportedCamera:
    """The exported frames of a stream, by time.

    Attributes:
        stream: The stream.
        numbers: Numbers of the frames, int64, shape (frames,).
        times: When they were taken, nanoseconds, increasing or equal; shape (frames,).
        view: How they look.
    """

    stream: Stream
    numbers: Integers
    times: Integers
    view: View

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def topic(self) -> str:
        """Topic of the images."""
        return self.stream.topic

    @property
    def frame_id(self) -> str:
        """Coordinate frame of the first image."""
        return self.stream.sidecar.headers[0].frame_id

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the exported images, pixels."""
        height, width = self.view.shape[:2]
        if self.view.is_plain:  # YUV has more rows than the image
            return self.stream.image_size
        return width, height

    @cached_property
    def calibration(self) -> Calibration | None:
        """The calibration of the exported images at the first frame; None if unknown."""
        if not len(self):
            return None
        found = self.stream.calibration_at(int(self.stream.log_times[self.numbers[0]]))
        if found is None or not found.k[0]:  # an uncalibrated camera has zeros
            return None
        return Placement((0, 0, *self.stream.image_size), self.size).calibration(found)

    @property
    def rate(self) -> float:
        """Usual frame rate; 0 if there is only one frame."""
        usual = usual_interval(intervals(self.times))
        return 1e9 / usual if usual else 0.0

    def at(self, places: Integers) -> ExportedCamera:
        """The camera with some of its frames only."""
        return replace(self, numbers=self.numbers[places], times=self.times[places])

    def pictures(self) -> Iterator[tuple[int, Pixels]]:
        """The exported pixels of each frame, in the order of the video.

        Yields:
            Index into `numbers`, and pixels of `view.encoding` owned by the caller.

        Raises:
            FormatError: The stream is damaged.
        """
        self.stream.verify_video()
        place_of = np.full(len(self.stream), -1, np.int64)
        place_of[self.numbers] = np.arange(len(self))
        with self.stream.open_video(sequential=True) as decoder:
            for index, picture in self.stream.pictures_in_order(decoder, marked(place_of >= 0)):
                pixels: Pixels = np.empty(self.view.shape, self.view.dtype)
                self.view.give(self.stream.rebuilder.pixels(picture), pixels)
                yield int(place_of[index]), pixels

    def png_files(self) -> Iterator[tuple[int, bytes]]:
        """PNG files of the frames; see `pictures`."""
        file = ImageFile(self.view.encoding.name, "png")
        for place, pixels in self.pictures():
            yield place, file.encode(pixels)


def chosen_cameras(
    streams: Sequence[Stream], options: ExportOptions, stats: ExportStats, notes: list[str]
) -> list[ExportedCamera]:
    """The cameras of some streams: calibrated ones first, then by topic.

    Args:
        streams: The streams.
        options: Which frames, and how.
        stats: Counts those that are left out.
        notes: Receives what frames are converted to.

    Raises:
        OptionError: Frames of a stream cannot be converted that way.
    """
    reduction = options.reduction
    cameras = []
    for stream in streams:
        sidecar = stream.sidecar
        if any(is_inverse_depth(sidecar, header) for header in sidecar.headers):
            stats.add_left_out(stream.topic, _INVERSE, len(stream))
            continue
        columns = stream.columns
        kept = np.flatnonzero(reduction.kept(columns))
        stats.add_left_out(stream.topic, _THINNED, len(stream) - len(kept))
        times = times_of(columns)
        if times is not columns.stamp:
            notes.append(
                f"{stream.topic}: its stamps do not increase, so log times are used instead"
            )
        kept = kept[np.argsort(times[kept], kind="stable")]
        view = _view(stream, options, notes)
        cameras.append(ExportedCamera(stream, kept, times[kept], view))
    cameras.sort(key=lambda camera: (camera.calibration is None, camera.topic))
    if options.tolerance_ns is not None and len(cameras) > 1:
        cameras = _matched(cameras, options.tolerance_ns, stats)
    return [camera for camera in cameras if len(camera)]


def _view(stream: Stream, options: ExportOptions, notes: list[str]) -> View:
    known = ENCODINGS[stream.encoding]
    colours = options.pixels if options.pixels in ("rgb", "gray") else "native"
    if options.pixels == "seen" and not is_plain(known):
        colours = "rgb"
    if colours != "native" and not is_plain(known):
        kind = "a Bayer mosaic" if known.mosaic else "YUV"
        keeps = (
            ", which --pixels native keeps" if known.mosaic and colours != options.pixels else ""
        )
        notes.append(f"{stream.topic}: its pixels are converted from {kind}{keeps}")
    if encoding_as(known, "rgb") is None:
        colours = "native"  # depths and other measurements have no colours
    return view_of(
        stream.topic,
        known,
        stream.image_size,
        format=colours,
        resize=options.reduction.resize,
        crop=None,
    )


def is_plain(encoding: Encoding) -> bool:
    """Whether an encoding can be shown directly: neither a mosaic nor YUV."""
    return not encoding.mosaic and encoding.rows == 1 and encoding.even == (1, 1)


def _matched(
    cameras: list[ExportedCamera], tolerance_ns: int, stats: ExportStats
) -> list[ExportedCamera]:
    """The frames that every camera has, frame n of each taken at the same time."""
    times = {str(number): camera.times for number, camera in enumerate(cameras)}
    matches = synchronize(times, tolerance_ns=tolerance_ns)
    for number, camera in enumerate(cameras):
        reason = "not every camera has a frame at this time (--sync)"
        stats.add_left_out(camera.topic, reason, len(matches.unmatched[str(number)]))
    columns = zip(cameras, matches.indices.T, strict=True)
    return [camera.at(places) for camera, places in columns]


def that_png_holds(cameras: Sequence[ExportedCamera], stats: ExportStats) -> list[ExportedCamera]:
    """The cameras whose images PNG files can hold; the others are left out."""
    found = []
    for camera in cameras:
        name = camera.view.encoding.name
        try:
            ImageFile(name, "png")
        except OptionError:
            stats.add_left_out(camera.topic, f"PNG cannot hold {name} images", len(camera))
        else:
            found.append(camera)
    return found


def of_different_times(camera: ExportedCamera, stats: ExportStats) -> ExportedCamera:
    """The camera with one frame per time, for formats that name files by time."""
    is_new = np.diff(camera.times, prepend=camera.times[:1] - 1) != 0
    stats.add_left_out(
        camera.topic,
        "another frame has the same time, and therefore the same name",
        int((~is_new).sum()),
    )
    return camera.at(np.flatnonzero(is_new))


def hold_calibration(camera: ExportedCamera, stats: ExportStats) -> Calibration | None:
    """The calibration of a camera, counted as kept once: formats cannot hold its times."""
    info = camera.stream.sidecar.camera_info
    if info is None or camera.calibration is None:
        return None
    topic = info.channel.topic
    columns = camera.stream.camera_info_columns
    if columns is not None:
        used = camera.stream.calibration_at(int(camera.stream.log_times[camera.numbers[0]]))
        same = [number for number, item in enumerate(info.calibrations) if item is used]
        is_same = np.isin(columns.variant, same)
        stats.add_exported(topic)
        stats.add_left_out(topic, "repeats the exported calibration", int(is_same.sum()) - 1)
        stats.add_left_out(
            topic, "a different calibration: only one per camera is exported", int((~is_same).sum())
        )
    return camera.calibration


# ---------------------------------------------------------------- job

_TELL_EVERY = 16  # frames


class ExportedDataset:
    """A dataset being exported.

    Attributes:
        dataset: The dataset.
        stats: Counts its messages.
        chosen: Whether a topic was selected.
        cameras: Its selected streams.
        notes: Deviations from the recording.
    """

    def __init__(self, dataset: Dataset, options: ExportOptions) -> None:
        dataset.verify_messages()
        self.dataset = dataset
        self.stats = ExportStats(dataset)
        self.notes = [
            f"damaged, but not needed for the selected topics: {problem}"
            for problem in dataset.unread
        ]
        options.selected.check(dataset.all_topics)
        self.chosen = options.chosen
        dataset.verify_sidecars(self.chosen)
        streams = [stream for stream in dataset.streams if options.selected(stream.topic)]
        self.cameras = chosen_cameras(streams, options, self.stats, self.notes)


@dataclass
class ExportJob:
    """An export in progress.

    Attributes:
        path: Where to make it.
        target: Its final name.
        options: How.
        sources: The datasets, one except for formats that hold several.
        tell: Called now and then with a phrase, and the share of frames done.
        places: Part of the output -> the topic that is in it.
    """

    path: Path
    target: Path
    options: ExportOptions
    sources: Sequence[ExportedDataset]
    tell: Callable[[str, float | None], None]
    places: dict[str, str] = field(default_factory=dict)
    _given: int = 0

    @property
    def source(self) -> ExportedDataset:
        """The dataset, for formats that hold only one."""
        return self.sources[0]

    def note(self, sentence: str) -> None:
        """Note a deviation from the recording."""
        if sentence not in self.source.notes:
            self.source.notes.append(sentence)

    def write_png_files(self, camera: ExportedCamera, place: str, names: Sequence[str]) -> None:
        """Write the frames of a camera as PNG files, and count them.

        Args:
            camera: The camera.
            place: The part of the output they are listed under.
            names: Path of each frame's file from the output's folder.
        """
        folder = self.path / names[0].rpartition("/")[0] if names else self.path
        folder.mkdir(parents=True, exist_ok=True)
        files = camera.png_files()
        for position, data in self.counted(files, f"{camera.topic} as {place}", len(camera)):
            (self.path / names[position]).write_bytes(data)
        self.places[place] = camera.topic
        self.source.stats.add_exported(camera.topic, len(camera))

    def counted(
        self, items: Iterator[tuple[int, bytes]], what: str, total: int
    ) -> Iterator[tuple[int, bytes]]:
        """The same items, with progress reported now and then."""
        for number, item in enumerate(items):
            if number % _TELL_EVERY == 0:
                due = sum(len(camera) for source in self.sources for camera in source.cameras)
                self.tell(f"{what}: frame {number} of {total}", (self._given + number) / due)
            yield item
        self._given += total
