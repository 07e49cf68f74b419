"""Ways to keep the frames of a camera: as they are, JPEG files, and videos of many settings.

Video is encoded and decoded by the package, of its own recipes; for the tools against noise, their
parameters are added, or filters put before the encoder.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.filter import Graph
from numpy.typing import NDArray
from PIL import Image

from mp4ds.plan import visual_setting
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import Recipe, recipe_for
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.pixels import PictureConverter
from mp4ds.video.planes import packet_sizes

Frames = NDArray[np.uint8]  # shape (frames, H, W, 3)

PLAIN = "AV1"
"""Family of the package's recipe for AV1, with preset 6."""
GOP = 60
_HZ = 30


@dataclass(frozen=True)
class Way:
    """How frames are kept.

    Attributes:
        recipe: Of a video; None for JPEG files, or the frames as they are.
        jpeg: Quality of JPEG files; 0 for none.
        filters: ffmpeg's filters before the encoder: name, and options.
        family: Ways of one family are points of one curve.
    """

    recipe: Recipe | None = None
    jpeg: int = 0
    filters: tuple[tuple[str, str], ...] = ()
    family: str = ""


def _av1(crf: int, preset: str = "6", parameters: str = "", codec: str = "av1") -> Recipe:
    recipe = recipe_for("rgb24", lossless=False, codec=codec, crf=crf, preset=preset)
    if not parameters:
        return recipe
    return replace(recipe, options={**recipe.options, "svtav1-params": parameters})


def _x264(crf: int) -> Recipe:
    return recipe_for("rgb24", lossless=False, codec="h264", crf=crf, preset="medium")


_CURVE = (16, 20, 24, 28, 32)
_TOOLS: dict[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    # name -> parameters of SVT-AV1, filters before it
    "no temporal filter": ("enable-tf=0", ()),
    "temporal filter 4": ("tf-strength=4", ()),
    "film grain 10": ("film-grain=10", ()),
    "denoised, grain 10": ("film-grain=10:film-grain-denoise=1", ()),
    "denoised, grain 25": ("film-grain=25:film-grain-denoise=1", ()),
    "atadenoise": ("", (("atadenoise", "s=5"),)),
    "nlmeans": ("", (("nlmeans", "s=2:p=5:r=9"),)),
    "fftdnoiz": ("", (("fftdnoiz", "sigma=4:prev=1:next=1"),)),
}


def ways() -> dict[str, Way]:
    """All of them, by name; the first is the original."""
    crf, preset = visual_setting(_HZ)
    found = {
        "original": Way(),
        "JPEG 90": Way(jpeg=90),
        "JPEG 75": Way(jpeg=75),
        "visual": Way(_av1(crf, str(preset))),
    }
    found |= {f"{PLAIN}, crf {crf}": Way(_av1(crf), family=PLAIN) for crf in _CURVE}
    for crf in _CURVE[::2]:
        found[f"10 bits, crf {crf}"] = Way(_av1(crf, codec="av1-10bit"), family="10 bits")
    found["x264 medium, crf 16"] = Way(_x264(16))
    for name, (parameters, filters) in _TOOLS.items():
        for crf in _CURVE[::2]:
            recipe = _av1(crf, parameters=parameters)
            found[f"{name}, crf {crf}"] = Way(recipe, filters=filters, family=name)
    return found


# ---------------------------------------------------------------- keeping frames


def kept(frames: Frames, way: Way, folder: Path) -> tuple[Frames, float]:
    """The frames as they come back, and bytes of one."""
    if way.recipe:
        return _as_video(frames, way.recipe, way.filters, folder / "video.mp4")
    if not way.jpeg:
        return frames, float(frames[0].nbytes)
    files = []
    for frame in frames:
        file = io.BytesIO()
        Image.fromarray(frame).save(file, "JPEG", quality=way.jpeg)
        files.append(file)
    back = np.stack([np.asarray(Image.open(file)) for file in files])
    return back, sum(file.tell() for file in files) / len(files)


def _as_video(
    frames: Frames, recipe: Recipe, filters: Sequence[tuple[str, str]], path: Path
) -> tuple[Frames, float]:
    height, width = frames.shape[1:3]
    encoder = VideoEncoder(
        path,
        recipe,
        picture_format="rgb24" if not filters else "yuv420p",
        width=width,
        height=height,
        gop=GOP,
        threads=1,
        rate=_HZ,
    )
    pictures = _filtered(frames, filters) if filters else ((frame,) for frame in frames)
    for number, picture in enumerate(pictures):
        encoder.write(picture, number * TIMESCALE // _HZ)
    encoder.close()
    size = packet_sizes(path).frame_bytes(GOP)
    converter = PictureConverter(recipe.matrix)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 1
        back = [converter.convert(f, "rgb24").to_ndarray() for f in container.decode(stream)]
    if len(back) != len(frames):
        raise SystemExit(f"{len(back)} frames of {len(frames)} came back")
    return np.stack(back), size


def _filtered(
    frames: Frames, filters: Sequence[tuple[str, str]]
) -> Iterator[tuple[NDArray[np.uint8], ...]]:
    """Planes of the frames, converted as the package does, through ffmpeg's filters."""
    height, width = frames.shape[1:3]
    graph, converter = Graph(), PictureConverter()
    nodes = [
        graph.add_buffer(width=width, height=height, format="yuv420p", time_base=Fraction(1, _HZ))
    ]
    nodes += [graph.add(name, options) for name, options in filters]
    nodes.append(graph.add("buffersink"))
    for first, second in pairwise(nodes):
        first.link_to(second)
    graph.configure()
    for number, rgb in enumerate([*frames, None]):
        if rgb is None:
            graph.push(None)
        else:
            frame = converter.convert(av.VideoFrame.from_ndarray(rgb, "rgb24"), "yuv420p")
            frame.pts = number
            graph.push(frame)
        while True:
            try:
                made: Any = graph.pull()
            except (BlockingIOError, EOFError):
                break
            yield tuple(
                np.frombuffer(p, np.uint8).reshape(-1, p.line_size)[: p.height, : p.width].copy()
                for p in made.planes
            )
