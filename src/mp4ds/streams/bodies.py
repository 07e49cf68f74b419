"""The messages of a stream, rebuilt from its sidecar and the frames of its video."""

from __future__ import annotations

import zlib

import numpy as np
import xxhash

from mp4ds.coded import Refused, body_of, png, rvl, zlib_build, zlib_fingerprint
from mp4ds.errors import FormatError
from mp4ds.layouts import ENCODINGS, Picture, Pixels, pixel_view, put_padding
from mp4ds.sidecar import StreamSidecar
from mp4ds.sidecar.fields import decode_base64
from mp4ds.streams.rebuild import check_slots, decode_columns, form_for, template_of
from mp4ds.video import ImageFile
from mp4ds.wire import CodedFields, Fields, ImageFields, Template


class MessageRebuilder:
    """Makes the camera messages of a stream.

    Args:
        sidecar: The stream's.
        place: Name of the sidecar, for errors.
        jpeg_quality: Of the JPEG files that transcoded messages get, 1 to 100.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(self, sidecar: StreamSidecar, place: str, *, jpeg_quality: int = 95) -> None:
        self._sidecar = sidecar
        self._place = place
        self._encoding = ENCODINGS[sidecar.image.encoding]
        self._layout = sidecar.layout
        self.columns = decode_columns(sidecar.columns, sidecar.frames, len(sidecar.headers), place)
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
        for variant in range(len(sidecar.headers)):  # so that a wrong one is told at once
            self._padding(variant)
        self._jpeg = (
            ImageFile(self._encoding.name, "jpeg", quality=jpeg_quality)
            if sidecar.body == "jpeg"
            else None
        )
        check_slots(self.columns, self._templates, place)

    @property
    def picture_format(self) -> str:
        """Pixel format of the pictures that `pixels` takes."""
        return self._layout.pixel_format

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures that `pixels` takes."""
        return self._layout.picture_size(self._sidecar.image.width, self._sidecar.image.height)

    def pixels(self, picture: Picture) -> Pixels:
        """A new array of the image's pixels, shape `Encoding.shape`, native byte order."""
        image = self._sidecar.image
        shape = self._encoding.shape(image.width, image.height)
        out: Pixels = np.empty(shape, self._encoding.dtype)
        self.write_pixels(picture, out)
        return out

    def write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the image's pixels into an array of the shape and type that `pixels` gives."""
        self._layout.to_pixels(picture, out)

    def payload(self, index: int, picture: Picture) -> bytes | bytearray:
        """The message of a frame, verified against its digest where there is one.

        Args:
            index: Of the frame.
            picture: Of the frame, decoded.

        Raises:
            FormatError: ``digest-mismatch``, naming topic and frame.
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
                body = prefix + rvl.encode(pixels)
        except Refused as error:
            raise self._failure("header-mismatch", index, f"cannot be made: {error}") from None
        if self._digests is None:  # its length may be another than the recorded one's
            body += bytes(self._templates[variant].padding(len(body)))
        return self._verified(index, self._around(index, body))

    def packet_payload(self, index: int, packet: bytes) -> bytes | bytearray:
        """The message of a packet, verified against its digest.

        Args:
            index: Of the frame.
            packet: As the video has it.

        Raises:
            FormatError: ``digest-mismatch`` or ``decode-failed``, naming topic and frame.
        """
        framing = self._sidecar.headers[int(self.columns.variant[index])].framing
        try:
            body = body_of(self._sidecar.video.codec, packet, framing)
        except Refused as error:
            raise self._failure("decode-failed", index, f"cannot be made: {error}") from None
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
                f": its PNG file is made again by zlib, and this Python has {zlib_build()}, which "
                "makes other bytes. Use a Python that is linked with zlib itself, or unpack with "
                "--images raw"
            )
        raise self._failure(
            "digest-mismatch", index, f"does not come back as it was recorded{remark}"
        )

    def _failure(self, code: str, index: int, problem: str) -> FormatError:
        topic = self._sidecar.channel.topic
        return FormatError(code, self._place, f"message {index} of topic {topic} {problem}")

    def _decode_digests(self) -> list[int] | None:
        if self._sidecar.digests is None:
            return None
        try:
            return self._sidecar.digests.decode(self._sidecar.frames).tolist()  # type: ignore[no-any-return]
        except ValueError as error:
            raise FormatError("column-invalid", f"{self._place} at digests", str(error)) from None

    def _padding(self, variant: int) -> bytes | None:
        """What follows the rows of pixels in messages of a header; None: zeros.

        Raises:
            FormatError: ``header-mismatch``: there are not as many bytes as the rows leave.
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
                    "header-mismatch", place, f"has not the {dues[0]} bytes that rows leave"
                )
            self._paddings = {variant: padding}  # one of them: they may be large
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
    """The bytes of base64 of a zlib stream, at most so many and one more.

    Raises:
        ValueError: It is none.
    """
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(decode_base64(text), most + 1)
    except zlib.error as error:
        raise ValueError(f"cannot be inflated: {error}") from None
    if len(data) <= most and (not inflater.eof or inflater.unused_data):
        raise ValueError("is not one whole stream of zlib")
    return data
