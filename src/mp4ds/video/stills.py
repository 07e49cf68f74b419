"""Image files: read as pixels, and made of colours."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import SourceError
from mp4ds.layouts import MAX_SIDE

STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm", ".webp")
"""Endings of the image files that are read."""

STILL_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM", "WEBP")
"""What may be in them, as Pillow calls it: it knows others, of which some run programs."""

_GREY = ("1", "L", "LA")
_COLOURS = ("RGB", "RGBA", "P", "CMYK", "YCbCr")


def read_still(path: Path) -> tuple[str, NDArray[np.uint8]]:
    """The pixels of an image file; alpha is left out.

    Returns:
        The ROS encoding, ``mono8`` or ``rgb8``, and pixels of shape (H, W) or (H, W, 3).

    Raises:
        SourceError: It is no image, is too large, or has other than 8 bits.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=STILL_FORMATS) as image:
                if max(image.size) > MAX_SIDE:
                    raise SourceError(path, f"has sides of more than {MAX_SIDE} pixels")
                if image.mode not in (*_GREY, *_COLOURS):
                    raise SourceError(
                        path, f"has samples of another kind than 8 bits ({image.mode})"
                    )
                is_grey = image.mode in _GREY
                pixels = np.asarray(image.convert("L" if is_grey else "RGB"), np.uint8)
    except SourceError:
        raise
    except (
        OSError, ValueError, SyntaxError, EOFError,
        Image.DecompressionBombError, Image.DecompressionBombWarning,
    ) as error:  # fmt: skip
        raise SourceError(path, f"cannot be read as an image: {error}") from None
    return ("mono8" if is_grey else "rgb8"), pixels


def png_file(rgb: NDArray[np.uint8]) -> bytes:
    """A PNG file.

    Args:
        rgb: Shape (H, W, 3).
    """
    return _file(rgb, "PNG", optimize=True)


def jpeg_bytes(rgb: NDArray[np.uint8], quality: int, *, is_grey: bool = False) -> int:
    """Bytes of the JPEG file that ROS's image transport and OpenCV make: of halved chroma.

    Args:
        rgb: Shape (H, W, 3).
        quality: 1 to 100.
        is_grey: Whether it shows a grey image, whose file has no chroma.
    """
    pixels = rgb[:, :, 1] if is_grey else rgb
    return len(_file(pixels, "JPEG", quality=quality))


def _file(pixels: NDArray[np.uint8], kind: str, **options: int) -> bytes:
    from PIL import Image

    save: Callable[..., None] = Image.fromarray(pixels).save
    file = io.BytesIO()
    save(file, kind, **options)
    return file.getvalue()
