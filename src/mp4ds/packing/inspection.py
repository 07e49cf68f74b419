"""What a message holds, to which stream it belongs, and what columns and headers it becomes."""

from __future__ import annotations

import base64
import zlib
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from mp4ds.errors import Refused
from mp4ds.format.fields import MAX_VARIANTS, Body, Columns, columns_model
from mp4ds.messages import depth, png
from mp4ds.messages.encodings import ENCODINGS, Pixels, Samples, pixel_view, row_padding
from mp4ds.messages.layouts import why_not
from mp4ds.messages.png import PNG_ENCODINGS
from mp4ds.messages.serializations import MessageSplitter
from mp4ds.messages.wire import (
    CodedFields,
    Form,
    ImageFields,
    Parts,
    Template,
    WireError,
    prove,
)
from mp4ds.records import Channel, Message
from mp4ds.times import INT64_MAX, INT64_MIN
from mp4ds.video.codecs import CODECS, packet_codec
from mp4ds.video.coded import StreamParser, parse_jpeg
from mp4ds.video.decoder import jpeg_pixels

_ModelT = TypeVar("_ModelT")

_MAX_PNG_REFUSALS = 20  # in a row


@dataclass(frozen=True, slots=True)
class StreamKey:
    """What the messages of one stream have in common.

    Attributes:
        wire: Serialization.
        body: What a message's body is to the video (spec/registry.md, "Bodies").
        codec: Codec of packets; empty if the video is encoded here.
        encoding: ROS image encoding of the frames.
        width: Columns.
        height: Rows.
        step: Bytes per row.
        is_bigendian: The byte as it stands.
    """

    wire: str
    body: Body
    codec: str
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: int = 0


@dataclass(frozen=True, slots=True)
class BodyFraming:
    """What turns a packet or pixels into a body, the same for many messages.

    Attributes:
        framing: Start codes and delimiters that an mp4 does not keep.
        prefix: Bytes before the coded picture.
        png: How its file was written.
        padding: The row padding, deflated; None: zeros.
    """

    framing: str = ""
    prefix: bytes = b""
    png: png.PngRecipe | None = None
    padding: bytes | None = None


@dataclass(frozen=True, slots=True)
class CameraMessage:
    """What a stream needs to know about a camera message.

    Attributes:
        message: As recorded; its payload must stay as it is while this is in use.
        form: How it is serialized.
        parts: Its parts.
        key: Its stream's.
        wrap: What its body has besides the packet or pixels.
        pixels: Its pixels, shape as `pixel_view` gives it; None for a packet.
        source: What its colours were made of, if a track that keeps that has proven it.
        keyframe: Whether decoding can begin at its packet.
        parameters: What a decoder needs before the packet.
    """

    message: Message
    form: Form
    parts: Parts
    key: StreamKey
    wrap: BodyFraming = BodyFraming()
    pixels: Pixels | None = None
    source: Samples | None = None
    keyframe: bool = True
    parameters: bytes = b""


class MessageInspector:
    """Inspects the messages of one channel.

    Args:
        channel: The channel.
        transcode: Decode JPEG files instead of taking them as packets.
    """

    def __init__(self, channel: Channel, *, transcode: bool = False) -> None:
        self._is_packets = _holds_packets(channel)
        self._forms = MessageSplitter(channel)
        self._parsers: dict[str, StreamParser] = {}
        self._png: png.PngRecipe | None = None
        self._png_refusals = 0
        self._transcode = transcode

    def inspect(self, message: Message) -> CameraMessage:
        """What a message holds.

        Raises:
            Refused: No stream can carry it; says why.
        """
        form, parts = self._forms.split(message)
        fields = parts.fields
        if isinstance(fields, ImageFields):
            return _raw_image(message, form, parts, fields)
        if isinstance(fields, CodedFields):
            return self._coded(message, form, parts, fields)
        raise Refused("it holds no image")

    def leave_out(self, seen: CameraMessage) -> None:
        """Note that no stream took the last message."""
        if seen.key.codec in self._parsers:
            self._parsers[seen.key.codec].leave_out()

    def _coded(
        self, message: Message, form: Form, parts: Parts, fields: CodedFields
    ) -> CameraMessage:
        if self._is_packets:
            codec = packet_codec(fields.format)
            if codec != "mjpeg":
                return self._packet(message, form, parts, codec)
        elif bytes(parts.body[: len(png.SIGNATURE)]) == png.SIGNATURE:
            return self._png_image(message, form, parts)
        elif "compressedDepth" in fields.format:
            return self._depth_image(message, form, parts)
        return self._jpeg_image(message, form, parts)

    def _packet(self, message: Message, form: Form, parts: Parts, codec: str) -> CameraMessage:
        if codec not in self._parsers:
            self._parsers[codec] = CODECS[codec].parser()
        parser = self._parsers[codec]
        picture = parser.picture(parts.body)
        return CameraMessage(
            message,
            form,
            parts,
            _coded_key(form, "packet", codec, "rgb8", picture.width, picture.height),
            BodyFraming(framing=picture.framing),
            keyframe=picture.keyframe,
            parameters=parser.parameters,
        )

    def _jpeg_image(self, message: Message, form: Form, parts: Parts) -> CameraMessage:
        width, height, components = parse_jpeg(parts.body)
        encoding = "mono8" if components == 1 else "rgb8"
        if not self._transcode:
            key = _coded_key(form, "packet", "mjpeg", encoding, width, height)
            return CameraMessage(message, form, parts, key)
        _, pixels = jpeg_pixels(parts.body, (width, height))
        key = _coded_key(form, "jpeg", "", encoding, width, height)
        return CameraMessage(message, form, parts, key, pixels=pixels)

    def _png_image(self, message: Message, form: Form, parts: Parts) -> CameraMessage:
        with self._png_trial():
            pixels, self._png = png.decode(parts.body, self._png)
        height, width = pixels.shape[:2]
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        encoding = PNG_ENCODINGS[pixels.itemsize, channels]
        key = _coded_key(form, "png", "", encoding, width, height)
        return CameraMessage(message, form, parts, key, BodyFraming(png=self._png), pixels=pixels)

    @contextmanager
    def _png_trial(self) -> Iterator[None]:
        """Give up on a topic whose files cannot be rebuilt: trying is costly."""
        if self._png_refusals == _MAX_PNG_REFUSALS:
            raise Refused("PNG files of its topic do not rebuild")
        try:
            yield
        except Refused:
            self._png_refusals += 1
            raise
        self._png_refusals = 0

    def _depth_image(self, message: Message, form: Form, parts: Parts) -> CameraMessage:
        with self._png_trial():
            header, pixels, recipe = depth.decode_depth(parts.body, self._png)
        self._png = recipe or self._png
        height, width = pixels.shape
        key = _coded_key(form, "png" if recipe else "rvl", "", "16UC1", width, height)
        wrap = BodyFraming(prefix=header, png=recipe)
        return CameraMessage(message, form, parts, key, wrap, pixels=pixels)


def depends_on_others(channel: Channel, message: Message) -> bool:
    """Whether messages of a channel cannot be understood without earlier ones.

    Args:
        channel: A camera channel.
        message: One of its messages.
    """
    try:
        _, parts = MessageSplitter(channel).split(message)
        fields = parts.fields
        if not isinstance(fields, CodedFields) or not _holds_packets(channel):
            return False
        return packet_codec(fields.format) != "mjpeg"
    except Refused:
        return _holds_packets(channel)


def begins_anew(message: Message) -> bool:
    """Whether a stream may begin with a message of a camera channel."""
    try:
        return MessageInspector(message.channel).inspect(message).keyframe
    except Refused:
        return False


def _holds_packets(channel: Channel) -> bool:
    return not channel.type_name.endswith("CompressedImage")


def _coded_key(
    form: Form, body: Body, codec: str, encoding: str, width: int, height: int
) -> StreamKey:
    step = width * ENCODINGS[encoding].pixel_bytes
    return StreamKey(form.wire, body, codec, encoding, width, height, step)


def _raw_image(message: Message, form: Form, parts: Parts, fields: ImageFields) -> CameraMessage:
    reason = why_not(
        fields.encoding,
        width=fields.width,
        height=fields.height,
        step=fields.step,
        size=len(parts.body),
    )
    if reason:
        raise Refused(reason)
    encoding = ENCODINGS[fields.encoding]
    size = {"width": fields.width, "height": fields.height, "step": fields.step}
    padding = row_padding(parts.body, encoding, **size)
    wrap = BodyFraming() if padding is None else BodyFraming(padding=zlib.compress(padding))
    is_bigendian = fields.is_bigendian
    pixels = pixel_view(parts.body, encoding, **size, is_bigendian=bool(is_bigendian))
    key = StreamKey(form.wire, "pixels", "", fields.encoding, **size, is_bigendian=is_bigendian)
    return CameraMessage(message, form, parts, key, wrap, pixels=pixels)


# ---------------------------------------------------------------- columns and headers


class MessageTable(Generic[_ModelT]):
    """The growing columns of a stream, or of its camera_info, and its distinct headers.

    Args:
        form: Of all messages.
        most: Messages that there may be.

    Attributes:
        headers: What `add` describes.
    """

    def __init__(self, form: Form, most: int) -> None:
        self.form = form
        self.headers: list[_ModelT] = []
        self._most = most
        self._columns = {name: array("q") for name in Columns.model_fields}
        self._templates: dict[bytes, Template] = {}
        self._numbers: dict[tuple[bytes, object], int] = {}

    def __len__(self) -> int:
        return len(self._columns["log_time"])

    def check(self, message: Message, parts: Parts) -> None:
        """Refuse what columns cannot hold.

        Raises:
            Refused: A time does not fit into a signed 64-bit integer, or there are too many.
        """
        for value in (message.log_time, message.publish_time, parts.pts or 0):
            if not INT64_MIN <= value <= INT64_MAX:
                raise Refused(f"time {value} ns does not fit into 64 bits with sign")
        if len(self) == self._most:
            raise Refused(f"more than {self._most} messages")

    def add(
        self,
        message: Message,
        parts: Parts,
        ordinal: int,
        *,
        describe: Callable[[str | None], _ModelT],
        extra: object = None,
    ) -> None:
        """Add a message that was checked, after rebuilding and comparing it.

        Args:
            message: The message.
            parts: Of it.
            ordinal: Its place among the channel's messages.
            describe: Makes the model of a new header, from its template or None for a plain one.
            extra: What else distinguishes headers.

        Raises:
            Refused: It does not rebuild, or there are too many headers; nothing was changed.
        """
        values = {
            "log_time": message.log_time,
            "publish_time": message.publish_time,
            "sequence": message.sequence,
            "stamp": parts.stamp,
            "seq": parts.seq,
            "pts": parts.pts,
            "variant": self._header(message, parts, describe, extra),
            "ordinal": ordinal,
        }
        for name, value in values.items():
            if value is not None:
                self._columns[name].append(value)

    def _header(
        self,
        message: Message,
        parts: Parts,
        describe: Callable[[str | None], _ModelT],
        extra: object,
    ) -> int:
        """The number of a message's header."""
        blank = parts.blank
        try:
            template = self._templates.get(blank) or self.form.template(blank)
            exact = prove(template, parts, memoryview(message.data))
        except WireError as error:
            raise Refused(f"its header does not rebuild: {error}") from None
        if not exact:
            raise Refused("its header does not rebuild")
        known = self._numbers.get((blank, extra))
        if known is not None:
            return known
        if len(self.headers) == MAX_VARIANTS:
            raise Refused(f"more than {MAX_VARIANTS} different message headers")
        plain = self.form.plain(parts.frame_id, parts.fields)
        self.headers.append(describe(None if plain == blank else base64.b64encode(blank).decode()))
        self._templates[blank] = template
        self._numbers[blank, extra] = len(self.headers) - 1
        return len(self.headers) - 1

    def to_model(self) -> Columns:
        """The columns as the sidecar holds them."""
        found = self._columns.items()
        return columns_model({name: np.frombuffer(own, np.int64) for name, own in found if own})
