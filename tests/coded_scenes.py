"""Recordings of cameras whose messages hold coded pictures or video packets.

`CODED` names a scene for each kind of message that real cameras, image transports and Foxglove
publish, and for what goes wrong in them::

    paths = SOURCES["mcap-ros2-zstd"](folder, CODED["jpeg-rgb"](frames=10))

All of their types exist in ROS 1 and ROS 2. Nothing here uses mp4ds, so that its tests have an
independent source.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import cv2
import numpy as np

import encoders
from definitions import CODED_VIDEO, COMPRESSED, INFO, PACKET
from encoders import GOP, Packet, Pixels, compressed_depth, cv, packets, pillow, quantised
from pictures import picture
from scenes import Record, Scene, calibration, instant, together

ODD = 3  # number of the message that is unlike the others, where a scene has one
FRAMES, WIDTH, HEIGHT = 10, 64, 48


class MakeScene(Protocol):
    """Frames and the size in pixels can be chosen; `seed` is that of the noise and the times."""

    def __call__(
        self, *, frames: int = FRAMES, width: int = WIDTH, height: int = HEIGHT, seed: int = 0
    ) -> Scene: ...


# ---------------------------------------------------------------- sensor_msgs/CompressedImage

Data = Callable[[int, Callable[..., Pixels]], bytes]
"""The n-th message's data, made of pictures: a function of their encoding (and options)."""


def _images(
    data: Data,
    told: str | Sequence[str],
    *,
    suffix: str = "compressed",
    frames: int = FRAMES,
    width: int = WIDTH,
    height: int = HEIGHT,
    seed: int = 0,
) -> Scene:
    """Messages on ``/cam/image_raw/SUFFIX``, with a calibration each.

    Args:
        data: Makes the data.
        told: The field ``format``; of several, each message has the next.
        suffix: Last part of the topic.
        frames: Number of images.
        width: Pixels.
        height: Pixels.
        seed: Of the noise and the jitter of the times.
    """
    rng = np.random.default_rng(seed)
    told = [told] if isinstance(told, str) else told
    groups = []
    for n in range(frames):
        stamp, log = instant(n, rng)
        made = partial(picture, frame=n, width=width, height=height, rng=rng)
        header = {"seq": n, "stamp": stamp, "frame_id": "cam"}
        values = {"header": header, "format": told[n % len(told)], "data": data(n, made)}
        size = {"header": header, "height": height, "width": width}
        groups.append(
            [
                Record(f"/cam/image_raw/{suffix}", COMPRESSED, log, values),
                Record("/cam/camera_info", INFO, log + 90_000, size | calibration(width, height)),
            ]
        )
    return together(groups)


def _cv_jpeg(n: int, made: Callable[..., Pixels], *, encoding: str = "bgr8") -> bytes:
    return cv(made(encoding), ".jpg", cv2.IMWRITE_JPEG_QUALITY, 80)


def _pillow_jpeg(
    n: int, made: Callable[..., Pixels], *, encoding: str = "rgb8", **options: Any
) -> bytes:
    return pillow(made(encoding), "JPEG", **options)


def _mixed_jpeg(n: int, made: Callable[..., Pixels]) -> bytes:
    pixels = made("bgr8")
    return cv(pixels[::2, ::2] if n >= 2 * ODD else pixels, ".jpg")


def _jpeg_and_more(n: int, made: Callable[..., Pixels]) -> bytes:
    trailer = b"\0" * 7 if n % 2 else b"MAKER\xff\xd8\xff\xd9 note"
    return pillow(made("rgb8"), "JPEG", exif=encoders.exif(), comment=b"lens 2") + trailer


def _odd_one(n: int, made: Callable[..., Pixels], *, change: Callable[[bytes], bytes]) -> bytes:
    data = _cv_jpeg(n, made)
    return change(data) if n == ODD else data


def _truncated(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


def _broken_scan(data: bytes) -> bytes:
    return data[:-200] + bytes(150) + data[-50:]


def _cv_png(n: int, made: Callable[..., Pixels], *, encoding: str, level: int = -1) -> bytes:
    options = () if level < 0 else (cv2.IMWRITE_PNG_COMPRESSION, level)
    return cv(made(encoding), ".png", *options)


def _pillow_png(n: int, made: Callable[..., Pixels], *, encoding: str, mode: str = "") -> bytes:
    return pillow(made(encoding), "PNG", mode=mode)


def _depth(n: int, made: Callable[..., Pixels], *, encoding: str, codec: str) -> bytes:
    if encoding == "32FC1":
        inverse, parameters = quantised(made("32FC1"))
        return compressed_depth(inverse, codec, parameters)
    unset = struct.pack("<II", 0x7FA00000, 0x80001234 + n)  # a signalling NaN, a denormal
    return compressed_depth(made("16UC1") >> 2, codec, unset)


_JPEG_FORMATS = {
    "plain": ("jpeg", "bgr8"),
    "jpg": ("jpg", "bgr8"),
    "upper": ("JPEG", "bgr8"),
    "rgb8": ("rgb8; jpeg compressed bgr8", "bgr8"),
    "bgr8": ("bgr8; jpeg compressed bgr8", "bgr8"),
    "bayer": ("bayer_rggb8; jpeg compressed ", "bayer_rggb8"),
    "mono8": ("mono8; jpeg compressed ", "mono8"),
    "empty": ("", "bgr8"),
    "vendor": ("jpeg; q=80; \u00e4", "bgr8"),
}
_PNG_ENCODINGS = {"rgb": "bgr8", "gray": "mono8", "16-bit": "mono16", "rgba": "bgra8"}
_BGR = "bgr8; jpeg compressed bgr8"

_IMAGES: dict[str, MakeScene] = {
    "jpeg-rgb": partial(_images, _cv_jpeg, _BGR),
    "jpeg-gray": partial(_images, partial(_cv_jpeg, encoding="mono8"), "mono8; jpeg compressed "),
    "jpeg-pillow-gray": partial(_images, partial(_pillow_jpeg, encoding="mono8"), "jpeg"),
    "jpeg-420": partial(_images, partial(_pillow_jpeg, subsampling=2, optimize=True), "jpeg"),
    "jpeg-422": partial(_images, partial(_pillow_jpeg, subsampling=1), "jpeg"),
    "jpeg-444": partial(_images, partial(_pillow_jpeg, subsampling=0, quality=95), "jpeg"),
    "jpeg-progressive": partial(_images, partial(_pillow_jpeg, progressive=True), "jpeg"),
    "jpeg-restart": partial(_images, partial(_pillow_jpeg, restart_marker_blocks=3), "jpeg"),
    "jpeg-no-huffman-tables": partial(
        _images, lambda n, made: encoders.without_huffman_tables(_cv_jpeg(n, made)), "jpeg"
    ),
    "jpeg-mixed-sizes": partial(_images, _mixed_jpeg, _BGR),
    "jpeg-exif-trailing": partial(_images, _jpeg_and_more, "jpeg"),
    "jpeg-cut-one": partial(_images, partial(_odd_one, change=_truncated), _BGR),
    "jpeg-corrupt-one": partial(_images, partial(_odd_one, change=_broken_scan), _BGR),
    "jpeg-empty-one": partial(_images, partial(_odd_one, change=lambda data: b""), _BGR),
    **{
        f"jpeg-format-{name}": partial(_images, partial(_cv_jpeg, encoding=encoding), told)
        for name, (told, encoding) in _JPEG_FORMATS.items()
    },
    "jpeg-format-changes": partial(_images, _cv_jpeg, ["jpeg", _BGR, "rgb8; jpeg compressed bgr8"]),
    **{
        f"png-{kind}-cv2{'' if level < 0 else '-9'}": partial(
            _images,
            partial(_cv_png, encoding=encoding, level=level),
            f"{encoding}; png compressed {'bgr8' if kind == 'rgb' else ''}",
        )
        for kind, encoding in _PNG_ENCODINGS.items()
        for level in (-1, 9)
    },
    **{
        f"png-{kind}-pillow": partial(
            _images, partial(_pillow_png, encoding=encoding.replace("bgr", "rgb")), "png"
        )
        for kind, encoding in _PNG_ENCODINGS.items()
    },
    "png-palette": partial(_images, partial(_pillow_png, encoding="rgb8", mode="P"), "png"),
    "png-1-bit": partial(_images, partial(_pillow_png, encoding="mono8", mode="1"), "png"),
    "png-called-jpeg": partial(_images, partial(_cv_png, encoding="bgr8"), "jpeg"),
    "jpeg-called-png": partial(_images, _cv_jpeg, "png"),
    **{
        f"depth-{encoding}-{codec}": partial(
            _images,
            partial(_depth, encoding=encoding, codec=codec),
            f"{encoding}; compressedDepth {codec}",
            suffix="compressedDepth",
        )
        for encoding in ("16UC1", "32FC1")
        for codec in ("png", "rvl")
    },
    "depth-16UC1-unnamed": partial(
        _images,
        partial(_depth, encoding="16UC1", codec="png"),
        "16UC1; compressedDepth",
        suffix="compressedDepth",
    ),
}
_OTHERS: dict[str, MakeScene] = {
    "jpeg-cmyk": partial(_images, partial(_pillow_jpeg, mode="CMYK"), "jpeg"),
    "webp": partial(_images, lambda n, made: cv(made("bgr8"), ".webp"), "webp"),
    "tiff": partial(_images, lambda n, made: cv(made("bgr8"), ".tiff"), "bgr8; tiff compressed "),
    "gif": partial(_images, lambda n, made: pillow(made("mono8"), "GIF"), "gif"),
    "garbage": partial(_images, lambda n, made: made("64FC4").tobytes()[: 999 + n], "jpeg"),
    "empty": partial(_images, lambda n, made: b"", "jpeg"),
    "depth-header-only": partial(
        _images,
        lambda n, made: bytes(max(0, 12 - n)),
        "16UC1; compressedDepth png",
        suffix="compressedDepth",
    ),
}

# ---------------------------------------------------------------- video packets

Change = Callable[[list[Packet]], list[Packet]]


def _each(edit: Callable[[Packet], Packet]) -> Change:
    return lambda given: [edit(packet) for packet in given]


def _headers_once(given: list[Packet]) -> list[Packet]:
    return [given[0], *map(encoders.without_parameters, given[1:])]


def _video(
    recipe: str,
    told: str,
    change: Change = lambda given: given,
    *,
    msgtype: str = CODED_VIDEO,
    frames: int = FRAMES,
    width: int = WIDTH,
    height: int = HEIGHT,
    seed: int = 0,
    resized: bool = False,
) -> Scene:
    """Packets as foxglove_msgs/CompressedVideo, or as FFMPEGPacket, in coding order.

    A packet's header stamp is that of the frame that it shows.

    Args:
        recipe: One of `encoders.RECIPES`.
        told: The field ``format``, or ``encoding`` of FFMPEGPacket.
        change: What happens to the packets on their way.
        msgtype: Of the messages.
        frames: Number of frames.
        width: Pixels.
        height: Pixels.
        seed: Of the noise and the jitter of the times.
        resized: The second half is of half the size.
    """
    make = partial(packets, recipe, seed=seed)
    if resized:
        first = make(frames=frames // 2, width=width, height=height)
        then = make(frames=frames - frames // 2, width=width // 2, height=height // 2)
        coded = [*first, *(Packet(p.data, p.number + len(first), p.is_key) for p in then)]
    else:
        coded = make(frames=frames, width=width, height=height)
    rng = np.random.default_rng(seed)
    times = [instant(n, rng) for n in range(frames)]
    groups, log = [], 0
    for n, packet in enumerate(change(list(coded))):
        stamp, done = times[packet.number]
        log = max(log + 200_000, done)
        header = {"seq": n, "stamp": stamp, "frame_id": "cam"}
        size = {"header": header, "height": height, "width": width}
        if msgtype == PACKET:
            values = size | {"encoding": told, "pts": packet.number, "data": packet.data}
            image = Record("/cam/image_raw/ffmpeg", PACKET, log, values | {"flags": packet.is_key})
        else:
            values = {"timestamp": stamp, "frame_id": "cam", "format": told, "data": packet.data}
            image = Record("/cam/video", CODED_VIDEO, log, values)
        info = Record("/cam/camera_info", INFO, log + 90_000, size | calibration(width, height))
        groups.append([image, info])
    return together(groups)


_FFMPEG = {  # what the field `encoding` says -> recipe
    "libx264": "h264",
    "h264;yuv420p;bgr8;bgr8": "h264",
    "h264_nvenc": "h264",
    "libx265": "h265",
    "hevc;yuv420p;bgr8;rgb8": "h265",
    "hevc_nvenc": "h265",
    "libsvtav1": "av1",
    "av1;yuv420p;bgr8;bayer_rggb8": "av1",
    "mjpeg;yuvj420p;bgr8;bgr8": "mjpeg",
}
_VIDEOS: dict[str, MakeScene] = {
    "video-h264": partial(_video, "h264", "h264"),
    "video-h264-slices": partial(_video, "h264-slices", "h264"),
    "video-h264-aud-sei": partial(_video, "h264", "h264", _each(encoders.with_aud_and_sei)),
    **{
        f"video-h264-{n}-byte": partial(
            _video, "h264", "h264", _each(partial(encoders.with_start_codes, length=n))
        )
        for n in (3, 4)
    },
    "video-h264-headers-once": partial(_video, "h264", "h264", _headers_once),
    "video-h264-headers-apart": partial(_video, "h264", "h264", encoders.parameters_apart),
    "video-h264-resized": partial(_video, "h264", "h264", resized=True),
    "video-h265": partial(_video, "h265", "h265"),
    "video-h265-called-hevc": partial(_video, "h265", "hevc"),
    "video-av1": partial(_video, "av1", "av1"),
    "video-av1-no-delimiter": partial(_video, "av1", "av1", _each(encoders.without_delimiter)),
    **{
        f"video-{codec}-mid-gop": partial(_video, codec, codec, lambda given: given[GOP // 2 :])
        for codec in ("h264", "h265", "av1")
    },
    **{
        f"video-{codec}-lost": partial(
            _video, codec, codec, lambda given: [*given[: GOP + 1], *given[GOP + 2 :]]
        )
        for codec in ("h264", "h265", "av1")
    },
    "video-h264-bframes": partial(_video, "h264-bframes", "h264"),
    "video-h265-bframes": partial(_video, "h265-bframes", "h265"),
    **{
        f"ffmpeg-{told.replace(';', '-')}": partial(_video, recipe, told, msgtype=PACKET)
        for told, recipe in _FFMPEG.items()
    },
    "ffmpeg-libx264-bframes": partial(_video, "h264-bframes", "libx264", msgtype=PACKET),
}
_OTHERS |= {
    "video-h264-avcc": partial(_video, "h264", "h264", _each(encoders.length_prefixed)),
    "video-vp9": partial(_video, "vp9", "vp9"),
    "ffmpeg-unknown": partial(_video, "h264", "vendor codec", msgtype=PACKET),
    "video-empty": partial(
        _video, "h264", "h264", _each(lambda packet: Packet(b"", packet.number, packet.is_key))
    ),
}

CODED: Mapping[str, MakeScene] = {**_IMAGES, **_VIDEOS, **_OTHERS}
VERBATIM = frozenset(_OTHERS)
"""Scenes of which no picture fits a video."""
