"""A folder of images as a ROS 2 recording: each message is made when it is read."""

from __future__ import annotations

import csv
import heapq
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.convert import ros2_channel
from mp4ds.bags.latched import LATCHED_QOS
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import OptionError, SourceError
from mp4ds.files.outputs import csv_cell
from mp4ds.files.sources import source_name, source_size
from mp4ds.messages.encodings import ENCODINGS, Encoding, Pixels
from mp4ds.messages.serializations import plain_message
from mp4ds.messages.transforms import Transform
from mp4ds.messages.wire import NS, CodedFields, Fields, ImageFields, PrimitiveWriter, Slots
from mp4ds.plugins.importing.scene import Scene, SceneCamera, SensorTable
from mp4ds.records import (
    Attachment,
    Channel,
    Excerpt,
    Message,
    Record,
)
from mp4ds.video.images import read_image

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_WIRE, _PREFIX = "cdr-le", b"\x00\x01\x00\x00"
_UNKNOWN = (-1.0, *(0.0 for _ in range(8)))  # the covariance of what is not measured
_NOT_TOLD = (0.0,) * 9


def camera_message(
    type_name: str, frame_id: str, fields: Fields, stamp: int, body: bytes = b""
) -> bytes:
    """An image or a calibration.

    Args:
        type_name: `IMAGE`, `COMPRESSED` or `INFO`.
        frame_id: Coordinate frame.
        fields: Of the type.
        stamp: Nanoseconds.
        body: Pixels or file of an image.

    Raises:
        WireError: The serialization cannot represent it.
    """
    return plain_message(_WIRE, type_name, frame_id, fields, Slots(stamp), body)


def transforms_message(stamp: int, transforms: Sequence[Transform]) -> bytes:
    """A tf2_msgs/TFMessage."""
    writer = _new()
    writer.put("I", len(transforms))
    for item in transforms:
        _header(writer, stamp, item.parent)
        writer.string(item.child, terminated=True)
        writer.put("d", *item.translation, *item.rotation)
    return writer.getvalue()


def _imu(stamp: int, frame_id: str, row: Sequence[float]) -> bytes:
    """Angular velocity x, y, z in rad/s, then acceleration x, y, z in m/s^2."""
    turn, acceleration = row[:3], row[3:]
    writer = _new()
    _header(writer, stamp, frame_id)
    writer.put("d", 0.0, 0.0, 0.0, 1.0, *_UNKNOWN, *turn, *_NOT_TOLD, *acceleration, *_NOT_TOLD)
    return writer.getvalue()


def _accelerometer(stamp: int, frame_id: str, row: Sequence[float]) -> bytes:
    """Acceleration x, y, z in m/s^2, as an Imu that measures nothing else."""
    writer = _new()
    _header(writer, stamp, frame_id)
    writer.put("d", 0.0, 0.0, 0.0, 1.0, *_UNKNOWN, 0.0, 0.0, 0.0, *_UNKNOWN, *row, *_NOT_TOLD)
    return writer.getvalue()


def _pose(stamp: int, frame_id: str, row: Sequence[float]) -> bytes:
    """Position x, y, z in metres, then the quaternion x, y, z, w."""
    writer = _new()
    _header(writer, stamp, frame_id)
    writer.put("d", *row)
    return writer.getvalue()


TABLES: Mapping[str, tuple[str, Callable[[int, str, Sequence[float]], bytes]]] = {
    "imu": ("sensor_msgs/msg/Imu", _imu),
    "accelerometer": ("sensor_msgs/msg/Imu", _accelerometer),
    "pose": ("geometry_msgs/msg/PoseStamped", _pose),
}
"""Kinds of tables -> message type, and what makes a message of stamp, frame and row."""


def _new() -> PrimitiveWriter:
    return PrimitiveWriter(_PREFIX, "<", aligned=True)


def _header(writer: PrimitiveWriter, stamp: int, frame_id: str) -> None:
    writer.put("I", *divmod(stamp, NS))
    writer.string(frame_id, terminated=True)


# ---------------------------------------------------------------- the reader

FILE_LIST = "images.csv"
"""Name of the attachment that lists which message was made from which file."""

_JPEG = (".jpg", ".jpeg")
_TF_STATIC = "/tf_static"


@dataclass(frozen=True)
class _Track:
    """The messages of a channel.

    Attributes:
        channel: The channel.
        stamps: Their times, nanoseconds, sorted.
        make: Makes the payload of a message by its number.
        files: The file of each message; empty if not made from files.
    """

    channel: Channel
    stamps: NDArray[np.int64]
    make: Callable[[int], bytes]
    files: Sequence[Path] = ()

    def message(self, number: int) -> Message:
        time = int(self.stamps[number])
        return Message(self.channel, time, time, 0, self.make(number))

    def within(self, excerpt: Excerpt) -> range:
        """Numbers of the messages of an excerpt."""
        if not excerpt.has_topic(self.channel.topic):
            return range(0)
        start, end = (
            default if time is None else int(np.searchsorted(self.stamps, time))
            for time, default in ((excerpt.start, 0), (excerpt.end, len(self.stamps)))
        )
        return range(start, end)

    def order(self, place: int, excerpt: Excerpt) -> Iterator[tuple[int, int, int]]:
        """Time, place of the track and number of the messages of an excerpt."""
        return ((int(self.stamps[number]), place, number) for number in self.within(excerpt))


class ImagesReader(BagReader):
    """Reads a scene found by a layout.

    Log times and publish times are the stamps. JPEG files become CompressedImage unchanged, all
    other images Image; each image has a CameraInfo if its calibration is known.

    Args:
        scene: What the folder holds.
    """

    # what a recorder of such messages would have written
    format = "mcap"
    profile = "ros2"
    is_indexed = True
    position = 0
    skipped: Mapping[str, int] = {}

    def __init__(self, scene: Scene) -> None:
        self.path = scene.folder
        self.files = list(dict.fromkeys(scene.files))
        self.skipped = dict(scene.skipped)
        self._kept = scene.kept
        self._tracks: list[_Track] = []
        for camera in scene.cameras:
            self._add_camera(camera.by_time())
        for table in scene.tables:
            self._add_table(table.by_time())
        times = [int(track.stamps[0]) for track in self._tracks if len(track.stamps)]
        self._start = min(times, default=0)
        if scene.transforms:
            payload = transforms_message(self._start, scene.transforms)
            stamps = np.array([self._start], np.int64)
            channel = self._channel(_TF_STATIC, TRANSFORMS, LATCHED_QOS)
            self._tracks.insert(0, _Track(channel, stamps, lambda _: payload))

    def _channel(self, topic: str, type_name: str, qos: str = "") -> Channel:
        return ros2_channel(len(self._tracks), topic, type_name, qos)

    def _add_camera(self, camera: SceneCamera) -> None:
        is_jpeg = np.array([path.suffix.lower() in _JPEG for path in camera.files], bool)
        if camera.encoding and is_jpeg.any():
            raise OptionError(
                f"{camera.topic} has JPEG files, which are kept as they are: `encoding` "
                f"{camera.encoding} cannot apply to them."
            )
        for chosen, topic, type_name in (
            (~is_jpeg, camera.topic, IMAGE),
            (is_jpeg, f"{camera.topic}/compressed", COMPRESSED),
        ):
            if chosen.any():
                files = [camera.files[number] for number in np.flatnonzero(chosen).tolist()]
                stamps = camera.stamps[chosen]
                make = _jpeg_message if type_name == COMPRESSED else _image_message
                self._tracks.append(
                    _Track(
                        self._channel(topic, type_name),
                        stamps,
                        partial(make, camera, files, stamps),
                        files,
                    )
                )
        if camera.calibration is not None and len(camera.stamps):
            topic = f"{''.join(camera.topic.rpartition('/')[:2])}camera_info"
            make_info = partial(_info_message, camera)
            self._tracks.append(_Track(self._channel(topic, INFO), camera.stamps, make_info))

    def _add_table(self, table: SensorTable) -> None:
        type_name, make = TABLES[table.kind]

        def message(number: int) -> bytes:
            return make(int(table.stamps[number]), table.frame_id, table.rows[number].tolist())

        self._tracks.append(_Track(self._channel(table.topic, type_name), table.stamps, message))

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels."""
        return [track.channel for track in self._tracks]

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Attachments, then messages by log time."""
        self.position = 0
        if excerpt.others:
            yield from self._attachments()
        orders = [track.order(place, excerpt) for place, track in enumerate(self._tracks)]
        for _, place, number in heapq.merge(*orders):
            track = self._tracks[place]
            if track.files:
                self.position += _size(track.files[number])
            yield track.message(number)
        self.position = sum(map(source_size, self.files))

    def _attachments(self) -> Iterator[Attachment]:
        """What messages cannot hold: the original calibrations, and the file names."""
        yield self._attached(FILE_LIST, "text/csv", self._file_list())
        for path in self._kept:
            try:
                data = path.read_bytes()
            except OSError as error:
                raise SourceError(path, f"cannot be read: {error.strerror}") from None
            is_yaml = path.suffix in (".yaml", ".yml")
            media_type = "application/yaml" if is_yaml else "text/plain"
            yield self._attached(source_name(path, self.path), media_type, data)

    def _attached(self, name: str, media_type: str, data: bytes) -> Attachment:
        return Attachment(name, media_type, self._start, self._start, data)

    def _file_list(self) -> bytes:
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


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None


def _image_message(
    camera: SceneCamera, files: Sequence[Path], stamps: NDArray[np.int64], number: int
) -> bytes:
    path = files[number]
    told, pixels = read_image(path)
    encoding = ENCODINGS[camera.encoding or told]
    if not _suits(encoding, pixels):
        raise SourceError(path, f"has {told} pixels, which cannot be {encoding.name}")
    height, width = pixels.shape[:2]
    step = width * encoding.pixel_bytes
    fields = ImageFields(encoding.name, width, height, step, is_bigendian=0)
    return camera_message(IMAGE, camera.frame_id, fields, int(stamps[number]), pixels.tobytes())


def _suits(encoding: Encoding, pixels: Pixels) -> bool:
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    is_whole = encoding.rows == 1  # image files cannot hold YUV planes
    return is_whole and channels == encoding.channels and pixels.dtype == np.dtype(encoding.dtype)


def _jpeg_message(
    camera: SceneCamera, files: Sequence[Path], stamps: NDArray[np.int64], number: int
) -> bytes:
    path = files[number]
    try:
        body = path.read_bytes()
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
    return camera_message(
        COMPRESSED, camera.frame_id, CodedFields("jpeg"), int(stamps[number]), body
    )


def _info_message(camera: SceneCamera, number: int) -> bytes:
    if camera.calibration is None:
        raise ValueError(f"{camera.topic} has no calibration")
    return camera_message(INFO, camera.frame_id, camera.calibration, int(camera.stamps[number]))
