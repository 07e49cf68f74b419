"""The images of a stream in another form, frame by frame.

Formats of CompressedImage are those of compressed_image_transport, and depths become metres as
in compressed_depth_image_transport (ros-perception/image_transport_plugins, their publishers and
subscribers).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded.depth import HEADER_BYTES
from mp4ds.errors import OptionError
from mp4ds.layouts import ENCODINGS, Pixels, pixel_view
from mp4ds.sidecar import Header, StreamSidecar
from mp4ds.streams import Stream
from mp4ds.streams.rebuild import form_for
from mp4ds.video import ImageFile, PacketReader
from mp4ds.video.packets import annexb_packets
from mp4ds.wire import CodedFields, Fields, ImageFields

_VIDEO_CODECS = ("h264", "h265", "av1", "vp9")  # formats of Foxglove's CompressedVideo
_COLOURS = ("rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "bgr16", "rgba16", "bgra16")
_DEPTHS = ("16UC1", "mono16")
_INVERSE_DEPTHS = "32FC1"


class AsRecorded(ValueError):  # noqa: N818 - no failure: the messages stay as they are
    """Images that cannot be given in another form; the text says why."""


@dataclass(frozen=True, slots=True)
class Given:
    """An image in its new form.

    Attributes:
        fields: What its message says of it.
        body: Pixels, file or packet.
    """

    fields: Fields
    body: bytes | memoryview


@dataclass(frozen=True, slots=True)
class Kept:
    """A message that stays as recorded, since its picture does not decode.

    Attributes:
        payload: The message.
    """

    payload: bytes | bytearray


Frames = Callable[[], Iterator[Given | Kept]]
"""One for each frame of a stream, in order.

Raises:
    FormatError: The stream is damaged.
"""


@dataclass(frozen=True, slots=True)
class Form:
    """What images are to be given as.

    Attributes:
        kind: One of `mp4ds.republish.KINDS`.
        ros1: Whether the messages are for ROS 1.
        jpeg_quality: Of new JPEG files, 1 to 100.
    """

    kind: str
    ros1: bool
    jpeg_quality: int


def frames_of(stream: Stream, form: Form) -> Frames:
    """How the images of a stream are given in another form.

    Raises:
        AsRecorded: They cannot be; says why.
    """
    if form.kind == "compressed-video":
        return _video(stream)
    if holds_files(stream.sidecar, form.kind):
        return partial(_own_files, stream, _own_formats(stream.sidecar, form))
    makers = [_maker(stream.sidecar, header, form) for header in stream.sidecar.headers]
    if stream.sidecar.body == "pixels":
        return partial(_from_pixels, stream, makers[0], form)
    return partial(_from_pictures, stream, makers)


def holds_files(sidecar: StreamSidecar, kind: str) -> bool:
    """Whether the messages of a stream hold JPEG or PNG files already."""
    if kind == "jpeg":
        return sidecar.body == "packet" and sidecar.video.codec == "mjpeg"
    is_metres = any(_is_inverse(sidecar, header) for header in sidecar.headers)
    return kind == "png" and sidecar.body == "png" and not is_metres


def files_of(stream: Stream) -> Iterator[memoryview]:
    """The files of a stream that `holds_files`, byte for byte.

    Raises:
        FormatError: A message does not come back as it was recorded.
    """
    variants = stream.rebuilder.columns.variant
    starts = [len(header.prefix) // 2 for header in stream.sidecar.headers]
    for index, body in enumerate(_bodies(stream)):
        yield body[starts[variants[index]] :] if stream.sidecar.body == "png" else body


def _video(stream: Stream) -> Frames:
    sidecar = stream.sidecar
    codec = sidecar.video.codec
    if codec not in _VIDEO_CODECS:
        known = ", ".join(_VIDEO_CODECS)
        raise AsRecorded(f"CompressedVideo has the codecs {known}, and this video is {codec}")
    if sidecar.body != "packet" and not sidecar.layout.is_shown:
        raise AsRecorded(
            f"its video does not show the images as they are seen (layout {sidecar.layout.name})"
        )

    def frames() -> Iterator[Given]:
        _verify(stream)
        fields = CodedFields(codec)
        return (Given(fields, packet) for packet in annexb_packets(stream.video_path, codec))

    return frames


def _own_formats(sidecar: StreamSidecar, form: Form) -> list[str]:
    encodings = [_encoding_of(sidecar, header) for header in sidecar.headers]
    return [_format(encoding, form, has_mosaic=True) for encoding in encodings]


def _own_files(stream: Stream, formats: list[str]) -> Iterator[Given]:
    for index, file in enumerate(files_of(stream)):
        variant = int(stream.rebuilder.columns.variant[index])
        yield Given(CodedFields(formats[variant]), file)


_Maker = Callable[[Pixels], Given]


def _maker(sidecar: StreamSidecar, header: Header, form: Form) -> _Maker:
    """What makes the new form of an image that a header belongs to."""
    if _is_inverse(sidecar, header) and len(header.prefix) != 2 * HEADER_BYTES:
        raise AsRecorded("the parameters of its quantised depths are missing")
    encoding = _encoding_of(sidecar, header)
    if form.kind == "raw":
        prefix = bytes.fromhex(header.prefix)
        as_metres = (
            partial(_metres, parameters=prefix[4:]) if _is_inverse(sidecar, header) else None
        )
        return partial(_raw, encoding=encoding, convert=as_metres)
    try:
        file = ImageFile(encoding, form.kind, quality=form.jpeg_quality)
    except OptionError:
        raise AsRecorded(f"{form.kind.upper()} files cannot hold {encoding} images") from None
    fields = CodedFields(_format(encoding, form, has_mosaic=form.kind == "png"))
    return lambda pixels: Given(fields, file.encode(pixels))


def _encoding_of(sidecar: StreamSidecar, header: Header) -> str:
    """ROS image encoding of the images; their format tells a mosaic or depths from plain grey."""
    own, told = ENCODINGS[sidecar.image.encoding], _told(header)
    if sidecar.body == "pixels":
        return own.name
    if _is_depth(sidecar, header):
        if told not in (*_DEPTHS, _INVERSE_DEPTHS):
            raise AsRecorded(f"its format {header.format!r} does not tell the unit of its depths")
        return told
    known = ENCODINGS.get(told, own)
    is_alike = known.rows == 1 and known.channels == own.channels == 1
    return known.name if is_alike and known.dtype == own.dtype else own.name


def _told(header: Header) -> str:
    return (header.format or "").partition(";")[0].strip()


def _is_depth(sidecar: StreamSidecar, header: Header) -> bool:
    """Whether the messages are those of compressed_depth_image_transport."""
    is_coded = sidecar.body in ("png", "rvl") and sidecar.image.encoding == _DEPTHS[0]
    return is_coded and (bool(header.prefix) or "compressedDepth" in (header.format or ""))


def _is_inverse(sidecar: StreamSidecar, header: Header) -> bool:
    """Whether its depths are quantised inverse metres."""
    return _is_depth(sidecar, header) and _told(header) == _INVERSE_DEPTHS


def _format(encoding: str, form: Form, *, has_mosaic: bool) -> str:
    """The field ``format``: the image's encoding, then that of the file.

    Args:
        encoding: Of the image.
        form: The form.
        has_mosaic: Whether the file shows a Bayer mosaic as it is, and not its colours.
    """
    known = ENCODINGS[encoding]
    if known.even != (1, 1) or known.rows != 1 or (known.mosaic and not has_mosaic):
        encoding = "rgb8"
    elif encoding == "8UC4" and form.kind == "jpeg":
        encoding = "8UC3"  # alpha is left out
    if encoding in _COLOURS:
        inner = "bgr16" if encoding.endswith("16") else "bgr8"
    else:
        is_grey = known.channels == 1 and form.kind == "jpeg"
        inner = "mono8" if is_grey and not form.ros1 else ""  # ROS 1 leaves it empty
    return f"{encoding}; {form.kind} compressed {inner}"


def _raw(
    pixels: Pixels, *, encoding: str, convert: Callable[[Pixels], Pixels] | None = None
) -> Given:
    if convert is not None:
        pixels = convert(pixels)
    height, width = pixels.shape[:2]
    step = width * ENCODINGS[encoding].pixel_bytes
    plain = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    return Given(ImageFields(encoding, width, height, step, 0), plain.tobytes())


def _metres(inverse: NDArray[np.uint16], *, parameters: bytes) -> NDArray[np.float32]:
    """Depths of inverse ones, as compressed_depth_image_transport computes them."""
    a, b = np.frombuffer(parameters, "<f4")
    with np.errstate(all="ignore"):
        metres = a / (inverse.astype(np.float32) - b)
    metres[inverse == 0] = np.nan
    found: NDArray[np.float32] = metres.astype(np.float32, copy=False)
    return found


def _from_pixels(stream: Stream, make: _Maker, form: Form) -> Iterator[Given]:
    """From raw images, whose bytes are compared with their digests."""
    image = stream.sidecar.image
    fields = ImageFields(image.encoding, image.width, image.height, image.step, image.is_bigendian)
    for body in _bodies(stream):
        if form.kind == "raw":
            yield Given(fields, body)
            continue
        yield make(
            pixel_view(
                body,
                ENCODINGS[image.encoding],
                width=image.width,
                height=image.height,
                step=image.step,
                is_bigendian=bool(image.is_bigendian),
            )
        )


def _bodies(stream: Stream) -> Iterator[memoryview]:
    """The bodies of the messages, each compared with its digest."""
    sidecar = stream.sidecar
    form = form_for(sidecar.channel.to_record(0), sidecar.wire, str(stream.path))
    if sidecar.digests is None:
        stream.verify_video()
    for payload in stream.payloads():
        yield form.split(memoryview(payload)).body


def _from_pictures(stream: Stream, makers: list[_Maker]) -> Iterator[Given | Kept]:
    """From the decoded pictures of files and packets."""
    _verify(stream)
    variants = stream.rebuilder.columns.variant
    with stream.open_video(sequential=True) as decoder:
        if stream.sidecar.body != "packet":
            for index, picture in enumerate(decoder.pictures()):
                yield makers[variants[index]](stream.rebuilder.pixels(picture))
            return
        due = 0
        for index, picture in decoder.numbered_pictures():
            yield from _kept(stream, range(due, index))
            yield makers[variants[index]](stream.rebuilder.pixels(picture))
            due = index + 1
        yield from _kept(stream, range(due, len(stream)))


def _kept(stream: Stream, indices: range) -> Iterator[Kept]:
    """Messages as recorded."""
    if not indices:
        return
    with PacketReader(
        stream.video_path, codec=stream.sidecar.video.codec, frames=len(stream)
    ) as reader:
        for index in indices:
            yield Kept(stream.rebuilder.packet_payload(index, reader.packet(index)))


def _verify(stream: Stream) -> None:
    """Compare the video with its SHA-256 or, without one, all messages with their digests."""
    stream.verify_video()
    if stream.sidecar.video.sha256 is None and stream.sidecar.digests is not None:
        for make in stream.makers():
            make()
