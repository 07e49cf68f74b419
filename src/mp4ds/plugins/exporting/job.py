"""The basis of an export: its options, cameras, and the account of what is kept and left out."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.images import VerbatimImages
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.views import Reduction, View, adapted
from mp4ds.errors import OptionError
from mp4ds.format.fields import DecodedColumns
from mp4ds.format.models import Calibration
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.messages.serializations import is_camera
from mp4ds.options import Parsed, SliceOptions, force, option, what
from mp4ds.times import Integers, at_most, intervals, sound_times, synchronize, usual_interval
from mp4ds.unpacking.pictures import FrameOptions, files_of, has_inverse_depths
from mp4ds.video.codecs import MAX_CRF
from mp4ds.video.images import ImageFile, encoding_as

NOTE_NAME = "mp4ds_export.json"
"""File in an exported folder that lists what it holds and leaves out."""

UNSELECTED = "not selected"
"""Why messages of a topic are left out that was not asked for."""

_POSED, _LEROBOT = ("euroc", "tum", "colmap"), ("lerobot",)
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
class ExportOptions(SliceOptions, Reduction, FrameOptions):
    """How to export."""

    native: bool = option(
        "Keep Bayer mosaics, as grey images, instead of interpolating.",
        False,
        only=("images", *_POSED),
    )
    tolerance_ns: Parsed[int | None] = what(
        "Keep only frames that all cameras have within this time of each other.",
        None,
        "--sync",
        metavar="MS",
        least=0,
        parse=_nanoseconds,
    )
    poses: str | None = what(
        "Topic with poses, for euroc, tum and colmap.", metavar="TOPIC", only=_POSED
    )
    fps: int | None = option(
        "Frame rate for lerobot; default: that of the first camera.",
        least=1,
        most=1000,
        only=_LEROBOT,
    )
    state: str | None = what(
        "Topic for lerobot's observation.state, and which of its fields.",
        metavar="TOPIC[:FIELD,...]",
        only=_LEROBOT,
    )
    action: str | None = what(
        "The same for lerobot's action.", metavar="TOPIC[:FIELD,...]", only=_LEROBOT
    )
    task: str = what(
        "Task description, for lerobot; or a topic of std_msgs/String with them, such as /task.",
        "",
        metavar="TEXT",
        only=_LEROBOT,
    )
    codec: str = option(
        "Video codec for lerobot: av1, h264 or h265.",
        "av1",
        choices=("av1", "h264", "h265"),
        only=_LEROBOT,
    )
    crf: int = option(
        "Quality of lerobot's videos; lower is better.", 30, least=0, most=63, only=_LEROBOT
    )
    force: bool = force()

    def __post_init__(self) -> None:
        super().__post_init__()
        most = MAX_CRF[self.codec]
        if not 0 <= self.crf <= most:
            raise OptionError(f"`crf` {self.crf} is not from 0 to {most}, as {self.codec} has it.")

    def chosen(self, topic: str) -> bool:
        """Whether a topic was selected, by a glob or by name."""
        given = (topics.partition(":")[0] for topics in (self.state, self.action) if topics)
        return self.selected(topic) or topic in (self.poses, self.task, *given)

    def uses(self, topic: str) -> bool:
        """Whether messages of a topic may be read: static transforms always are."""
        return self.chosen(topic) or topic.endswith("tf_static")


@dataclass(frozen=True)
class ExportSummary:
    """The result of an export.

    Every message of the datasets is counted once, either as kept or by the reason why it is left
    out.

    Attributes:
        output: The folder made.
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


# ---------------------------------------------------------------- cameras

_THINNED = "left out on request (--every, --max-rate)"
_INVERSE = "quantised inverse depths; `mp4ds unpack --images raw` converts them to depths"


@dataclass(frozen=True)
class ExportedCamera:
    """The exported frames of a stream, by time.

    Attributes:
        stream: The stream, or the images that are stored verbatim.
        numbers: Numbers of the frames, int64, shape (frames,).
        times: When they were taken, nanoseconds, increasing or equal; shape (frames,).
        view: How they look.
    """

    stream: Stream | VerbatimImages
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
        return self.stream.frame_id(0)

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
        return adapted(found, (0, 0, *self.stream.image_size), self.size)

    @property
    def rate(self) -> float:
        """Usual frame rate; 0 if there is only one frame."""
        usual = usual_interval(intervals(self.times))
        return 1e9 / usual if usual else 0.0

    def at(self, places: Integers) -> ExportedCamera:
        """The camera with some of its frames only."""
        return replace(self, numbers=self.numbers[places], times=self.times[places])

    @cached_property
    def _places(self) -> Mapping[int, int]:
        return {number: place for place, number in enumerate(self.numbers.tolist())}

    def _choice(self, _: DecodedColumns) -> Iterator[int]:
        return iter(sorted(self._places))

    def pictures(self, *, is_strict: bool = True) -> Iterator[tuple[int, Pixels]]:
        """The exported pixels of each frame, in the order of the video.

        Args:
            is_strict: Whether a packet that cannot be decoded is an error, and not left out.

        Yields:
            Index into `numbers`, and pixels of `view.encoding` owned by the caller.

        Raises:
            FormatError: The stream is damaged.
        """
        if isinstance(self.stream, Stream):
            self.stream.verify_pictures()
        found = self.stream.pictures(self._choice, self.view.scale, is_strict=is_strict)
        for index, picture in found:
            yield self._places[index], self.stream.pixels(picture, self.view, index)

    @property
    def recorded_suffix(self) -> str:
        """Of the recorded files, ``jpg`` or ``png``; empty if others have to be made."""
        return self.stream.file_suffix if self.view.is_plain else ""

    def files(self, *, as_recorded: bool) -> Iterator[tuple[int, bytes | memoryview]]:
        """The file of each frame, as `pictures` gives its pixels.

        Args:
            as_recorded: Whether recorded files are given instead of new PNG files, and packets that
                cannot be decoded are left out.
        """
        if as_recorded and self.recorded_suffix:
            for index, data in files_of(self.stream, self._choice):
                yield self._places[index], data
            return
        file = ImageFile(self.view.encoding.name, "png")
        for place, pixels in self.pictures(is_strict=not as_recorded):
            yield place, file.encode(pixels)


# ---------------------------------------------------------------- numbers

Row = tuple[int, tuple[float, ...]]
"""Time in nanoseconds, and values."""

_NS = 10**9
_WINDOW = 1000  # messages that may be out of order
_ROS = ("ros1", "cdr")


IMU = "sensor_msgs/Imu"

# type -> where its messages have x, y, z and, of quaternions, w
_VECTORS: Mapping[str, tuple[str, str]] = {
    IMU: ("angular_velocity", "linear_acceleration"),  # rad/s, m/s^2
    "geometry_msgs/PoseStamped": ("pose.position", "pose.orientation"),  # metres
    "geometry_msgs/PoseWithCovarianceStamped": ("pose.pose.position", "pose.pose.orientation"),
    "nav_msgs/Odometry": ("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/TransformStamped": ("transform.translation", "transform.rotation"),
}


def ros_type(dataset: Dataset, topic: str) -> str:
    """Type of a ROS topic as ``package/Name``; empty for other serializations and topics."""
    for channel in dataset.channels:
        if channel.topic == topic and channel.message_encoding in _ROS:
            return channel.type_name.replace("/msg/", "/")
    return ""


class Measures:
    """The measurements of a topic.

    Args:
        dataset: The dataset.
        topic: The topic.
        option: That named the topic, if it is one of poses.

    Attributes:
        topic: The topic.
        first: Its first message, decoded; None if there is none.

    Raises:
        OptionError: The topic does not exist, or has the wrong type.
    """

    def __init__(self, dataset: Dataset, topic: str, option: str = "") -> None:
        types, name = set(_VECTORS) - {IMU} if option else {IMU}, ros_type(dataset, topic)
        if name not in types:
            raise OptionError(
                f"`{option}` {topic} is {f'of type {name}' if name else 'not a ROS topic'} in "
                f"{dataset.path}. Use a topic of type {', '.join(sorted(types))}."
            )
        self._dataset, self._vectors = dataset, attrgetter(*_VECTORS[name])
        self.topic = topic
        first = next(dataset.messages([topic]), None)
        self.first: Any = None if first is None else first.decoded

    @property
    def frame_id(self) -> str:
        """Coordinate frame of the first message; empty if there is none."""
        return str(self.first.header.frame_id) if hasattr(self.first, "header") else ""

    @property
    def body(self) -> str:
        """Frame whose poses these are; empty if messages do not say."""
        return str(getattr(self.first, "child_frame_id", ""))

    def rows(self) -> Iterator[Row]:
        """The numbers by stamp.

        Raises:
            SourceError: A message does not match its topic's type.
        """
        return in_order(self._rows())

    def _rows(self) -> Iterator[Row]:
        for message in self._dataset.messages([self.topic]):
            decoded = message.decoded
            time = int(decoded.header.stamp.sec) * _NS + int(decoded.header.stamp.nanosec)
            values = [
                float(getattr(vector, axis))
                for vector in self._vectors(decoded)
                for axis in "xyzw"
                if hasattr(vector, axis)
            ]
            yield time, tuple(values)


def in_order(rows: Iterable[Row], window: int = _WINDOW) -> Iterator[Row]:
    """Sort rows by time, of which each is at most `window` rows out of order.

    Args:
        rows: In the order of the recording.
        window: Number of rows to hold back.
    """
    waiting: list[tuple[int, int, tuple[float, ...]]] = []
    for number, (time, values) in enumerate(rows):
        heapq.heappush(waiting, (time, number, values))  # the number keeps equal times in order
        if len(waiting) > window:
            time, _, values = heapq.heappop(waiting)
            yield time, values
    yield from ((time, values) for time, _, values in sorted(waiting))


# ---------------------------------------------------------------- job

_TELL_EVERY = 16  # frames


class ExportJob:
    """A dataset being exported; every message of it is counted in the summary.

    Args:
        dataset: The dataset.
        path: Where to write.
        options: How.
        summary: Gets what is kept, and left out, of this dataset too.
        tell: Called now and then with a phrase, and the share of frames done.
        where: What notes begin with, if there are several datasets.
        in_colour: Whether all images with colours become RGB.
        as_recorded: Whether all images are wanted that there are: also those that are stored
            verbatim, of equal times, or without a picture, and files as recorded.
        views: Topics with the images of views, of which a slice does not tell.

    Attributes:
        dataset: The dataset.
        path: Where to write.
        options: How.
        places: Those of the summary: part of the output -> the topic that is in it.
        tell: Called now and then with a phrase, and the share of frames done.
        cameras: Its selected streams: calibrated ones first, then by topic.

    Raises:
        OptionError: No topic matches, or frames of a stream cannot be converted that way.
        FormatError: The dataset is damaged.
    """

    def __init__(
        self,
        dataset: Dataset,
        path: Path,
        options: ExportOptions,
        summary: ExportSummary,
        tell: Callable[[str, float | None], None],
        *,
        where: str,
        in_colour: bool,
        as_recorded: bool,
        views: Sequence[str],
    ) -> None:
        self.dataset, self.path, self.options, self.tell = dataset, path, options, tell
        self.places, self._summary, self._where = summary.places, summary, where
        self._counted: Counter[str] = Counter()
        self._in_colour, self._as_recorded = in_colour, as_recorded
        self._views, self._written = views, 0
        if dataset.damage:
            self.note(dataset.damage)
        if dataset.manifest and dataset.manifest.reduced:
            self.note(dataset.manifest.reduced)
        options.selected.check(dataset.all_topics)
        dataset.verify_sidecars(options.chosen)
        streams: list[Stream | VerbatimImages] = [
            stream for stream in dataset.streams if options.selected(stream.topic)
        ]
        for topic in filter(options.selected, dataset.all_topics if as_recorded else ()):
            verbatim, without = dataset.verbatim(topic)
            streams += verbatim
            for why, count in without.items():
                self.leave_out(topic, f"no picture: {why}", count)
        found = [camera for stream in streams for camera in self._camera(stream)]
        found.sort(key=lambda camera: (camera.calibration is None, camera.topic))
        if options.tolerance_ns is not None and found:
            found = self._matched(found, options.tolerance_ns)
        self.cameras = [camera for camera in found if len(camera)]

    def keep(self, topic: str, count: int = 1) -> None:
        """Count messages that are kept."""
        if count:
            self._counted[topic] += count
            self._summary.messages[topic] = self._summary.messages.get(topic, 0) + count

    def leave_out(self, topic: str, reason: str, count: int) -> None:
        """Count messages that are left out."""
        if count:
            self._counted[topic] += count
            reasons = self._summary.left_out.setdefault(topic, {})
            reasons[reason] = reasons.get(reason, 0) + count

    def note(self, sentence: str) -> None:
        """Note a deviation from the recording, once."""
        if self._where + sentence not in self._summary.notes:
            self._summary.notes.append(self._where + sentence)

    def leave_out_rest(self, name: str) -> None:
        """Count the remaining messages with their reason, and note which kept ones differ.

        Args:
            name: Of the format.
        """
        counts, totals = self.dataset.counts(), Counter[str]()
        channels = {channel.topic: channel for channel in self.dataset.channels}
        for channel in self.dataset.channels:
            totals[channel.topic] += counts.get(channel.id, 0)
        for topic, total in totals.items():
            if not self.options.chosen(topic):
                reason = UNSELECTED
            elif is_camera(channels[topic]):
                reason = "stored as recorded in messages.mcap, not as video"
            else:
                reason = f"{name} has no place for {channels[topic].type_name or 'such messages'}"
            self.leave_out(topic, reason, total - self._counted[topic])
        for topic in self._views:
            if topic in self._summary.messages:
                self.note(f"{topic}: its pixels are those of its view")
        for stream in self.dataset.streams:
            if stream.is_lossy and stream.topic in {*self._summary.messages} - {*self._views}:
                why = f"it was packed with quality {stream.sidecar.profile}"
                self.note(f"{stream.topic}: its pixels differ from those recorded: {why}")

    # ------------------------------------------------ cameras

    def _camera(self, stream: Stream | VerbatimImages) -> Iterator[ExportedCamera]:
        """The camera of a stream; none if its images cannot be exported."""
        if has_inverse_depths(stream):
            if not self._as_recorded:
                self.leave_out(stream.topic, _INVERSE, len(stream))
                return
            self.note(f"{stream.topic}: its pixels are {_INVERSE}")
        columns = stream.columns
        times = sound_times(columns.stamp, columns.log_time)
        kept = np.arange(0, len(stream), self.options.every)
        if self.options.max_rate is not None:
            kept = kept[at_most(self.options.max_rate, times[kept])]
        self.leave_out(stream.topic, _THINNED, len(stream) - len(kept))
        uses_times = (self.options.max_rate, self.options.tolerance_ns) != (None, None)
        if times is not columns.stamp and (uses_times or not self._as_recorded):
            self.note(f"{stream.topic}: its stamps do not increase, so log times are used instead")
        kept = kept[np.argsort(times[kept], kind="stable")]
        yield ExportedCamera(stream, kept, times[kept], self._view(stream))

    def _view(self, stream: Stream | VerbatimImages) -> View:
        known = ENCODINGS[stream.encoding]
        is_native = known.mosaic and self.options.native
        is_converted = not known.is_plain and (self._in_colour or not is_native)
        if is_converted and stream.topic not in self._views:
            kind = "a Bayer mosaic" if known.mosaic else "YUV"
            kept = ", which --native keeps" if known.mosaic and not self._in_colour else ""
            self.note(f"{stream.topic}: its pixels are converted from {kind}{kept}")
        # depths and other measurements have no colours
        has_colours = encoding_as(known, "rgb") is not None
        colours = "rgb" if has_colours and (self._in_colour or is_converted) else "native"
        size = self.options.size_of(stream.topic, stream.image_size)
        if is_native and not is_converted and size is not None:
            raise OptionError(
                f"{stream.topic} has Bayer mosaics, which `native` keeps: use it or `resize`."
            )
        return stream.view(colours, size)

    def _matched(self, cameras: list[ExportedCamera], tolerance_ns: int) -> list[ExportedCamera]:
        """The frames that every camera has, frame n of each taken at the same time."""
        times: dict[str, Integers] = {}
        first = []  # of each camera among the frames of its topic, which may have several streams
        for camera in cameras:
            others = times.get(camera.topic, camera.times[:0])
            first.append(len(others))
            times[camera.topic] = np.concatenate([others, camera.times])
        matches = synchronize(times, tolerance_ns=tolerance_ns)
        for topic, unmatched in matches.unmatched.items():
            reason = "not every camera has a frame at this time (--sync)"
            self.leave_out(topic, reason, len(unmatched))
        columns = dict(zip(times, matches.indices.T, strict=True))
        found = []
        for camera, start in zip(cameras, first, strict=True):
            places = columns[camera.topic] - start
            found.append(camera.at(places[(places >= 0) & (places < len(camera))]))
        return found

    def png_cameras(self) -> Iterator[ExportedCamera]:
        """The cameras whose images PNG files can hold, with one frame per time to name it by.

        With those of equal times if images are wanted as recorded.
        """
        for camera in self.cameras:
            name = camera.view.encoding.name
            try:
                ImageFile(name, "png")
            except OptionError:
                self.leave_out(camera.topic, f"PNG cannot hold {name} images", len(camera))
                continue
            if self._as_recorded:
                yield camera
                continue
            is_new = np.diff(camera.times, prepend=camera.times[:1] - 1) != 0
            reason = "another frame has the same time, and therefore the same name"
            self.leave_out(camera.topic, reason, int((~is_new).sum()))
            yield camera.at(np.flatnonzero(is_new))

    def export_calibration(self, camera: ExportedCamera) -> Calibration | None:
        """The calibration of a camera, counted as exported once: formats cannot hold its times."""
        stream = camera.stream
        if camera.calibration and isinstance(stream, Stream) and stream.infos is not None:
            columns, topic = stream.infos.columns, stream.infos.channel.topic
            used = stream.calibration_at(int(stream.log_times[camera.numbers[0]]))
            same = [number for number, item in enumerate(stream.calibrations) if item is used]
            is_same = np.isin(columns.variant, same)
            self.keep(topic)
            self.leave_out(topic, "repeats the exported calibration", int(is_same.sum()) - 1)
            reason = "a different calibration: only one per camera is exported"
            self.leave_out(topic, reason, int((~is_same).sum()))
        return camera.calibration

    # ------------------------------------------------ files

    def write_files(self, camera: ExportedCamera, place: str, names: Sequence[str]) -> list[int]:
        """Write the frames of a camera as PNG files, or as recorded, and count them.

        Args:
            camera: The camera.
            place: The part of the output they are listed under.
            names: Path of each frame's file from the output's folder.

        Returns:
            Index of each that was written; others have no picture.
        """
        (self.path / names[0]).parent.mkdir(parents=True, exist_ok=True)
        due, written = sum(len(camera) for camera in self.cameras), list[int]()
        for number, (position, data) in enumerate(camera.files(as_recorded=self._as_recorded)):
            if number % _TELL_EVERY == 0:
                done = (self._written + number) / due
                self.tell(f"{camera.topic} as {place}: frame {number} of {len(camera)}", done)
            (self.path / names[position]).write_bytes(data)
            written.append(position)
        self._written += len(camera)
        self.places[place] = camera.topic
        self.keep(camera.topic, len(written))
        reason = "its picture cannot be decoded"
        self.leave_out(camera.topic, reason, len(camera) - len(written))
        return written

    def write_lines(
        self, name: str, lines: Iterable[str], *, place: str = "", topic: str = ""
    ) -> None:
        """Write a text file.

        Args:
            name: Path of the file from the output's folder.
            lines: Its lines.
            place: The part of the output under which a topic is listed.
            topic: Of which each line that is no comment is a message.
        """
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="utf-8") as file:
            for line in lines:
                file.write(f"{line}\n")
                if topic:
                    self.keep(topic, not line.startswith("#"))
        if topic:
            self.places[place] = topic
