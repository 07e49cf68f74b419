"""``info --intrinsics``: the calibrations of all cameras, ready for OpenCV, and static transforms.

Of a dataset they are in its sidecars and manifest. A recording is read once from its start to its
end, since any message may bring another calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mp4ds.bags import BagReader, open_reader
from mp4ds.dataset import Dataset, Stream
from mp4ds.pairing import StampPairing, pair_camera_infos
from mp4ds.records import Channel, Message
from mp4ds.remote import location
from mp4ds.sidecar import names_dataset
from mp4ds.streams import Forms, Looker, Unsuited
from mp4ds.streams.calibrations import Matrix, effective
from mp4ds.streams.camera_info import fields_of
from mp4ds.wire import CalibrationFields, CodedFields, is_calibration, is_camera
from mp4ds.wire.transforms import Transform, TransformCollector

MAX_LISTED = 1000
"""Calibrations of a camera that are listed; of a self-calibrating one there may be more."""


@dataclass(frozen=True, slots=True)
class ListedCalibration:
    """A calibration of a camera, and from where on it holds.

    Attributes:
        message: Number of the message that it holds from, among its channel's; None where no
            messages were recorded.
        log_time: When that was recorded, nanoseconds.
        frame_id: Coordinate frame.
        width: Columns of the calibrated image.
        height: Rows of the calibrated image.
        distortion_model: Such as ``plumb_bob``, whose `d` is in the order of OpenCV.
        k: Intrinsic matrix, 3 x 3.
        d: Distortion parameters.
        r: Rectification matrix, 3 x 3.
        p: Projection matrix, 3 x 4.
        binning: Columns and rows binned into one, or None where both are 0.
        roi: x_offset, y_offset, height, width, do_rectify, or None where all are 0.
        k_effective: `k` for the images as they are, cut and binned; None where it is `k`.
        p_effective: `p` for the images as they are; None where it is `p`.
    """

    message: int | None
    log_time: int | None
    frame_id: str
    width: int
    height: int
    distortion_model: str
    k: Matrix
    d: list[float]
    r: Matrix
    p: Matrix
    binning: tuple[int, int] | None
    roi: dict[str, int] | None
    k_effective: Matrix | None
    p_effective: Matrix | None


@dataclass
class Camera:
    """A camera topic and its calibrations.

    Attributes:
        topic: Of the images; empty for calibrations that belong to no images.
        info_topic: Of the calibrations; empty where the images have none.
        frame_id: Coordinate frame of the first image.
        sizes: Width and height of the images; several if they change, none if unknown.
        calibrations: Each that differs from the one before, in the order of the recording.
        more: Changes of the calibration beyond those listed.
    """

    topic: str
    info_topic: str = ""
    frame_id: str = ""
    sizes: list[tuple[int, int]] = field(default_factory=list)
    calibrations: list[ListedCalibration] = field(default_factory=list)
    more: int = 0


@dataclass
class Intrinsics:
    """The cameras of a recording or dataset.

    Attributes:
        path: What was looked at.
        kind: ``bag``, ``rosbag2``, ``mcap``, ``dataset`` or ``stream``.
        cameras: By topic; calibrations without images last.
        transforms: Static transforms that connect the cameras.
    """

    path: Path
    kind: str
    cameras: list[Camera]
    transforms: list[Transform] = field(default_factory=list)


def intrinsics(path: Path | str) -> Intrinsics:
    """The intrinsics and extrinsics in a recording, a dataset, or a video with its sidecar.

    Args:
        path: Where it is, or its URL.

    Raises:
        SourceError: It is no recording or cannot be read.
        FormatError: The dataset breaks a rule of the format.
    """
    path = location(path)
    if names_dataset(path):
        with Dataset(path) as dataset:
            return _of_dataset(dataset)
    with open_reader(path) as reader:
        return _of_recording(reader)


def _rows(values: Sequence[float]) -> Matrix:
    step = len(values) // 3
    return [list(values[row * step : (row + 1) * step]) for row in range(3)]


def _listed(
    fields: CalibrationFields, frame_id: str, message: int | None, log_time: int | None
) -> ListedCalibration:
    k, p = _rows(fields.k), _rows(fields.p)
    k_effective, p_effective = effective(fields)
    roi = dict(zip(("x_offset", "y_offset", "height", "width"), fields.roi, strict=True))
    roi["do_rectify"] = fields.roi_do_rectify
    return ListedCalibration(
        message=message,
        log_time=log_time,
        frame_id=frame_id,
        width=fields.width,
        height=fields.height,
        distortion_model=fields.distortion_model,
        k=k,
        d=list(fields.d),
        r=_rows(fields.r),
        p=p,
        binning=(
            (fields.binning_x, fields.binning_y) if fields.binning_x or fields.binning_y else None
        ),
        roi=roi if any(roi.values()) else None,
        k_effective=k_effective if k_effective != k else None,
        p_effective=p_effective if p_effective != p else None,
    )


class _History:
    """The calibrations of one channel, as its messages come."""

    def __init__(self, channel: Channel) -> None:
        self.topic = channel.topic
        self._forms = Forms(channel)
        self._messages = 0
        self._last: tuple[str, CalibrationFields] | None = None
        self.calibrations: list[ListedCalibration] = []
        self.more = 0

    def take(self, message: Message, stamps: StampPairing) -> None:
        number = self._messages
        self._messages += 1
        try:
            _, parts = self._forms.split(message)
        except Unsuited:
            return
        stamps.add(message.channel, parts)
        fields = parts.fields
        if not isinstance(fields, CalibrationFields) or (parts.frame_id, fields) == self._last:
            return
        self._last = parts.frame_id, fields
        if len(self.calibrations) < MAX_LISTED:
            listed = _listed(fields, parts.frame_id, number, message.log_time)
            self.calibrations.append(listed)
        else:
            self.more += 1

    def give(self, camera: Camera) -> None:
        """Hand all over to the camera."""
        camera.info_topic = self.topic
        camera.calibrations += self.calibrations
        camera.more += self.more


# ---------------------------------------------------------------- recordings


class _Cameras:
    """What one pass over messages tells of their cameras.

    Args:
        channels: Gives the channels, as far as they are known by then.
    """

    def __init__(self, channels: Callable[[], Sequence[Channel]]) -> None:
        self._channels = channels
        self._histories: dict[int, _History] = {}
        self._forms: dict[int, Forms] = {}
        self._seen: dict[int, tuple[str, tuple[int, int]]] = {}
        self._stamps = StampPairing()
        self._known = -1  # channels when it was last decided whether stamps are needed
        self._needs_stamps = False
        self.transforms = TransformCollector()

    def take(self, message: Message) -> None:
        channel = message.channel
        if is_calibration(channel):
            if channel.id not in self._histories:
                self._histories[channel.id] = _History(channel)
            self._histories[channel.id].take(message, self._stamps)
        elif is_camera(channel):
            if channel.id not in self._seen or self._wants_stamps():
                self._take_image(message)
        else:
            self.transforms.add(channel, message.data)

    def _wants_stamps(self) -> bool:
        """Whether names leave a calibration channel unpaired; some formats tell channels late."""
        channels = self._channels()
        if len(channels) != self._known:
            self._known = len(channels)
            infos = {channel.id for channel in channels if is_calibration(channel)}
            self._needs_stamps = bool(infos - set(pair_camera_infos(channels)))
        return self._needs_stamps

    def _take_image(self, message: Message) -> None:
        channel = message.channel
        try:
            _, parts = self._forms.setdefault(channel.id, Forms(channel)).split(message)
        except Unsuited:
            return
        if channel.id not in self._seen:
            size = parts.fields.width, parts.fields.height
            if isinstance(parts.fields, CodedFields):
                size = _coded_size(message, size)
            self._seen[channel.id] = parts.frame_id, size
        self._stamps.add(channel, parts, size=self._seen[channel.id][1])

    def cameras(self) -> list[Camera]:
        """All of them, once all channels are known."""
        channels = self._channels()
        pairs = pair_camera_infos(channels)
        pairs.update(self._stamps.decide(pairs))
        by_topic: dict[str, Camera] = {}
        for channel in filter(is_camera, channels):
            camera = by_topic.setdefault(channel.topic, Camera(channel.topic))
            frame_id, size = self._seen.get(channel.id, ("", (0, 0)))
            camera.frame_id = camera.frame_id or frame_id
            if 0 not in size and size not in camera.sizes:
                camera.sizes.append(size)
        topics = {channel.id: channel.topic for channel in channels}
        alone = []
        for info_id, history in self._histories.items():
            if info_id in pairs:
                history.give(by_topic[topics[pairs[info_id]]])
            elif history.calibrations:
                alone.append(Camera(""))
                history.give(alone[-1])
        return [*by_topic.values(), *alone]


def _coded_size(message: Message, told: tuple[int, int]) -> tuple[int, int]:
    try:
        key = Looker(message.channel).look(message).key
    except Unsuited:
        return told
    return key.width, key.height


def _sorted(cameras: Iterable[Camera]) -> list[Camera]:
    return sorted(cameras, key=lambda camera: (not camera.topic, camera.topic, camera.info_topic))


def _of_recording(reader: BagReader) -> Intrinsics:
    found = _Cameras(lambda: reader.channels)
    for record in reader.records():
        if isinstance(record, Message):
            found.take(record)
    cameras = _sorted(found.cameras())
    frames = {camera.frame_id for camera in cameras}
    frames |= {item.frame_id for camera in cameras for item in camera.calibrations}
    return Intrinsics(reader.path, reader.format, cameras, found.transforms.between(sorted(frames)))


# ---------------------------------------------------------------- datasets


def _of_dataset(dataset: Dataset) -> Intrinsics:
    by_topic: dict[str, Camera] = {}
    for stream in dataset.streams:
        camera = by_topic.setdefault(stream.topic, Camera(stream.topic))
        image = stream.sidecar.image
        camera.frame_id = camera.frame_id or stream.sidecar.headers[0].frame_id
        camera.sizes.append((image.width, image.height))
        _add_stream(camera, stream)
    manifest = dataset.manifest
    transforms = [
        Transform(
            parent=item.parent,
            child=item.child,
            translation=(item.translation[0], item.translation[1], item.translation[2]),
            rotation=(item.rotation[0], item.rotation[1], item.rotation[2], item.rotation[3]),
        )
        for item in (manifest.transforms if manifest else [])
    ]
    return Intrinsics(
        dataset.path,
        "dataset" if manifest else "stream",
        _sorted([*by_topic.values(), *_verbatim(dataset)]),
        transforms,
    )


def _add_stream(camera: Camera, stream: Stream) -> None:
    info = stream.sidecar.camera_info
    if info is None:
        return
    camera.info_topic = info.channel.topic
    columns = stream.camera_info_columns
    if columns is None:
        camera.calibrations += [
            _listed(fields_of(item), item.frame_id, None, None) for item in info.calibrations
        ]
        return
    changes = np.flatnonzero(np.diff(columns.variant, prepend=-1))
    for place in changes[:MAX_LISTED].tolist():
        item = info.calibrations[int(columns.variant[place])]
        number, log_time = int(columns.ordinal[place]), int(columns.log_time[place])
        camera.calibrations.append(_listed(fields_of(item), item.frame_id, number, log_time))
    camera.more += max(0, len(changes) - MAX_LISTED)


def _verbatim(dataset: Dataset) -> list[Camera]:
    """Cameras without a stream, all messages of which are in messages.mcap."""
    models = [stream.sidecar.channel for stream in dataset.streams]
    models += [item.channel for s in dataset.streams if (item := s.sidecar.camera_info)]
    owned = {model.to_record(0).identity for model in models}
    channels = [
        channel
        for channel in dataset.channels
        if (is_camera(channel) or is_calibration(channel)) and channel.identity not in owned
    ]
    if not channels:
        return []
    found = _Cameras(lambda: channels)
    ids = {channel.id for channel in channels}
    for record in dataset.recorded_records():
        if isinstance(record, Message) and record.channel.id in ids:
            found.take(record)
    return found.cameras()
