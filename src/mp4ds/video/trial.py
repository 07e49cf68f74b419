"""Which layout and codec make the smallest video of a stream, tried on some of its images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from mp4ds.errors import OptionError
from mp4ds.layouts import MAX_SIDE, Encoding, Layout, Parameters, Picture, Pixels, fit
from mp4ds.video.codecs import Recipe, codecs_to_try, recipe_for
from mp4ds.video.convert import Converter, picture_to_frame
from mp4ds.video.encoder import EncoderRefusedError, coded_size, color_range, open_encoder
from mp4ds.video.scarcity import raise_if_scarce

NEAR = 1.02
"""A candidate that stands earlier is taken if it is larger by no more than this."""

_LARGEST = 800 * 600  # pixels of an image that are tried; of a larger one its middle


@dataclass(frozen=True, slots=True)
class Choice:
    """What was chosen for a stream.

    Attributes:
        layout: Name of the layout.
        parameters: Of the layout; with them, it may refuse later images.
        recipe: Codec and options.
        bytes_per_frame: Estimated size of a coded image.
    """

    layout: str
    parameters: Parameters
    recipe: Recipe
    bytes_per_frame: float


def estimate(
    pictures: Sequence[Picture],
    recipe: Recipe,
    *,
    picture_format: str,
    gop: int,
    threads: int,
) -> float:
    """Bytes of a coded frame of a long video, from a few consecutive pictures.

    The first is a key frame; that the others are like all others of a group of pictures is
    what is assumed.

    Args:
        pictures: At least one, all of one size.
        recipe: Codec and options.
        picture_format: Pixel format of the pictures.
        gop: Frames from one key frame to the next.
        threads: Threads of the encoder.

    Raises:
        EncoderRefusedError: The codec does not take such pictures.
    """
    sizes = [0] * len(pictures)
    for number, size in _packets(pictures, recipe, picture_format, threads):
        sizes[number] += size
    if gop == 1 or len(sizes) == 1:
        return float(sizes[0])
    return (sizes[0] + (gop - 1) * sum(sizes[1:]) / (len(sizes) - 1)) / gop


def _packets(
    pictures: Sequence[Picture], recipe: Recipe, picture_format: str, threads: int
) -> Iterator[tuple[int, int]]:
    """Picture number and bytes of each packet."""
    rows, columns = pictures[0][0].shape[:2]
    width, height = coded_size(recipe, columns, rows)
    converter = Converter()
    context: Any = av.CodecContext.create(recipe.encoder, "w")
    context.options = {**recipe.options, "g": str(len(pictures))}
    context.time_base = Fraction(1, 30)
    context.framerate = Fraction(30)
    try:
        open_encoder(context, recipe, width, height, threads=threads)
        for number, picture in enumerate(pictures):
            frame = picture_to_frame(picture, picture_format, recipe.pixel_format, converter)
            frame.pts = number
            frame.time_base = context.time_base
            frame.color_range = color_range(recipe)
            for packet in context.encode(frame):
                yield packet.pts, packet.size
        for packet in context.encode(None):
            yield packet.pts, packet.size
    except MemoryError:
        raise
    except (FFmpegError, ValueError) as error:
        raise_if_scarce(error)
        raise EncoderRefusedError(
            f"{recipe.encoder} does not take pictures of {columns}x{rows}"
        ) from None


def choose(
    samples: Sequence[Pixels],
    encoding: Encoding,
    *,
    codec: str | None,
    preset: str | None,
    gop: int,
    threads: int,
) -> Choice:
    """The lossless layout and recipe that make the smallest video, by trying each.

    Args:
        samples: Pixels of consecutive images, at least one; about six tell enough.
        encoding: Of the images.
        codec: The only codec to try, or None for all.
        preset: The encoder's preset, or None for the default.
        gop: Frames from one key frame to the next.
        threads: Threads of the encoder.

    Returns:
        The smallest or, of those within 2 % of it, the first in the order of the encoding's
        layouts and their codecs.

    Raises:
        OptionError: The codec has no form for any layout of the encoding.
        EncoderRefusedError: No codec takes such pictures.
    """
    crops, share = _crops(samples, encoding)
    tried: list[Choice] = []
    refusals: list[Exception] = []
    for layout in _candidates(samples, encoding):
        pictures = [layout.to_picture(pixels) for pixels in crops]
        picture_format = layout.pixel_format
        for name in codecs_to_try(picture_format) if codec is None else [codec]:
            try:
                recipe = recipe_for(picture_format, lossless=True, codec=name, preset=preset)
                size = estimate(
                    pictures, recipe, picture_format=picture_format, gop=gop, threads=threads
                )
            except (OptionError, EncoderRefusedError) as error:
                refusals.append(error)
            else:
                tried.append(Choice(layout.name, layout.parameters, recipe, size / share))
    if not tried:
        # that an encoder refuses the size says more than that another has no such format
        raise next((e for e in refusals if isinstance(e, EncoderRefusedError)), refusals[0])
    smallest = min(choice.bytes_per_frame for choice in tried)
    return next(choice for choice in tried if choice.bytes_per_frame <= NEAR * smallest)


def _candidates(samples: Sequence[Pixels], encoding: Encoding) -> list[Layout]:
    """The layouts that suit the samples, but not byte planes where anything else does."""
    fitted = [fit(name, encoding, samples) for name in encoding.exact]
    found = [layout for layout in fitted if layout and _is_in_bounds(layout, samples[0])]
    return [layout for layout in found if layout.name != "bytes"] or found


def _is_in_bounds(layout: Layout, pixels: Pixels) -> bool:
    encoding = layout.encoding
    width, height = pixels.shape[1], int(pixels.shape[0] / encoding.rows)
    return max(layout.picture_size(width, height)) <= MAX_SIDE


def _crops(samples: Sequence[Pixels], encoding: Encoding) -> tuple[Sequence[Pixels], float]:
    """The middle of large images, at even places, and its share of their pixels.

    Planes that stand one over the other are left whole.
    """
    rows, columns = samples[0].shape[:2]
    if encoding.rows != 1 or rows * columns <= _LARGEST:
        return samples, 1.0
    scale = float(np.sqrt(_LARGEST / (rows * columns)))
    height, width = (max(2, int(side * scale) // 2 * 2) for side in (rows, columns))
    top, left = ((side - kept) // 4 * 2 for side, kept in ((rows, height), (columns, width)))
    middle = slice(top, top + height), slice(left, left + width)
    return [pixels[middle] for pixels in samples], height * width / (rows * columns)
