"""Coded pictures (JPEG, PNG, RVL, packets of video codecs): parsed, taken apart, and remade.

Nothing here decodes a video. A parser says what a picture is and what of it an mp4 would not
keep; what cannot be shown to come back byte for byte is `Refused`, with the reason, and is then
stored verbatim.
"""

from __future__ import annotations

from mp4ds.coded.base import Refused
from mp4ds.coded.codecs import packet_codec
from mp4ds.coded.packets import PACKET_CODECS, CodedPicture, PictureParser, body_of
from mp4ds.coded.png import ENCODINGS as PNG_ENCODINGS
from mp4ds.coded.png import PngRecipe, zlib_build, zlib_fingerprint

__all__ = [
    "PACKET_CODECS",
    "PNG_ENCODINGS",
    "CodedPicture",
    "PictureParser",
    "PngRecipe",
    "Refused",
    "body_of",
    "packet_codec",
    "zlib_build",
    "zlib_fingerprint",
]
