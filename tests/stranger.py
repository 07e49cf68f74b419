"""A reader written from spec/ alone: what pixels and bodies are made of, without mp4ds.

Names and tables are read from spec/registry.md, so that a mistake there is one here.
"""

from __future__ import annotations

import base64
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SPEC = Path(__file__).parents[1] / "spec"
Array = NDArray[Any]


def tables(title: str) -> list[list[list[str]]]:
    """The tables of a section of the registry, as cells, without title rows."""
    text = (SPEC / "registry.md").read_text().split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]
    blocks = [block.strip().split("\n")[2:] for block in re.findall(r"(?:^\|.*\n?)+", text, re.M)]
    return [[[cell.strip() for cell in row[1:-1].split("|")] for row in rows] for rows in blocks]


def quoted(cell: str) -> list[str]:
    """The names in backticks."""
    return re.findall(r"`([^`]+)`", cell)


ENCODINGS = {
    name: (int(count), np.dtype(samples))
    for names, channels, samples, *_ in tables("Encodings")[0]
    for name, count in zip(quoted(names), channels.split(", ") * len(quoted(names)), strict=False)
}
LAYOUTS = {quoted(row[0])[0]: row for row in tables("Layouts")[0]}
RULES = {quoted(row[0])[0]: row[1:] for row in tables("PNG files")[0]}


# ---------------------------------------------------------------- layouts


def pixels(
    layout: str,
    parameters: Mapping[str, Any],
    encoding: str,
    size: tuple[int, int],
    picture: Sequence[Array],
) -> Array:
    """The bit patterns of an image, shape (rows, columns, channels).

    Args:
        layout: Name of the layout.
        parameters: Of the layout.
        encoding: Of the image.
        size: Width and height of the image.
        picture: One array, or one for each plane.
    """
    channels, samples = ENCODINGS[encoding]
    row = LAYOUTS[layout]
    (values,) = quoted(row[2])
    patterns = np.dtype(f"u{samples.itemsize}")
    count = 3 if values == "opaque" else channels
    placed = _placed(quoted(row[3]), parameters, encoding, size, picture, count)
    if values == "whole":
        top = 1 << (8 * samples.itemsize - 1) if samples.kind == "i" else 0
        return placed.astype(patterns) ^ patterns.type(top)
    if values == "bits":
        bits, shift = parameters["bits"], parameters["shift"]
        half = 1 << (bits + shift - 1) if samples.kind == "i" else 0
        return ((placed.astype(np.int64) * 2**shift - half) % 2**16).astype(patterns)
    if values == "table":
        table = np.array(parameters["table"], patterns)
        return table[np.minimum(placed, len(table) - 1)]
    if values == "metres":
        numbers = np.arange(65536).astype("f4")
        factor = np.frombuffer(bytes.fromhex("3a83126f"), ">f4").astype("f4")
        floats = (
            numbers * factor if parameters["scale"] == "product" else numbers / np.float32(1000)
        )
        known = floats.astype("f4").view("u4")
        known[0] = parameters["hole"]
        return known[placed]
    assert values == "opaque"
    alpha = np.full((*placed.shape[:2], 1), parameters["alpha"], placed.dtype)
    return np.concatenate((placed, alpha), axis=2)


def _placed(
    places: list[str],
    parameters: Mapping[str, Any],
    encoding: str,
    size: tuple[int, int],
    picture: Sequence[Array],
    channels: int,
) -> Array:
    """The values of an image, shape (rows, columns, channels)."""
    (width, height), first = size, picture[0]
    bits, low = parameters.get("bits", 16), parameters.get("low", 8)
    if places == ["plain"] or (places == ["plain", "fold", "plain"] and _is_short(parameters)):
        return first[..., None]
    if places == ["fold", "plain"] or places == ["plain", "fold", "plain"]:
        return _unfolded(first, bits, low)[..., None]
    if places == ["mosaic"]:
        return _unmosaiced(first, width, height)[..., None]
    if places == ["fold", "mosaic"]:
        return _unmosaiced(_unfolded(first, bits, low), width, height)[..., None]
    if places == ["palette"]:
        return _listed(first, parameters["entries"], encoding, height)[..., None]
    if places == ["stack"]:
        return np.stack([first[n * height : (n + 1) * height] for n in range(channels)], axis=2)
    if places == ["bytes"]:
        return _joined(first, width, height, channels, ENCODINGS[encoding][1].itemsize)
    if places == ["yuv"]:
        return _interleaved(picture, encoding, width, height)
    names, order = channel_names(encoding), colours(places, encoding) or "gbra"
    planes = list(np.moveaxis(first, 2, 0)) if colours(places, encoding) else list(picture)
    return np.stack([planes[order.index(name)] for name in names[:channels]], axis=2)


def _is_short(parameters: Mapping[str, Any]) -> bool:
    return len(parameters["table"]) <= 256


def colours(places: list[str], encoding: str) -> str:
    """The order of the channels of a picture, or nothing if it is not of colours."""
    orders = [place for place in places if set(place) <= set("rgba")]
    return next((order for order in orders if channel_names(encoding).startswith(order)), "")


def channel_names(encoding: str) -> str:
    """A letter for each channel."""
    found = re.match("rgba?|bgra?", encoding)
    return found.group() if found else "bgra"


def _unfolded(picture: Array, bits: int, low: int) -> Array:
    height = len(picture) // 2
    high, folded = picture[:height].astype(np.int64), picture[height:].astype(np.int64)
    assert high.max() < 2 ** (bits - low)
    assert folded.max() < 2**low
    return high * 2**low + np.where(high % 2, 2**low - 1 - folded, folded)


def _unmosaiced(picture: Array, width: int, height: int) -> Array:
    h, w = -(-height // 2), -(-width // 2)
    y, x = np.mgrid[:height, :width]
    return picture[y % 2 * h + y // 2, x % 2 * w + x // 2]


def _listed(picture: Array, entries: int, encoding: str, height: int) -> Array:
    rows = height if entries <= 256 else 2 * height
    numbers = picture[:height] if entries <= 256 else _unfolded(picture[:rows], 16, 8)
    size = ENCODINGS[encoding][1].itemsize
    listed = picture[rows:].ravel()[: entries * size].reshape(size, entries).astype(np.uint64)
    known = sum(listed[n] * np.uint64(256 ** (size - 1 - n)) for n in range(size))
    return np.asarray(known)[np.minimum(numbers, entries - 1)]


def _joined(picture: Array, width: int, height: int, channels: int, size: int) -> Array:
    y, x, c = np.mgrid[:height, :width, :channels]
    total = np.zeros(y.shape, np.uint64)
    for i in range(size):
        part = picture[(2 * c + i // (size // 2)) * height + y, i % (size // 2) * width + x]
        total = total * np.uint64(256) + part
    return total


def _interleaved(picture: Sequence[Array], encoding: str, width: int, height: int) -> Array:
    luma, u, v = picture
    if encoding.startswith("nv"):
        both = np.stack((v, u) if encoding == "nv21" else (u, v), axis=2)
        return np.concatenate((luma, both.reshape(-1, width)))[..., None]
    chroma = np.stack((u, v), axis=2).reshape(height, width)
    return np.stack(
        (luma, chroma) if encoding.startswith("yuyv") or "yuy2" in encoding else (chroma, luma),
        axis=2,
    )


def rows(patterns: Array, step: int, padding: str | None, *, big_endian: bool) -> bytes:
    """The body of an image message: rows of so many bytes."""
    ordered = patterns.astype(patterns.dtype.newbyteorder(">" if big_endian else "<"))
    raw = np.frombuffer(ordered.tobytes(), np.uint8).reshape(len(patterns), -1)
    if padding is None:
        return np.pad(raw, ((0, 0), (0, step - raw.shape[1]))).tobytes()
    between, size = zlib.decompress(base64.b64decode(padding)), step - raw.shape[1]
    return b"".join(row.tobytes() + between[n * size : (n + 1) * size] for n, row in enumerate(raw))


# ---------------------------------------------------------------- bodies


def png_file(patterns: Array, recipe: Mapping[str, Any]) -> bytes:
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


def _chunk(body: bytes) -> bytes:
    return struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))


def _filtered(lines: Array, pixel: int, rule: str) -> bytes:
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


def _filter(line: Array, above: Array, pixel: int, kind: int) -> Array:
    left, corner = (
        np.concatenate((np.zeros(pixel, np.uint8), part[:-pixel])) for part in (line, above)
    )
    a, b, c = (part.astype(int) for part in (left, above, corner))
    near = np.abs(np.stack((b - c, a - c, a + b - 2 * c)))
    paeth = np.choose(np.argmin(near, axis=0), (a, b, c))  # the first of equally near ones
    predicted = (np.zeros_like(a), a, b, (a + b) // 2, paeth)[kind]
    return (line - predicted).astype(np.uint8)


def rvl_image(patterns: Array) -> bytes:
    """An RVL image of pixels, shape (rows, columns, 1)."""
    values = patterns.ravel().tolist()
    numbers: list[int] = []
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
    nibbles: list[int] = []
    for number in numbers:
        while number > 7:
            nibbles.append(number % 8 + 8)
            number //= 8
        nibbles.append(number)
    nibbles += [0] * (-len(nibbles) % 8)
    words = ["".join(f"{n:x}" for n in nibbles[i : i + 8]) for i in range(0, len(nibbles), 8)]
    head = struct.pack("<II", patterns.shape[1], patterns.shape[0])
    return head + b"".join(struct.pack("<I", int(word, 16)) for word in words)


def packet_body(codec: str, packet: bytes, framing: str) -> bytes:
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
    assert at == len(packet)
    return body + bytes(trailing)
