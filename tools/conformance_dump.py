"""Prints what mp4ds reads from a file, in the form used to compare readers.

    python tools/conformance_dump.py A_SIDECAR_OR_DATASET

The exit code is 1 if the file has problems. conformance/README.md says what each key means. 64-bit
integers are strings, since JSON parsers keep only 53 bits of a number.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.dataset.checks import Problem, validate
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import ChannelGroup
from mp4ds.dataset.stream import Stream
from mp4ds.errors import Mp4dsError, SourceError
from mp4ds.files.urls import location
from mp4ds.format.fields import MESSAGES_NAME, DecodedColumns
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import MANIFEST_NAME, THE_TOP
from mp4ds.messages.encodings import Picture
from mp4ds.records import Attachment, Message, MetadataRecord
from mp4ds.video.packets import PacketReader

sys.path.append(str(Path(__file__).resolve().parents[1] / "conformance"))

from images import planes_of

Values = dict[str, Any]


def as_json(values: Values) -> str:
    """The result of `dump` as reproducible text."""
    return json.dumps(values, indent=1)


def dump(path: Path | str) -> dict[str, Any]:
    """The contents of a sidecar with its video, or of a dataset, as JSON values.

    Every frame is decoded and every message rebuilt, one frame at a time; the result has a few
    hashes for each.

    Args:
        path: A sidecar, its video, a dataset or its manifest; or a URL.

    Returns:
        ``problems``, and if there are none, everything listed in conformance/README.md.

    Raises:
        SourceNotFoundError: The path does not exist.
        SourceError: It is neither of these.
    """
    path = location(path)
    if path.name == MANIFEST_NAME:
        path = path.parent
    if path.is_dir() and not (path / MANIFEST_NAME).exists():
        raise SourceError(
            path, f"is not a dataset: there is no {MANIFEST_NAME} in it", "Give one dataset."
        )
    problems = [_problem(problem) for problem in validate(path, deep=True)]
    if problems:
        return {"problems": sorted(problems, key=lambda item: tuple(item.values()))}
    with Dataset(path) as dataset:
        found: Values = {"problems": []}
        if dataset.manifest:
            found["manifest"] = _manifest(dataset.manifest)
        found["streams"] = [_stream(stream) for stream in dataset.streams]
        if dataset.manifest:
            found["order"] = [_order(channel) for channel in dataset.image_channels()]
            found["messages"] = _messages(dataset)
        return found


def _problem(problem: Problem) -> Values:
    """A problem; its place is a file name and a key in it, or just a topic."""
    file, _, key = problem.place.removesuffix(f" at {THE_TOP}").partition(" at ")
    is_file = Path(file).suffix in (".yaml", ".yml", ".mp4", ".mcap")
    return {
        "file": Path(file).name if is_file else "",
        "at": key if is_file else problem.place,
        "code": problem.code,
    }


def _texts(values: Iterable[int]) -> list[str]:
    return [str(value) for value in values]


def _sha256(data: bytes | bytearray | memoryview) -> str:
    return hashlib.sha256(data).hexdigest()


def _manifest(manifest: Manifest) -> Values:
    span = manifest.time_range
    return {
        "profile": manifest.profile,
        "format": manifest.format,
        "recording_profile": manifest.recording_profile,
        "messages": str(manifest.messages),
        "time_range": {"start": str(span.start), "end": str(span.end)} if span else None,
        "streams": [entry.sidecar for entry in manifest.streams],
        "files": sorted(entry.name for entry in manifest.files),
    }


# ---------------------------------------------------------------- streams


def _stream(stream: Stream) -> Values:
    sidecar = stream.sidecar
    columns = stream.columns
    channel = sidecar.channel
    own = _video(stream)
    pixels, payloads = _made(stream)
    return {
        "sidecar": stream.path.name,
        "video": own.pop("video"),
        "topic": channel.topic,
        "type": channel.schema_.name if channel.schema_ else "",
        "message_encoding": channel.message_encoding,
        "wire": sidecar.wire,
        "profile": sidecar.profile,
        "stamps": sidecar.stamps,
        "body": sidecar.body,
        "image": sidecar.image.model_dump(),
        **{key: own.pop(key) for key in ("layout", "codec", "coded_size")},
        "frames": sidecar.frames,
        "columns": _columns(columns),
        "frame_id": [sidecar.headers[number].frame_id for number in columns.variant.tolist()],
        **own,
        "pixels": pixels,
        "payloads": payloads,
        **({"view": _view(stream.in_layer("view"))} if sidecar.view else {}),
        "camera_info": _camera_info(stream),
    }


def _columns(columns: DecodedColumns) -> Values:
    """Every column, including absent ones with their defaults."""
    zeros: NDArray[np.int64] = np.zeros(len(columns.stamp), np.int64)
    found = {
        "log_time": columns.log_time,
        "publish_time": columns.publish_time,
        "sequence": columns.sequence,
        "stamp": columns.stamp,
        "seq": zeros if columns.seq is None else columns.seq,
        "pts": zeros if columns.pts is None else columns.pts,
        "variant": columns.variant,
        "ordinal": columns.ordinal,
    }
    return {name: _texts(values.tolist()) for name, values in found.items()}


def _video(stream: Stream) -> Values:
    """Hashes of each frame's packet in the video, and of what is decoded from it."""
    video = stream.sidecar.video
    return {
        "video": video.file,
        "layout": video.layout,
        "codec": video.codec,
        "coded_size": [video.width, video.height],
        "packets": _packets(stream),
        "planes": _planes(stream),
    }


def _view(stream: Stream) -> Values:
    return {**_video(stream), "pixels": [_pixels(stream, one) for _, one in stream.pictures()]}


def _made(stream: Stream) -> tuple[list[str] | None, list[str] | None]:
    """SHA-256 of the pixels and of the payload of each frame; None for what is not defined."""
    is_lossless = stream.sidecar.profile == "lossless"
    if stream.sidecar.body == "packet":
        return None, [_sha256(one) for _, one in stream.payloads()] if is_lossless else None
    pixels, payloads = [], []
    for index, picture in stream.pictures():
        pixels.append(_pixels(stream, picture))
        payloads.append(_sha256(stream.rebuilder.payload(index, picture)))
    return pixels, payloads if is_lossless else None


def _pixels(stream: Stream, picture: Picture) -> str:
    pixels = stream.recorded_pixels(picture)
    return _sha256(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes())


def _packets(stream: Stream) -> list[str]:
    with PacketReader(stream.video_path, codec=stream.sidecar.video.codec) as reader:
        return [_sha256(reader.packet(index)) for index in range(len(stream))]


def _planes(stream: Stream) -> Values | None:
    """Hashes of each picture; None if decoders may differ, or a packet cannot be decoded."""
    video = stream.sidecar.video
    if video.codec == "mjpeg":
        return None
    formats, hashes = set(), []
    try:
        for frame in decoded(stream.video_path):
            name, planes = planes_of(frame)
            if (video.pixel_format or "").startswith("gray"):  # some decoders make up the chroma
                name, planes = video.pixel_format, planes[:1]
            formats.add(name)
            hashes.append(_sha256(b"".join(plane.tobytes() for plane in planes)))
    except FFmpegError:
        return None
    if len(hashes) != len(stream) or len(formats) != 1:
        return None
    return {"pixel_format": formats.pop(), "sha256": hashes}


def decoded(path: Path) -> Iterator[av.VideoFrame]:
    """Every picture of a video, in order."""
    with av.open(str(path)) as container:
        yield from container.decode(video=0)


def _camera_info(stream: Stream) -> Values | None:
    """The calibrations, their messages, and which of them applies to each frame."""
    info = stream.sidecar.camera_info
    if info is None:
        return None
    channel = info.channel.to_record(0)
    found: Values = {
        "topic": channel.topic,
        "type": channel.type_name,
        "wire": info.wire,
        "messages": info.messages,
        "calibrations": [
            {"frame_id": item.frame_id, "width": item.width, "height": item.height, "k": item.k}
            for item in info.calibrations
        ],
        "columns": None,
        "payloads": None,
        "holds": None,
    }
    if stream.infos is not None:
        columns, messages = stream.infos.columns, stream.infos.messages(channel)
        found["columns"] = _columns(columns)
        found["payloads"] = [_sha256(message.data) for _, message in messages]
        after = np.searchsorted(columns.log_time, stream.log_times, side="right")
        found["holds"] = columns.variant[np.maximum(after - 1, 0)].tolist()
    return found


# ---------------------------------------------------------------- the dataset


def _order(channel: ChannelGroup) -> Values:
    """The file of each message of a channel, in the channel's order."""
    places = {
        ordinal: stream.path.name
        for stream in channel.streams
        for ordinal in stream.columns.ordinal.tolist()
    }
    count = len(places) + channel.recorded_count
    return {
        "topic": channel.channel.topic,
        "files": [places.get(ordinal, MESSAGES_NAME) for ordinal in range(count)],
    }


def _messages(dataset: Dataset) -> Values:
    """The contents of messages.mcap."""
    topics = Counter[tuple[str, str]]()
    kinds = Counter[type]()
    for record in dataset.messages_file.in_file_order():
        kinds[type(record)] += 1
        if isinstance(record, Message):
            topics[record.channel.topic, record.channel.type_name] += 1
    return {
        "topics": [
            {"topic": topic, "type": type_name, "messages": count}
            for (topic, type_name), count in sorted(topics.items())
        ],
        "attachments": kinds[Attachment],
        "metadata": kinds[MetadataRecord],
    }


def main() -> int:
    """Print what a file holds."""
    try:
        found = dump(sys.argv[1])
    except (IndexError, Mp4dsError) as error:
        print(error if isinstance(error, Mp4dsError) else __doc__, file=sys.stderr)
        return 2
    print(as_json(found))
    return 1 if found["problems"] else 0


if __name__ == "__main__":
    sys.exit(main())
