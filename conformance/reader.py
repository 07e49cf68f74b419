"""A second reader of the format, written from spec/ alone; it shares no code with mp4ds.

    python conformance/reader.py FILE    what a sidecar or dataset holds, as JSON

Needs numpy, PyAV, PyYAML, jsonschema, xxhash, mcap and protobuf. It tells the first problem that
stops it.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import xxhash

from documents import RefusedError, columns, load
from images import has_grain, pixels, read_video
from payloads import filled, messages_by_channel, packet_body, png_file, rows, rvl_image, template


def sha256(*data):
    """Hexadecimal."""
    return hashlib.sha256(b"".join(data)).hexdigest()


def as_texts(found):
    """Columns as JSON has them."""
    return {name: list(map(str, values)) for name, values in found.items()}


# ---------------------------------------------------------------- streams


def stream(path):
    """What is told of a stream, and the channel that it belongs to."""
    side = load(path, "stream")
    if "view" in side and not (path.parent / side["video"]["file"]).exists():
        side = seen(side)
    video, view, image, channel = side["video"], side.get("view"), side["image"], side["channel"]
    for file in (path.parent / one["file"] for one in (video, view) if one):
        if not file.is_file():
            raise RefusedError("file-missing", file)
        if side["frames"] > file.stat().st_size:
            raise RefusedError("frame-count", path)
    found = columns(path, side["columns"], side["frames"], len(side["headers"]))
    digests = side.get("digests", {"values": "0" * 16 * side["frames"]})["values"]
    if not re.fullmatch(rf"([0-9a-f]{{16}}){{{side['frames']}}}", "".join(digests.split())):
        raise RefusedError("column-invalid", path)
    info = camera_info(path, side.get("camera_info"), found["log_time"])
    own, packets, pictures = decoded(path, side, video)
    of_view, predicted = {}, None
    if view:
        of_view, _, shown = decoded(path, side, view)
        if view["codec"] == "av1" and has_grain(path.parent / view["file"]):
            raise RefusedError("codec-mismatch", path.parent / view["file"])
        predicted = [pixels(image, view, picture) for picture in shown]
        of_view = {"view": {**of_view, "pixels": hashes_of(predicted)}}
    if not side.get("predicted", True):
        predicted = None
    hashes, payloads = messages(path, side, found, packets, pictures, predicted)
    return channel, {
        "sidecar": path.name,
        "topic": channel["topic"],
        "type": channel.get("schema", {}).get("name", ""),
        "message_encoding": channel["message_encoding"],
        "wire": side["wire"],
        "profile": side["profile"],
        "stamps": side.get("stamps", "header"),
        "body": side.get("body", "pixels"),
        "image": {
            key: image[key] for key in ("encoding", "width", "height", "step", "is_bigendian")
        },
        "frames": side["frames"],
        "columns": as_texts(found),
        "frame_id": [side["headers"][number]["frame_id"] for number in found["variant"]],
        **own,
        "pixels": hashes,
        "payloads": payloads,
        **of_view,
        "camera_info": info,
    }


def seen(side):
    """What is left of a stream without the video that its view predicts."""
    gone = "view", "predicted", "digests"
    kept = {key: value for key, value in side.items() if key not in gone}
    video, body = dict(side["view"]), side.get("body", "pixels")
    if body == "packet" and side["video"]["codec"] == "mjpeg":
        body = "jpeg"
    elif body == "packet":
        del video["pixel_format"]  # packets of another codec than those recorded
    return {**kept, "profile": "visual", "video": video, "body": body}


def decoded(path, side, video):
    """What is told of a video, its packets, and its pictures."""
    file = path.parent / video["file"]
    packets, name, pictures = read_video(file, video)
    if len(packets) != side["frames"]:
        raise RefusedError("frame-count", file)
    if video["codec"] != "mjpeg" and len(pictures) != side["frames"]:
        raise RefusedError("decode-failed", file)
    planes = {"pixel_format": name, "sha256": [sha256(*map(bytes, one)) for one in pictures]}
    found = {
        "video": video["file"],
        "layout": video["layout"],
        "codec": video["codec"],
        "coded_size": [video["width"], video["height"]],
        "packets": [sha256(packet) for packet in packets],
        "planes": None if video["codec"] == "mjpeg" else planes,
    }
    return found, packets, pictures


def used_bits(view, patterns):
    """Of the samples of images that a view predicts."""
    told = view.get("parameters", {})
    return told["bits"] + told["shift"] if "bits" in told else 8 * patterns.itemsize


def hashes_of(images):
    """Of the pixels of images, little-endian."""
    return [sha256(one.astype(one.dtype.newbyteorder("<")).tobytes()) for one in images]


def messages(path, side, found, packets, pictures, predicted):
    """Hashes of the pixels, and of the messages unless the stream is lossy."""
    kind, image, video = side.get("body", "pixels"), side["image"], side["video"]
    hashes, payloads = [], []
    for n, variant in enumerate(found["variant"]):
        header = side["headers"][variant]
        if kind == "packet" and side["profile"] == "lossless":
            body = packet_body(video["codec"], packets[n], header.get("framing", ""))
        elif kind != "packet":
            is_source = video["layout"].startswith("from_")
            of_source = predicted[n] if predicted and is_source else None
            patterns = pixels(image, video, pictures[n], of_source)
            if predicted and not is_source:
                bits = used_bits(side["view"], patterns)
                whole = patterns.astype(np.int64) + predicted[n] - 2 ** (bits - 1)
                patterns = (whole % 2**bits).astype(patterns.dtype)
            hashes += hashes_of([patterns])
            if kind == "pixels":
                big_endian = bool(image["is_bigendian"])
                body = rows(patterns, image["step"], header.get("padding"), big_endian=big_endian)
            elif side["profile"] == "lossless":
                coded = png_file(patterns, header["png"]) if kind == "png" else rvl_image(patterns)
                body = bytes.fromhex(header.get("prefix", "")) + coded
        if side["profile"] == "lossless":
            blank = template(side["wire"], side["channel"], {**image, **header})
            payloads.append(filled(side["wire"], side["channel"], blank, found, n, body))
    if "digests" in side and side["profile"] == "lossless":
        digests = "".join(map(xxhash.xxh64_hexdigest, payloads))
        if digests != "".join(side["digests"]["values"].split()):
            raise RefusedError("digest-mismatch", path)
    is_lossless = side["profile"] == "lossless"
    return (
        None if kind == "packet" else hashes,
        list(map(sha256, payloads)) if is_lossless else None,
    )


def camera_info(path, info, log_times):
    """The calibrations of a stream, and which of them holds for each frame."""
    if info is None:
        return None
    told = ("frame_id", "width", "height", "k")
    found = {
        "topic": info["channel"]["topic"],
        "type": info["channel"].get("schema", {}).get("name", ""),
        "wire": info["wire"],
        "messages": info["messages"],
        "calibrations": [{key: item[key] for key in told} for item in info["calibrations"]],
        "columns": None,
        "payloads": None,
        "holds": None,
    }
    if info["messages"]:
        if "columns" not in info:
            raise RefusedError("column-invalid", path)
        held = columns(path, info["columns"], info["messages"], len(info["calibrations"]))
        last = [max(sum(time <= log for time in held["log_time"]) - 1, 0) for log in log_times]
        payloads = []
        for n, variant in enumerate(held["variant"]):
            item = info["calibrations"][variant]
            roi = {f"roi_{key}": value for key, value in item.get("roi", {}).items()}
            blank = template(info["wire"], info["channel"], {**item, **roi})
            payloads.append(sha256(filled(info["wire"], info["channel"], blank, held, n)))
        found |= {"columns": as_texts(held), "payloads": payloads}
        found["holds"] = [held["variant"][at] for at in last]
    return found


# ---------------------------------------------------------------- datasets


def identity(channel):
    """A sidecar's channel as it is compared with those of messages.mcap."""
    schema = channel.get("schema")
    if schema:
        text = schema.get("text")
        data = base64.b64decode(schema["base64"]) if text is None else text.encode()
        schema = schema["name"], schema["encoding"], data
    return channel["topic"], channel["message_encoding"], schema, channel.get("metadata", {})


def order(streams, recorded):
    """In which file each message of a camera's channel is."""
    told = []
    channels = []
    for channel, _ in streams:
        if identity(channel) not in channels:
            channels.append(identity(channel))
    for channel in channels:
        places = {
            int(number): found["sidecar"]
            for own, found in streams
            if identity(own) == channel
            for number in found["columns"]["ordinal"]
        }
        total = len(places) + sum(count for own, count in recorded if own == channel)
        if max(places) >= total:
            raise RefusedError("messages-missing", Path("dataset"))
        files = [places.get(number, "messages.mcap") for number in range(total)]
        told.append({"topic": channel[0], "files": files})
    return told


def dataset(folder):
    """What is told of a dataset."""
    manifest = load(folder / "dataset.yaml", "dataset")
    span = manifest.get("time_range")
    streams = [stream(folder / entry["sidecar"]) for entry in manifest["streams"]]
    recorded, (attachments, metadata) = messages_by_channel(folder / "messages.mcap")
    topics = {}
    for (topic, _, schema, _), count in recorded:
        key = topic, schema[0] if schema else ""
        topics[key] = topics.get(key, 0) + count
    return {
        "problems": [],
        "manifest": {
            **{key: manifest[key] for key in ("profile", "format", "recording_profile")},
            "messages": str(manifest["messages"]),
            "time_range": {key: str(span[key]) for key in ("start", "end")} if span else None,
            "streams": [entry["sidecar"] for entry in manifest["streams"]],
            "files": sorted(entry["name"] for entry in manifest["files"]),
        },
        "streams": [found for _, found in streams],
        "order": order(streams, recorded),
        "messages": {
            "topics": [
                {"topic": topic, "type": kind, "messages": count}
                for (topic, kind), count in sorted(topics.items())
                if count
            ],
            "attachments": attachments,
            "metadata": metadata,
        },
    }


def main(path):
    """Print what a file holds."""
    try:
        is_pair = not path.is_dir()
        found = {"problems": [], "streams": [stream(path)[1]]} if is_pair else dataset(path)
    except RefusedError as refused:
        code, file = refused.args
        found = {"problems": [{"file": file.name, "code": code}]}
    print(json.dumps(found, indent=1))
    return 1 if found["problems"] else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
