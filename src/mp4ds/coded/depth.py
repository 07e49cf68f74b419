"""ROS' compressedDepth: a header of twelve bytes, then a PNG or RVL image of 16 bits.

As compressed_depth_image_transport writes it: the header is an enum and two floats, with which
depths in metres are coded as inverse depths; for millimetres the floats hold whatever was in
memory. Header and coded values are kept as they are; nothing is turned into metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded import png, rvl
from mp4ds.coded.base import Refused

HEADER_BYTES = 12


@dataclass(frozen=True, slots=True)
class DepthImage:
    """A compressedDepth image, unpacked.

    Attributes:
        header: Twelve bytes, or none where an image stands without a header.
        pixels: uint16 array of shape (H, W), the values as they are coded.
        recipe: How the PNG is made again; None for RVL.
    """

    header: bytes
    pixels: NDArray[np.uint16]
    recipe: png.PngRecipe | None


def decode(data: bytes | memoryview, hint: png.PngRecipe | None = None) -> DepthImage:
    """Unpack the data of a message whose bytes can be made again, which is tried.

    Whether it is PNG or RVL is told by the content: formats such as ``16UC1; compressedDepth``
    do not say it.

    Args:
        data: The message's data.
        hint: Recipe of another image of the same topic.

    Raises:
        Refused: It is neither, damaged, not of 16 bits, or does not rebuild.
    """
    view = memoryview(data)
    start = 0 if bytes(view[:8]) == png.SIGNATURE else HEADER_BYTES
    header, body = bytes(view[:start]), view[start:]
    if bytes(body[:8]) == png.SIGNATURE:
        pixels, recipe = png.decode(body, hint)
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise Refused("its depth image is not grey with 16 bits")
        return DepthImage(header, pixels.astype(np.uint16, copy=False), recipe)
    depth = rvl.decode(body)
    if rvl.encode(depth) != body:
        raise Refused("its RVL does not rebuild byte for byte")
    return DepthImage(header, depth, None)


def rebuild(image: DepthImage) -> bytes:
    """The message's data.

    Raises:
        Refused: The recipe is none.
    """
    if image.recipe is None:
        return image.header + rvl.encode(image.pixels)
    return image.header + png.rebuild(image.pixels, image.recipe)
