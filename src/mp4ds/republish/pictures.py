"""The images of a stream in another form, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial

from mp4ds.layouts import ENCODINGS, pixel_view
from mp4ds.republish.forms import (
    AsRecorded,
    Form,
    Given,
    Kept,
    Maker,
    encoding_of,
    format_of,
    is_inverse_depth,
    maker,
    resizer,
)
from mp4ds.republish.packets import VideoFields
from mp4ds.republish.reduction import Reduction
from mp4ds.republish.types import type_of
from mp4ds.sidecar import StreamSidecar
from mp4ds.streams import Stream
from mp4ds.streams.choices import Choice, everything, unbroken
from mp4ds.streams.rebuild import form_for
from mp4ds.video import ImageFile, PacketReader
from mp4ds.video.stand_alone import StandAlonePackets
from mp4ds.wire import CodedFields, ImageFields

VIDEO_KINDS = ("compressed-video", "ffmpeg")
"""Kinds whose messages are packets of the video as it is."""

_VIDEO_CODECS = ("h264", "h265", "av1", "vp9")  # formats of Foxglove's CompressedVideo

Frames = Callable[[Choice, bool], Iterator[tuple[int, Given | Kept]]]
"""One for each frame of a stream that is wanted, with its number, in order.

Packets come with those that they refer to, from a key frame on.

Args:
    choice: Which are wanted.
    verify: Compare the whole video first, for where no digest tells damage.

Raises:
    FormatError: The stream is damaged.
"""


def frames_of(stream: Stream, form: Form) -> Frames:
    """How the images of a stream are given in another form.

    Raises:
        AsRecorded: They cannot be; says why.
    """
    if form.kind in VIDEO_KINDS:
        return _video(stream, form.kind)
    if form.size is None and holds_files(stream.sidecar, form.kind):
        return partial(_own_files, stream, _own_formats(stream.sidecar, form))
    makers = [maker(stream.sidecar, header, form) for header in stream.sidecar.headers]
    if stream.sidecar.body == "pixels":
        return partial(_from_pixels, stream, makers[0], form)
    return partial(_from_pictures, stream, makers)


def holds_files(sidecar: StreamSidecar, kind: str) -> bool:
    """Whether the messages of a stream hold JPEG or PNG files already."""
    if kind == "jpeg":
        return sidecar.body == "packet" and sidecar.video.codec == "mjpeg"
    is_metres = any(is_inverse_depth(sidecar, header) for header in sidecar.headers)
    return kind == "png" and sidecar.body == "png" and not is_metres


def files_of(
    stream: Stream, choice: Choice = everything, verify: bool = True
) -> Iterator[tuple[int, memoryview]]:
    """The files of a stream that `holds_files`, byte for byte, each with its number.

    Args:
        stream: The stream.
        choice: Which are wanted.
        verify: Compare the whole video first, where messages have no digests.

    Raises:
        FormatError: A message does not come back as it was recorded.
    """
    variants = stream.rebuilder.columns.variant
    starts = [len(header.prefix) // 2 for header in stream.sidecar.headers]
    for index, body in _bodies(stream, choice, verify):
        start = starts[variants[index]] if stream.sidecar.body == "png" else 0
        yield index, body[start:]


def _video(stream: Stream, kind: str) -> Frames:
    sidecar = stream.sidecar
    codec = sidecar.video.codec
    if codec not in _VIDEO_CODECS:
        known, name = ", ".join(_VIDEO_CODECS), type_of(kind).rpartition("/")[2]
        raise AsRecorded(f"{name} has the codecs {known}, and this video is {codec}")
    if sidecar.body != "packet" and not sidecar.layout.is_shown:
        raise AsRecorded(
            f"its video does not show the images as they are seen (layout {sidecar.layout.name})"
        )
    return partial(_packets_of, stream)


def _packets_of(stream: Stream, choice: Choice, verify: bool) -> Iterator[tuple[int, Given]]:
    """The packets of the video, which stand alone from each key frame on."""
    if verify:
        _verify(stream)
    codec, image = stream.sidecar.video.codec, stream.sidecar.image
    with StandAlonePackets(stream.video_path, codec=codec, frames=len(stream)) as packets:
        fields = VideoFields(codec, image.encoding, image.width, image.height, packets.pixel_format)
        wanted = choice(stream.rebuilder.columns)
        for index in unbroken(wanted, packets.key_numbers, from_key=True):
            is_key = bool(packets.keyframes[index])
            yield index, Given(fields, packets.packet(index), is_key=is_key)


def _own_formats(sidecar: StreamSidecar, form: Form) -> list[str]:
    encodings = [encoding_of(sidecar, header) for header in sidecar.headers]
    return [format_of(encoding, form, has_mosaic=True) for encoding in encodings]


def _own_files(
    stream: Stream, formats: list[str], choice: Choice, verify: bool
) -> Iterator[tuple[int, Given]]:
    for index, file in files_of(stream, choice, verify):
        variant = int(stream.rebuilder.columns.variant[index])
        yield index, Given(CodedFields(formats[variant]), file)


def _from_pixels(
    stream: Stream, make: Maker, form: Form, choice: Choice, verify: bool
) -> Iterator[tuple[int, Given]]:
    """From raw images, whose bytes are compared with their digests."""
    image = stream.sidecar.image
    fields = ImageFields(image.encoding, image.width, image.height, image.step, image.is_bigendian)
    for index, body in _bodies(stream, choice, verify):
        if form.kind == "raw" and form.size is None:
            yield index, Given(fields, body)
            continue
        pixels = pixel_view(
            body,
            ENCODINGS[image.encoding],
            width=image.width,
            height=image.height,
            step=image.step,
            is_bigendian=bool(image.is_bigendian),
        )
        yield index, make(pixels)


def _bodies(stream: Stream, choice: Choice, verify: bool) -> Iterator[tuple[int, memoryview]]:
    """The bodies of the messages, each compared with its digest."""
    sidecar = stream.sidecar
    form = form_for(sidecar.channel.to_record(0), sidecar.wire, str(stream.path))
    if sidecar.digests is None and verify:
        stream.verify_video()
    for index, make in stream.numbered_makers(choice):
        yield index, form.split(memoryview(make())).body


def _from_pictures(
    stream: Stream, makers: list[Maker], choice: Choice, verify: bool
) -> Iterator[tuple[int, Given | Kept]]:
    """From the decoded pictures of files and packets."""
    if verify:
        _verify(stream)
    columns = stream.rebuilder.columns
    with stream.open_video(sequential=True) as decoder, ExitStack() as files:
        if stream.sidecar.body != "packet":
            for index, picture in stream.pictures_in_order(decoder, choice):
                make = makers[columns.variant[index]]
                yield index, make(stream.rebuilder.pixels(picture))
            return
        packets = None
        for index, found in decoder.decodable_pictures(choice(columns)):
            if found is not None:
                make = makers[columns.variant[index]]
                yield index, make(stream.rebuilder.pixels(found))
                continue
            packets = packets or files.enter_context(_packets(stream))
            yield index, Kept(stream.rebuilder.packet_payload(index, packets.packet(index)))


def _packets(stream: Stream) -> PacketReader:
    return PacketReader(stream.video_path, codec=stream.sidecar.video.codec, frames=len(stream))


def _verify(stream: Stream) -> None:
    """Compare the video with its SHA-256 or, without one, all messages with their digests."""
    stream.verify_video()
    if stream.sidecar.video.sha256 is None and stream.sidecar.digests is not None:
        for make in stream.makers():
            make()


def image_files(
    stream: Stream, kind: str, reduction: Reduction, *, jpeg_quality: int
) -> Iterator[tuple[int, bytes | memoryview]]:
    """The images of a stream as files, each with its number.

    JPEG files stay as they were recorded if that is what is wanted, all others are those of the
    stream's frames.

    Args:
        stream: The stream.
        kind: ``png`` or ``jpeg``.
        reduction: How much smaller or fewer they are.
        jpeg_quality: Of new JPEG files, 1 to 100.

    Raises:
        OptionError: The files cannot hold the images.
        FormatError: The stream is damaged.
    """
    choice = reduction.choice_of(stream)
    size = reduction.size_of(stream)
    if kind == "jpeg" and size is None and holds_files(stream.sidecar, kind):
        yield from files_of(stream, choice)
        return
    resize, encoding = resizer(stream.sidecar, stream.sidecar.image.encoding, size)
    file = ImageFile(encoding, kind, quality=jpeg_quality)
    with stream.open_video(sequential=True) as decoder:
        for index, picture in stream.pictures_in_order(decoder, choice):
            yield index, file.encode(resize(stream.rebuilder.pixels(picture)))
