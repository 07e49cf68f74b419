"""Videos: encoding pictures, decoding them, and the table of codecs. Only here is PyAV used."""

from __future__ import annotations

from mp4ds.video.codecs import Recipe, check_codec, recipe_for
from mp4ds.video.decoder import VideoDecoder
from mp4ds.video.encoder import VideoEncoder, tool_versions
from mp4ds.video.images import ImageFile

__all__ = [
    "ImageFile",
    "Recipe",
    "VideoDecoder",
    "VideoEncoder",
    "check_codec",
    "recipe_for",
    "tool_versions",
]
