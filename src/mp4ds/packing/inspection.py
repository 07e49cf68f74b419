"""What messages of cameras hold, and to which stream they belong: images and calibrations."""

from __future__ import annotations

import base64
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from typing import Generic, TypeVar

import numpy as np

from mp4ds.bags.protocols import with_own_payload
from mp4ds.errors import OptionError, Refused
from mp4ds.format.fields import MAX_CAMERA_INFOS, MAX_VARIANTS, Body, Columns, columns_model
from mp4ds.format.models import Calibration, CameraInfo, ChannelModel
from mp4ds.messages import depth, png
from mp4ds.messages.encodings import ENCODINGS, Pixels, Samples, pixel_view, row_padding
from mp4ds.messages.layouts import why_not
from mp4ds.messages.png import PNG_ENCODINGS
from mp4ds.messages.serializations import (
    INFO_NAMES,
    TRANSPORTS,
    MessageSplitter,
    is_calibration,
    is_camera,
    kind_of,
)
from mp4ds.messages.wire import (
    CalibrationFields,
    CodedFields,
    Form,
    ImageFields,
    Parts,
    Template,
    prove,
)
from mp4ds.packing.options import TopicSummary
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
    if reason := why_not(fields, len(parts.body)):
        raise Refused(reason)
    padding = row_padding(parts.body, fields)
    wrap = BodyFraming() if padding is None else BodyFraming(padding=zlib.compress(padding))
    pixels = pixel_view(parts.body, fields)
    key = StreamKey(form.wire, "pixels", "", *astuple(fields))
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
        except Refused as error:
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


# ---------------------------------------------------------------- calibrations: pairs by choice

Pairs = Mapping[int, int]
"""Id of a calibration channel -> id of the channel of its images."""

_LISTED = 20


def choose_pairs(choices: Sequence[str], channels: Sequence[Channel]) -> dict[int, int]:
    """Pair what the user asks for.

    With several publishers on the topics, the first of one is paired with the first of the other,
    and so on.

    Args:
        choices: ``IMAGE=INFO`` each, two topics, spelled as in the recording.
        channels: The recording's, as far as they are packed.

    Returns:
        Id of the calibration channel -> id of the image channel.

    Raises:
        OptionError: A topic is unknown or of the wrong kind, or is paired with two others.
    """
    cameras, calibrations = (
        by_topic(filter(holds, channels)) for holds in (is_camera, is_calibration)
    )
    pairs: dict[int, int] = {}
    chosen: dict[str, str] = {}  # topics of a pair, in both directions
    for choice in dict.fromkeys(choices):
        image, _, info = choice.partition("=")
        if not image or not info:
            example = "/left/image_raw=/left/info"
            raise OptionError(
                f"`camera_info` {choice!r} is not of the form IMAGE=INFO, such as {example}."
            )
        kinds = (image, "images", cameras), (info, "calibrations", calibrations)
        for topic, noun, known in kinds:
            if topic not in known:
                listed = ", ".join(sorted(known)[:_LISTED]) + ", ..." * (len(known) > _LISTED)
                raise OptionError(
                    f"`camera_info` {choice!r}: {topic!r} is not among the packed topics of {noun}."
                    f" Topics of {noun}: {listed or 'none'}."
                )
            if topic in chosen:
                raise OptionError(
                    f"`camera_info` pairs {topic} with {chosen[topic]}, so {choice} cannot be: a "
                    "stream has one calibration topic, which belongs to it only. Leave one of the "
                    "two out: all messages are kept."
                )
        chosen[image], chosen[info] = info, image
        matches = zip(calibrations[info], cameras[image], strict=False)
        pairs.update((own.id, shown.id) for own, shown in matches)
    return pairs


def by_topic(channels: Iterable[Channel]) -> dict[str, list[Channel]]:
    """The channels of each topic, by their ids."""
    found: dict[str, list[Channel]] = {}
    for channel in sorted(channels, key=lambda channel: channel.id):
        found.setdefault(channel.topic, []).append(channel)
    return found


# ---------------------------------------------------------------- calibrations: pairs by name


def pair_camera_infos(
    channels: Sequence[Channel], *, chosen: Pairs | None = None
) -> dict[int, int]:
    """Pair calibrations with images by the names of their topics.

    A topic named ``camera_info``, or ``calibration`` as in Foxglove's examples, belongs to the
    image topic in the same namespace. For coded images the namespace is that of the image they
    transport: ``/cam/image_raw/compressed`` has its calibration on ``/cam/camera_info``. Among
    several, raw images come first, with ``image_raw`` preferred, then the first by name.
    librealsense's ``NAME/info/camera_info`` belongs to ``NAME/image/data``. With several publishers
    on a calibration topic none is paired.

    Args:
        channels: The recording's, as far as they are packed.
        chosen: Existing pairs, such as those of `choose_pairs`.

    Returns:
        Id of the calibration channel -> id of the image channel; the chosen ones too.
    """
    pairs = dict(chosen or {})
    beside: dict[str, list[tuple[tuple[object, ...], Channel]]] = {}
    for image in filter(is_camera, channels):
        base = image.topic.strip("/")
        if _leaf(base) in TRANSPORTS and _parent(base):  # even if its images were decoded
            base = _parent(base)
        # the raw image is what the calibration was made for
        is_coded, is_other = kind_of(image) is CodedFields, _leaf(base) != "image_raw"
        for rank, namespace in enumerate(dict.fromkeys((_parent(base), _parent(image.topic)))):
            order = rank, is_coded, is_other, image.topic, image.id
            beside.setdefault(namespace, []).append((order, image))
    found = []
    for topic, own in by_topic(filter(is_calibration, channels)).items():
        name, namespace = _leaf(topic), _parent(topic)
        if _leaf(namespace) == "info":  # of librealsense
            namespace = f"{_parent(namespace)}/image"
        if len(own) == 1 and name in INFO_NAMES:
            rank = INFO_NAMES.index(name)
            found += [((rank, *order), own[0], one) for order, one in beside.get(namespace, [])]
    taken = set(pairs.values())
    for _, info, image in sorted(found, key=lambda item: (item[0], item[1].topic)):
        if info.id not in pairs and image.id not in taken:
            pairs[info.id] = image.id
            taken.add(image.id)
    return pairs


def _leaf(topic: str) -> str:
    return topic.strip("/").rpartition("/")[2]


def _parent(topic: str) -> str:
    return topic.strip("/").rpartition("/")[0]


# ---------------------------------------------------------------- calibrations: their streams

_MAX_PENDING = 1000
"""Calibrations of a topic that may wait for their stream; with more, all are kept verbatim."""

Identity = tuple[object, ...]
"""Of a channel of images, whose first stream takes its calibrations."""


class _InfoChannel:
    """The calibration messages of one channel.

    Attributes:
        images: The channel of their images.
        pending: Messages, with ordinals, that wait for a stream of the images.
    """

    def __init__(self, channel: Channel, images: Identity) -> None:
        self.images = images
        self.pending: list[tuple[Message, int]] = []
        self._channel = channel
        self._forms = MessageSplitter(channel)
        self._table: MessageTable[Calibration] | None = None  # with the form of the first message

    def accept(self, message: Message, ordinal: int) -> None:
        """Put a message into the stream.

        Args:
            message: The message.
            ordinal: Its position among the channel's messages.

        Raises:
            Refused: It cannot be modelled exactly; nothing was changed.
        """
        form, parts = self._forms.split(message)
        table = self._table or MessageTable[Calibration](form, MAX_CAMERA_INFOS)
        table.check(message, parts)
        fields = parts.fields
        if not isinstance(fields, CalibrationFields):
            raise Refused("it is not a calibration")
        if table.form.wire != form.wire:
            raise Refused("its byte order differs from the first one's")
        table.add(
            message,
            parts,
            ordinal,
            describe=lambda template: Calibration.of(parts.frame_id, fields, template),
        )
        self._table = table

    def to_model(self) -> CameraInfo | None:
        """The model, or None if no message was accepted."""
        table = self._table
        if table is None:
            return None
        return CameraInfo(
            channel=ChannelModel.from_record(self._channel),
            wire=table.form.wire,
            messages=len(table),
            calibrations=table.headers,
            columns=table.to_model(),
        )


class Calibrations:
    """Hands calibrations to the streams of their images.

    Args:
        channels: The recording's, as far as they are packed.
        pairs: Of `pair_camera_infos`.
        topic_of: The summary of a channel's topic.
        keep: Stores messages that belong to no stream.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        pairs: Pairs,
        topic_of: Callable[[Channel], TopicSummary],
        keep: Callable[[Message], None],
    ) -> None:
        self._topic_of = topic_of
        self._keep = keep
        self._channels = {channel.id: channel for channel in channels}
        self._pairs = dict(pairs)
        self._counts: Counter[Identity] = Counter()
        self._infos: dict[int, _InfoChannel | None] = {}  # None: they are kept
        self._streams: dict[Identity, _InfoChannel | None] = {}  # of which images, with whose

    def meet(self, channel: Channel) -> None:
        """Pair a channel by its name if it was not known at the beginning."""
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self._pairs = pair_camera_infos(list(self._channels.values()), chosen=self._pairs)

    def have_images(self, channel: Channel) -> bool:
        """Whether it is known which images the calibrations of a channel are for."""
        return channel.id in self._pairs

    def take(self, message: Message) -> None:
        """Add a calibration to its stream, or keep it if it belongs to none."""
        channel = message.channel
        # its position among those of all channels with the same identity
        ordinal = self._counts[channel.identity]
        self._counts[channel.identity] += 1
        if channel.id not in self._infos:
            images = self._channels.get(self._pairs.get(channel.id, -1))
            new = _InfoChannel(channel, images.identity) if images else None
            self._infos[channel.id] = new
            self._settle()
        if (info := self._infos[channel.id]) is None:
            self._keep(message)
        elif self._streams.get(info.images) is info:
            self._add(info, message, ordinal)
        elif len(info.pending) < _MAX_PENDING:
            info.pending.append((with_own_payload(message), ordinal))
        else:
            self._give_up(channel.id, info)
            self._keep(message)

    def adopt(self, images: Identity) -> None:
        """Take the calibrations that waited for the first stream of a channel of images."""
        self._streams[images] = None
        self._settle()

    def _settle(self) -> None:
        for info in self._infos.values():
            # a stream has the calibrations of one channel
            if info and info.images in self._streams and self._streams[info.images] is None:
                self._streams[info.images] = info
                pending, info.pending = info.pending, []
                for message, ordinal in pending:
                    self._add(info, message, ordinal)

    def finish(self) -> dict[Identity, CameraInfo]:
        """The calibrations of each stream; those whose stream never came are kept."""
        for info_id, info in self._infos.items():
            if info is not None:
                self._give_up(info_id, info)
        models = {images: info and info.to_model() for images, info in self._streams.items()}
        return {images: model for images, model in models.items() if model}

    def _add(self, info: _InfoChannel, message: Message, ordinal: int) -> None:
        try:
            info.accept(message, ordinal)
        except Refused as reason:
            self._topic_of(message.channel).count_verbatim(str(reason), ordinal)
            self._keep(message)

    def _give_up(self, info_id: int, info: _InfoChannel) -> None:
        for message, _ in info.pending:
            self._keep(message)
        self._infos[info_id] = None
