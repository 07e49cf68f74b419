"""An open stream of a dataset: its frames by number, and its messages."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from mp4ds.dataset.images import Images
from mp4ds.dataset.rebuild import (
    CameraInfoRebuilder,
    Choice,
    DecodedColumns,
    camera_info_columns,
    check_slots,
    decode_columns,
    everything,
    form_for,
    message_at,
    template_of,
    unbroken,
)
from mp4ds.errors import FormatError, OptionError, Refused, VideoError
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import decode_base64
from mp4ds.format.models import Calibration, StreamSidecar
from mp4ds.format.sidecars import load_stream
from mp4ds.messages import depth, png
from mp4ds.messages.arrangements import Picture
from mp4ds.messages.encodings import ENCODINGS, Pixels, pixel_view, put_padding
from mp4ds.messages.png import zlib_build, zlib_fingerprint
from mp4ds.messages.wire import CodedFields, Fields, ImageFields, Template
from mp4ds.records import Channel, Message
from mp4ds.video.coded_messages import body_of
from mp4ds.video.decoder import VideoDecoder
from mp4ds.video.images import ImageFile
from mp4ds.video.packets import PacketReader
from mp4ds.video.pixels import Scale
from mp4ds.video.reader import FrameReader, open_frames


class MessageRebuilder:
    """Rebuilds the camera messages of a stream.

    Args:
        sidecar: The stream's.
        columns: The stream's.
        place: Name of the sidecar, for errors.
        jpeg_quality: Quality of the JPEG files in transcoded messages, 1 to 100.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(
        self, sidecar: StreamSidecar, columns: DecodedColumns, place: str, *, jpeg_quality: int = 95
    ) -> None:
        self._sidecar = sidecar
        self._place = place
        self._encoding = ENCODINGS[sidecar.image.encoding]
        self._layout = sidecar.layout
        self.columns = columns
        self._digests = self._decode_digests()
        self._templates = self._make_templates()
        self._recipes = [
            png.PngRecipe(**header.png.model_dump(exclude={"deflate"})) if header.png else None
            for header in sidecar.headers
        ]
        image = sidecar.image
        self._row_bytes = image.width * self._encoding.pixel_bytes
        rows = self._encoding.shape(image.width, image.height)[0]
        self._padding_size = rows * (image.step - self._row_bytes)
        self._paddings: dict[int, bytes | None] = {}
        for variant in range(len(sidecar.headers)):  # so that a wrong one is reported at once
            self._padding(variant)
        self._jpeg = (
            ImageFile(self._encoding.name, "jpeg", quality=jpeg_quality)
            if sidecar.body == "jpeg"
            else None
        )
        check_slots(self.columns, self._templates, place)

    @property
    def picture_format(self) -> str:
        """Pixel format of the pictures for `pixels`."""
        return self._layout.pixel_format

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures for `pixels`."""
        return self._layout.picture_size(self._sidecar.image.width, self._sidecar.image.height)

    def pixels(self, picture: Picture) -> Pixels:
        """A new array of the image's pixels, shape `Encoding.shape`, native byte order."""
        image = self._sidecar.image
        shape = self._encoding.shape(image.width, image.height)
        out: Pixels = np.empty(shape, self._encoding.dtype)
        self.write_pixels(picture, out)
        return out

    def write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the image's pixels into an array with the shape and type returned by `pixels`."""
        self._layout.to_pixels(picture, out)

    def payload(self, index: int, picture: Picture) -> bytes | bytearray:
        """The message of a frame, verified against its digest if there is one.

        Args:
            index: Of the frame.
            picture: Of the frame, decoded.

        Raises:
            FormatError: ``digest-mismatch``, with the frame's number.
        """
        if self._sidecar.body == "pixels":
            return self._verified(index, self._with_pixels(index, picture))
        variant = int(self.columns.variant[index])
        pixels, recipe = self.pixels(picture), self._recipes[variant]
        prefix = bytes.fromhex(self._sidecar.headers[variant].prefix)
        try:
            if self._jpeg is not None:
                body = self._jpeg.encode(pixels)
            elif recipe is not None:
                body = prefix + png.rebuild(pixels, recipe)
            else:
                body = prefix + depth.encode_rvl(pixels)
        except Refused as error:
            raise self._failure("header-mismatch", index, f"cannot be rebuilt: {error}") from None
        if self._digests is None:  # its length may differ from the recorded one
            body += bytes(self._templates[variant].padding(len(body)))
        return self._verified(index, self._around(index, body))

    def packet_payload(self, index: int, packet: bytes) -> bytes | bytearray:
        """The message of a packet, verified against its digest.

        Args:
            index: Of the frame.
            packet: As stored in the video.

        Raises:
            FormatError: ``digest-mismatch`` or ``decode-failed``, with the frame's number.
        """
        framing = self._sidecar.headers[int(self.columns.variant[index])].framing
        try:
            body = body_of(self._sidecar.video.codec, packet, framing)
        except Refused as error:
            raise self._failure("decode-failed", index, f"cannot be rebuilt: {error}") from None
        return self._verified(index, self._around(index, body))

    def _with_pixels(self, index: int, picture: Picture) -> bytes | bytearray:
        image = self._sidecar.image
        template = self._templates[int(self.columns.variant[index])]
        padding = self._padding(int(self.columns.variant[index]))
        size = self._encoding.size(image.step, image.height)
        if padding is not None:
            size += len(padding) - self._padding_size
        head, tail = template.around(self.columns.slots(index), size)
        payload = bytearray(len(head) + size + len(tail))
        payload[: len(head)] = head
        out = pixel_view(
            memoryview(payload)[len(head) :],
            self._encoding,
            width=image.width,
            height=image.height,
            step=image.step,
            is_bigendian=bool(image.is_bigendian),
        )
        self._layout.to_pixels(picture, out)
        if padding is not None:
            body = memoryview(payload)[len(head) : len(head) + size]
            put_padding(body, padding, row_bytes=self._row_bytes, step=image.step)
        if tail:
            payload[len(payload) - len(tail) :] = tail
        return payload

    def _around(self, index: int, body: bytes | bytearray) -> bytes:
        template = self._templates[int(self.columns.variant[index])]
        head, tail = template.around(self.columns.slots(index), len(body))
        return b"".join((head, body, tail))

    def _verified(self, index: int, payload: bytes | bytearray) -> bytes | bytearray:
        if self._digests is None or xxhash.xxh64_intdigest(payload) == self._digests[index]:
            return payload
        header = self._sidecar.headers[int(self.columns.variant[index])]
        remark = ""
        if header.png and header.png.deflate != zlib_fingerprint():
            remark = (
                f": its PNG file is rebuilt with zlib, and this Python has {zlib_build()}, which "
                "compresses to different bytes. Use a Python linked with plain zlib, or unpack "
                "with `images` raw"
            )
        raise self._failure("digest-mismatch", index, f"differs from what was recorded{remark}")

    def _failure(self, code: str, index: int, problem: str) -> FormatError:
        return FormatError(code, self._place, problem, frame=index)

    def _decode_digests(self) -> list[int] | None:
        if self._sidecar.digests is None:
            return None
        try:
            return self._sidecar.digests.decode(self._sidecar.frames).tolist()  # type: ignore[no-any-return]
        except ValueError as error:
            raise FormatError("column-invalid", f"{self._place} at digests", str(error)) from None

    def _padding(self, variant: int) -> bytes | None:
        """The row padding in messages of a header; None: zeros.

        Raises:
            FormatError: ``header-mismatch``: it does not have as many bytes as the rows leave.
        """
        if variant not in self._paddings:
            text = self._sidecar.headers[variant].padding
            place = f"{self._place} at headers.{variant}.padding"
            try:
                padding = None if text is None else _inflated(text, self._padding_size)
            except ValueError as error:
                raise FormatError("header-mismatch", place, str(error)) from None
            per_row = self._sidecar.image.step - self._row_bytes
            dues = (self._padding_size, self._padding_size - per_row)
            if padding is not None and (not per_row or len(padding) not in dues):
                raise FormatError(
                    "header-mismatch", place, f"does not have the {dues[0]} bytes that rows leave"
                )
            self._paddings = {variant: padding}  # only one of them: they may be large
        return self._paddings[variant]

    def _make_templates(self) -> list[Template]:
        sidecar, image = self._sidecar, self._sidecar.image
        form = form_for(sidecar.channel.to_record(0), sidecar.wire, self._place)
        raw = ImageFields(
            encoding=image.encoding,
            width=image.width,
            height=image.height,
            step=image.step,
            is_bigendian=image.is_bigendian,
        )
        templates = []
        for number, header in enumerate(sidecar.headers):
            fields: Fields = raw if sidecar.body == "pixels" else CodedFields(header.format or "")
            place = f"{self._place} at headers.{number}.template"
            templates.append(template_of(form, header.template, header.frame_id, fields, place))
        return templates


def _inflated(text: str, most: int) -> bytes:
    """The contents of a base64 zlib stream, up to one byte more than allowed.

    Raises:
        ValueError: It is not valid.
    """
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(decode_base64(text), most + 1)
    except zlib.error as error:
        raise ValueError(f"cannot be inflated: {error}") from None
    if len(data) <= most and (not inflater.eof or inflater.unused_data):
        raise ValueError("is not a single complete zlib stream")
    return data


# ---------------------------------------------------------------- the reader


class Stream(Images):
    """A video with its sidecar: images of one size and encoding, and their messages.

    Attributes:
        sidecar: The contents of its sidecar.
        sound: Which frames are read of a damaged video: those that `damages` does not name, shape
            (frames,). None: all, and damage is an error.

    Args:
        path: The sidecar; the video is next to it.
        sidecar: Its contents, if already read.
        jpeg_quality: Quality of the JPEG files in messages of a transcoded stream, 1 to 100.

    Raises:
        FormatError: The sidecar or its video breaks a rule of the format.
    """

    def __init__(
        self,
        path: Path,
        *,
        sidecar: StreamSidecar | None = None,
        jpeg_quality: int = 95,
    ) -> None:
        self.path = path
        self.sound: NDArray[np.bool_] | None = None
        self._jpeg_quality = jpeg_quality
        self.sidecar = sidecar or load_stream(path)
        self.topic = self.sidecar.channel.topic
        self.video_path = path.parent / self.sidecar.video.file

    @cached_property
    def channel(self) -> Channel:  # type: ignore[override]
        """The channel of the images; its id has no meaning."""
        return self.sidecar.channel.to_record(0)

    @property
    def ordinals(self) -> NDArray[np.int64]:
        """Numbers among the messages of the channel, shape (frames,)."""
        return self.columns.ordinal

    @property
    def topics(self) -> list[str]:
        """Topic of the images, and that of the calibrations if there are any."""
        info = self.sidecar.camera_info
        return [self.topic, *([info.channel.topic] if info and info.messages else [])]

    @cached_property
    def columns(self) -> DecodedColumns:
        """One value per frame: its times, and what fills its message; checked on first use."""
        self.check_size()
        count, variants = self.sidecar.frames, len(self.sidecar.headers)
        return decode_columns(self.sidecar.columns, count, variants, str(self.path))

    def check_size(self) -> None:
        """Refuse a video that is missing, or too short for so many frames.

        Raises:
            FormatError: ``file-missing`` or ``frame-count``.
        """
        try:
            size = self.video_path.stat().st_size
        except OSError as error:
            raise FormatError(
                "file-missing", self.video_path, f"cannot be read: {error.strerror}"
            ) from None
        if self.sidecar.frames > size:  # a coded frame takes at least a byte
            raise FormatError(
                "frame-count", self.path, f"declares {self.sidecar.frames} frames in {size} bytes"
            )

    @cached_property
    def rebuilder(self) -> MessageRebuilder:
        """Makes the stream's messages."""
        return MessageRebuilder(
            self.sidecar, self.columns, str(self.path), jpeg_quality=self._jpeg_quality
        )

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, shape (frames,)."""
        return self.columns.stamp

    @property
    def log_times(self) -> NDArray[np.int64]:
        """Log times, nanoseconds, shape (frames,)."""
        return self.columns.log_time

    @property
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded."""
        return self.sidecar.image.encoding

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""
        return self.sidecar.image.width, self.sidecar.image.height

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen."""
        return self.sidecar.camera_info.calibrations if self.sidecar.camera_info else []

    @cached_property
    def camera_info_columns(self) -> DecodedColumns | None:
        """The columns of the CameraInfo messages, if there are any."""
        info = self.sidecar.camera_info
        return camera_info_columns(info, str(self.path)) if info and info.messages else None

    @cached_property
    def info_rebuilder(self) -> CameraInfoRebuilder | None:
        """Makes the CameraInfo messages, if there are any."""
        info, columns = self.sidecar.camera_info, self.camera_info_columns
        if info is None or columns is None:
            return None
        return CameraInfoRebuilder(info, columns, str(self.path))

    def calibration_at(self, log_time: int) -> Calibration | None:
        """The calibration that applied at a log time: the last one before it, else the first."""
        if not self.calibrations:
            return None
        columns = self.camera_info_columns
        if columns is None:
            return self.calibrations[0]
        place = np.searchsorted(columns.log_time, log_time, side="right")
        return self.calibrations[int(columns.variant[max(int(place) - 1, 0)])]

    def open_video(self, *, sequential: bool) -> VideoDecoder:
        """A separate decoder for the stream's pictures.

        Args:
            sequential: Decode with all cores, for reading in order.

        Raises:
            VideoError: The video cannot be read, or does not match the sidecar.
        """
        is_sound = self.sound is None
        return VideoDecoder(self.video_path, **self._promises, sequential=sequential and is_sound)

    @property
    def _promises(self) -> dict[str, Any]:
        """The sidecar's description of the video, as arguments for decoders."""
        video = self.sidecar.video
        return {
            "codec": video.codec,
            "coded_size": (video.width, video.height),
            "frames": self.sidecar.frames,
            "picture_format": self.rebuilder.picture_format,
            "picture_size": self.rebuilder.picture_size,
            "matrix": video.matrix,
            "full_range": video.full_range,
        }

    def __len__(self) -> int:
        return self.sidecar.frames

    def open_reader(self) -> FrameReader:
        """A separate decoder for frames by number."""
        return open_frames(
            self.video_path,
            **self._promises,
            references=self.sidecar.video.references,
        )

    def pictures(self, scale: Scale | None) -> Iterator[Picture]:
        """All pictures in order, from a separate decoder that uses all cores."""
        with self.open_video(sequential=True) as decoder:
            for _, picture in self.pictures_in_order(decoder, scale=scale):
                yield picture

    @property
    def shows_colours(self) -> bool:  # type: ignore[override]
        """Whether the decoder can make RGB directly, in any size."""
        return self.sidecar.shows_colours

    def write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture, as recorded."""
        self.rebuilder.write_pixels(picture, out)

    def depth_header(self, index: int) -> bytes:
        """What gives the quantised depths of a frame in metres; empty for all others.

        Raises:
            OptionError: It is not in the sidecar.
        """
        header = self.sidecar.headers[int(self.columns.variant[index])]
        prefix = bytes.fromhex(header.prefix)
        if not depth.is_quantised(header.format, prefix):
            return b""
        if len(prefix) != depth.HEADER_BYTES:
            raise OptionError(
                f"frame {index} of {self.topic} holds quantised depths without their parameters: "
                "only format='native' is available"
            )
        return prefix

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return self.sidecar.headers[int(self.columns.variant[index])].frame_id

    def messages(
        self, channel: Channel, choice: Choice = everything
    ) -> Iterator[tuple[int, Message]]:
        """The image messages, each with its ordinal.

        Args:
            channel: The channel to make them on.
            choice: Which are wanted; see `numbered_makers`. The video is checked against its
                SHA-256 only if all are.

        Raises:
            FormatError: A frame cannot be decoded, or a message does not match its digest.
        """
        columns = self.columns
        if self.sidecar.digests is None and choice is everything:
            self.verify_video()
        for index, make in self.numbered_makers(choice):
            yield int(columns.ordinal[index]), message_at(columns, index, channel, make())

    def payloads(self, choice: Choice = everything) -> Iterator[bytes | bytearray]:
        """The payloads of messages, in order; see `messages`."""
        return (make() for make in self.makers(choice))

    def makers(self, choice: Choice = everything) -> Iterator[Callable[[], bytes | bytearray]]:
        """Like `numbered_makers`, without the numbers."""
        return (make for _, make in self.numbered_makers(choice))

    @property
    def hidden_frames(self) -> int:
        """How many frames the video hides before its first one, which may refer to them."""
        with PacketReader(self.video_path, codec=self.sidecar.video.codec) as reader:
            return reader.hidden

    def numbered_makers(
        self, choice: Choice = everything
    ) -> Iterator[tuple[int, Callable[[], bytes | bytearray]]]:
        """Number of each message, and what makes its payload before the next one is taken.

        Args:
            choice: Which are wanted. Packets that others refer to are included between two wanted
                ones.

        Raises:
            FormatError: A frame cannot be read; the functions raise any other error of a message.
        """
        rebuilder = self.rebuilder
        if self.sidecar.body == "packet":
            with self.naming_frames(), self._open_packets() as reader:
                for index in self.sound_of(unbroken(choice(self.columns), reader.key_numbers)):
                    packet = reader.packet(index)
                    yield index, partial(self._made, rebuilder.packet_payload, index, packet)
            return
        with self.open_video(sequential=True) as decoder:
            for index, picture in self.pictures_in_order(decoder, choice):
                yield index, partial(self._made, rebuilder.payload, index, picture)

    def _open_packets(self) -> PacketReader:
        video = self.sidecar.video
        return PacketReader(
            self.video_path,
            codec=video.codec,
            frames=self.sidecar.frames,
            coded_size=(video.width, video.height),
        )

    def _made(self, make: Callable[..., bytes | bytearray], *given: Any) -> bytes | bytearray:
        with self.naming_frames():
            return make(*given)

    def pictures_in_order(
        self, decoder: VideoDecoder, choice: Choice = everything, scale: Scale | None = None
    ) -> Iterator[tuple[int, Picture]]:
        """The wanted pictures, each with its number.

        Args:
            decoder: From `open_video`.
            choice: Which are wanted. If all are, the video must end after them.
            scale: See `PictureMaker.make`.

        Yields:
            Views that are valid until the next one is requested.

        Raises:
            VideoError: See `VideoDecoder.pictures`.
        """
        with self.naming_frames():
            if self.sound is not None:
                wanted = self.sound_of(choice(self.columns))
                yield from map(self._found, decoder.decodable_pictures(wanted, scale))
            elif choice is everything:
                yield from enumerate(decoder.pictures(scale))
            else:
                yield from decoder.pictures_at(choice(self.columns), scale)

    def _found(self, numbered: tuple[int, Picture | None]) -> tuple[int, Picture]:
        """A picture that could be decoded, with its number.

        Raises:
            VideoError: ``decode-failed``: it could not.
        """
        index, picture = numbered
        if picture is None:
            raise VideoError("decode-failed", self.video_path, "cannot be decoded", frame=index)
        return index, picture

    # ------------------------------------------------------------ damage

    @property
    def is_lost(self) -> bool:
        """Whether none of its frames can be read."""
        return self.sound is not None and not self.sound.any()

    def sound_of(self, indices: Iterable[int]) -> Iterator[int]:
        """Those of some frames that can be read."""
        return (index for index in indices if self.sound is None or self.sound[index])

    def count(self, is_wanted: NDArray[np.bool_] | None = None) -> int:
        """How many frames can be read.

        Args:
            is_wanted: Count only these, shape (frames,); None: all.
        """
        marks = [mark for mark in (is_wanted, self.sound) if mark is not None]
        return int(np.logical_and.reduce(marks).sum()) if marks else len(self)

    def damages(self, report: Callable[[int], None] = lambda _: None) -> Iterator[FormatError]:
        """What is wrong with the frames: all are decoded, rebuilt and compared.

        Args:
            report: Called with the number of each frame.

        Yields:
            An error with the number of each frame that cannot be read, in order; one without a
            number, the last, if none can.
        """
        try:
            for index, make in self._makers_of_all():
                report(index)
                try:
                    self._made(make)
                except FormatError as error:
                    yield error
        except FormatError as error:
            yield error

    def _makers_of_all(self) -> Iterator[tuple[int, Callable[[], bytes | bytearray]]]:
        """Number of each message and what makes it, even after one that cannot be read."""
        rebuilder = self.rebuilder
        if self.sidecar.body == "packet":
            with self._open_packets() as reader:
                for index in range(len(self)):
                    yield index, partial(self._of_packet, reader, index)
            return
        for index, picture in self.decodable_pictures():
            yield (
                index,
                partial(lambda *found: rebuilder.payload(*self._found(found)), index, picture),
            )

    def _of_packet(self, reader: PacketReader, index: int) -> bytes | bytearray:
        return self.rebuilder.packet_payload(index, reader.packet(index))

    def decodable_pictures(
        self, choice: Choice = everything, scale: Scale | None = None
    ) -> Iterator[tuple[int, Picture | None]]:
        """Like `pictures_in_order`, but None for a picture that cannot be decoded.

        Args:
            choice: Which are wanted; asked twice.
            scale: See `PictureMaker.make`.

        Raises:
            VideoError: None of them can be read.
        """
        done = -1
        with self.naming_frames():
            if self.sound is None:
                try:
                    with self.open_video(sequential=True) as decoder:
                        for index, picture in decoder.pictures_at(choice(self.columns), scale):
                            yield index, picture
                            done = index
                    return
                except VideoError as error:
                    if error.frame is None:
                        raise
            # from there on on one core; see the decoder
            with self.open_video(sequential=False) as decoder:
                rest = (index for index in self.sound_of(choice(self.columns)) if index > done)
                yield from decoder.decodable_pictures(rest, scale)

    def verify_video(self) -> None:
        """Check the video against its SHA-256, for when no message digest would reveal damage.

        Not if it is known to be damaged.

        Raises:
            FormatError: ``file-missing`` or ``hash-mismatch``.
        """
        if self.sound is not None:
            return
        video = self.sidecar.video
        if not self.video_path.is_file():
            raise FormatError("file-missing", self.video_path, "does not exist")
        if video.sha256 is not None and digest_file(self.video_path)[1] != video.sha256:
            problem = f"does not match the SHA-256 in its sidecar; it has frames of {self.topic}"
            raise FormatError("hash-mismatch", self.video_path, problem)

    def camera_info_messages(
        self, channel: Channel, choice: Choice = everything
    ) -> Iterator[tuple[int, Message]]:
        """The CameraInfo messages, each with its ordinal.

        Args:
            channel: The channel to make them on.
            choice: Which are wanted.
        """
        rebuilder = self.info_rebuilder
        return rebuilder.messages(channel, choice(rebuilder.columns)) if rebuilder else iter(())
