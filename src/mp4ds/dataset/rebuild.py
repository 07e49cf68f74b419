"""Rebuilds messages from their bodies, and all that a sidecar says about the rest."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from functools import cached_property

import numpy as np
import xxhash

from mp4ds.errors import FormatError, Refused
from mp4ds.format.fields import Choice, DecodedColumns, decode_base64, decode_columns, everything
from mp4ds.format.models import CameraInfo, StreamSidecar
from mp4ds.messages import depth, png
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels, pixel_view, put_padding
from mp4ds.messages.png import zlib_fingerprint
from mp4ds.messages.serializations import form_of
from mp4ds.messages.wire import (
    CodedFields,
    Fields,
    Form,
    Slots,
    Template,
)
from mp4ds.records import Channel, Message
from mp4ds.video.codecs import CODECS
from mp4ds.video.images import ImageFile


def check_slots(columns: DecodedColumns, templates: list[Template], place: str) -> None:
    """Refuse stamps and numbers that the serialization cannot represent.

    Raises:
        FormatError: ``column-invalid``.
    """
    names = ("stamp", "seq", "pts")
    for name in names:
        values = getattr(columns, name)
        if values is None:
            continue
        for value in (int(values.min()), int(values.max())):
            slots = Slots(**{"stamp": 0, "seq": 0, "pts": 0, name: value})
            try:
                templates[0].around(slots, 0)
            except Refused as error:
                raise FormatError(
                    "column-invalid", f"{place} at columns.{name}", f"holds {value}: {error}"
                ) from None


def form_for(channel: Channel, wire: str, place: str) -> Form:
    """The form of a channel's messages.

    Raises:
        FormatError: ``header-mismatch``: there is none.
    """
    try:
        return form_of(wire, channel.type_name, channel.schema.data if channel.schema else b"")
    except Refused as error:
        raise FormatError("header-mismatch", f"{place} at channel", str(error)) from None


def template_of(
    form: Form, encoded: str | None, frame_id: str, fields: Fields, place: str
) -> Template:
    """The template of a header or calibration.

    Args:
        form: Of the messages.
        encoded: The blank in base64, or None for a plain one.
        frame_id: The sidecar's value.
        fields: The sidecar's other values; the size of coded images is ignored.
        place: Of the template, for errors.

    Raises:
        FormatError: ``header-mismatch``.
    """
    try:
        blank = form.plain(frame_id, fields) if encoded is None else decode_base64(encoded)
        if blank is None:
            raise Refused("a message of this type needs a template")
        parts = form.split(memoryview(blank))
        found = parts.fields
        if isinstance(found, CodedFields):
            found = CodedFields(found.format)
        if (parts.frame_id, found) != (frame_id, fields):
            raise Refused("contradicts the fields beside it")
        return form.template(blank)
    except ValueError as error:
        raise FormatError("header-mismatch", place, str(error)) from None


def message_at(
    columns: DecodedColumns, index: int, channel: Channel, payload: bytes | bytearray
) -> Message:
    """The message with the times of an entry of the columns."""
    return Message(
        channel=channel,
        log_time=int(columns.log_time[index]),
        publish_time=int(columns.publish_time[index]),
        sequence=int(columns.sequence[index]),
        data=memoryview(payload),
    )


# ---------------------------------------------------------------- images


class MessageRebuilder:
    """Rebuilds the camera messages of a stream.

    Args:
        sidecar: The stream's.
        columns: The stream's.
        place: Name of the sidecar, for errors.
        write_pixels: Writes the pixels of a picture.
        jpeg_quality: Quality of the JPEG files in transcoded messages, 1 to 100.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(
        self,
        sidecar: StreamSidecar,
        columns: DecodedColumns,
        place: str,
        write_pixels: Callable[[Picture, Pixels], None],
        *,
        jpeg_quality: int,
    ) -> None:
        self._write_pixels = write_pixels
        self._sidecar = sidecar
        self._place = place
        self._encoding = ENCODINGS[sidecar.image.encoding]
        self.columns = columns
        self._digests: list[int] | None = None
        if sidecar.digests is not None:
            try:
                self._digests = sidecar.digests.decode(sidecar.frames).tolist()
            except ValueError as error:
                raise FormatError("column-invalid", f"{place} at digests", str(error)) from None
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
        image, recipe = self._sidecar.image, self._recipes[variant]
        shape = self._encoding.shape(image.width, image.height)
        pixels: Pixels = np.empty(shape, self._encoding.dtype)
        self._write_pixels(picture, pixels)
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
            body = CODECS[self._sidecar.video.codec].parser.body(packet, framing)
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
        out = pixel_view(memoryview(payload)[len(head) :], image.to_fields())
        self._write_pixels(picture, out)
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
                ": its PNG file is rebuilt with zlib, and this Python has "
                f"{zlib.ZLIB_RUNTIME_VERSION}, which compresses to different bytes. Use a Python "
                "linked with plain zlib, or unpack with `images` raw"
            )
        raise self._failure("digest-mismatch", index, f"differs from what was recorded{remark}")

    def _failure(self, code: str, index: int, problem: str) -> FormatError:
        return FormatError(code, self._place, problem, frame=index)

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
        raw = image.to_fields()
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


# ---------------------------------------------------------------- calibrations


class CalibrationMessages:
    """The CameraInfo messages of a stream, of which there is at least one.

    Args:
        info: From its sidecar.
        place: Name of the sidecar, for errors.

    Attributes:
        info: As given.
        channel: Their channel; its id has no meaning.
    """

    def __init__(self, info: CameraInfo, place: str) -> None:
        self.info = info
        self.channel = info.channel.to_record(0)
        self._place = f"{place} at camera_info"

    def __len__(self) -> int:
        return self.info.messages

    @cached_property
    def columns(self) -> DecodedColumns:
        """One value per message, with the number of its calibration.

        Raises:
            FormatError: ``column-invalid``.
        """
        if self.info.columns is None:
            raise FormatError("column-invalid", self._place, "has no columns")
        calibrations = len(self.info.calibrations)
        return decode_columns(self.info.columns, len(self), calibrations, self._place)

    @cached_property
    def templates(self) -> list[Template]:
        """What makes a message of each calibration.

        Raises:
            FormatError: The sidecar contradicts itself.
        """
        form = form_for(self.channel, self.info.wire, self._place)
        templates = [
            template_of(
                form,
                calibration.template,
                calibration.frame_id,
                calibration.fields,
                f"{self._place}.calibrations.{number}",
            )
            for number, calibration in enumerate(self.info.calibrations)
        ]
        check_slots(self.columns, templates, self._place)
        return templates

    def messages(
        self, channel: Channel, choice: Choice = everything
    ) -> Iterator[tuple[int, Message]]:
        """Ordinal and message of each wanted one.

        Args:
            channel: The channel to make them on.
            choice: Which are wanted.
        """
        columns = self.columns
        for index in choice(columns):
            template = self.templates[int(columns.variant[index])]
            payload = b"".join(template.around(columns.slots(index), 0))
            yield int(columns.ordinal[index]), message_at(columns, index, channel, payload)
