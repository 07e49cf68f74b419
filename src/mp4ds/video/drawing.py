"""Drawings of lines, dots and words as SVG, and pictures on one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

_TEXT_SIZE = 12


@dataclass(frozen=True, slots=True)
class Line:
    """A line through points, in pixels from the top left.

    Attributes:
        points: At least two.
        color: As ``#rrggbb``.
        width: Pixels.
        dashed: Whether the line is dashed.
    """

    points: Sequence[tuple[float, float]]
    color: str
    width: float = 1.0
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Dot:
    """A disc.

    Attributes:
        place: Of its middle, pixels.
        color: As ``#rrggbb``.
        radius: Pixels.
        tip: Tooltip in an SVG.
    """

    place: tuple[float, float]
    color: str
    radius: float = 4.0
    tip: str = ""


@dataclass(frozen=True, slots=True)
class Text:
    """Words.

    Attributes:
        place: Pixels; their height is in the middle of it.
        words: One line.
        anchor: ``start``, ``middle`` or ``end``: which part of them is there.
        color: As ``#rrggbb``.
    """

    place: tuple[float, float]
    words: str
    anchor: str = "start"
    color: str = "#333333"


Shape = Line | Dot | Text


def svg_of(shapes: Sequence[Shape], size: tuple[int, int]) -> str:
    """The drawing as an SVG element.

    Args:
        shapes: Later shapes cover earlier ones.
        size: Width and height, pixels.
    """
    width, height = size
    parts = "\n".join(map(_svg_shape, shapes))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="{_TEXT_SIZE}">\n'
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>\n{parts}\n</svg>\n'
    )


def _svg_shape(shape: Shape) -> str:
    if isinstance(shape, Line):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shape.points)
        dashes = ' stroke-dasharray="5 4"' if shape.dashed else ""
        return (
            f'<polyline points="{points}" fill="none" stroke="{shape.color}" '
            f'stroke-width="{shape.width:g}"{dashes}/>'
        )
    x, y = shape.place
    if isinstance(shape, Dot):
        tip = f"<title>{escape(shape.tip)}</title>" if shape.tip else ""
        return (
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{shape.radius:g}" fill="{shape.color}">'
            f"{tip}</circle>"
        )
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{shape.anchor}" '
        f'dominant-baseline="central" fill="{shape.color}">{escape(shape.words)}</text>'
    )


# ---------------------------------------------------------------- sheets

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
