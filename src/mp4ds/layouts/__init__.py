"""How the pixels of a ROS image become the picture that a video holds, and return.

numpy only. A picture is what the encoder is given, in one of ffmpeg's pixel formats; the codec
is not chosen here. A layout is a step on the values (`mp4ds.layouts.values`) and one on their
places (`mp4ds.layouts.arrangements`).
"""

from __future__ import annotations

from mp4ds.layouts.arrangements import Picture
from mp4ds.layouts.bound import Layout, bind, fit, layout_for, why_not
from mp4ds.layouts.chroma import CHROMA_SHIFTS
from mp4ds.layouts.encodings import (
    ENCODINGS,
    MAX_ROW_PADDING,
    MAX_SIDE,
    Encoding,
    Pixels,
    pixel_view,
    put_padding,
    row_padding,
)
from mp4ds.layouts.kinds import LAYOUTS, LayoutKind
from mp4ds.layouts.numbers import MAX_TABLE, SCALES
from mp4ds.layouts.values import NO_PARAMETERS, Parameters

__all__ = [
    "CHROMA_SHIFTS",
    "ENCODINGS",
    "LAYOUTS",
    "MAX_ROW_PADDING",
    "MAX_SIDE",
    "MAX_TABLE",
    "NO_PARAMETERS",
    "SCALES",
    "Encoding",
    "Layout",
    "LayoutKind",
    "Parameters",
    "Picture",
    "Pixels",
    "bind",
    "fit",
    "layout_for",
    "pixel_view",
    "put_padding",
    "row_padding",
    "why_not",
]
