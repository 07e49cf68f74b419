"""What messages are built from: blanks of all serializations, bodies, and messages.mcap.

A part of the second reader, reader.py.
"""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.exceptions import McapError
from mcap.reader import make_reader

from documents import RefusedError
from images import quoted, tables

FIELDS = {
    quoted(row[0])[0]: [field.partition(": ")[::2] for field in row[1].split(", ")]
    for row in tables("Message types")[0]
}
NUMBERS = {"uint8": "B", "int32": "i", "uint32": "I", "uint64": "Q", "float64": "d"}
RULES = {quoted(row[0])[0]: row[1:] for row in tables("PNG files")[0]}


# ---------------------------------------------------------------- blanks


def template(wire, channel, fields):
    """The blank of a header or calibration."""
    if "template" in fields:
        return base64.b64decode(fields["template"])
    cdr = wire != "ros1"
    out = bytearray({"cdr-le": b"\0\1\0\0", "cdr-be": b"\0\0\0\0"}.get(wire, b""))
    order = ">" if wire == "cdr-be" else "<"

    def put(code, *values):
        if cdr:
            out.extend(bytes(-(len(out) - 4) % struct.calcsize(code)))
        out.extend(struct.pack(f"{order}{len(values)}{code}", *values))

    def text(value):
        raw = value.encode() + (b"\0" if cdr else b"")
        put("I", len(raw))
        out.extend(raw)

    for name, kind in FIELDS[channel["schema"]["name"].replace("/msg/", "/")]:
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


def filled(wire, channel, blank, columns, n, body=b""):
    """A blank with its slots filled from entry `n` of the columns, and with its body."""
    times = divmod(columns["stamp"][n], 10**9)
    name = channel["schema"]["name"]
    if wire == "protobuf":
        return _protobuf(base64.b64decode(channel["schema"]["base64"]), name, blank, times, body)
    cdr, order = wire != "ros1", ">" if wire == "cdr-be" else "<"
    out, at = bytearray(blank), 4 if cdr else 0
    start = end = len(blank)

    def skip(size, count=1):
        nonlocal at
        at += -(at - 4) % size if cdr else 0
        found, at = at, at + size * count
        return found

    def length():
        return struct.unpack_from(f"{order}I", blank, skip(4))[0]

    for field, kind in FIELDS[name.replace("/msg/", "/")]:
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


def _protobuf(schema, name, blank, times, body):
    (message,) = (
        message
        for file in FileDescriptorSet.FromString(schema).file
        for message in file.message_type
        if f"{file.package}.{message.name}" == name
    )
    names = {field.number: field.name for field in message.field}
    sec, nanos = times
    stamp = b"\x08" + _varint(sec % 2**64) if sec else b""
    stamp += b"\x10" + _varint(nanos) if nanos else b""
    slots = {"timestamp": stamp, "data": body}
    out, at = b"", 0

    def varint():
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


def _varint(value):
    out = b""
    while value > 127:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])


# ---------------------------------------------------------------- bodies


def rows(patterns, step, padding, *, big_endian):
    """The body of an image message: rows of so many bytes."""
    ordered = patterns.astype(patterns.dtype.newbyteorder(">" if big_endian else "<"))
    raw = np.frombuffer(ordered.tobytes(), np.uint8).reshape(len(patterns), -1)
    if padding is None:
        return np.pad(raw, ((0, 0), (0, step - raw.shape[1]))).tobytes()
    between, size = zlib.decompress(base64.b64decode(padding)), step - raw.shape[1]
    return b"".join(row.tobytes() + between[n * size : (n + 1) * size] for n, row in enumerate(raw))


def png_file(patterns, recipe):
    """A PNG file of pixels, shape (rows, columns, channels)."""
    height, width, channels = patterns.shape
    size = patterns.dtype.itemsize
    color = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    head = struct.pack(">4sIIBBBBB", b"IHDR", width, height, 8 * size, color, 0, 0, 0)
    lines = patterns.astype(f">u{size}").reshape(height, -1).view(np.uint8)
    deflate = zlib.compressobj(
        recipe["level"], 8, recipe["window_bits"], recipe["memory_level"], recipe["strategy"]
    )
    data = deflate.compress(_filtered(lines, channels * size, recipe["filters"])) + deflate.flush()
    data = bytes.fromhex(recipe["zlib_header"]) + data[2:]
    part = recipe["chunk_bytes"] or len(data)
    parts = [b"IDAT" + data[at : at + part] for at in range(0, len(data), part)]
    before, after = (base64.b64decode(recipe.get(key, "")) for key in ("before", "after"))
    chunks = [_chunk(body) for body in (head, *parts)]
    return b"\x89PNG\r\n\x1a\n" + chunks[0] + before + b"".join(chunks[1:]) + after


def _chunk(body):
    return struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))


def _filtered(lines, pixel, rule):
    tried, first = RULES[rule]
    kinds = [int(kind) for kind in tried.split(", ")]
    if rule.startswith("libpng"):
        left_out = ({2, 3, 4} if len(lines) == 1 else set()) | (
            {1, 3, 4} if lines.shape[1] == pixel else set()
        )
        kinds = [kind for kind in kinds if kind not in left_out]
    out = b""
    above = np.zeros(lines.shape[1], np.uint8)
    for number, line in enumerate(lines):
        choice = kinds if number or first == "as the others" else [int(first)]
        made = [(_filter(line, above, pixel, kind), kind) for kind in choice]
        weight = 1 if rule == "ffmpeg-mixed" else 0
        sums = [np.abs(row.view(np.int8).astype(int)).sum() + weight * kind for row, kind in made]
        row, kind = made[int(np.argmin(sums))]
        out += bytes([kind]) + row.tobytes()
        above = line
    return out


def _filter(line, above, pixel, kind):
    left, corner = (
        np.concatenate((np.zeros(pixel, np.uint8), part[:-pixel])) for part in (line, above)
    )
    a, b, c = (part.astype(int) for part in (left, above, corner))
    near = np.abs(np.stack((b - c, a - c, a + b - 2 * c)))
    paeth = np.choose(np.argmin(near, axis=0), (a, b, c))  # the first of equally near ones
    predicted = (np.zeros_like(a), a, b, (a + b) // 2, paeth)[kind]
    return (line - predicted).astype(np.uint8)


def rvl_image(patterns):
    """An RVL image of pixels, shape (rows, columns, 1)."""
    values = patterns.ravel().tolist()
    numbers = []
    at = last = 0
    while at < len(values):
        zeros = next((n for n, v in enumerate(values[at:]) if v), len(values) - at)
        run = values[at + zeros :]
        run = run[: next((n for n, v in enumerate(run) if not v), len(run))]
        numbers += [zeros, len(run)]
        for value in run:
            d, last = value - last, value
            numbers.append(2 * d if d >= 0 else -2 * d - 1)
        at += zeros + len(run)
    nibbles = []
    for number in numbers:
        while number > 7:
            nibbles.append(number % 8 + 8)
            number //= 8
        nibbles.append(number)
    nibbles += [0] * (-len(nibbles) % 8)
    words = ["".join(f"{n:x}" for n in nibbles[i : i + 8]) for i in range(0, len(nibbles), 8)]
    head = struct.pack("<II", patterns.shape[1], patterns.shape[0])
    return head + b"".join(struct.pack("<I", int(word, 16)) for word in words)


def packet_body(codec, packet, framing):
    """The body whose packet a video has."""
    if codec == "av1":
        return (b"\x12\x00" if framing == "td" else b"") + packet
    if codec not in ("h264", "h265"):
        return packet
    body, at = b"", 0
    items = framing.split(" ")
    trailing = int(items.pop()) if items[-1].startswith("+") else 0
    for item in items:
        (size,) = struct.unpack_from(">I", packet, at)
        body += bytes(int(item) - 1) + b"\x01" + packet[at + 4 : at + 4 + size]
        at += 4 + size
    if at != len(packet):
        raise ValueError("a framing of another packet")
    return body + bytes(trailing)


# ---------------------------------------------------------------- messages.mcap


def messages_by_channel(path):
    """Messages of each channel by the file's summary, and of attachments and metadata records."""
    if not path.is_file() or not path.stat().st_size:
        raise RefusedError("file-missing", path)
    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, struct.error, ValueError) as error:
        raise RefusedError("messages-unreadable", path) from error
    if summary is None or summary.statistics is None:
        raise RefusedError("messages-unreadable", path)
    found, counts = [], summary.statistics.channel_message_counts
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        named = (schema.name, schema.encoding, schema.data) if schema else None
        identity = channel.topic, channel.message_encoding, named, channel.metadata
        found.append((identity, counts.get(channel.id, 0)))
    return found, (summary.statistics.attachment_count, summary.statistics.metadata_count)
