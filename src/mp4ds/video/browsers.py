"""What web browsers play."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from mp4ds.video.media import Media, pixel_format_of

_8BIT = frozenset({"yuv420p", "yuv422p", "yuv444p", "gbrp"})
_PLAYED = {
    "h264": _8BIT
    | {"yuvj420p", "yuvj422p", "yuvj444p", "gray"}
    | {"yuv420p10le", "yuv422p10le", "yuv444p10le", "gray10le"},
    "av1": frozenset({"yuv420p", "yuvj420p", "gray", "yuv420p10le", "gray10le"}),
    "vp9": _8BIT,
}
"""What Chromium was seen to show as it is; others play less of it."""

_FEW = ("hevc",)  # where the system or the graphics card decodes it


def why_not_in_browsers(path: Path) -> str:
    """Why browsers do not play a video; empty if Chromium and its kin do.

    Args:
        path: An mp4.

    Raises:
        VideoError: It cannot be read.
    """
    with closing(Media(path)) as media:
        context = media.track.codec_context
        name, pixel_format = context.codec.canonical_name, pixel_format_of(context)
    if name not in _PLAYED:
        return f"{'few browsers play' if name in _FEW else 'no browser plays'} {name}"
    if pixel_format not in _PLAYED[name]:
        return f"no browser plays {name} of the pixel format {pixel_format}"
    return ""
