"""What web browsers play."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from mp4ds.video.media import Media, pixel_format_of

_YUV420 = frozenset({"yuv420p", "yuvj420p", "gray"})
_PLAYED = {
    "h264": _YUV420,
    "av1": _YUV420 | {"yuv420p10le", "gray10le"},
    "vp9": frozenset({"yuv420p"}),
}


def why_not_in_browsers(path: Path) -> str:
    """Why no browser plays a video; empty if those that have its codec do.

    Args:
        path: An mp4.

    Raises:
        VideoError: It cannot be read.
    """
    with closing(Media(path)) as media:
        context = media.track.codec_context
        name, pixel_format = context.codec.canonical_name, pixel_format_of(context)
    if name not in _PLAYED:
        return f"no browser plays {name}"
    if pixel_format not in _PLAYED[name]:
        return f"no browser plays {name} of the pixel format {pixel_format}"
    return ""
