"""The recordings of the conformance suite, and which layout and codec each topic gets.

Layouts are normally chosen by trial; here each is to occur, however small the images are.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from coded_scenes import CODED  # noqa: E402
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES  # noqa: E402
from mp4ds.messages.encodings import Encoding, Parameters, Pixels  # noqa: E402
from mp4ds.messages.layouts import bind, fit  # noqa: E402
from mp4ds.packing import tracks  # noqa: E402
from mp4ds.video.codecs import LOSSLESS_GOP, recipe_for  # noqa: E402
from mp4ds.video.trial import Choice  # noqa: E402
from pictures import picture  # noqa: E402
from scenes import IMAGE, PERIOD, START, Record, Scene, image_cdr, odd_scene, scene  # noqa: E402
from sources import SOURCES  # noqa: E402

FRAMES = 4
Wanted = tuple[str, str]
"""Layout and codec."""
_DEEP_FOLD = ("mono16", 66)
_IN_10_BITS = Parameters(bits=16, shift=0, low=6)
"""High bits that take a picture of 10, which no image so small makes the best."""


@dataclass(frozen=True)
class Recording:
    """One recording of the suite.

    Attributes:
        shows: What its dataset is there for.
        make: Gives its messages.
        source: Name in `sources.SOURCES` or `foxglove_scenes.FOXGLOVE_SOURCES`.
        options: Of the pack.
        wanted: Layout and codec by encoding and number of columns.
        part: Options of another pack, which copies a part of the dataset; None for the whole.
    """

    shows: str
    make: Callable[[], Scene]
    source: str
    options: Mapping[str, Any] = field(default_factory=dict)
    wanted: Mapping[tuple[str, int], Wanted] = field(default_factory=dict)
    part: Mapping[str, Any] | None = None

    def write(self, folder: Path) -> list[Path]:
        """Write it into a folder."""
        return (SOURCES | FOXGLOVE_SOURCES)[self.source](folder, self.make())


@contextmanager
def chosen_layouts(wanted: Mapping[tuple[str, int], Wanted]) -> Iterator[None]:
    """Packs take these layouts and codecs, and store no image verbatim for its size."""

    def choose(samples: Sequence[Pixels], encoding: Encoding, **_: object) -> Choice:
        columns = samples[0].shape[1]
        default = encoding.general, None
        name, codec = wanted.get((encoding.name, columns), default)
        deep = (encoding.name, columns) == _DEEP_FOLD
        layout = bind(name, encoding, _IN_10_BITS) if deep else fit(name, encoding, samples)
        if layout is None:
            raise ValueError(f"{encoding.name} of {columns} columns does not fit {name}")
        recipe = recipe_for(layout.pixel_format, lossless=True, codec=codec)
        return Choice(name, layout.parameters, recipe, bytes_per_frame=0, gop=LOSSLESS_GOP)

    before = tracks.choose
    tracks.choose = choose  # type: ignore[assignment]
    try:
        yield
    finally:
        tracks.choose = before


# ---------------------------------------------------------------- every layout

Image = tuple[str, str, str, int, int, str]
"""Encoding, layout, codec, columns, rows, content."""

LAYOUTS_8: list[Image] = [
    ("mono8", "gray8", "h264", 16, 16, "full"),
    ("mono8", "gray8", "ffv1", 18, 10, "full"),
    ("8UC1", "gray8", "h264", 19, 11, "full"),
    ("8SC1", "gray8", "ffv1", 16, 12, "full"),
    ("rgb8", "rgb24", "ffv1", 16, 12, "full"),
    ("rgb8", "rgb24", "h264", 18, 14, "full"),
    ("bgr8", "bgr24", "ffv1", 18, 12, "full"),
    ("8SC3", "bgr24", "h264", 16, 16, "full"),
    ("rgba8", "rgba", "ffv1", 16, 12, "full"),
    ("8UC4", "bgra", "ffv1", 17, 11, "full"),
    ("rgba8", "opaque", "ffv1", 18, 12, "opaque"),
    ("bgra8", "opaque", "h264", 16, 16, "opaque"),
    ("bayer_rggb8", "mosaic8", "h264", 18, 16, "full"),
    ("bayer_gbrg8", "mosaic8", "ffv1", 17, 13, "full"),
    ("8UC2", "stack8", "h264", 16, 12, "full"),
    ("uyvy", "planar422", "h264", 16, 12, "full"),
    ("yuyv", "planar422", "ffv1", 18, 12, "full"),
    ("nv12", "planar420", "h264", 16, 16, "full"),
    ("nv21", "planar420", "ffv1", 18, 14, "full"),
    ("nv24", "planar444", "h264", 16, 12, "full"),
]
LAYOUTS_16: list[Image] = [
    ("mono16", "gray16", "ffv1", 16, 12, "full"),
    ("16SC1", "gray16", "ffv1", 18, 11, "full"),
    ("mono16", "gray_bits", "ffv1", 18, 12, "12-bit"),
    ("16UC1", "gray_bits", "ffv1", 17, 12, "12-bit-high"),
    ("mono16", "gray_bits", "h265", 64, 16, "10-bit"),
    ("mono16", "gray_bits", "h264", 20, 12, "10-bit"),
    ("mono16", "fold", "h264", 22, 12, "12-bit"),
    ("mono16", "fold", "h265", 66, 16, "full"),
    ("16SC1", "fold", "ffv1", 16, 12, "12-bit"),
    ("mono16", "table", "ffv1", 24, 12, "few-values"),
    ("16UC1", "palette", "h264", 24, 16, "few-values"),
    ("rgb16", "gbr16", "ffv1", 16, 12, "full"),
    ("bgr16", "gbr_bits", "ffv1", 16, 12, "12-bit"),
    ("16SC3", "gbr_bits", "ffv1", 18, 12, "12-bit"),
    ("rgba16", "gbra16", "ffv1", 16, 12, "full"),
    ("bgra16", "gbra_bits", "ffv1", 16, 12, "12-bit-high"),
    ("bayer_grbg16", "mosaic16", "ffv1", 17, 11, "full"),
    ("bayer_bggr16", "mosaic_bits", "ffv1", 18, 12, "12-bit"),
    ("bayer_rggb16", "mosaic_fold", "h264", 18, 14, "12-bit-high"),
    ("16UC2", "stack16", "ffv1", 16, 12, "full"),
]
LAYOUTS_DEEP: list[Image] = [
    ("32FC1", "bytes", "h264", 16, 12, "full"),
    ("32SC2", "bytes", "ffv1", 16, 12, "full"),
    ("64FC1", "bytes", "ffv1", 16, 12, "full"),
    ("32FC1", "metres16", "ffv1", 18, 12, "millimetres"),
    ("32FC1", "metres16", "ffv1", 20, 12, "millimetres-product"),
    ("32FC1", "metres_fold", "h264", 22, 12, "millimetres"),
    ("32FC1", "table", "h264", 24, 12, "few-values"),
    ("32FC1", "palette", "ffv1", 26, 12, "few-values"),
]


def _pixels(encoding: str, number: int, columns: int, rows: int, content: str) -> Any:
    """The n-th image; `content` is one of `pictures.CONTENTS`, or one that is made of these."""
    if content == "few-values":
        number %= 2  # a table is taken where later images have no other values
    rng = np.random.default_rng([number, columns])
    known = {"opaque": "full", "10-bit": "12-bit"}.get(content, content)
    made = picture(encoding, frame=number, width=columns, height=rows, rng=rng, content=known)
    if content == "opaque":
        made[..., 3] = 200
    if content == "10-bit":
        made >>= 2
        made[0, 0] = 1023  # which tells that there are no more bits
    return made


def images(listed: Sequence[Image]) -> Scene:
    """A topic for each image, with padded rows and big-endian samples among them."""
    messages = []
    for place, (encoding, layout, codec, columns, rows, content) in enumerate(listed):
        topic = f"/{layout}/{encoding}_{codec}_{columns}"
        for number in range(FRAMES):
            pixels = _pixels(encoding, number, columns, rows, content)
            is_big = int(pixels.dtype.itemsize > 1 and place % 2 == 1)
            data = np.ascontiguousarray(pixels.byteswap() if is_big else pixels).view(np.uint8)
            lines = np.pad(data.reshape(len(pixels), -1), ((0, 0), (0, place % 4)))
            stamp = START + number * PERIOD + 1_001 * place + 17 * number * place
            header = {"seq": number + place, "stamp": stamp, "frame_id": f"cam_{place}"}
            values = {"header": header, "height": rows, "width": columns, "encoding": encoding}
            values |= {"is_bigendian": is_big, "step": lines.shape[1], "data": lines.ravel()}
            messages.append(Record(topic, IMAGE, stamp + 4_000_000 + 13 * place, values))
    return _sorted(messages)


def _wanted(listed: Sequence[Image]) -> dict[tuple[str, int], Wanted]:
    return {(encoding, columns): (layout, codec) for encoding, layout, codec, columns, *_ in listed}


# ---------------------------------------------------------------- other scenes


def _sorted(messages: list[Record]) -> Scene:
    return Scene(sorted(messages, key=lambda message: message.log_time))


def beside(parts: Mapping[str, Scene], keep: Sequence[str] = ()) -> Scene:
    """Cameras of several scenes, each in a namespace; of their other topics those that are kept."""
    messages = []
    for name, part in parts.items():
        for message in part.messages:
            first = message.topic.split("/")[1]
            if first in ("cam", "camera", "odd"):
                messages.append(replace(message, topic=f"/{name}{message.topic}"))
            elif message.topic in keep and name == next(iter(parts)):
                messages.append(message)
    return _sorted(messages)


def _coded(*names: str, frames: int = FRAMES, width: int = 64, height: int = 48) -> Scene:
    made = {name: CODED[name](frames=frames, width=width, height=height) for name in names}
    return beside({name.replace("-", "_").replace(";", "_"): part for name, part in made.items()})


def _odd(*traits: str, frames: int = 5) -> Scene:
    parts = {trait.replace("-", "_"): odd_scene(trait, frames=frames) for trait in traits}
    return beside(parts, keep=("/chatter",))


def _lossy() -> Scene:
    return beside(
        {
            encoding: scene(encoding, frames=FRAMES, width=64, height=48, with_info=False)
            for encoding in (
                "mono8",
                "rgb8",
                "bgr8",
                "bayer_bggr8",
                "uyvy",
                "nv21",
                "nv24",
                "mono16",
            )
        }
    )


def _before_1970() -> Scene:
    """Stamps and log times that an int32 of seconds holds at most: negative, zero, the last."""
    stamps = [-(2**31) * 10**9, -1, 0, 2**31 * 10**9 - 1]
    messages = []
    for number, stamp in enumerate(stamps):
        pixels = picture("mono8", frame=number, width=16, height=16, rng=None).tobytes()
        cdr = image_cdr(width=16, height=16, encoding="mono8", data=pixels, stamp=stamp)
        messages.append(Record("/cam/image_raw", IMAGE, START + number, cdr=cdr))
    return Scene(messages)


def _many_cameras() -> Scene:
    """Two cameras with calibrations, the other topics of a robot."""
    left = scene("bayer_rggb8", frames=FRAMES, width=32, height=24, frame_id="left")
    right = scene("bgr8", frames=FRAMES, width=24, height=18, frame_id="right", seed=1)
    return beside({"left": left, "right": right}, keep=("/imu", "/tf", "/chatter"))


def _foxglove(name: str) -> Callable[[], Scene]:
    return partial(FOXGLOVE[name], frames=FRAMES, width=24, height=16)


RECORDINGS: dict[str, Recording] = {
    "bag": Recording(
        "a ROS 1 bag: two cameras with calibrations, other topics of several publishers",
        _many_cameras,
        "bag-lz4",
    ),
    "rosbag2": Recording(
        "a rosbag2 in sqlite3: two cameras with calibrations, QoS, tables in metadata records",
        _many_cameras,
        "rosbag2-sqlite3-v9",
    ),
    "no-cameras": Recording(
        "no stream at all: attachments, metadata, and channels that have no message",
        lambda: Scene(
            [m for m in scene("mono8", frames=2).messages if not m.topic.startswith("/cam")],
            {"/diagnostics": "std_msgs/msg/String"},
        ),
        "mcap-ros2-zstd",
    ),
    "layouts-8": Recording(
        "layouts of samples of 8 bits, lossless H.264 and FFV1, ros1",
        partial(images, LAYOUTS_8),
        "mcap-ros1-zstd",
        wanted=_wanted(LAYOUTS_8),
    ),
    "layouts-16": Recording(
        "layouts of samples of 16 bits, lossless H.264, H.265 and FFV1, cdr-le",
        partial(images, LAYOUTS_16),
        "mcap-ros2-zstd",
        wanted=_wanted(LAYOUTS_16),
    ),
    "layouts-deep": Recording(
        "layouts of samples of 32 and 64 bits, NaN among them, cdr-le",
        partial(images, LAYOUTS_DEEP),
        "mcap-ros2-zstd",
        wanted=_wanted(LAYOUTS_DEEP),
    ),
    **{
        f"lossy-{codec}": Recording(
            f"lossy layouts in {codec}, and an encoding that stays lossless",
            _lossy,
            "mcap-ros2-zstd",
            {"quality": "crf=30", "codec": codec},
        )
        for codec in ("av1", "h264", "h265")
    },
    **{
        f"slice-{codec}": Recording(
            f"a slice of a dataset of {codec}: an edit list hides the frames before it",
            _lossy,
            "mcap-ros2-zstd",
            {"quality": "crf=30", "codec": codec},
            part={"start": "0.04", "topics": ["/rgb8*", "/mono8*"]},
        )
        for codec in ("av1", "h264")
    },
    "packets": Recording(
        "packets as they came: H.264, H.265, AV1, VP9, JPEG, with their framing",
        partial(
            _coded,
            *("video-h264-aud-sei", "video-h264-3-byte", "video-h265", "video-av1"),
            *("video-av1-no-delimiter", "video-vp9", "ffmpeg-libx264", "ffmpeg-libsvtav1"),
            *("jpeg-rgb", "jpeg-pillow-gray", "jpeg-exif-trailing"),
            height=32,
        ),
        "mcap-ros2-zstd",
    ),
    "packets-verbatim": Recording(
        "packets before the first key frame and a file cut short, verbatim; a size that changes",
        partial(
            _coded,
            *("video-h264-mid-gop", "video-h265-mid-gop", "video-h264-resized", "jpeg-cut-one"),
            frames=8,
        ),
        "mcap-ros1-zstd",
    ),
    "png-rvl": Recording(
        "PNG files of several encoders and depth as PNG and RVL, made again from their pixels",
        partial(
            _coded,
            *("png-rgb-cv2", "png-gray-pillow", "png-rgba-cv2-9", "png-16-bit-cv2"),
            *("depth-16UC1-png", "depth-16UC1-rvl", "depth-32FC1-rvl"),
            width=32,
            height=24,
        ),
        "mcap-ros1-zstd",
    ),
    "jpeg": Recording(
        "JPEG files encoded anew: the body jpeg, which is never exact",
        partial(_coded, "jpeg-rgb", "jpeg-pillow-gray"),
        "mcap-ros1-zstd",
        {"quality": "crf=30", "transcode": True},
    ),
    **{
        f"foxglove-{name}": Recording(
            f"Foxglove's messages in {name}: images and calibrations by template",
            _foxglove("raw-padded"),
            f"mcap-{name}",
        )
        for name in ("protobuf-unknown-field", "foxglove-ros2")
    },
    "foxglove-video": Recording(
        "H.264 packets in protobuf whose fields stand in another order",
        _foxglove("video-h264"),
        "mcap-protobuf-stamp-last",
    ),
    "odd-times": Recording(
        "stamps that are zero, repeat and run backwards; log times that do, and gaps",
        partial(
            _odd,
            *("stamp-zero", "stamp-repeated", "stamp-backward", "seq-jumps", "log-equal"),
            *("log-backward", "log-tiny", "log-gap"),
        ),
        "mcap-ros1-zstd",
    ),
    "before-1970": Recording(
        "the least and the last stamp of cdr, negative ones between", _before_1970, "mcap-ros2-none"
    ),
    "odd-messages": Recording(
        "padding, bytes after the message, big-endian CDR; messages that are stored verbatim",
        partial(
            _odd,
            *("cdr-big-endian", "cdr-padding-garbage", "tail-bytes", "row-padding-zero"),
            *("row-padding-garbage", "frame-id-change", "encoding-unknown", "stamp-impossible"),
        ),
        "mcap-ros2-zstd",
    ),
    "row-padding": Recording(
        "padding between the rows that is not zero, that changes, and that the last row lacks",
        partial(_odd, "row-padding-garbage", "row-padding-varied", "row-padding-not-last"),
        "mcap-ros2-zstd",
    ),
    "several-streams": Recording(
        "several streams of one topic, verbatim messages between: order by ordinals",
        partial(_odd, "encoding-change", "size-change", "data-empty"),
        "mcap-ros1-zstd",
    ),
}


def _gray() -> Scene:
    made = scene("mono8", frames=FRAMES, width=24, height=16)
    return Scene([message for message in made.messages if message.topic.startswith("/cam")])


_BASES: dict[str, Recording] = {
    "gray": Recording("the pair that sidecars are edits of", _gray, "mcap-ros1-zstd"),
    "h264": Recording(
        "the pair of packets that sidecars are edits of",
        partial(_coded, "video-h264-aud-sei", width=32, height=16),
        "mcap-ros1-zstd",
    ),
    "changing": Recording(
        "the dataset that broken ones are edits of",
        partial(_odd, "encoding-change", frames=4),
        "mcap-ros1-zstd",
    ),
}


def recording_of(name: str) -> Recording:
    """A recording that is no case itself, but what cases are made of."""
    return _BASES[name]
