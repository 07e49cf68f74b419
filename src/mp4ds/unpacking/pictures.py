"""The images of a stream in another form, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from mp4ds.dataset.images import Images, VerbatimImages
from mp4ds.dataset.rebuild import form_for
from mp4ds.dataset.stream import Layer, Stream
from mp4ds.errors import OptionError, Refused
from mp4ds.format.fields import Choice, unbroken
from mp4ds.format.models import Header, StreamSidecar
from mp4ds.messages.depth import (
    DEPTHS,
    HEADER_BYTES,
    is_depth,
    is_quantised,
    metres_of,
    told_encoding,
)
from mp4ds.messages.encodings import ENCODINGS, Pixels, pixel_view
from mp4ds.messages.wire import CodedFields, Fields, ImageFields
from mp4ds.options import TopicOptions, option
from mp4ds.video.codecs import CODECS, VISUAL
from mp4ds.video.images import ImageFile

# ---------------------------------------------------------------- kinds

_ENCODERS = {"h264": "libx264", "h265": "hevc_nvenc"}  # decoders in ROS 1 go by these
_VIDEO = "string frame_id\nuint8[] data\nstring format\n"


@dataclass(frozen=True, slots=True)
class Kind:
    """What images can be converted to.

    Attributes:
        type_name: Type of the messages, as ROS 2 spells it.
        family: ``raw``, ``file`` or ``video``.
        noun: What the images are, for people.
        suffix: Last part of the topic that image_transport gives them; None if it has none.
        definitions: Message encoding -> definition, of a type that is not standard.
    """

    type_name: str
    family: str
    noun: str
    suffix: str | None
    definitions: Mapping[str, str] = field(default_factory=dict)

    @property
    def ros1_type(self) -> str:
        """Type of the messages, as ROS 1 spells it."""
        return self.type_name.replace("/msg/", "/")


KINDS: Mapping[str, Kind] = {
    "raw": Kind("sensor_msgs/msg/Image", "raw", "raw images", None),
    "jpeg": Kind("sensor_msgs/msg/CompressedImage", "file", "JPEG files", "compressed"),
    "png": Kind("sensor_msgs/msg/CompressedImage", "file", "PNG files", "compressed"),
    "compressed-video": Kind(
        "foxglove_msgs/msg/CompressedVideo",
        "video",
        "CompressedVideo",
        "compressed_video",
        {
            "ros1": f"time timestamp\n{_VIDEO}",
            "cdr": f"builtin_interfaces/Time timestamp\n{_VIDEO}",
        },
    ),
    "ffmpeg": Kind(
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "video",
        "FFMPEGPackets",
        "ffmpeg",
        {
            "ros1": "Header header\nuint8[] data\nint32 img_width\nint32 img_height\n"
            "string encoding\nuint64 pts\nuint8 flags\n",
            "cdr": "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\n"
            "uint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data\n",
        },
    ),
}
"""Names of kinds, as users write them."""

FAMILIES = {kind.type_name.rpartition("/")[2]: kind.family for kind in KINDS.values()}
"""Last part of the name of a camera's type -> its family."""
FAMILIES["RawImage"] = FAMILIES["Image"]  # Foxglove's


# ---------------------------------------------------------------- layers


@dataclass(frozen=True, kw_only=True)
class FrameOptions(TopicOptions):
    """Which topics, and which of their images."""

    quality: str | None = option(
        "visual: the images of the views of lossless cameras; default: as recorded.",
        choices=(VISUAL,),
    )

    @property
    def layer(self) -> Layer | None:
        """Which frames are read of cameras that have a view; None: exact ones where they are."""
        return "view" if self.quality else None


# ---------------------------------------------------------------- forms

_COLOURS = ("rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "bgr16", "rgba16", "bgra16")


@dataclass(frozen=True, slots=True)
class Given:
    """An image in its new form.

    Attributes:
        fields: Its message's fields.
        body: Pixels, file or packet.
        is_key: For a packet, whether decoding can begin with it.
    """

    fields: Fields
    body: bytes | memoryview
    is_key: bool = False


def encoding_of(sidecar: StreamSidecar, header: Header) -> str:
    """ROS image encoding of the images; their format tells a mosaic or depths from plain grey."""
    own, told = ENCODINGS[sidecar.image.encoding], told_encoding(header.format)
    if sidecar.body == "pixels":
        return own.name
    if _is_depth(sidecar, header):
        if told not in DEPTHS:
            raise Refused(f"its format {header.format!r} does not give the unit of its depths")
        return told
    return named_encoding(own.name, header.format)


def named_encoding(encoding: str, format_: str | None) -> str:
    """The encoding of a coded image of one: that of the field ``format``, where it can be."""
    own = ENCODINGS[encoding]
    known = ENCODINGS.get(told_encoding(format_), own)
    is_alike = known.rows == 1 and known.channels == own.channels == 1
    return known.name if is_alike and known.dtype == own.dtype else own.name


def _is_depth(sidecar: StreamSidecar, header: Header) -> bool:
    """Whether the messages are those of compressed_depth_image_transport."""
    is_coded = sidecar.body in ("png", "rvl") and sidecar.image.encoding == "16UC1"
    return is_coded and is_depth(header.format, bytes.fromhex(header.prefix))


def is_inverse_depth(sidecar: StreamSidecar, header: Header) -> bool:
    """Whether its depths are quantised inverse metres."""
    return _is_depth(sidecar, header) and is_quantised(header.format, bytes.fromhex(header.prefix))


def has_inverse_depths(stream: Images) -> bool:
    """Whether depths of a stream are quantised inverse metres."""
    return isinstance(stream, Stream) and any(
        is_inverse_depth(stream.sidecar, header) for header in stream.sidecar.headers
    )


def raw_image(
    pixels: Pixels, *, encoding: str, convert: Callable[[Pixels], Pixels] | None = None
) -> Given:
    """A raw image of pixels in native byte order, or of what they are converted to."""
    if convert is not None:
        pixels = convert(pixels)
    height, width = pixels.shape[:2]
    step = width * ENCODINGS[encoding].pixel_bytes
    plain = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    return Given(ImageFields(encoding, width, height, step, 0), plain.tobytes())


# ---------------------------------------------------------------- pictures

_VIDEO_CODECS = ("h264", "h265", "av1", "vp9")  # formats of Foxglove's CompressedVideo

Frames = Iterator[tuple[int, Given | bytes | bytearray]]
"""Frames with their numbers; one whose picture cannot be decoded is the message as recorded."""


class Conversion:
    """How the images of a stream get another form.

    Args:
        stream: The stream.
        kind: The form, one of `KINDS`.
        world: ``ros1`` or ``ros2``: what the messages are for.
        jpeg_quality: Of new JPEG files, 1 to 100.
        in_place: Whether the messages are of that kind already, and stay on their channel. Files
            then keep their format field if they hold the same.

    Attributes:
        frames: Gives the wanted frames, in order; packets come with those they refer to, from a key
            frame on. It is also told whether to check the whole video first, for when no digest
            would reveal damage. It raises a `FormatError` where the stream is damaged.

    Raises:
        Refused: They cannot be converted; says why.
    """

    frames: Callable[[Choice, bool], Frames]

    def __init__(
        self, stream: Stream, kind: str, world: str, *, jpeg_quality: int, in_place: bool
    ) -> None:
        self.stream, self.kind, self.world, self.in_place = stream, kind, world, in_place
        headers = stream.sidecar.headers
        if KINDS[kind].family == "video":
            self._shown = shown_by_packets(stream)
            shown, known = self._shown.sidecar, ", ".join(_VIDEO_CODECS)
            if shown.video.codec not in _VIDEO_CODECS:
                name, codec = KINDS[kind].type_name.rpartition("/")[2], shown.video.codec
                raise Refused(f"{name} supports the codecs {known}, but this video is {codec}")
            if shown.body != "packet" and not shown.layout.is_shown:
                raise Refused(
                    f"its video does not show the images as they look (layout {shown.layout.name})"
                )
            if self._shown.hides_frames:
                raise Refused("the first packets of the slice depend on packets outside it")
            self.frames = self._packets
        elif holds_files(stream, kind):
            encodings = [encoding_of(stream.sidecar, header) for header in headers]
            self._formats = [self._format(one, has_mosaic=True) for one in encodings]
            self.frames = self._files
        else:
            self._makers = [self._maker(header, jpeg_quality) for header in headers]
            is_raw = stream.sidecar.body == "pixels"
            self.frames = self._from_pixels if is_raw else self._from_pictures

    def _maker(self, header: Header, jpeg_quality: int) -> Callable[[Pixels], Given]:
        """What makes the new form of images with a header from their pixels.

        Raises:
            Refused: They have no such form; says why.
        """
        sidecar, kind = self.stream.sidecar, self.kind
        is_inverse = is_inverse_depth(sidecar, header)
        if is_inverse and len(header.prefix) != 2 * HEADER_BYTES:
            raise Refused("the parameters of its quantised depths are missing")
        recorded = encoding_of(sidecar, header)
        if kind == "raw":
            prefix = bytes.fromhex(header.prefix)
            as_metres = partial(metres_of, header=prefix) if is_inverse else None
            return partial(raw_image, encoding=recorded, convert=as_metres)
        try:
            file = ImageFile(recorded, kind, quality=jpeg_quality)
        except OptionError:
            raise Refused(f"{kind.upper()} files cannot hold {recorded} images") from None
        told = self._format(recorded, has_mosaic=kind == "png")
        if self.in_place:
            told = header.format or ""
        return lambda pixels: Given(CodedFields(told), file.encode(pixels))

    def _format(self, encoding: str, *, has_mosaic: bool) -> str:
        """The field ``format`` of files: the image's encoding, then that of the file.

        Args:
            encoding: Of the image.
            has_mosaic: Whether the file shows a raw Bayer mosaic, not its colours.
        """
        known, is_jpeg = ENCODINGS[encoding], self.kind == "jpeg"
        if known.even != (1, 1) or known.rows != 1 or (known.mosaic and not has_mosaic):
            encoding = "rgb8"
        elif encoding == "8UC4" and is_jpeg:
            encoding = "8UC3"  # alpha is dropped
        if encoding in _COLOURS:
            inner = "bgr16" if encoding.endswith("16") else "bgr8"
        else:
            is_grey = known.channels == 1 and is_jpeg
            inner = "mono8" if is_grey and self.world == "ros2" else ""  # ROS 1 leaves it empty
        return f"{encoding}; {self.kind} compressed {inner}"

    def _packet_format(self, pixel_format: str) -> str:
        """What messages say about the coding of their packets, whose pictures have a format."""
        sidecar = self._shown.sidecar
        if self.kind == "compressed-video":
            return sidecar.video.codec
        codec = CODECS[sidecar.video.codec].ffmpeg
        if self.world == "ros1":
            return _ENCODERS.get(sidecar.video.codec, codec)
        known = ENCODINGS[sidecar.image.encoding]
        before = shown = "mono8"
        if known.channels != 1 or known.mosaic or known.rows != 1:
            before, shown = "bgr8", "rgb8" if known.name.startswith("rgb") else "bgr8"
        # the video itself has its range
        return ";".join((codec, pixel_format.replace("yuvj", "yuv"), before, shown))

    def _packets(self, choice: Choice, verify: bool) -> Frames:
        """The packets of the video, self-contained from each key frame on."""
        stream, shown = self.stream, self._shown
        if verify:  # without a hash, digests of exact images tell of damage to what predicts them
            (shown if shown.sidecar.video.sha256 else stream).verify_pictures()
        with shown.open_packets() as packets:
            told = self._packet_format(packets.pixel_format)
            fields = CodedFields(told, *stream.image_size)
            wanted = unbroken(choice(stream.columns), packets.key_numbers, from_key=True)
            for index in stream.sound_of(wanted):
                is_key = bool(packets.keyframes[index])
                yield index, Given(fields, packets.stand_alone(index), is_key=is_key)

    def _files(self, choice: Choice, verify: bool) -> Frames:
        variants = self.stream.columns.variant
        for index, file in files_of(self.stream, choice, verify):
            yield index, Given(CodedFields(self._formats[variants[index]]), file)

    def _from_pixels(self, choice: Choice, verify: bool) -> Frames:
        """From raw images, checked against their digests."""
        make, fields = self._makers[0], self.stream.sidecar.image.to_fields()
        for index, body in _bodies(self.stream, choice, verify):
            if self.kind == "raw":
                yield index, Given(fields, body)
                continue
            yield index, make(pixel_view(body, fields))

    def _from_pictures(self, choice: Choice, verify: bool) -> Frames:
        """From the decoded pictures of files and packets."""
        stream = self.stream
        if verify:
            stream.verify_pictures()
        with ExitStack() as files:
            packets = None
            is_strict = not stream.sidecar.keeps_packets
            for index, picture in stream.decodable_pictures(choice, is_strict=is_strict):
                if picture is not None:
                    make = self._makers[stream.columns.variant[index]]
                    yield index, make(stream.recorded_pixels(picture))
                    continue
                packets = packets or files.enter_context(stream.open_packets())
                yield index, stream.rebuilder.packet_payload(index, packets.packet(index))


def shown_by_packets(stream: Stream) -> Stream:
    """The layer of a stream whose packets players show: its own if they are those of a video."""
    sidecar = stream.sidecar
    is_video = sidecar.body == "packet" and sidecar.video.codec in _VIDEO_CODECS
    return stream if is_video else stream.in_layer("view")


def holds_files(stream: Stream, kind: str) -> bool:
    """Whether the messages of a stream hold JPEG or PNG files already."""
    is_alike = (kind, stream.file_suffix) in (("jpeg", "jpg"), ("png", "png"))
    return is_alike and not has_inverse_depths(stream)


def files_of(
    stream: Stream | VerbatimImages, choice: Choice, verify: bool = True
) -> Iterator[tuple[int, bytes | memoryview]]:
    """The files in messages that hold some, byte for byte, each with its number.

    Args:
        stream: Images with a `file_suffix`.
        choice: Which are wanted.
        verify: Check the whole video first, if messages have no digests.

    Raises:
        FormatError: A message differs from what was recorded.
    """
    if isinstance(stream, VerbatimImages):
        yield from ((index, stream.shown(index).file) for index in choice(stream.columns))
        return
    variants = stream.columns.variant
    starts = [len(header.prefix) // 2 for header in stream.sidecar.headers]
    for index, body in _bodies(stream, choice, verify):
        start = starts[variants[index]] if stream.sidecar.body == "png" else 0
        yield index, body[start:]


def _bodies(stream: Stream, choice: Choice, verify: bool) -> Iterator[tuple[int, memoryview]]:
    """The bodies of the messages, each checked against its digest."""
    sidecar = stream.sidecar
    form = form_for(stream.channel, sidecar.wire, str(stream.path))
    if sidecar.digests is None and verify:
        stream.verify_video()
    for index, payload in stream.payloads(choice):
        yield index, form.split(memoryview(payload)).body
