"""A video and the YAML of the tool published with the paper (version 0), as a whole dataset.

Nothing is re-encoded: the video's packets get the times of the YAML, which the sidecar keeps.
"""

from __future__ import annotations

import os
from pathlib import Path

from mp4ds.bags.convert import Converter
from mp4ds.bags.mcap import McapWriter
from mp4ds.errors import FormatError, OptionError, SourceError, SourceNotFoundError
from mp4ds.files.outputs import digest_file, staged
from mp4ds.files.sources import SourceState, unchanged
from mp4ds.files.urls import location, remote
from mp4ds.format.manifest import Source
from mp4ds.format.models import ChannelModel, StreamSidecar, video_facts
from mp4ds.format.sidecars import FileNames, dump_document, load_stream
from mp4ds.packing.manifest import (
    PartRecord,
    dataset_files,
    summarize,
    write_manifest,
)
from mp4ds.packing.options import PackSummary
from mp4ds.times import PresentationClock
from mp4ds.video.packets import PacketReader, join_segments

_PROFILE = "ros1"  # that tool reads bags
_ANY = "video.mp4"
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
        SourceError: A file is missing or cannot be read.
        FormatError: The YAML is incomplete, or does not match the video.
        OptionError: The YAML is of another tool, or a path is a URL.
        TargetError: The dataset cannot be written there.
        WriteError: The dataset could not be written; nothing is left behind.
    """
    source, described = _local(video), _local(sidecar)
    for path in (source, described):
        if not path.is_file():
            raise (
                SourceNotFoundError(path)
                if not path.exists()
                else SourceError(path, "is not a file")
            )
    target = Path(os.path.abspath(_local(dataset)))  # noqa: PTH100 - keeps links, unlike resolve()
    states = [SourceState.of(source), SourceState.of(described)]
    old = load_stream(described, video=_ANY)  # users may have renamed theirs
    if old.stamps != "record-float":
        raise OptionError(
            f"{described} is not a YAML file of the tool published with the paper: it is already "
            "an mp4ds sidecar."
        )
    with (
        staged(target, force=force, owned=dataset_files, sources=[source, described]) as folder,
        unchanged(states),
    ):
        _check(source, described, old)
        folder.mkdir()
        part = _part_of(source, old, folder)
        sources = [
            Source(name=path.name, size=size, sha256=sha256)
            for path in (source, described)
            for size, sha256 in [digest_file(path)]
        ]
        origin = {"format": "bag", "recording_profile": _PROFILE, "sources": sources}
        write_manifest(part, origin, old.profile)
        return summarize(part, target, sum(item.size for item in sources))


def _local(path: Path | str) -> Path:
    found = location(path)
    if remote(found):
        raise OptionError(f"{found} is not on this machine. Download it first.")
    return found


def _check(video: Path, described: Path, old: StreamSidecar) -> None:
    """Refuse a YAML that does not match the video.

    Raises:
        FormatError: Says why.
    """
    size = old.video.width, old.video.height
    with PacketReader(video, codec=old.video.codec, coded_size=size) as reader:
        if len(reader) != old.frames:
            raise FormatError(
                "frame-count",
                video,
                f"has {len(reader)} frames, but {described} has the times of {old.frames}",
            )
    stamps = old.columns.stamp.decode(old.frames)
    if stamps.min() < 0 or stamps.max() > _MAX_STAMP:
        raise FormatError("column-invalid", described, "has times outside the range of ROS 1")


def _part_of(video: Path, old: StreamSidecar, folder: Path) -> PartRecord:
    """The stream and an empty messages.mcap, made in a folder."""
    channel = old.channel.to_record(0)
    stem = FileNames().name_for(channel.topic)
    path = folder / f"{stem}.mp4"
    stamps = old.columns.stamp.decode(old.frames).tolist()
    clock = PresentationClock()
    join_segments([video], (clock.tick(stamp, stamp) for stamp in stamps), path)
    facts = video_facts(path, old.video.codec)
    new = old.model_copy(
        update={
            "channel": _completed(old.channel),
            "camera_info": old.camera_info
            and old.camera_info.model_copy(update={"channel": _completed(old.camera_info.channel)}),
            "video": old.video.model_copy(update=facts),
        }
    )
    (folder / f"{stem}.yaml").write_bytes(dump_document(new))
    part = PartRecord(folder, streams=[new])
    with McapWriter(part.messages_path, profile=_PROFILE):
        pass
    topic = part.topic(channel)
    topic.messages = len(stamps)
    topic.raw_bytes = len(stamps) * new.image.step * new.image.height
    topic.notes.append("its times are record times in float seconds, not exact header stamps")
    part.span = min(stamps), max(stamps)
    return part


def _completed(channel: ChannelModel) -> ChannelModel:
    """The channel with definition and md5sum, which a bag needs and that tool did not keep."""
    return ChannelModel.from_record(Converter(_PROFILE).channel(channel.to_record(0)))
