"""A second reader of the format, written from spec/ alone; it shares no code with mp4ds.

    python conformance/reader.py FILE    what a sidecar or dataset holds, as JSON

Needs ffmpeg and ffprobe on the path, and PyYAML. It reads manifests, sidecars, columns, the index
of messages.mcap, the order of messages, packets and decoded planes. It makes the pixels of lossy
videos in colour, no others, and no messages, and tells the first problem that stops it.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import struct
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

from subset import M64, RefusedError, load


def sha256(data):
    """Hexadecimal."""
    return hashlib.sha256(data).hexdigest()


# ---------------------------------------------------------------- columns


def column(path, values, count):
    """The values of a column."""
    numbers = [values["start"]]
    for token in re.split("[ \n]+", values["values"].strip(" \n")):
        found = re.fullmatch(r"(-?[0-9]+)(?:\*([0-9]+))?", token)
        if not found and token:
            raise RefusedError("column-invalid", path)
        residual, times = (int(found[1]), int(found[2] or 1)) if found else (0, 0)
        if (found and not times) or not -(2**63) <= residual < 2**63:
            raise RefusedError("column-invalid", path)
        if len(numbers) + times > count:
            raise RefusedError("column-invalid", path)
        for _ in range(times):
            total = numbers[-1] + values["step"] + residual
            numbers.append((total + 2**63 & M64) - 2**63)
    if len(numbers) != count:
        raise RefusedError("column-invalid", path)
    return numbers


def columns(path, listed, count, variants):
    """All columns, the absent ones with their defaults."""
    found = {name: column(path, values, count) for name, values in listed.items()}
    zeros = [0] * count
    found = {
        "log_time": found["log_time"],
        "publish_time": found.get("publish_time", found["log_time"]),
        "sequence": found.get("sequence", zeros),
        "stamp": found["stamp"],
        "seq": found.get("seq", zeros),
        "pts": found.get("pts", zeros),
        "variant": found.get("variant", zeros),
        "ordinal": found.get("ordinal", list(range(count))),
    }
    later = pairwise(found["ordinal"])
    if not all(0 <= number < variants for number in found["variant"]) or any(
        a >= b for a, b in later
    ):
        raise RefusedError("column-invalid", path)
    return found


def as_texts(found):
    """Columns as JSON has them."""
    return {name: list(map(str, values)) for name, values in found.items()}


# ---------------------------------------------------------------- the video

CODECS = {"h264": "h264", "h265": "hevc", "av1": "av1", "vp9": "vp9", "ffv1": "ffv1"}
PACKED = {"bgr0": (1, 0, 2), "bgra": (1, 0, 2, 3), "rgb24": (1, 2, 0), "bgr24": (1, 0, 2)}


def probe(video, side):
    """The pixel format of a video that is what its sidecar says."""
    show = "stream=codec_name,width,height,pix_fmt,codec_type"
    command = ["ffprobe", "-v", "error", "-show_entries", show, "-of", "json", str(video)]
    done = subprocess.run(command, capture_output=True, check=False)
    streams = json.loads(done.stdout or "{}").get("streams", [])
    streams = [stream for stream in streams if stream["codec_type"] == "video"]
    if len(streams) != 1:
        raise RefusedError("video-unreadable", video)
    (stream,) = streams
    if stream["codec_name"] != {**CODECS, "mjpeg": "mjpeg"}.get(side["codec"]):
        raise RefusedError("codec-mismatch", video)
    if (stream["width"], stream["height"]) != (side["width"], side["height"]):
        raise RefusedError("geometry-mismatch", video)
    return stream["pix_fmt"]


def decode(video, side, coded):
    """SHA-256 of each packet; format and planes, as a list of bytes, of each picture."""
    width, height = side["width"], side["height"]
    name = coded.replace("yuvj", "yuv")
    command = ["ffmpeg", "-v", "quiet", "-threads", "1", "-i", str(video)]
    command += ["-map", "0:v", "-c", "copy", "-f", "framehash", "-hash", "sha256", "pipe:2"]
    command += ["-map", "0:v", "-fps_mode", "passthrough", "-pix_fmt", coded]
    done = subprocess.run([*command, "-f", "rawvideo", "pipe:1"], capture_output=True, check=False)
    lines = [line.split(",") for line in done.stderr.decode().splitlines() if line[0] != "#"]
    hashes = [words[-1].strip() for words in lines if int(words[2]) >= 0]
    name, frames = pictures(done.stdout, name, width, height, side.get("pixel_format", ""))
    hidden = len(lines) - len(hashes)  # by an edit list; older versions of ffmpeg show them
    return hashes, name, frames[hidden:] if len(frames) == len(lines) else frames


def pictures(raw, name, width, height, told):
    """Format and planes of pictures that stand one after the other."""
    deep = 2 if name.endswith("le") else 1
    if name in PACKED:
        places = PACKED[name]
        size = 3 if name.endswith("24") else 4
        whole = [
            raw[at : at + size * width * height] for at in range(0, len(raw), size * width * height)
        ]
        name = "gbrap" if len(places) == 4 else "gbrp"
        return name, [[frame[place::size] for place in places] for frame in whole]
    across, down = {"yuv420": (2, 2), "yuv422": (2, 1)}.get(name[:6], (1, 1))
    chroma = deep * -(-width // across) * -(-height // down)
    sizes = [deep * width * height]
    sizes += [chroma] * {"y": 2, "g": 0 if name.startswith("gray") else 2}[name[0]]
    sizes += sizes[:1] * name.startswith("gbra")
    frames = []
    for at in range(0, len(raw), sum(sizes)):
        frames.append(
            [raw[at + sum(sizes[:n]) : at + sum(sizes[: n + 1])] for n in range(len(sizes))]
        )
    if told.startswith("gray") and name.startswith("yuv"):
        return told, [frame[:1] for frame in frames]
    return name, frames


# ---------------------------------------------------------------- streams, datasets


def stream(path):
    """What is told of a stream, and the channel that it belongs to."""
    side = load(path, "stream")
    video, image, channel = side["video"], side["image"], side["channel"]
    file = path.parent / video["file"]
    if not file.is_file():
        raise RefusedError("file-missing", file)
    if side["frames"] > file.stat().st_size:
        raise RefusedError("frame-count", path)
    found = columns(path, side["columns"], side["frames"], len(side["headers"]))
    digests = side.get("digests", {"values": "0" * 16 * side["frames"]})["values"]
    if not re.fullmatch(rf"([0-9a-f]{{16}}){{{side['frames']}}}", "".join(digests.split())):
        raise RefusedError("column-invalid", path)
    info = camera_info(path, side.get("camera_info"), found["log_time"])
    coded = probe(file, video)
    hashes, name, decoded = decode(file, video, coded)
    if len(hashes) != side["frames"]:
        raise RefusedError("frame-count", file)
    told = None
    if video["codec"] != "mjpeg":
        if len(decoded) != side["frames"]:
            raise RefusedError("decode-failed", file)
        told = {"pixel_format": name, "sha256": [sha256(b"".join(frame)) for frame in decoded]}
    return channel, {
        "sidecar": path.name,
        "video": video["file"],
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
        "layout": video["layout"],
        "codec": video["codec"],
        "coded_size": [video["width"], video["height"]],
        "frames": side["frames"],
        "columns": as_texts(found),
        "frame_id": [side["headers"][number]["frame_id"] for number in found["variant"]],
        "packets": hashes,
        "planes": told,
        **colours(side, decoded),
        "camera_info": info,
    }


# ---------------------------------------------------------------- colours of lossy videos

SHARES = {"bt709": (0.2126, 0.0722), "smpte170m": (0.299, 0.114)}
CHANNELS = {"rgb24": (0, 1, 2), "bgr24": (2, 1, 0)}


def colours(side, decoded):
    """The key of the pixels, where they are what a lossy video shows."""
    video, image = side["video"], side["image"]
    if side["profile"] == "lossless" or video["layout"] not in (*CHANNELS, "demosaic8"):
        return {}
    hashes = []
    for planes in decoded:
        rgb = as_rgb(planes, video)
        rows = [
            row_of(image["encoding"], y, [channel[y] for channel in rgb], image["width"])
            for y in range(image["height"])
        ]
        hashes.append(sha256(b"".join(rows)))
    return {"pixels": hashes}


def row_of(encoding, y, channels, width):
    """A row of the image: of a mosaic each sample is that of its place."""
    if encoding in ("rgb8", "bgr8", "8UC3"):
        order = CHANNELS["rgb24" if encoding == "rgb8" else "bgr24"]
        return bytes(channels[channel][x] for x in range(width) for channel in order)
    mosaic = encoding.removeprefix("bayer_")[2 * (y % 2) :]
    return bytes(channels["rgb".index(mosaic[x % 2])][x] for x in range(width))


def as_rgb(planes, video):
    """Rows of R, of G and of B: spec/index.md, "Colours"."""
    width, height, bits = video["width"], video["height"], 8 + 2 * ("10" in video["pixel_format"])
    is_full = video["color"]["range"] == "full"
    kr, kb = SHARES[video["color"]["matrix"]]
    kg = 1 - kr - kb
    luma, chroma = (32 * 255 * 256 / span for span in (219, 224))
    if is_full:
        luma = chroma = 32 * 255 * 2**bits / (2**bits - 1)
    red, blue = 2 * chroma * (1 - kr), 2 * chroma * (1 - kb)
    factors = luma, red, blue * kb / kg, red * kr / kg, blue
    luma, red, green_u, green_v, blue = map(round, factors)
    black = 0 if is_full else 2 ** (bits - 4)
    half = -(-width // 2), -(-height // 2)
    y_rows, u_rows, v_rows = (
        rows_of(plane, size[0], bits)
        for plane, size in zip(planes, ((width, height), half, half), strict=True)
    )
    found = [], [], []
    for y in range(height):
        u, v = (interpolated(rows, y, width, bits) for rows in (u_rows, v_rows))
        light = [product((s - black) << (15 - bits), luma) + 16 for s in y_rows[y]]
        rgb = (
            [a + product(c, red) for a, c in zip(light, v, strict=True)],
            [
                a - product(b, green_u) - product(c, green_v)
                for a, b, c in zip(light, u, v, strict=True)
            ],
            [a + product(b, blue) for a, b in zip(light, u, strict=True)],
        )
        for rows, values in zip(found, rgb, strict=True):
            rows.append(bytes(min(max(value >> 5, 0), 255) for value in values))
    return found


def rows_of(plane, width, bits):
    """Samples of a plane by rows."""
    samples = plane if bits == 8 else struct.unpack(f"<{len(plane) // 2}H", plane)
    return [samples[at : at + width] for at in range(0, len(samples), width)]


def product(a, k):
    """Of a sample and a factor."""
    return (a * k + 2**14) >> 15


def between(values, place):
    """Of samples around a place of the picture, 32 times what is there."""
    near, side, last = place // 2, 1 if place % 2 else -1, len(values) - 1
    a, b, c, d = (values[min(max(near + side * far, 0), last)] for far in (0, 1, -1, 2))
    return 28 * a + 8 * b - 3 * c - d


def interpolated(rows, y, width, bits):
    """Chroma of each pixel of a row."""
    columns = range(len(rows[0]))
    half = [between([row[x] - 2 ** (bits - 1) for row in rows], y) for x in columns]
    half = [(value + 2 ** (bits - 6)) >> (bits - 5) for value in half]
    return [between(half, x) for x in range(width)]


# ---------------------------------------------------------------- calibrations


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
        "holds": None,
    }
    if info["messages"]:
        if "columns" not in info:
            raise RefusedError("column-invalid", path)
        held = columns(path, info["columns"], info["messages"], len(info["calibrations"]))
        last = [max(sum(time <= log for time in held["log_time"]) - 1, 0) for log in log_times]
        found |= {"columns": as_texts(held), "holds": [held["variant"][at] for at in last]}
    return found


def messages_by_channel(path):
    """Messages of each channel of an MCAP file by its summary; attachments, metadata."""
    data = path.read_bytes() if path.is_file() else b""
    if not data:
        raise RefusedError("file-missing", path)
    magic = b"\x89MCAP0\r\n"
    if not data.startswith(magic) or not data.endswith(magic):
        raise RefusedError("messages-unreadable", path)
    (at,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    if not at:
        raise RefusedError("messages-unreadable", path)
    schemas, channels, counts, others = {}, {}, {}, (0, 0)

    def take(record, place):
        (size,) = struct.unpack_from("<I", record, place)
        return record[place + 4 : place + 4 + size], place + 4 + size

    while data[at] != 2:
        kind, size = struct.unpack_from("<BQ", data, at)
        record, at = data[at + 9 : at + 9 + size], at + 9 + size
        (number,) = struct.unpack_from("<H", record)
        if kind == 3:
            name, place = take(record, 2)
            encoding, place = take(record, place)
            schemas[number] = name.decode(), encoding.decode(), take(record, place)[0]
        elif kind == 4:
            topic, place = take(record, 4)
            encoding, place = take(record, place)
            pairs, place, metadata = take(record, place)[0], 0, {}
            while place < len(pairs):
                key, place = take(pairs, place)
                value, place = take(pairs, place)
                metadata[key.decode()] = value.decode()
            schema = schemas.get(struct.unpack_from("<H", record, 2)[0])
            channels[number] = topic.decode(), encoding.decode(), schema, metadata
        elif kind == 11:
            others = struct.unpack_from("<II", record, 14)
            for place in range(46, len(record), 10):
                number, count = struct.unpack_from("<HQ", record, place)
                counts[number] = count
    return [(channel, counts.get(number, 0)) for number, channel in channels.items()], others


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
