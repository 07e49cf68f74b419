"""Images and videos as a ROS 2 recording: each message is made when it is read."""

from __future__ import annotations

import csv
import heapq
import io
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.convert import ros2_channel
from mp4ds.bags.latched import LATCHED_QOS
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import OptionError, SourceError
from mp4ds.files.outputs import csv_cell
from mp4ds.files.sources import source_name, source_size
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.serializations import plain_message
from mp4ds.messages.wire import (
    NS,
    CalibrationFields,
    CodedFields,
    Fields,
    ImageFields,
    PrimitiveWriter,
    Slots,
)
from mp4ds.records import (
    QOS_KEY,
    Attachment,
    Channel,
    Excerpt,
    Message,
    MetadataRecord,
    Record,
    Schema,
)
from mp4ds.unpacking.pictures import KINDS
from mp4ds.unpacking.republish import Types
from mp4ds.video.decoder import Clip
from mp4ds.video.images import read_image

_INFO = "sensor_msgs/msg/CameraInfo"
_JPEG = (".jpg", ".jpeg")

# dtype -> message of std_msgs, and the code of its data
_NUMBERS = {
    **{f"{kind}{bits}": (f"{kind.capitalize()}{bits}", code) for kind, bits, code in (
        *(("int", 8 << n, code) for n, code in enumerate("bhiq")),
        ("float", 32, "f"), ("float", 64, "d"),
    )},
    **{f"uint{8 << n}": (f"UInt{8 << n}", code) for n, code in enumerate("BHIQ")},
    "bool": ("Bool", "?"),
}  # fmt: skip

_WIRE, _PREFIX = "cdr-le", b"\x00\x01\x00\x00"


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of the system into one that a user can meet.

    Raises:
        SourceError: A file, or else this path, cannot be read.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(error.filename or path, f"cannot be read: {error.strerror}") from None


@dataclass(frozen=True)
class _Track:
    """The messages of a channel.

    Attributes:
        channel: The channel.
        stamps: Their times, nanoseconds, sorted.
        make: Makes the payload of a message by its number.
        files: The file of each message; empty if not made from files.
        frame_bytes: Of a message in its source, on average, if that is a video.
    """

    channel: Channel
    stamps: NDArray[np.int64]
    make: Callable[[int], bytes]
    files: Sequence[Path] = ()
    frame_bytes: int = 0

    def order(self, place: int, excerpt: Excerpt) -> Iterator[tuple[int, int, int]]:
        """Time, place of the track and number of the messages of an excerpt."""
        if not excerpt.has_topic(self.channel.topic):
            return iter(())
        start, end = (
            default if time is None else int(np.searchsorted(self.stamps, time))
            for time, default in ((excerpt.start, 0), (excerpt.end, len(self.stamps)))
        )
        return ((int(self.stamps[number]), place, number) for number in range(start, end))


class ImagesReader(BagReader):
    """Reads what a layout adds of a folder.

    Log times and publish times are the stamps. JPEG files become CompressedImage unchanged, all
    other images Image; each image has a CameraInfo if its calibration is known.

    Args:
        folder: The folder.

    Attributes:
        files: What it was read from, including folders of images.
        left_out: What is left out: a phrase -> how many.
    """

    # what a recorder of such messages would have written
    format = "mcap"
    profile = "ros2"
    is_indexed = True
    position = 0

    def __init__(self, folder: Path) -> None:
        self.path = folder
        self.files: list[Path] = []
        self._kept: list[Path] = []
        self._metadata: list[MetadataRecord] = []
        self._skipped = self.left_out = Counter[str]()
        self._tracks: list[_Track] = []

    # ------------------------------------------------ for layouts

    def add_file(self, path: Path, *, is_kept: bool = False) -> None:
        """Note a file or folder of images that was read; messages do not hold all that is kept."""
        if path.resolve() not in {file.resolve() for file in self.files}:
            self.files.append(path)
        if is_kept:
            self._kept.append(path)

    def add_camera(
        self,
        topic: str,
        frame_id: str,
        images: Sequence[Path],
        stamps: NDArray[np.int64],
        calibration: CalibrationFields | None,
        encoding: str | None,
    ) -> None:
        """Add the images of a camera, in any order.

        Args:
            topic: Of its raw images.
            frame_id: Coordinate frame.
            images: Their files.
            stamps: Their times, nanoseconds, int64, shape (images,).
            calibration: Its intrinsics, if known.
            encoding: ROS image encoding; None: as in the files.

        Raises:
            OptionError: The encoding cannot be that of its files.
        """
        order = np.argsort(stamps, kind="stable")
        is_jpeg = np.array([path.suffix.lower() in _JPEG for path in images], bool)[order]
        if encoding and is_jpeg.any():
            raise OptionError(
                f"{topic} has JPEG files, which are kept as they are: `encoding` {encoding} "
                "cannot apply to them."
            )

        def add(topic: str, type_name: str, chosen: NDArray[np.int64]) -> None:
            own, times = [images[number] for number in chosen.tolist()], stamps[chosen]

            def make(number: int) -> bytes:
                fields, body = _image(own[number], encoding)
                return _camera_message(type_name, frame_id, fields, int(times[number]), body)

            if own:
                self._add(topic, type_name, times, make, own)

        add(topic, "sensor_msgs/msg/Image", order[~is_jpeg])
        add(f"{topic}/compressed", "sensor_msgs/msg/CompressedImage", order[is_jpeg])
        self._add_calibration(topic, frame_id, stamps[order], calibration)

    def add_clip(
        self,
        topic: str,
        frame_id: str,
        clip: Clip,
        stamps: NDArray[np.int64],
        *,
        calibration: CalibrationFields | None = None,
        depths: NDArray[Any] | None = None,
    ) -> None:
        """Add the frames of a video.

        Args:
            topic: Of its raw images.
            frame_id: Coordinate frame.
            clip: The video.
            stamps: Times of its frames, nanoseconds, none before the last; int64, shape (frames,).
            calibration: The intrinsics of its camera, if known.
            depths: The depths, uint16 or float32, whose numbers its pixels are, if they are that.
        """
        width, height = clip.file.size
        fields: Fields = CodedFields(clip.file.codec)
        if clip.is_decoded:
            name = "rgb8" if depths is None else {"u": "16UC1", "f": "32FC1"}[depths.dtype.kind]
            step = width * ENCODINGS[name].pixel_bytes
            fields, kind = ImageFields(name, width, height, step, is_bigendian=0), "raw"
        elif clip.file.codec == "mjpeg":
            fields, kind = CodedFields("jpeg"), "jpeg"
        else:
            kind = "compressed-video"
        suffix = KINDS[kind].suffix
        topic_of = f"{topic}/{suffix}" if suffix else topic
        type_name = KINDS[kind].type_name
        made = Channel(0, topic_of, "cdr", Schema(type_name, "", b""), {QOS_KEY: ""})
        channel = Types("ros2", kind).channel(made, len(self._tracks), topic_of)

        def make(number: int) -> bytes:
            body = clip.body(number)
            if depths is not None:
                body = depths[np.frombuffer(body, "<u2")].tobytes()
            return _camera_message(type_name, frame_id, fields, int(stamps[number]), body)

        self._tracks.append(_Track(channel, stamps, make, frame_bytes=clip.frame_bytes))
        self._add_calibration(topic, frame_id, stamps, calibration)
        self._metadata.append(clip.metadata)
        self.left_out.update(clip.left_out)

    def add_joints(
        self,
        topic: str,
        names: Sequence[str],
        stamps: NDArray[np.int64],
        rows: NDArray[np.float64],
    ) -> None:
        """Add numbers with names, as the positions of joints.

        Args:
            topic: Their topic.
            names: Of the numbers.
            stamps: Nanoseconds, sorted, int64, shape (rows,).
            rows: float64, shape (rows, names).
        """

        def make(number: int) -> bytes:
            writer = PrimitiveWriter(_PREFIX, "<", is_cdr=True)
            writer.put("I", *divmod(int(stamps[number]), NS))
            writer.string("")
            writer.put("I", len(names))
            for name in names:
                writer.string(name)
            writer.put("I", len(names))
            writer.put("d", *rows[number].tolist())
            writer.put("I", 0, 0)  # neither velocities nor efforts
            return writer.getvalue()

        self._add(topic, "sensor_msgs/msg/JointState", stamps, make)

    def add_numbers(
        self,
        topic: str,
        stamps: NDArray[np.int64],
        rows: NDArray[Any],
        shape: Sequence[int],
        *,
        latched: bool = False,
    ) -> None:
        """Add numbers or texts as messages of std_msgs: one as such, several as an array.

        Args:
            topic: Their topic.
            stamps: Nanoseconds, sorted, int64, shape (rows,).
            rows: Shape (rows, numbers).
            shape: Of the numbers of a row.
            latched: Whether late subscribers get the last one.

        Raises:
            ValueError: There are no messages for them.
        """
        is_single = rows.shape[1] == 1
        if rows.dtype.name == "bool" and not is_single:
            rows = rows.astype(np.uint8)
        kind, code = _NUMBERS.get(rows.dtype.name, ("String", "s"))
        if code == "s" and not (is_single and all(isinstance(one, str) for one in rows.flat)):
            raise ValueError(f"rows of {rows.dtype.name} have no message")
        sides = list(map(int, shape))

        def make(number: int) -> bytes:
            writer = PrimitiveWriter(_PREFIX, "<", is_cdr=True)
            values = rows[number].tolist()
            if code == "s":
                writer.string(values[0])
                return writer.getvalue()
            if not is_single:
                writer.put("I", len(sides))
                for place, side in enumerate(sides):
                    writer.string(f"dim{place}")
                    writer.put("I", side, math.prod(sides[place:]))
                writer.put("I", 0, len(values))
            writer.put(code, *values)
            return writer.getvalue()

        name = f"std_msgs/msg/{kind}" + ("" if is_single else "MultiArray")
        self._add(topic, name, stamps, make, latched=latched)

    def _add_calibration(
        self,
        topic: str,
        frame_id: str,
        stamps: NDArray[np.int64],
        fields: CalibrationFields | None,
    ) -> None:
        if fields is not None:
            info = f"{''.join(topic.rpartition('/')[:2])}camera_info"
            self._add(
                info,
                _INFO,
                stamps,
                lambda number: _camera_message(_INFO, frame_id, fields, int(stamps[number])),
            )

    def _add(
        self,
        topic: str,
        type_name: str,
        stamps: NDArray[np.int64],
        make: Callable[[int], bytes],
        files: Sequence[Path] = (),
        *,
        latched: bool = False,
    ) -> None:
        qos = LATCHED_QOS if latched else ""
        channel = ros2_channel(len(self._tracks), topic, type_name, qos)
        self._tracks.append(_Track(channel, stamps, make, files))

    # ------------------------------------------------ for readers

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels."""
        return [track.channel for track in self._tracks]

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Attachments, then messages by log time."""
        self.position = 0
        orders = [track.order(place, excerpt) for place, track in enumerate(self._tracks)]
        with reading(self.path):
            if excerpt.others:
                yield from self._attachments()
                yield from self._metadata
            for time, place, number in heapq.merge(*orders):
                track = self._tracks[place]
                if track.files:
                    self.position += track.files[number].stat().st_size
                self.position += track.frame_bytes
                yield Message(track.channel, time, time, 0, track.make(number))
            self.position = sum(map(source_size, self.files))

    def _attachments(self) -> Iterator[Attachment]:
        """What messages cannot hold: the original calibrations, and the file names."""
        start = min(int(track.stamps[0]) for track in self._tracks if len(track.stamps))
        if any(track.files for track in self._tracks):
            yield Attachment("images.csv", "text/csv", start, start, self._file_list())
        for path in self._kept:
            is_yaml = path.suffix in (".yaml", ".yml")
            kind = "application/yaml" if is_yaml else "text/plain"
            name = source_name(path, self.path)
            yield Attachment(name, kind, start, start, path.read_bytes())

    def _file_list(self) -> bytes:
        """Which message was made from which file."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("topic", "stamp_ns", "file"))
        for track in self._tracks:
            for stamp, path in zip(track.stamps.tolist(), track.files, strict=False):
                name = str(path.relative_to(self.path))
                name = name if csv_cell(name) == name else f"./{name}"
                writer.writerow((csv_cell(track.channel.topic), stamp, name))
        return text.getvalue().encode(errors="backslashreplace")

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """The stamps of each channel."""
        return {track.channel.id: track.stamps for track in self._tracks}


# ---------------------------------------------------------------- messages


def _image(path: Path, encoding: str | None) -> tuple[Fields, bytes]:
    """The fields of an image's message, and its pixels, or the file if it is JPEG."""
    if path.suffix.lower() in _JPEG:
        return CodedFields("jpeg"), path.read_bytes()
    found, pixels = read_image(path)
    wanted = ENCODINGS[encoding or found]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    is_whole = wanted.rows == 1  # image files cannot hold YUV planes
    if not is_whole or (channels, pixels.dtype) != (wanted.channels, np.dtype(wanted.dtype)):
        raise SourceError(path, f"has {found} pixels, which cannot be {wanted.name}")
    height, width = pixels.shape[:2]
    step = width * wanted.pixel_bytes
    return ImageFields(wanted.name, width, height, step, is_bigendian=0), pixels.tobytes()


def _camera_message(
    type_name: str, frame_id: str, fields: Fields, stamp: int, body: bytes = b""
) -> bytes:
    return plain_message(_WIRE, type_name, frame_id, fields, Slots(stamp), body)
