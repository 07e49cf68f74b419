"""Rerun: an .rrd file of videos or images, cameras, transforms, poses, IMUs and joints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun

from mp4ds.dataset.messages import RecordedMessage
from mp4ds.format.models import Calibration
from mp4ds.messages.transforms import TransformCollector
from mp4ds.plan import FileNames
from mp4ds.plugins.exporting.job import ExportedCamera, ExportJob, hold_calibration
from mp4ds.plugins.exporting.motion import POSES, ros_type, stamp_of, static_transforms, topics_of
from mp4ds.unpacking.pictures import files_of, holds_files
from mp4ds.video.images import ImageFile, encoding_as
from mp4ds.video.packets import StandAlonePackets

_CODECS = {"h264": "H264", "h265": "H265", "av1": "AV1"}
_UNITS_IN_METRE = {"16UC1": 1000.0, "32FC1": 1.0}
_TF_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
_IMU, _JOINTS = "sensor_msgs/Imu", "sensor_msgs/JointState"
_POSES_ALONE = ("geometry_msgs/PoseStamped", "geometry_msgs/TransformStamped")
_STAMP, _RECORDED = "stamp", "recorded"
_MOST_DEPTH = 64  # depth of nested frames


def write(job: ExportJob) -> None:
    """Write the format."""
    stream = rerun.RecordingStream("mp4ds")
    stream.save(str(job.path))
    try:
        manifest = job.source.dataset.manifest
        if manifest and manifest.about:
            if manifest.about.title:
                stream.send_recording_name(manifest.about.title)
            text = "\n".join(manifest.about.lines)
            stream.log("about", rerun.TextDocument(text), static=True)
        _Writer(job, stream).write()
        stream.flush()
    finally:
        stream.disconnect()


class _Writer:
    """Logs a dataset; every frame is an entity below its parent's."""

    def __init__(self, job: ExportJob, stream: Any) -> None:
        self._job, self._stream = job, stream
        self._source = job.source
        self._dataset = job.source.dataset
        self._static = static_transforms(self._dataset)
        topics = [channel.topic for channel in self._dataset.channels]
        self._tf_topics = [
            topic
            for topic in dict.fromkeys(topics)
            if ros_type(self._dataset, topic) in _TF_TYPES
            and self._source.chosen(topic)
            and topic not in self._static_topics
        ]
        self._parents = {_name(item.child): _name(item.parent) for item in self._static}
        for message in self._moving():
            for transform in message.decoded.transforms:
                self._parents[_name(transform.child_frame_id)] = _name(transform.header.frame_id)

    @property
    def _static_topics(self) -> list[str]:
        takes = TransformCollector.takes
        return [channel.topic for channel in self._dataset.channels if takes(channel)]

    def _moving(self) -> Iterator[RecordedMessage]:
        """The messages of /tf and similar topics."""
        return self._dataset.messages(self._tf_topics) if self._tf_topics else iter(())

    def _path(self, frame: str, *more: str) -> str:
        """Entity path of a frame, below its parents."""
        names = [_name(frame) or "unknown"]
        while len(names) < _MOST_DEPTH and (parent := self._parents.get(names[-1])):
            if parent in names:
                break
            names.append(parent)
        found: str = rerun.new_entity_path(["tf", *reversed(names), *more])
        return found

    def _at(self, stamp: int, log_time: int) -> None:
        for name, time in ((_STAMP, stamp), (_RECORDED, log_time)):
            self._stream.set_time(name, timestamp=np.datetime64(time, "ns"))

    def _log(self, path: str, value: Any, *, static: bool = False) -> None:
        self._stream.log(path, value, static=static)

    def write(self) -> None:
        """Log everything."""
        self._write_transforms()
        names = FileNames()
        for camera in self._source.cameras:
            path = self._path(camera.frame_id, names.name_for(camera.topic)[0])
            if self._write_camera(camera, path):
                self._job.places[path] = camera.topic
                self._source.ledger.hold(camera.topic, len(camera))
        for topic in topics_of(self._dataset, _IMU, self._source.chosen):
            self._write_imu(topic)
        for kind in POSES:
            for topic in topics_of(self._dataset, kind, self._source.chosen):
                self._write_poses(topic, kind)
        for topic in topics_of(self._dataset, _JOINTS, self._source.chosen):
            self._write_joints(topic)

    # ------------------------------------------------------------ transforms

    def _write_transforms(self) -> None:
        for item in self._static:
            self._log(
                self._path(item.child),
                self._transform(item.translation, item.rotation),
                static=True,
            )
        ledger = self._source.ledger
        for topic in dict.fromkeys(self._static_topics):
            if self._source.chosen(topic):
                ledger.hold(topic, ledger.total(topic))
                self._job.note(f"{topic}: only the last transform of each child frame is kept")
        for message in self._moving():
            if self._write_moving(message):
                ledger.hold(message.topic)
            else:
                ledger.leave(message.topic, "a frame has several parents; Rerun allows one", 1)
        for topic in self._tf_topics:
            self._job.places[rerun.new_entity_path(["tf"])] = topic

    def _write_moving(self, message: RecordedMessage) -> bool:
        """Log the transforms of a message; returns whether all of them could be."""
        is_whole = True
        for item in message.decoded.transforms:
            child = _name(item.child_frame_id)
            if self._parents[child] != _name(item.header.frame_id):
                is_whole = False
                continue
            self._at(stamp_of(item.header), message.log_time_ns)
            at, turn = item.transform.translation, item.transform.rotation
            value = self._transform((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))
            self._log(self._path(child), value)
        return is_whole

    def _transform(self, translation: tuple[float, ...], rotation: tuple[float, ...]) -> Any:
        return rerun.Transform3D(
            translation=translation, quaternion=rerun.Quaternion(xyzw=rotation)
        )

    # ------------------------------------------------------------ cameras

    def _write_camera(self, camera: ExportedCamera, path: str) -> bool:
        """Log the frames of a camera; returns whether they could be."""
        encoding = camera.view.encoding
        is_light = encoding_as(encoding, "rgb") is not None
        if not is_light and encoding.name not in _UNITS_IN_METRE:
            reason = f"Rerun cannot hold {encoding.name} as an image or as depths"
            self._source.ledger.leave(camera.topic, reason, len(camera))
            return False
        calibration = hold_calibration(camera, self._source.ledger)
        if calibration is not None:
            self._log(path, self._pinhole(camera, calibration), static=True)
            if any(calibration.d):
                self._job.note(f"{camera.topic}: Rerun has no place for its distortion")
        if not is_light:
            self._write_depths(camera, path, _UNITS_IN_METRE[encoding.name])
        elif self._can_be_video(camera):
            self._write_packets(camera, path)
        elif camera.is_as_recorded and holds_files(camera.stream.sidecar, "jpeg"):
            self._write_files(camera, path, files_of(camera.stream), "image/jpeg")
        else:
            file = ImageFile(encoding.name, "png")
            found = ((place, file.encode(pixels)) for place, pixels in camera.pictures())
            self._write_files(camera, path, found, "image/png")
        return True

    def _pinhole(self, camera: ExportedCamera, calibration: Calibration) -> Any:
        return rerun.Pinhole(
            image_from_camera=np.array(calibration.k).reshape(3, 3),
            resolution=camera.size,
            camera_xyz=rerun.ViewCoordinates.RDF,
        )

    def _can_be_video(self, camera: ExportedCamera) -> bool:
        sidecar = camera.stream.sidecar
        is_shown = sidecar.body == "packet" or sidecar.layout.is_shown
        # a viewer decodes in the order of the times
        is_later = len(camera) < 2 or bool((np.diff(camera.times) > 0).all())
        return (
            camera.is_as_recorded
            and is_shown
            and is_later
            and sidecar.video.codec in _CODECS
            and not camera.stream.hidden_frames
        )

    def _write_packets(self, camera: ExportedCamera, path: str) -> None:
        stream, codec = camera.stream, camera.stream.sidecar.video.codec
        kind = getattr(rerun.VideoCodec, _CODECS[codec])
        stream.verify_video()
        self._log(path, rerun.VideoStream(codec=kind), static=True)
        with StandAlonePackets(stream.video_path, codec=codec, frames=len(stream)) as packets:
            found = ((index, packets.packet(index)) for index in range(len(stream)))
            for index, packet in self._job.counted(found, camera.topic, len(camera)):
                self._at_frame(camera, index)
                self._log(path, rerun.VideoStream.from_fields(sample=packet))

    def _write_files(
        self, camera: ExportedCamera, path: str, files: Iterator[tuple[int, Any]], kind: str
    ) -> None:
        for place, data in self._job.counted(files, camera.topic, len(camera)):
            self._at_frame(camera, place)
            value = rerun.EncodedImage(contents=bytes(data), media_type=kind)
            self._log(path, value)

    def _write_depths(self, camera: ExportedCamera, path: str, metre: float) -> None:
        for place, pixels in camera.pictures():
            self._at_frame(camera, place)
            self._log(path, rerun.DepthImage(pixels, meter=metre))

    def _at_frame(self, camera: ExportedCamera, place: int) -> None:
        number = int(camera.numbers[place])
        stream = camera.stream
        self._at(int(stream.stamps[number]), int(stream.log_times[number]))

    # ------------------------------------------------------------ inertial measurements

    def _write_imu(self, topic: str) -> None:
        parts = ["imu", *topic.strip("/").split("/")]
        paths = {
            name: rerun.new_entity_path([*parts, name])
            for name in ("angular_velocity", "linear_acceleration")
        }
        count = 0
        for message in self._dataset.messages([topic]):
            values = message.decoded
            self._at(stamp_of(values.header), message.log_time_ns)
            for name, path in paths.items():
                vector = getattr(values, name)
                self._log(path, rerun.Scalars([vector.x, vector.y, vector.z]))
            count += 1
        self._source.ledger.hold(topic, count)
        self._job.places[rerun.new_entity_path(parts)] = topic
        self._job.note(f"{topic}: orientation and covariances are not kept")

    # ------------------------------------------------------------ poses and joints

    def _write_poses(self, topic: str, kind: str) -> None:
        """Log poses as transforms of the topic's entity, below their parent frame."""
        names = ["poses", *topic.strip("/").split("/")]
        count, path = 0, ""
        for message in self._dataset.messages([topic]):
            values = message.decoded
            at, turn = POSES[kind](values)
            path = self._path(values.header.frame_id, *names)
            self._at(stamp_of(values.header), message.log_time_ns)
            value = self._transform((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))
            self._log(path, value)
            count += 1
        self._source.ledger.hold(topic, count)
        if path:
            self._job.places[path] = topic
        if kind not in _POSES_ALONE:
            self._job.note(f"{topic}: only position and orientation are kept")

    def _write_joints(self, topic: str) -> None:
        """Log positions, velocities and efforts, one series per joint."""
        parts = ["joints", *topic.strip("/").split("/")]
        count = 0
        for message in self._dataset.messages([topic]):
            values = message.decoded
            self._at(stamp_of(values.header), message.log_time_ns)
            for kind in ("position", "velocity", "effort"):
                for number, value in enumerate(getattr(values, kind)):
                    joint = values.name[number] if number < len(values.name) else number
                    path = rerun.new_entity_path([*parts, str(joint), kind])
                    self._log(path, rerun.Scalars([float(value)]))
            count += 1
        self._source.ledger.hold(topic, count)
        self._job.places[rerun.new_entity_path(parts)] = topic


def _name(frame: str) -> str:
    return frame.removeprefix("/")
