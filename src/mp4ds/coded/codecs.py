"""Which codec a packet is of, by what its message says."""

from __future__ import annotations

from mp4ds.coded.base import Refused

# codec -> names that messages have for it: of the codec, or of an encoder that makes it
_NAMES = {
    "h264": ("h264", "avc", "libx264", "libopenh264"),
    "h265": ("h265", "hevc", "libx265"),
    "av1": ("av1", "libsvtav1", "libaom-av1", "librav1e"),
    "vp9": ("vp9", "libvpx-vp9"),
    "mjpeg": ("mjpeg", "jpeg", "jpg"),
}


def packet_codec(message_format: str) -> str:
    """The codec of the packets of a message.

    Args:
        message_format: `format` of Foxglove's CompressedVideo, or `encoding` of an
            FFMPEGPacket, whose first part names the codec or its encoder
            (``libx264``, ``hevc_nvenc``, ``h264;yuv420p;bgr8;bgr8``).

    Raises:
        Refused: No video here has that codec.
    """
    name = message_format.partition(";")[0].strip().lower()
    for codec, names in _NAMES.items():
        # hardware encoders are called h264_nvenc, hevc_vaapi ...
        if name in names or name.partition("_")[0] in names:
            return codec
    raise Refused(f"its codec {message_format[:40]!r} is none that a video here has")
