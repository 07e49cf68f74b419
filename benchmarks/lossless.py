"""What lossless packing saves and costs, for each family of images, beside other codecs.

    python benchmarks/lossless.py [--frames N] [--size WxH] [--family F ...] [--scene S ...]

Each clip (clips.py, depth_clips.py) is written as a ROS 2 MCAP with zstd chunks, as a robot records
it, and packed by `mp4ds.pack` as it chooses by itself, and with ``--view none``. A dataset counts
as a whole: videos, sidecars, manifest, messages.mcap; its CPU time is that of all of `pack`, and of
reading all images. Of the view there are the bytes of its video, and the time of reading it.

The others code the pictures as they look to a program that knows pixel formats and nothing of
mp4ds: a mosaic is grey as it stands, YUV is planes, a float's four bytes are four grey pictures in
one. Pillow makes PNG files (ffmpeg those of rgb of 16 bits), imagecodecs JPEG XL (effort 7) and
JPEG-LS, where it is installed, and ffmpeg the videos: FFV1 by its defaults, x264 and x265 at their
default presets and SVT-AV1 at preset 8, with a key frame every 10. What takes no such pictures has
no figures. Everything is decoded, and compared with the clip byte for byte.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_typestore

import clips
import mp4ds
from measure import cpu_seconds, parse_size, parser_of, print_machine, print_table, size_of
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import bind
from mp4ds.records import Message
from mp4ds.video.colour import samples
from mp4ds.video.pixels import PictureConverter, picture_to_frame
from recordings import HERTZ, IMAGE, TOPIC, times, write_mcap

Pixels = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Cost:
    """Bytes of a clip stored in one way, and CPU seconds of writing and of reading it."""

    bytes: int
    write: float = 0.0
    read: float = 0.0


Costs = Mapping[str, Cost]
PACKED, VIEW, ALONE = "mp4ds", "its view", "--view none"
_LOSSLESS = {"svtav1-params": "lossless=1", "preset": "8"}
_QUIET = {"x265-params": "lossless=1:log-level=error"}
VIDEOS: Mapping[str, Mapping[str, tuple[str, str, Mapping[str, str]]]] = {
    "FFV1": {"": ("ffv1", "", {}), "rgb24": ("ffv1", "bgr0", {}), "rgba": ("ffv1", "bgra", {})},
    "x264": {"": ("libx264", "", {"qp": "0"}), "rgb24": ("libx264rgb", "", {"qp": "0"})},
    "x265": {"": ("libx265", "", _QUIET), "rgb24": ("libx265", "gbrp", _QUIET)},
    "SVT-AV1": {"": ("libsvtav1", "", _LOSSLESS), "gray": ("libsvtav1", "yuv420p", _LOSSLESS)},
}
"""Codec -> pixel format of the pictures -> encoder, its pixel format (empty: the same), options."""
WAYS = (PACKED, VIEW, ALONE, "raw", "zstd MCAP", "PNG", "JPEG XL", "JPEG-LS", *VIDEOS)


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=parse_size, help="WxH; each scene's own by default")
    parser.add_argument("--family", action="append", choices=clips.FAMILIES)
    parser.add_argument("--scene", action="append", help="only these scenes")
    parser.add_argument("--noise", action="append", choices=list(clips.SENSORS))
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    families: dict[str, list[Costs]] = {}
    for family in options.family or clips.FAMILIES:
        print(f"\n### {family}: bits a sample (CPU ms a frame of writing, of reading)")
        header = ("clip", "frames", "packed as", *WAYS)
        print_table(header, rows(family, options, families.setdefault(family, [])))
    titles = {"bytes": "Bytes", "write": "CPU of writing", "read": "CPU of reading all in order"}
    for name, title in titles.items():
        print(f"\n### {title}, of those of {PACKED}: geometric means (least to most)")
        print_table(("family", "clips", *WAYS[1:]), summary(families, name))


def rows(
    family: str, options: argparse.Namespace, results: list[Costs]
) -> Iterator[tuple[object, ...]]:
    """One for each clip of a family, whose results are kept."""
    noises = tuple(options.noise or clips.SENSORS)
    for spec in clips.specs(family, options.frames, options.size, noises):
        if options.scene and spec.scene not in options.scene:
            continue
        clip = clips.load(spec)
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
            costs, recipe = measure(clip, spec, Path(folder))
        results.append(costs)
        scale = 1000 / len(clip)
        cells = (
            f"{8 * cost.bytes / clip.size:.3f} ({scale * cost.write:.1f}, {scale * cost.read:.1f})"
            if (cost := costs.get(way))
            else ""
            for way in WAYS
        )
        yield f"{spec.scene} {spec.noise}", len(clip), recipe, *cells


def measure(clip: Pixels, spec: clips.ClipSpec, folder: Path) -> tuple[Costs, str]:
    """All ways of one clip, and what it is packed as."""
    source, recipe = folder / "clip.mcap", ""
    write_mcap(source, clip, spec.encoding, compression="zstd")
    found = {"raw": Cost(clip.nbytes), "zstd MCAP": Cost(source.stat().st_size)}
    for way, view in ((ALONE, "none"), (PACKED, None)):
        begun = cpu_seconds()
        mp4ds.pack(source, folder / way, mp4ds.PackOptions(view=view))
        write = cpu_seconds() - begun
        read, recipe = check(clip, folder / way, spec.name)
        found[way] = Cost(size_of(folder / way), write, read)
    if "view" in recipe:
        begun = cpu_seconds()
        with mp4ds.open(folder / PACKED, layer="view") as opened:
            seen = sum(stream.path.with_suffix(".mp4").stat().st_size for stream in opened.streams)
            for _ in (frame.data for topic in opened for frame in topic):
                pass
        found[VIEW] = Cost(seen, 0.0, cpu_seconds() - begun)
    encoding = ENCODINGS[spec.encoding]
    if encoding.mosaic:
        encoding = ENCODINGS["mono8" if encoding.bytes_per_sample == 1 else "mono16"]
    layout = bind(encoding.general, encoding)
    kind, pictures = layout.pixel_format, [layout.to_picture(pixels.copy()) for pixels in clip]
    for way, forms in VIDEOS.items():
        encoder, made, options = forms.get(kind, forms[""])
        found |= video_cost(way, pictures, kind, encoder, made or kind, {"g": "10", **options})
    arrays = [np.ascontiguousarray(plane) for planes in pictures for plane in planes]
    if kind.startswith("gbrp"):  # which Pillow writes no PNG of
        arrays = [np.dstack([red, green, blue]) for green, blue, red in pictures]
        found |= video_cost("PNG", pictures, kind, "png", "rgb48be", {"pred": "mixed"})
    else:
        found |= {"PNG": still_cost(arrays, _pillow, lambda file: Image.open(io.BytesIO(file)))}
    if not find_spec("imagecodecs"):
        return found, recipe
    codecs: Any = import_module("imagecodecs")
    encode = partial(codecs.jpegxl_encode, effort=7, lossless=True, numthreads=1)
    found["JPEG XL"] = still_cost(arrays, encode, codecs.jpegxl_decode)
    if kind not in ("rgba", "bgra"):
        found["JPEG-LS"] = still_cost(arrays, codecs.jpegls_encode, codecs.jpegls_decode)
    return found, recipe


def check(clip: Pixels, dataset: Path, name: str) -> tuple[float, str]:
    """CPU seconds of reading images, all of which have their bytes; layouts and codecs."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    missing = dict(zip((stamp for stamp, _ in times(HERTZ)), clip, strict=False))
    begun = cpu_seconds()
    with mp4ds.open(dataset) as opened:
        found = {frame.stamp_ns: frame.data for topic in opened for frame in topic}
        for record in opened.messages_file.in_file_order():
            if isinstance(record, Message) and record.channel.topic == TOPIC:
                image: Any = store.deserialize_cdr(record.data, IMAGE)
                stamp = image.header.stamp
                found[stamp.sec * 10**9 + stamp.nanosec] = image.data
        seconds = cpu_seconds() - begun
        sidecars = [stream.sidecar for stream in opened.streams]
    if found.keys() != missing.keys() or any(
        pixels.tobytes() != missing[stamp].tobytes() for stamp, pixels in found.items()
    ):
        raise SystemExit(f"{name}: images do not come back exactly.")
    recipes = (
        f"{'view + ' if sidecar.view else ''}{sidecar.video.layout} {sidecar.video.codec}"
        for sidecar in sidecars
    )
    return seconds, ", ".join(recipes) or "verbatim"


def video_cost(
    way: str,
    pictures: Sequence[Any],
    kind: str,
    encoder: str,
    made: str,
    options: Mapping[str, str],
) -> Costs:
    """Of the packets of an encoder; none if it does not take such pictures."""
    converter = PictureConverter()
    given = [picture_to_frame(picture, kind, made, converter) for picture in pictures]
    context: Any = av.CodecContext.create(encoder, "w")
    context.options, context.width, context.height = dict(options), given[0].width, given[0].height
    context.pix_fmt, context.time_base, context.thread_count = made, Fraction(1, 30), 1
    begun = cpu_seconds()
    try:
        packets = [packet for frame in (*given, None) for packet in context.encode(frame)]
    except (FFmpegError, ValueError):
        return {}
    write, decoder = cpu_seconds() - begun, _decoder(context)
    begun = cpu_seconds()
    frames = [frame for packet in (*packets, None) for frame in decoder.decode(packet)]
    read = cpu_seconds() - begun
    for one, other in zip(frames, given, strict=True):
        if not all(map(np.array_equal, _planes(one, kind), _planes(other, kind))):
            raise SystemExit(f"{way} is not exact.")
    return {way: Cost(sum(packet.size for packet in packets), write, read)}


def _decoder(encoder: Any) -> Any:
    names = {"libx264": "h264", "libx264rgb": "h264", "libx265": "hevc", "libsvtav1": "libdav1d"}
    decoder: Any = av.CodecContext.create(names.get(encoder.name, encoder.name), "r")
    decoder.width, decoder.height, decoder.thread_count = encoder.width, encoder.height, 1
    decoder.pix_fmt, decoder.extradata = encoder.pix_fmt, encoder.extradata
    return decoder


def _planes(frame: av.VideoFrame, kind: str) -> list[Pixels]:
    """In the pixel format of the pictures, as far as it has a meaning: grey has no chroma."""
    if kind in ("rgb24", "rgba"):
        return [frame.to_ndarray(format=kind)]
    return [samples(frame, n) for n in range(1 if kind == "gray" else len(frame.planes))]


def _pillow(pixels: Pixels) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def still_cost(
    arrays: Sequence[Pixels], encode: Callable[[Pixels], bytes], decode: Callable[[bytes], Any]
) -> Cost:
    """Of a file for each picture."""
    begun = cpu_seconds()
    files = list(map(encode, arrays))
    write, begun = cpu_seconds() - begun, cpu_seconds()
    found = [np.asarray(decode(file)) for file in files]
    read = cpu_seconds() - begun
    if not all(map(np.array_equal, found, arrays)):
        raise SystemExit("A still picture does not come back exactly.")
    return Cost(sum(map(len, files)), write, read)


def summary(families: Mapping[str, Sequence[Costs]], name: str) -> Iterator[tuple[object, ...]]:
    """Geometric means over the clips of each family (least to most)."""
    for family, results in families.items():
        texts = []
        for way in WAYS[1:]:
            pairs = [(one[way], one[PACKED]) for one in results if way in one]
            both = [(getattr(mine, name), getattr(packed, name)) for mine, packed in pairs]
            if ratios := [mine / packed for mine, packed in both if mine]:
                spread = f" ({min(ratios):.2f} to {max(ratios):.2f})" if len(ratios) > 1 else ""
                texts.append(f"{geometric_mean(ratios):.2f}{spread}")
            else:
                texts.append("")
        yield family, len(results), *texts


if __name__ == "__main__":
    main()
