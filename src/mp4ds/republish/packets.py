"""Messages of video packets, in the serialization of ROS 1 and in ROS 2's CDR.

What an FFMPEGPacket calls its encoding is what ffmpeg_image_transport looks its decoder up by: in
ROS 2 the codec, the video's pixel format, that of the images before they were encoded, and the ROS
encoding to decode to (ffmpeg_image_transport_msgs, "FFMPEGPacket.msg"); in ROS 1 the name of an
encoder, of which it knows those that are named here.
"""

from __future__ import annotations

from dataclasses import dataclass

from mp4ds.layouts import ENCODINGS
from mp4ds.wire import Slots, WireError
from mp4ds.wire.cursor import Writer
from mp4ds.wire.forms import NS

_FFMPEG_NAMES = {"h265": "hevc"}
_ENCODERS = {"h264": "libx264", "h265": "hevc_nvenc"}
_KEY_FRAME = 1  # AV_PKT_FLAG_KEY


@dataclass(frozen=True, slots=True)
class VideoFields:
    """What a message says of a packet of video.

    Attributes:
        codec: Name in the registry.
        encoding: ROS image encoding of the images that the video was made of.
        width: Columns of the images.
        height: Rows of the images.
        pixel_format: Of the video as ffmpeg calls it.
    """

    codec: str
    encoding: str
    width: int
    height: int
    pixel_format: str

    def ffmpeg_encoding(self, *, ros1: bool) -> str:
        """The field ``encoding`` of an FFMPEGPacket."""
        codec = _FFMPEG_NAMES.get(self.codec, self.codec)
        if ros1:
            return _ENCODERS.get(self.codec, codec)
        known = ENCODINGS[self.encoding]
        if known.channels == 1 and not known.mosaic and known.rows == 1:
            before = shown = "mono8"
        else:
            before = "bgr8"
            shown = "rgb8" if self.encoding.startswith("rgb") else "bgr8"
        pixel_format = self.pixel_format.replace("yuvj", "yuv")  # the video itself tells its range
        return ";".join((codec, pixel_format, before, shown))


def video_message(
    encoding: str, slots: Slots, frame_id: str, codec: str, body: bytes | memoryview
) -> bytes:
    """A CompressedVideo: what follows the data is aligned in CDR.

    Args:
        encoding: ``ros1`` or ``cdr``.
        slots: Stamp.
        frame_id: Coordinate frame.
        codec: Its field ``format``.
        body: The packet.

    Raises:
        WireError: The stamp has no place in the serialization.
    """
    is_cdr = encoding == "cdr"
    head = _begun(encoding, slots)
    head.string(frame_id, terminated=is_cdr)
    head.put("I", len(body))
    tail = Writer(b"", "<", aligned=False)
    tail.string(codec, terminated=is_cdr)
    gap = bytes(-len(body) % 4 if is_cdr else 0)
    return b"".join((head.getvalue(), body, gap, tail.getvalue()))


def ffmpeg_message(
    encoding: str,
    slots: Slots,
    frame_id: str,
    fields: VideoFields,
    body: bytes | memoryview,
    is_key: bool,
) -> bytes:
    """An FFMPEGPacket, whose fields ROS 1 has in another order and under other names.

    Args:
        encoding: ``ros1`` or ``cdr``.
        slots: Stamp, sequence number, presentation time.
        frame_id: Coordinate frame.
        fields: Of the video.
        body: The packet.
        is_key: Whether decoding can begin with it.

    Raises:
        WireError: The stamp or a number has no place in the serialization.
    """
    is_cdr = encoding == "cdr"
    head = _begun(encoding, slots, has_seq=not is_cdr)
    head.string(frame_id, terminated=is_cdr)
    told = Writer(b"", "<", aligned=False) if not is_cdr else head
    told.put("i", fields.width, fields.height)
    told.string(fields.ffmpeg_encoding(ros1=not is_cdr), terminated=is_cdr)
    told.put("Q", slots.pts or 0)
    told.put("B", _KEY_FRAME if is_key else 0)
    if is_cdr:
        head.put("B", 0)  # not of a machine that stores big endian
        head.put("I", len(body))
        return b"".join((head.getvalue(), body))
    head.put("I", len(body))
    return b"".join((head.getvalue(), body, told.getvalue()))


def _begun(encoding: str, slots: Slots, *, has_seq: bool = False) -> Writer:
    """A message up to its stamp."""
    is_cdr = encoding == "cdr"
    seconds, nanoseconds = divmod(slots.stamp, NS)
    if not (-(2**31) if is_cdr else 0) <= seconds < (2**31 if is_cdr else 2**32):
        raise WireError("its stamp is beyond what ROS has bits for")
    writer = Writer(b"\0\1\0\0" if is_cdr else b"", "<", aligned=is_cdr)
    if has_seq:
        writer.put("I", slots.seq or 0)
    writer.put("i" if is_cdr else "I", seconds)
    writer.put("I", nanoseconds)
    return writer
