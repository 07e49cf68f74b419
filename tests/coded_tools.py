"""Coded pictures from real encoders, for the tests that take them apart."""

from __future__ import annotations

import io
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from encoders import Packet, encoded
from mp4ds.errors import Refused

WIDTH, HEIGHT = 64, 48


def scene(frames: int, width: int = WIDTH, height: int = HEIGHT) -> Iterator[NDArray[np.uint8]]:
    """A textured wall that the camera moves over, shape (H, W, 3)."""
    rng = np.random.default_rng([width, height])
    wall = rng.integers(0, 256, (height + 8, width + 2 * frames, 3), np.uint8)
    wall = cv2.GaussianBlur(wall, (5, 5), 0)
    for number in range(frames):
        yield np.ascontiguousarray(wall[number % 8 :][:height, 2 * number :][:, :width])


@dataclass(frozen=True)
class Encoding:
    """How to encode a stream.

    Attributes:
        codec: Name in the registry.
        encoder: ffmpeg's encoder.
        options: Its options.
        pixel_format: Its input.
        in_order: Whether pictures are sent as they are shown.
    """

    codec: str
    encoder: str
    options: dict[str, str] = field(default_factory=dict)
    pixel_format: str = "yuv420p"
    in_order: bool = True


_X265 = "log-level=none:keyint=5:min-keyint=5:repeat-headers=1"
ENCODINGS = {
    "h264": Encoding("h264", "libx264", {"bf": "0"}),
    "h264-aud": Encoding("h264", "libx264", {"bf": "0", "x264-params": "aud=1"}),
    "h264-slices": Encoding("h264", "libx264", {"tune": "zerolatency", "slices": "4"}),
    "h264-baseline": Encoding("h264", "libx264", {"profile": "baseline"}),
    "h264-hrd": Encoding(
        "h264",
        "libx264",
        {"bf": "0", "x264-params": "nal-hrd=cbr:vbv-maxrate=900:vbv-bufsize=900:bitrate=900"},
    ),
    "h264-rgb": Encoding("h264", "libx264rgb", {"bf": "0", "qp": "0"}, "rgb24"),
    "h264-10bit": Encoding("h264", "libx264", {"bf": "0"}, "yuv422p10le"),
    "h264-matrix": Encoding("h264", "libx264", {"bf": "0", "x264-params": "cqm=jvt"}),
    "h264-b": Encoding("h264", "libx264", {"bf": "2", "b_strategy": "0"}, in_order=False),
    "h264-b-pyramid": Encoding(
        "h264", "libx264", {"bf": "3", "b_strategy": "0", "b-pyramid": "normal"}, in_order=False
    ),
    "h265": Encoding("h265", "libx265", {"x265-params": f"bframes=0:{_X265}"}),
    "h265-aud": Encoding("h265", "libx265", {"x265-params": f"bframes=0:aud=1:{_X265}"}),
    "h265-gray12": Encoding("h265", "libx265", {"x265-params": f"bframes=0:{_X265}"}, "gray12le"),
    "h265-b": Encoding(
        "h265", "libx265", {"x265-params": f"bframes=3:b-adapt=0:{_X265}"}, in_order=False
    ),
    "av1": Encoding("av1", "libsvtav1", {"preset": "12"}),
    "av1-low-delay": Encoding(
        "av1", "libsvtav1", {"preset": "12", "svtav1-params": "pred-struct=1"}
    ),
    "mjpeg": Encoding("mjpeg", "mjpeg", pixel_format="yuvj420p"),
}
DECODERS = {"h265": "hevc", "av1": "libdav1d"}
IN_ORDER = [name for name, encoding in ENCODINGS.items() if encoding.in_order]


def encode(
    encoding: Encoding,
    *,
    frames: int = 12,
    width: int = WIDTH,
    height: int = HEIGHT,
    gop: int = 5,
    all_p: bool = False,
) -> list[Packet]:
    """Encode the scene; with `all_p`, without B-frames although they are allowed."""
    return encoded(
        encoding.encoder,
        encoding.pixel_format,
        {"g": str(gop), **encoding.options},
        scene(frames, width, height),
        all_p=all_p,
    )


def jpeg(pixels: NDArray[np.uint8], mode: str | None = None, **options: Any) -> bytes:
    """A JPEG by Pillow; four channels are CMYK if `mode` says so."""
    file = io.BytesIO()
    image = Image.frombytes(mode, pixels.shape[1::-1], pixels) if mode else Image.fromarray(pixels)
    image.save(file, "JPEG", **options)
    return file.getvalue()


def hide(frame: bytes) -> bytes:
    """A VP9 frame of profile 0 with its `show_frame` cleared."""
    return bytes([frame[0] & ~2]) + frame[1:]


def mutations(data: bytes, count: int, head: int = 400) -> Iterator[bytes]:
    """The data with a few bytes near its beginning changed, cut, or doubled."""
    rng = random.Random(len(data))
    for _ in range(count):
        changed = bytearray(data)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(min(len(changed), head))
            match rng.randrange(3):
                case 0:
                    changed[at] = rng.randrange(256)
                case 1:
                    changed[at:] = changed[at + rng.randint(1, 4) :]
                case _:
                    changed[at:at] = changed[at : at + rng.randint(1, 4)]
            if not changed:
                changed = bytearray(b"\0")
        yield bytes(changed)


def refusal(call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """The reason of a refusal; empty if there is none. Any other error goes through."""
    try:
        call(*arguments, **options)
    except Refused as reason:
        return str(reason)
    return ""


def decodes(codec: str, bodies: Sequence[bytes]) -> int:
    """How many pictures ffmpeg decodes of bodies, without a container."""
    context: Any = av.CodecContext.create(DECODERS.get(codec, codec), "r")
    frames = [frame for body in bodies for frame in context.decode(av.Packet(body))]
    return len(frames) + len(context.decode(None))
