"""Pictures and words on one page, by Pillow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]


class Page:
    """A page of one colour to put pictures and words on.

    Args:
        size: Width and height, pixels.
        paper: Its colour.
        ink: Colour of the words.
        text_size: Height of the letters, pixels.
    """

    def __init__(
        self, size: tuple[int, int], *, paper: Colour, ink: Colour, text_size: int
    ) -> None:
        from PIL import Image, ImageDraw, ImageFont

        self._image = Image.new("RGB", size, paper)
        self._draw = ImageDraw.Draw(self._image)
        self._font = ImageFont.load_default(text_size)
        self._ink = ink

    def put(self, place: tuple[int, int], picture: NDArray[np.uint8]) -> None:
        """Put a picture of shape (H, W, 3) with its upper left corner at a place."""
        from PIL import Image

        self._image.paste(Image.fromarray(picture), place)

    def write(self, place: tuple[int, int], text: str) -> None:
        """Write words with their upper left corner at a place."""
        self._draw.text(place, text, self._ink, self._font)

    def pixels(self) -> NDArray[np.uint8]:
        """The page, shape (H, W, 3)."""
        made: NDArray[np.uint8] = np.asarray(self._image)
        return made
