"""Pictures of a video, and the pixels that they hold: layouts, and colours of lossy videos.

A part of the second reader, reader.py. Names and tables are those of spec/registry.md, so that a
mistake there is one here.
"""

from __future__ import annotations

import re
from pathlib import Path

import av
import numpy as np

from documents import RefusedError

SPEC = Path(__file__).resolve().parents[1] / "spec"
CODECS = {"h265": "hevc"}  # others are called as FFmpeg calls them
PACKED = {  # places of G, B, R and alpha
    **dict.fromkeys(("bgr0", "bgr24"), (1, 0, 2)),
    **dict.fromkeys(("rgb0", "rgb24"), (1, 2, 0)),
    "bgra": (1, 0, 2, 3),
    "rgba": (1, 2, 0, 3),
}


def tables(title):
    """The tables of a section of the registry, as cells, without title rows."""
    text = (SPEC / "registry.md").read_text().split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]
    blocks = [block.strip().split("\n")[2:] for block in re.findall(r"(?:^\|.*\n?)+", text, re.M)]
    return [[[cell.strip() for cell in row[1:-1].split("|")] for row in rows] for rows in blocks]


def quoted(cell):
    """The names in backticks."""
    return re.findall(r"`([^`]+)`", cell)


ENCODINGS = {
    name: (int(count), np.dtype(samples))
    for names, channels, samples, *_ in tables("Encodings")[0]
    for name, count in zip(quoted(names), channels.split(", ") * len(quoted(names)), strict=False)
}
LAYOUTS = {quoted(row[0])[0]: row for row in tables("Layouts")[0]}


# ---------------------------------------------------------------- the video


def read_video(path, told):
    """The packets of a video; format and planes of its pictures, unless they do not decode."""
    try:
        with av.open(str(path)) as container:
            (stream,) = container.streams.video
            context = stream.codec_context
            if context.codec.canonical_name != CODECS.get(told["codec"], told["codec"]):
                raise RefusedError("codec-mismatch", path)
            if (context.width, context.height) != (told["width"], told["height"]):
                raise RefusedError("geometry-mismatch", path)
            shown = [packet for packet in container.demux(stream) if packet.size]
            # an edit list gives negative times to what is only needed to decode the rest
            packets = [bytes(packet) for packet in shown if packet.pts >= 0]
    except (av.FFmpegError, ValueError) as error:
        raise RefusedError("video-unreadable", path) from error
    try:
        with av.open(str(path)) as container:
            pictures = [planes_of(frame) for frame in container.decode(video=0) if frame.pts >= 0]
    except av.FFmpegError:
        pictures = []
    if told.get("pixel_format", "").startswith("gray"):  # some decoders make up the chroma
        pictures = [(told["pixel_format"], planes[:1]) for _, planes in pictures]
    names = {name for name, _ in pictures}
    if told.get("pixel_format", "").startswith("yuv") and names - {told["pixel_format"], "gray"}:
        raise RefusedError("codec-mismatch", path)
    return packets, names.pop() if len(names) == 1 else "", [planes for _, planes in pictures]


def has_grain(path):
    """Whether a decoder may add film grain to a picture."""
    with av.open(str(path)) as container:
        container.streams.video[0].codec_context.options = {"export_side_data": "film_grain"}
        return any("FILM_GRAIN_PARAMS" in frame.side_data for frame in container.decode(video=0))


def planes_of(frame):
    """Format and planes of a picture; packed colours as if they were planar."""
    name = frame.format.name.replace("yuvj", "yuv")
    rows = [
        np.frombuffer(plane, "<u2" if name.endswith("le") else "u1").reshape(plane.height, -1)
        for plane in frame.planes
    ]
    if name in PACKED:
        size = 3 if name.endswith("24") else 4
        pixels = rows[0][:, : size * frame.width].reshape(frame.height, frame.width, size)
        planes = [pixels[..., place].copy() for place in PACKED[name]]
        return ("gbrap" if len(planes) == 4 else "gbrp"), planes
    return name, [
        row[:, : plane.width].copy() for row, plane in zip(rows, frame.planes, strict=True)
    ]


# ---------------------------------------------------------------- layouts


def pixels(image, video, planes, prediction=None):
    """The bit patterns of an image, shape (rows, columns, channels), of the planes of a picture.

    Args:
        image: Its `encoding`, `width` and `height`.
        video: Its `layout` and its `parameters`, if it has any; of a lossy one, the `color`.
        planes: Of colours G, B and R, and alpha.
        prediction: What values of a source differ from, as this function gives it.
    """
    encoding, width, height = image["encoding"], image["width"], image["height"]
    channels, samples = ENCODINGS[encoding]
    parameters = video.get("parameters", {})
    row = LAYOUTS[video["layout"]]
    (values,), places = quoted(row[2]), quoted(row[3])
    if values == "tone":
        places = ["colour" if "bayer" in encoding else "plain" if channels == 1 else "rgb"]
    is_colour = places == ["colour"] or not {*"".join(places)} - {*"rgba"}
    if is_colour and "color" in video and len(planes) == 3 and planes[1].shape != planes[0].shape:
        planes = as_gbr(planes, video)
    elif video.get("pixel_format") == "yuv420p10le":
        planes = as_bytes(planes, is_full=video["color"]["range"] == "full")
    patterns = np.dtype(f"u{samples.itemsize}")
    if values in ("converted", "demosaiced") and prediction is not None:
        prediction = _named(prediction, encoding).astype(int)
        if values == "converted":
            both = zip(planes, _yuv_of(prediction, planes), strict=True)
            planes = [(plane + own - 128) % 256 for plane, own in both]
    if values == "converted":
        return _named(_converted(planes, parameters["rule"], (width, height)), encoding)
    count = 3 if values == "opaque" else channels
    placed = _placed(places, parameters, encoding, (width, height), planes, count)
    if values == "demosaiced":
        mosaic, block = placed[..., 0].astype(int), _block(parameters["mosaic"])
        if prediction is not None:
            y, x = np.mgrid[:height, :width]
            mosaic = (mosaic + prediction[y, x, block[y % 2, x % 2]] - 128) % 256
        return _named(_demosaiced(mosaic, block), encoding)
    if values == "whole":
        top = 1 << (8 * samples.itemsize - 1) if samples.kind == "i" else 0
        return placed.astype(patterns) ^ patterns.type(top)
    if values == "bits":
        bits, shift = parameters["bits"], parameters["shift"]
        half = 1 << (bits + shift - 1) if samples.kind == "i" else 0
        return ((placed.astype(np.int64) * 2**shift - half) % 2**16).astype(patterns)
    if values in ("table", "tone"):
        table = np.array(parameters["table"], patterns)
        return table[np.minimum(placed, len(table) - 1)]
    if values == "metres":
        numbers = np.arange(65536).astype("f4")
        factor = np.frombuffer(bytes.fromhex("3a83126f"), ">f4").astype("f4")
        is_product = parameters["scale"] == "product"
        known = (numbers * factor if is_product else numbers / np.float32(1000)).view("u4")
        known[0] = parameters["hole"]
        return known[placed]
    alpha = np.full((*placed.shape[:2], 1), parameters["alpha"], placed.dtype)
    return np.concatenate((placed, alpha), axis=2)  # of "opaque"


def _named(rgb, encoding):
    """Colours in the order of an encoding."""
    return (rgb if encoding.startswith("rgb") else rgb[..., ::-1]).astype(np.uint8)


def _block(name):
    """Numbers of the colours of a mosaic."""
    return np.array(["rgb".index(letter) for letter in name]).reshape(2, 2)


def _yuv_of(rgb, planes):
    """Y, U and V that a prediction stands for, in the sizes of planes."""
    r, g, b = np.moveaxis(rgb, 2, 0)
    (tall, wide), (rows, columns) = planes[0].shape, planes[1].shape
    shape = rows, tall // rows, columns, wide // columns
    r4, g4, b4 = (color.reshape(shape).sum(axis=(1, 3)) for color in (r, g, b))
    count = shape[1] * shape[3]
    u = -38 * r4 - 74 * g4 + 112 * b4 + 0x8080 * count
    v = 112 * r4 - 94 * g4 - 18 * b4 + 0x8080 * count
    return (66 * r + 129 * g + 25 * b + 0x1080) >> 8, u // (256 * count), v // (256 * count)


def _demosaiced(mosaic, block):
    """R, G and B, shape (rows, columns, 3)."""
    if min(mosaic.shape) < 3:
        return np.zeros((*mosaic.shape, 3))
    y, x = np.mgrid[: mosaic.shape[0], : mosaic.shape[1]]
    y, x = (np.clip(place, 1, place.max() - 1) for place in (y, x))
    color, beside = block[y % 2, x % 2], block[y % 2, (x + 1) % 2]
    left, right, above, below = (
        mosaic[y + down, x + across] for down, across in ((0, -1), (0, 1), (-1, 0), (1, 0))
    )
    corners = sum(mosaic[y + down, x + across] for down in (-1, 1) for across in (-1, 1))
    is_green = color == 1
    found = np.empty((*mosaic.shape, 3), int)
    for name in range(3):
        mean = np.where(beside == name, (left + right + 1) >> 1, (above + below + 1) >> 1)
        around = (left + right + above + below + 2) >> 2 if name == 1 else (corners + 2) >> 2
        other = np.where(is_green, mean, around)
        found[..., name] = np.where(color == name, mosaic[y, x], other)
    return found


def _converted(planes, rule, size):
    """R, G and B, shape (rows, columns, 3), of Y, U and V."""
    across, down = (round(a / b) for a, b in zip(planes[0].shape, planes[1].shape, strict=True))
    rows, columns = np.mgrid[: size[1], : size[0]]
    luma = planes[0][rows, columns].astype(int) - 16
    u, v = (plane[rows // across, columns // down].astype(int) - 128 for plane in planes[1:])
    if rule == "opencv":
        z = 1220542 * np.maximum(luma, 0) + 2**19
        r, g, b = z + 1673527 * v, z - 409993 * u - 852492 * v, z + 2116026 * u
        r, g, b = r >> 20, g >> 20, b >> 20
    elif rule == "librealsense":
        y = 298 * luma >> 8
        r, g, b = y + (409 * v >> 8), y - (100 * u >> 8) - (208 * v >> 8), y + (516 * u >> 8)
    else:
        y = 9539 * luma >> 13
        r, b = y + (13075 * v >> 13), y + (16525 * u >> 13)
        g = y + (-3209 * u >> 13) + (-6660 * v >> 13)
    return np.clip(np.stack((r, g, b), axis=2), 0, 255)


def _placed(places, parameters, encoding, size, planes, channels):
    """The values of an image, shape (rows, columns, channels)."""
    (width, height), first = size, planes[0]
    if places == ["plain", "fold", "plain"]:
        places = ["plain"] if len(parameters["table"]) <= 256 else ["fold", "plain"]
    if places[0] == "fold":
        first, places = _unfolded(first, parameters.get("low", 8)), places[1:]
    if places == ["plain"]:
        return first[:height, :width, None]
    if places == ["mosaic"]:
        h, w = -(-height // 2), -(-width // 2)
        y, x = np.mgrid[:height, :width]
        return first[y % 2 * h + y // 2, x % 2 * w + x // 2][..., None]
    if places == ["colour"]:
        colours = encoding.removeprefix("bayer_")[:4]
        y, x = np.mgrid[:height, :width]
        block = np.array(["gbr".index(letter) for letter in colours]).reshape(2, 2)
        return np.stack(planes)[block[y % 2, x % 2], y, x][..., None]
    if places == ["palette"]:
        return _listed(first, parameters["entries"], encoding, height)[..., None]
    if places == ["stack"]:
        return np.stack([first[n * height : (n + 1) * height] for n in range(channels)], axis=2)
    if places == ["bytes"]:
        return _joined(first, width, height, channels, ENCODINGS[encoding][1].itemsize)
    if places[0] in ("yuv", "yuv420"):
        return _interleaved(planes, encoding, width, height, halved=places == ["yuv420"])
    names = (re.match("rgba?|bgra?", encoding) or ["bgra"])[0][:channels]
    return np.stack([planes["gbra".index(name)][:height, :width] for name in names], axis=2)


def _unfolded(picture, low):
    height = len(picture) // 2
    high, folded = picture[:height].astype(np.int64), picture[height : 2 * height].astype(np.int64)
    return high * 2**low + np.where(high % 2, 2**low - 1 - folded, folded)


def _listed(picture, entries, encoding, height):
    rows = height if entries <= 256 else 2 * height
    numbers = picture[:height] if entries <= 256 else _unfolded(picture[:rows], 8)
    size = ENCODINGS[encoding][1].itemsize
    listed = picture[rows:].ravel()[: entries * size].reshape(size, entries).astype(np.uint64)
    known = sum(listed[n] * np.uint64(256 ** (size - 1 - n)) for n in range(size))
    return np.asarray(known)[np.minimum(numbers, entries - 1)]


def _joined(picture, width, height, channels, size):
    y, x, c = np.mgrid[:height, :width, :channels]
    total = np.zeros(y.shape, np.uint64)
    for i in range(size):
        part = picture[(2 * c + i // (size // 2)) * height + y, i % (size // 2) * width + x]
        total = total * np.uint64(256) + part
    return total


def _interleaved(planes, encoding, width, height, *, halved):
    luma, chroma = planes[0][:height, :width], planes[1:]
    if halved:
        chroma = [plane.repeat(2, axis=0)[:height] for plane in chroma]
    if encoding.startswith("nv"):
        if halved:
            chroma = [plane.repeat(2, axis=1)[:, :width] for plane in chroma]
        both = np.stack(chroma[::-1] if encoding == "nv21" else chroma, axis=2)
        return np.concatenate((luma, both.reshape(-1, width)))[..., None]
    both = np.stack(chroma, axis=2)[:, : width // 2].reshape(height, width)
    is_luma_first = encoding.startswith("yuyv") or "yuy2" in encoding
    return np.stack((luma, both) if is_luma_first else (both, luma), axis=2)


# ---------------------------------------------------------------- colours of lossy videos

SHARES = {"bt709": (0.2126, 0.0722), "smpte170m": (0.299, 0.114)}


def as_gbr(planes, video):
    """G, B and R of a lossy picture."""
    bits = 8 + 2 * ("10" in video["pixel_format"])
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
    light = _product((planes[0].astype(np.int64) - black) << (15 - bits), luma) + 16
    u, v = (_full_size(plane.astype(np.int64), light.shape, bits) for plane in planes[1:])
    found = (
        light - _product(u, green_u) - _product(v, green_v),
        light + _product(u, blue),
        light + _product(v, red),
    )
    return [np.clip(values >> 5, 0, 255).astype(np.uint8) for values in found]


def as_bytes(planes, *, is_full):
    """Planes of 10 bits in 8."""
    found = []
    for plane, middle in zip(planes, (0, 128, 128), strict=False):
        values = plane.astype(np.int64) - 4 * middle
        narrow = np.rint(values * 255 / 1023 if is_full else values / 4)  # ties to even
        found.append(np.clip(narrow + middle, 0, 255).astype(np.uint8))
    return found


def _product(a, k):
    return (a * k + 2**14) >> 15


def _full_size(plane, shape, bits):
    """Chroma of each pixel."""
    half = (_between(plane - 2 ** (bits - 1), shape[0]) + 2 ** (bits - 6)) >> (bits - 5)
    return _between(half.T, shape[1]).T


def _between(rows, count):
    """So many rows of twice as many, 32 times what is there."""
    place = np.arange(count)
    near, side = place // 2, np.where(place % 2, 1, -1)
    a, b, c, d = (rows[np.clip(near + side * far, 0, len(rows) - 1)] for far in (0, 1, -1, 2))
    return 28 * a + 8 * b - 3 * c - d
