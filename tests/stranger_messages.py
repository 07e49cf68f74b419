"""A reader written from spec/ alone: the messages of a stream, without mp4ds."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np
import yaml
from google.protobuf.descriptor_pb2 import FileDescriptorSet

import stranger
from stranger import Array

ROS_TYPES = {
    stranger.quoted(row[0])[0]: [field.partition(": ")[::2] for field in row[1].split(", ")]
    for row in stranger.tables("Message types")[0]
}
NUMBERS = {"uint8": "B", "int32": "i", "uint32": "I", "uint64": "Q", "float64": "d"}


class Stream:
    """A sidecar and its video."""

    def __init__(self, path: Path) -> None:
        self.sidecar: dict[str, Any] = yaml.load(path.read_text(), yaml.CSafeLoader)
        self.video = path.parent / self.sidecar["video"]["file"]

    def payloads(self) -> Iterator[bytes]:
        """The payloads of all frames."""
        side = self.sidecar
        columns = decoded(side["columns"], side["frames"])
        for n, body in enumerate(self._bodies(columns["variant"])):
            header = side["headers"][columns["variant"][n]]
            blank = self._blank(header)
            yield filled(side["wire"], side["channel"], blank, columns, n, body)

    def calibrations(self) -> Iterator[bytes]:
        """The payloads of all calibrations."""
        info = self.sidecar.get("camera_info")
        if info is None:
            return
        columns = decoded(info["columns"], info["messages"])
        for n in range(info["messages"]):
            item = info["calibrations"][columns["variant"][n]]
            roi = {f"roi_{key}": value for key, value in item.get("roi", {}).items()}
            blank = template(info["wire"], info["channel"], {**item, **roi})
            yield filled(info["wire"], info["channel"], blank, columns, n, b"")

    def digests(self) -> list[str]:
        """The digests of all payloads."""
        return str(self.sidecar["digests"]["values"]).split()

    def _blank(self, header: Mapping[str, Any]) -> bytes:
        side = self.sidecar
        return template(side["wire"], side["channel"], {**side["image"], **header})

    def _bodies(self, variants: list[int]) -> Iterator[bytes]:
        side = self.sidecar
        kind, video = side.get("body", "pixels"), side["video"]
        if kind == "packet":
            for n, packet in enumerate(packets(self.video)):
                framing = side["headers"][variants[n]].get("framing", "")
                yield stranger.packet_body(video["codec"], packet, framing)
            return
        image = side["image"]
        size = image["width"], image["height"]
        for n, picture in enumerate(pictures(self.video, video["layout"], image["encoding"])):
            found = stranger.pixels(
                video["layout"], video.get("parameters", {}), image["encoding"], size, picture
            )
            header = side["headers"][variants[n]]
            prefix = bytes.fromhex(header.get("prefix", ""))
            if kind == "pixels":
                big = bool(image["is_bigendian"])
                yield stranger.rows(found, image["step"], header.get("padding"), big_endian=big)
            elif kind == "png":
                yield prefix + stranger.png_file(found, header["png"])
            else:
                assert kind == "rvl"
                yield prefix + stranger.rvl_image(found)


def decoded(columns: Mapping[str, Any], count: int) -> dict[str, list[int]]:
    """All columns, the absent ones with their defaults."""
    found: dict[str, list[int]] = {}
    for name, column in columns.items():
        residuals: list[int] = []
        for token in column["values"].split():
            value, _, times = token.partition("*")
            residuals += [int(value)] * int(times or 1)
        values = [column["start"]]
        for residual in residuals:
            total = (values[-1] + column["step"] + residual + 2**63) % 2**64 - 2**63
            values.append(total)
        assert len(values) == count
        found[name] = values
    zeros = [0] * count
    return {"variant": zeros, "seq": zeros, "pts": zeros, **found}


# ---------------------------------------------------------------- the video


def packets(path: Path) -> Iterator[bytes]:
    """The samples of the video track."""
    with av.open(str(path)) as container:
        for packet in container.demux(video=0):
            if packet.size:
                yield bytes(packet)


def pictures(path: Path, layout: str, encoding: str) -> Iterator[list[Array]]:
    """The pictures of the video, as arrays of the layout's pixel format."""
    places = stranger.quoted(stranger.LAYOUTS[layout][3])
    order = stranger.colours(places, encoding)
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            planes, name = raw_planes(frame), frame.format.name
            if not order:
                yield planes if places in (["planes"], ["yuv"]) else planes[:1]
                continue
            planar = name.startswith("gbr")
            letters = "gbra" if planar else name.removesuffix("24")
            parts = planes if planar else list(np.moveaxis(planes[0], 2, 0))
            yield [np.stack([parts[letters.index(c)] for c in order], axis=2)]


def raw_planes(frame: av.VideoFrame) -> list[Array]:
    """The planes of a frame as arrays, packed colours with a third axis."""
    found = []
    wide = frame.format.name.endswith("le")
    for plane in frame.planes:
        rows = np.frombuffer(bytes(plane), np.uint8).reshape(plane.height, -1)
        if wide:
            rows = rows.view("<u2")
        if len(frame.planes) == 1 and not frame.format.name.startswith("gray"):
            depth = len(frame.format.components)
            depth = 4 if frame.format.name == "bgr0" else depth
            found.append(rows[:, : depth * plane.width].reshape(plane.height, plane.width, depth))
        else:
            found.append(rows[:, : plane.width])
    return found


# ---------------------------------------------------------------- blanks


def template(wire: str, channel: Mapping[str, Any], fields: Mapping[str, Any]) -> bytes:
    """The blank of a header or calibration."""
    if "template" in fields:
        return base64.b64decode(fields["template"])
    cdr = wire != "ros1"
    out = bytearray({"cdr-le": b"\0\1\0\0", "cdr-be": b"\0\0\0\0"}.get(wire, b""))
    order = ">" if wire == "cdr-be" else "<"

    def put(code: str, *values: float) -> None:
        if cdr:
            out.extend(bytes(-(len(out) - 4) % struct.calcsize(code)))
        out.extend(struct.pack(f"{order}{len(values)}{code}", *values))

    def text(value: str) -> None:
        raw = value.encode() + (b"\0" if cdr else b"")
        put("I", len(raw))
        out.extend(raw)

    for name, kind in ROS_TYPES[channel["schema"]["name"].replace("/msg/", "/")]:
        if name in ("header", "timestamp"):
            for _ in range(3 if name == "header" and not cdr else 2):
                put("I", 0)
            if name == "header":
                text(fields["frame_id"])
        elif name == "data":
            put("I", 0)
        elif kind == "string":
            text(fields[name])
        else:
            number, _, length = kind.partition("[")
            value = fields.get(name, 0)
            if length == "]":
                put("I", len(value))
            for item in value if length else [value]:
                put(NUMBERS[number], item)
    return bytes(out)


def filled(
    wire: str,
    channel: Mapping[str, Any],
    blank: bytes,
    columns: Mapping[str, list[int]],
    n: int,
    body: bytes,
) -> bytes:
    """A blank with its slots filled from the columns, and with its body."""
    times = divmod(columns["stamp"][n], 10**9)
    name = channel["schema"]["name"]
    if wire == "protobuf":
        return _protobuf(base64.b64decode(channel["schema"]["base64"]), name, blank, times, body)
    return _ros(wire, name.replace("/msg/", "/"), blank, times, columns, n, body)


def _ros(
    wire: str,
    name: str,
    blank: bytes,
    times: tuple[int, int],
    columns: Mapping[str, list[int]],
    n: int,
    body: bytes,
) -> bytes:
    cdr, order = wire != "ros1", ">" if wire == "cdr-be" else "<"
    out, at = bytearray(blank), 4 if cdr else 0
    start = end = len(blank)

    def skip(size: int, count: int = 1) -> int:
        nonlocal at
        at += -(at - 4) % size if cdr else 0
        found, at = at, at + size * count
        return found

    def length() -> int:
        return int(struct.unpack_from(f"{order}I", blank, skip(4))[0])

    for field, kind in ROS_TYPES[name]:
        if field in ("header", "timestamp"):
            if field == "header" and not cdr:
                struct.pack_into("<I", out, skip(4), columns["seq"][n])
            struct.pack_into(f"{order}{'i' if cdr else 'I'}I", out, skip(4), *times)
            at += 4
            if field == "header":
                skip(1, length())
        elif field == "data":
            kept = length()
            struct.pack_into(f"{order}I", out, at - 4, len(body))
            start, at = at, at + kept
            end = at
        elif kind == "string":
            skip(1, length())
        elif field == "pts":
            struct.pack_into(f"{order}Q", out, skip(8), columns["pts"][n])
        else:
            number, _, many = kind.partition("[")
            count = length() if many == "]" else int(many.rstrip("]") or 1)
            if count:
                skip(struct.calcsize(NUMBERS[number]), count)
    return bytes(out[:start]) + body + bytes(out[end:])


def _varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])


def _protobuf(schema: bytes, name: str, blank: bytes, times: tuple[int, int], body: bytes) -> bytes:
    (message,) = (
        message
        for file in FileDescriptorSet.FromString(schema).file
        for message in file.message_type
        if f"{file.package}.{message.name}" == name
    )
    names = {field.number: field.name for field in message.field}
    sec, nanos = times
    stamp = (b"\x08" + _varint(sec % 2**64) if sec else b"") + (
        b"\x10" + _varint(nanos) if nanos else b""
    )
    slots = {"timestamp": stamp, "data": body}
    out, at = b"", 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            value |= (blank[at] & 127) << shift
            shift, at = shift + 7, at + 1
            if blank[at - 1] < 128:
                return value

    while at < len(blank):
        begin = at
        tag = varint()
        if names.get(tag >> 3) in slots:
            value = slots[names[tag >> 3]]
            out += blank[begin:at] + _varint(len(value)) + value
            at += 1
            continue
        if tag & 7 == 0:
            varint()
        else:
            size = varint() if tag & 7 == 2 else {1: 8, 5: 4}[tag & 7]
            at += size
        out += blank[begin:at]
    return out
