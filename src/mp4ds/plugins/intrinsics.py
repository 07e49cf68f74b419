"""``info --intrinsics``: the calibrations in a recording or dataset, and its static transforms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.views import Matrix, effective
from mp4ds.errors import Refused
from mp4ds.format.models import Calibration
from mp4ds.messages.serializations import MessageSplitter, is_calibration, is_camera
from mp4ds.messages.transforms import Transform, TransformCollector
from mp4ds.messages.wire import CalibrationFields, CodedFields, ImageFields
from mp4ds.packing.calibrations import StampPairing, pair_camera_infos
from mp4ds.packing.inspection import MessageInspector
from mp4ds.plugins.info import open_any
from mp4ds.records import Channel, Message

MAX_LISTED = 1000
"""Maximum number of listed calibrations of a camera; a self-calibrating one may have more."""


@dataclass(frozen=True, slots=True)
class ListedCalibration:
    """A calibration of a camera, and where it starts to apply.

    Attributes:
        message: Number of the message it comes from, within its channel; None if no messages were
            recorded.
        log_time: When that was recorded, nanoseconds.
        frame_id: Coordinate frame.
        width: Columns of the calibrated image.
        height: Rows of the calibrated image.
        distortion_model: Such as ``plumb_bob``, whose `d` is in the order of OpenCV.
        k: Intrinsic matrix, 3 x 3.
        d: Distortion parameters.
        r: Rectification matrix, 3 x 3.
        p: Projection matrix, 3 x 4.
        binning: Columns and rows binned into one, or None if both are 0.
        roi: x_offset, y_offset, height, width, do_rectify, or None if all are 0.
        k_effective: `k` for the recorded images, cropped and binned; None if equal to `k`.
        p_effective: `p` for the recorded images; None if equal to `p`.
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
class CameraCalibrations:
    """A camera topic and its calibrations.

    Attributes:
        topic: Of the images; empty for calibrations that belong to no images.
        info_topic: Of the calibrations; empty if the images have none.
        frame_id: Coordinate frame of the first image.
        sizes: Width and height of the images; several if they change, none if unknown.
        calibrations: Each that differs from the previous one, in recorded order.
        more: Number of further changes not listed.
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
        path: The recording or dataset.
        kind: ``bag``, ``rosbag2``, ``mcap``, ``dataset`` or ``stream``.
        cameras: By topic; calibrations without images last.
        transforms: Static transforms that connect the cameras.
    """

    path: Path
    kind: str
    cameras: list[CameraCalibrations]
    transforms: list[Transform] = field(default_factory=list)


def intrinsics(path: Path | str) -> Intrinsics:
    """The intrinsics and extrinsics in a recording, a dataset, or a video with its sidecar.

    Args:
        path: Its path or URL.

    Raises:
        SourceError: It is not a recording or cannot be read.
        FormatError: The dataset breaks a rule of the format.
    """
    with open_any(path) as found:
        return _of_dataset(found) if isinstance(found, Dataset) else _of_recording(found)


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


class _Cameras:
    """Collects information about cameras in one pass over messages."""

    def __init__(self) -> None:
        self._forms: dict[int, MessageSplitter] = {}
        self._counts: Counter[int] = Counter()
        self._infos: dict[int, CameraCalibrations] = {}
        self._last: dict[int, tuple[str, CalibrationFields]] = {}
        self._seen: dict[int, tuple[str, tuple[int, int]]] = {}
        self._stamps = StampPairing()
        self.transforms = TransformCollector()

    def take(self, message: Message) -> None:
        channel = message.channel
        if not is_calibration(channel) and not is_camera(channel):
            self.transforms.add(channel, message.data)
            return
        number = self._counts[channel.id]
        self._counts[channel.id] += 1
        if channel.id not in self._forms:
            self._forms[channel.id] = MessageSplitter(channel)
            if is_calibration(channel):
                self._infos[channel.id] = CameraCalibrations("", channel.topic)
        try:
            _, parts = self._forms[channel.id].split(message)
        except Refused:
            return
        size = 0, 0
        if isinstance(parts.fields, CalibrationFields):
            self._add(message, number, parts.frame_id, parts.fields)
        else:
            if channel.id not in self._seen:
                self._seen[channel.id] = parts.frame_id, _size(message, parts.fields)
            size = self._seen[channel.id][1]
        self._stamps.add(channel, parts, size=size)

    def _add(self, message: Message, number: int, frame_id: str, fields: CalibrationFields) -> None:
        """Add a calibration if it differs from the one before it."""
        key, found = message.channel.id, self._infos[message.channel.id]
        if self._last.get(key) == (frame_id, fields):
            return
        self._last[key] = frame_id, fields
        if len(found.calibrations) < MAX_LISTED:
            found.calibrations.append(_listed(fields, frame_id, number, message.log_time))
        else:
            found.more += 1

    def cameras(self, channels: Sequence[Channel]) -> list[CameraCalibrations]:
        """All of them; calibrations without images last.

        Args:
            channels: All channels.
        """
        pairs = pair_camera_infos(channels)
        pairs.update(self._stamps.decide(pairs))
        by_topic: dict[str, CameraCalibrations] = {}
        for channel in filter(is_camera, channels):
            camera = by_topic.setdefault(channel.topic, CameraCalibrations(channel.topic))
            frame_id, size = self._seen.get(channel.id, ("", (0, 0)))
            camera.frame_id = camera.frame_id or frame_id
            if 0 not in size and size not in camera.sizes:
                camera.sizes.append(size)
        topics = {channel.id: channel.topic for channel in channels}
        alone = []
        for info_id, found in self._infos.items():
            if info_id in pairs:
                camera = by_topic[topics[pairs[info_id]]]
                camera.info_topic = found.info_topic
                camera.calibrations += found.calibrations
                camera.more += found.more
            elif found.calibrations:
                alone.append(found)
        return [*by_topic.values(), *alone]


def _size(message: Message, fields: ImageFields | CodedFields) -> tuple[int, int]:
    """Width and height of an image; 0 if unknown."""
    if isinstance(fields, CodedFields):
        with suppress(Refused):
            key = MessageInspector(message.channel).inspect(message).key
            return key.width, key.height
    return fields.width, fields.height


def _sorted(cameras: Iterable[CameraCalibrations]) -> list[CameraCalibrations]:
    return sorted(cameras, key=lambda camera: (not camera.topic, camera.topic, camera.info_topic))


def _of_recording(reader: BagReader) -> Intrinsics:
    found = _Cameras()
    for record in reader.records():
        if isinstance(record, Message):
            found.take(record)
    cameras = _sorted(found.cameras(reader.channels))
    frames = {camera.frame_id for camera in cameras}
    frames |= {item.frame_id for camera in cameras for item in camera.calibrations}
    return Intrinsics(reader.path, reader.format, cameras, found.transforms.between(sorted(frames)))


# ---------------------------------------------------------------- datasets


def _of_dataset(dataset: Dataset) -> Intrinsics:
    by_topic: dict[str, CameraCalibrations] = {}
    for stream in dataset.streams:
        camera = by_topic.setdefault(stream.topic, CameraCalibrations(stream.topic))
        image = stream.sidecar.image
        camera.frame_id = camera.frame_id or stream.sidecar.headers[0].frame_id
        camera.sizes.append((image.width, image.height))
        _add_intrinsics(camera, stream)
    manifest = dataset.manifest
    transforms = [item.to_record() for item in (manifest.transforms if manifest else [])]
    return Intrinsics(
        dataset.path,
        "dataset" if manifest else "stream",
        _sorted([*by_topic.values(), *_verbatim(dataset)]),
        transforms,
    )


def _add_intrinsics(camera: CameraCalibrations, stream: Stream) -> None:
    changes = calibration_changes(stream)
    if stream.sidecar.camera_info is not None:
        camera.info_topic = stream.sidecar.camera_info.channel.topic
    camera.more += max(0, len(changes) - MAX_LISTED)
    for item, number, log_time in changes[:MAX_LISTED]:
        camera.calibrations.append(_listed(item.fields, item.frame_id, number, log_time))


def calibration_changes(stream: Stream) -> list[tuple[Calibration, int | None, int | None]]:
    """Each calibration that differs from the one before it, its ordinal, and its log time.

    These two are None if no messages were recorded.
    """
    info, columns = stream.sidecar.camera_info, stream.infos.columns if stream.infos else None
    if info is None:
        return []
    if columns is None:
        return [(item, None, None) for item in info.calibrations]
    places = np.flatnonzero(np.diff(columns.variant, prepend=-1)).tolist()
    return [
        (
            info.calibrations[int(columns.variant[place])],
            int(columns.ordinal[place]),
            int(columns.log_time[place]),
        )
        for place in places
    ]


def _verbatim(dataset: Dataset) -> list[CameraCalibrations]:
    """Cameras without a stream, with all messages in messages.mcap."""
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
    found = _Cameras()
    ids = {channel.id for channel in channels}
    for record in dataset.messages_file.in_file_order():
        if isinstance(record, Message) and record.channel.id in ids:
            found.take(record)
    return found.cameras(channels)
