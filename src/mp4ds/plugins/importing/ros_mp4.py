"""A video and the YAML of the tool published with the paper, as a dataset (docs/importing.md).

Nothing is re-encoded: the video's packets get the times of the YAML, which the sidecar keeps.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError

from mp4ds import yamlio
from mp4ds.bags.convert import Converter
from mp4ds.bags.mcap import McapWriter
from mp4ds.errors import FormatError, OptionError, SourceError, SourceNotFoundError
from mp4ds.files.outputs import digest_file, local_target, staged
from mp4ds.files.sources import SourceState, unchanged
from mp4ds.files.urls import location, remote
from mp4ds.format.fields import FORMAT_VERSION, Model, columns_model
from mp4ds.format.manifest import Source
from mp4ds.format.models import Calibration, ChannelModel, StreamSidecar, video_facts
from mp4ds.format.sidecars import FileNames, dump_document, model_problems
from mp4ds.packing.manifest import PartRecord, dataset_files, summarize, write_manifest
from mp4ds.packing.options import PackSummary
from mp4ds.records import Channel, Schema
from mp4ds.times import PresentationClock
from mp4ds.video.packets import PacketReader, join_segments

_PROFILE = "ros1"  # that tool reads bags
_MAX_STAMP = 2**32 * 10**9 - 1


def import_ros_mp4(
    video: Path | str, sidecar: Path | str, dataset: Path | str, *, force: bool = False
) -> PackSummary:
    """Make a dataset from a video and YAML of the tool published with the paper.

    Args:
        video: The mp4.
        sidecar: The YAML.
        dataset: The folder to make.
        force: Replace an existing dataset.

    Returns:
        The result for the topic.

    Raises:
        SourceError: A file is missing or cannot be read, or the YAML is not of that tool.
        FormatError: The YAML is not valid, or does not match the video.
        OptionError: A source is a URL.
        TargetError: The dataset cannot be written there.
        WriteError: The dataset could not be written; nothing is left behind.
    """
    source, described = _local(video), _local(sidecar)
    for path in (source, described):
        if not path.is_file():
            missing = SourceNotFoundError(path)
            raise SourceError(path, "is not a file") if path.exists() else missing
    target = local_target(dataset)
    states = [SourceState.of(source), SourceState.of(described)]
    stream = read_pair(described)
    with (
        staged(target, force=force, owned=dataset_files, sources=[source, described]) as folder,
        unchanged(states),
    ):
        size = stream.video.width, stream.video.height
        with PacketReader(source, codec=stream.video.codec, coded_size=size) as reader:
            if len(reader) != stream.frames:
                problem = f"has {len(reader)} frames, but {described} has the times of"
                raise FormatError("frame-count", source, f"{problem} {stream.frames}")
        folder.mkdir()
        part = _part_of(source, stream, folder)
        sources = [
            Source(name=path.name, size=size, sha256=sha256)
            for path in (source, described)
            for size, sha256 in [digest_file(path)]
        ]
        origin = {"format": "bag", "recording_profile": _PROFILE, "sources": sources}
        write_manifest(part, origin, stream.profile)
        return summarize(part, target, sum(item.size for item in sources))


def _local(path: Path | str) -> Path:
    found = location(path)
    if remote(found):
        raise OptionError(f"{found} is not on this machine. Download it first.")
    return found


class _Pair(Model):
    """The YAML of that tool: float seconds of record time, and the first camera_info."""

    bagname: Any = None
    topic_name: Annotated[list[str], Field(min_length=2, max_length=2)]
    camera_info: dict[str, Any]
    img_timestamp: Annotated[list[FiniteFloat], Field(min_length=1)]


def read_pair(path: Path) -> StreamSidecar:
    """The stream that a YAML of that tool describes; its video gets the name of the topic.

    Raises:
        FormatError: It is not valid YAML.
        SourceError: It is not of that tool, or not complete; says why.
    """
    with path.open("rb") as file:
        document = yamlio.load(file.read(yamlio.MAX_BYTES + 1), str(path))
    try:
        return _stream_of(_Pair.model_validate(document))
    except ValidationError as error:
        reason = ": ".join(model_problems(error)[0])
    except KeyError as error:
        reason = f"camera_info has no {error}"
    except ValueError as error:
        reason = str(error)
    raise SourceError(
        path, f"is not a complete YAML file of the tool published with the paper: {reason}"
    )


def _stream_of(pair: _Pair) -> StreamSidecar:
    # round half even of the exact product: the nearest nanosecond to the stored float
    times = [round(Fraction(seconds) * 10**9) for seconds in pair.img_timestamp]
    if min(times) < 0 or max(times) > _MAX_STAMP:
        raise ValueError("img_timestamp has times outside the range of ROS 1")
    info_topic, topic = pair.topic_name
    info = pair.camera_info
    calibration = Calibration.model_validate(
        {
            "frame_id": str(info["frameid"]),
            "width": info["width"],
            "height": info["height"],
            "distortion_model": str(info["distortion_model"]),
            **{name.lower(): info[name] for name in "DKRP"},
        }
    )
    size = {"width": calibration.width, "height": calibration.height}
    stamps = np.array(times, np.int64)
    columns = {"log_time": stamps, "stamp": stamps, "seq": np.arange(len(times))}
    return StreamSidecar.model_validate(
        {
            "mp4ds": FORMAT_VERSION,
            "kind": "stream",
            "profile": "crf=22",
            "stamps": "record-float",
            "frames": len(times),
            "channel": _channel(topic, "sensor_msgs/Image"),
            "wire": "ros1",
            "image": {**size, "encoding": "bgr8", "step": 3 * calibration.width, "is_bigendian": 0},
            "headers": [{"frame_id": calibration.frame_id}],
            "video": {
                **size,
                "file": f"{FileNames().name_for(topic)}.mp4",
                "layout": "bgr24",
                "codec": "av1",
                "pixel_format": "yuv420p",
                # that tool left the conversion to ffmpeg, which then takes BT.601, limited
                "color": {
                    "primaries": "bt709",
                    "transfer": "bt709",
                    "matrix": "smpte170m",
                    "range": "limited",
                },
            },
            "camera_info": {
                "channel": _channel(info_topic, "sensor_msgs/CameraInfo"),
                "wire": "ros1",
                "messages": 0,
                "calibrations": [calibration],
            },
            "columns": columns_model(columns),
        }
    )


def _channel(topic: str, type_name: str) -> ChannelModel:
    """A channel with definition and md5sum, which a bag needs and that tool did not keep."""
    bare = Channel(0, topic, "ros1", Schema(type_name, "", b""), {})
    return ChannelModel.from_record(Converter(_PROFILE).channel(bare))


def _part_of(video: Path, stream: StreamSidecar, folder: Path) -> PartRecord:
    """The stream and an empty messages.mcap, made in a folder."""
    path = folder / stream.video.file
    stamps = stream.columns.stamp.decode(stream.frames).tolist()
    clock = PresentationClock()
    join_segments([video], (clock.tick(stamp, stamp) for stamp in stamps), path)
    facts = video_facts(path, stream.video.codec)
    stream = stream.model_copy(update={"video": stream.video.model_copy(update=facts)})
    path.with_suffix(".yaml").write_bytes(dump_document(stream))
    part = PartRecord(folder, streams=[stream])
    with McapWriter(part.messages_path, profile=_PROFILE):
        pass
    topic = part.topic(stream.channel.to_record(0))
    topic.messages = len(stamps)
    topic.raw_bytes = len(stamps) * stream.image.step * stream.image.height
    topic.notes.append("its times are record times in float seconds, not exact header stamps")
    part.span = min(stamps), max(stamps)
    return part
