"""The messages of a stream, rebuilt from its sidecar and the pictures of its video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xxhash
from numpy.typing import NDArray

from mp4ds.errors import FormatError
from mp4ds.layouts import ENCODINGS, LAYOUTS, Pixels, pixel_view
from mp4ds.records import Channel, Message
from mp4ds.sidecar import Calibration, CameraInfo, Columns, StreamSidecar
from mp4ds.sidecar.models import decode_base64
from mp4ds.streams.camera_info import fields_of
from mp4ds.streams.writer import picture_format
from mp4ds.wire import ImageParts
from mp4ds.wire.formats import WIRES


@dataclass(frozen=True)
class DecodedColumns:
    """The columns of a stream as int64 arrays of shape (messages,); times in nanoseconds."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    stamp: NDArray[np.int64]
    seq: NDArray[np.int64] | None
    variant: NDArray[np.int64]
    ordinal: NDArray[np.int64]


def decode_columns(columns: Columns, count: int, variants: int, place: str) -> DecodedColumns:
    """Decode all columns and check what they refer to.

    Raises:
        FormatError: ``column-invalid``, naming the column.
    """
    arrays: dict[str, NDArray[np.int64]] = {}
    for name in columns.names():
        try:
            arrays[name] = getattr(columns, name).decode(count)
        except ValueError as error:
            raise FormatError("column-invalid", f"{place} at columns.{name}", str(error)) from None
    zeros = np.broadcast_to(np.int64(0), (count,))
    decoded = DecodedColumns(
        log_time=arrays["log_time"],
        publish_time=arrays.get("publish_time", arrays["log_time"]),
        sequence=arrays.get("sequence", zeros),
        stamp=arrays["stamp"],
        seq=arrays.get("seq"),
        variant=arrays.get("variant", zeros),
        ordinal=arrays.get("ordinal", np.arange(count, dtype=np.int64)),
    )
    if decoded.variant.min() < 0 or decoded.variant.max() >= variants:
        raise FormatError(
            "column-invalid",
            f"{place} at columns.variant",
            f"refers to number {int(decoded.variant.max())} of {variants}",
        )
    if decoded.ordinal[0] < 0 or (decoded.ordinal[1:] <= decoded.ordinal[:-1]).any():
        raise FormatError("column-invalid", f"{place} at columns.ordinal", "does not increase")
    return decoded


def check_stamps(columns: DecodedColumns, wire: str, place: str) -> None:
    """Refuse stamps and sequence numbers that the serialization has no bits for.

    Raises:
        FormatError: ``column-invalid``, naming the column.
    """
    low, high = (0, 2**32) if wire == "ros1" else (-(2**31), 2**31)
    seconds = columns.stamp // 10**9
    if seconds.min() < low or seconds.max() >= high:
        raise FormatError(
            "column-invalid",
            f"{place} at columns.stamp",
            f"has seconds outside of {low} to {high}",
        )
    seq = columns.seq
    if seq is not None and (seq.min() < 0 or seq.max() >= 2**32):
        raise FormatError("column-invalid", f"{place} at columns.seq", "has values beyond 32 bits")


def _template(text: str, place: str) -> bytes:
    try:
        return decode_base64(text)
    except ValueError as error:
        raise FormatError("header-mismatch", place, str(error)) from None


class ImageRebuilder:
    """Makes the image messages of a stream.

    Args:
        sidecar: The stream's.
        place: Name of the sidecar, for errors.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(self, sidecar: StreamSidecar, place: str) -> None:
        self._sidecar = sidecar
        self._place = place
        self._wire = WIRES[sidecar.wire]
        self._encoding = ENCODINGS[sidecar.image.encoding]
        self._layout = LAYOUTS[sidecar.video.layout]
        self.columns = decode_columns(sidecar.columns, sidecar.frames, len(sidecar.headers), place)
        self._digests = self._decode_digests()
        self._heads = [self._head(number) for number in range(len(sidecar.headers))]
        self._tails = [bytes.fromhex(header.tail) for header in sidecar.headers]
        check_stamps(self.columns, sidecar.wire, place)

    @property
    def picture_format(self) -> str:
        """Pixel format of the pictures that `pixels` takes."""
        return picture_format(self._layout.pixel_format, self._encoding.mosaic)

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures that `pixels` takes."""
        return self._layout.picture_size(self._sidecar.image.width, self._sidecar.image.height)

    def pixels(self, picture: Pixels) -> Pixels:
        """A new array of the image's pixels, shape (H, W) or (H, W, C), native byte order."""
        image = self._sidecar.image
        shape: tuple[int, ...] = (image.height, image.width)
        if self._encoding.channels > 1:
            shape += (self._encoding.channels,)
        out: Pixels = np.empty(shape, picture.dtype)
        self._layout.to_pixels(picture, out)
        return out

    def payload(self, index: int, picture: Pixels) -> bytearray:
        """The message of a frame, verified against its digest where there is one.

        Raises:
            FormatError: ``digest-mismatch``, naming topic and frame.
        """
        image = self._sidecar.image
        columns = self.columns
        variant = int(columns.variant[index])
        seq = int(columns.seq[index]) if columns.seq is not None else None
        head = self._wire.patch_head(self._heads[variant], int(columns.stamp[index]), seq)
        tail = self._tails[variant]
        payload = bytearray(len(head) + image.step * image.height + len(tail))
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
        if tail:
            payload[len(payload) - len(tail) :] = tail
        if self._digests is not None:
            self._verify(index, payload)
        return payload

    def _verify(self, index: int, payload: bytearray) -> None:
        if self._digests is not None and xxhash.xxh64_intdigest(payload) != self._digests[index]:
            raise FormatError(
                "digest-mismatch",
                self._place,
                f"message {index} of topic {self._sidecar.channel.topic} does not come back "
                "as it was recorded",
            )

    def _decode_digests(self) -> list[int] | None:
        if self._sidecar.digests is None:
            return None
        try:
            return self._sidecar.digests.decode(self._sidecar.frames).tolist()  # type: ignore[no-any-return]
        except ValueError as error:
            raise FormatError("column-invalid", f"{self._place} at digests", str(error)) from None

    def _head(self, number: int) -> bytes:
        header, image = self._sidecar.headers[number], self._sidecar.image
        empty = memoryview(b"")
        plain = self._wire.image_head(
            ImageParts(
                stamp=0,
                seq=None if self.columns.seq is None else 0,
                frame_id=header.frame_id,
                height=image.height,
                width=image.width,
                encoding=image.encoding,
                is_bigendian=image.is_bigendian,
                step=image.step,
                size=image.step * image.height,
                head=empty,
                pixels=empty,
                tail=empty,
            )
        )
        if header.template is None:
            return plain
        template = _template(header.template, f"{self._place} at headers.{number}.template")
        if len(template) != len(plain):
            raise FormatError(
                "header-mismatch",
                f"{self._place} at headers.{number}.template",
                f"has {len(template)} bytes where its fields take {len(plain)}",
            )
        return template


class CameraInfoRebuilder:
    """Makes the CameraInfo messages of a stream.

    Args:
        camera_info: The stream's; must have messages.
        place: Name of the sidecar, for errors.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(self, camera_info: CameraInfo, place: str) -> None:
        self._wire = WIRES[camera_info.wire]
        self._count = camera_info.messages
        if camera_info.columns is None:
            raise FormatError("column-invalid", f"{place} at camera_info", "has no columns")
        self.columns = decode_columns(
            camera_info.columns,
            camera_info.messages,
            len(camera_info.calibrations),
            f"{place} at camera_info",
        )
        check_stamps(self.columns, camera_info.wire, f"{place} at camera_info")
        self._blanks = [
            self._blank(calibration, f"{place} at camera_info.calibrations.{number}")
            for number, calibration in enumerate(camera_info.calibrations)
        ]

    def _blank(self, calibration: Calibration, place: str) -> bytes:
        plain = self._wire.camera_info(0, 0, calibration.frame_id, fields_of(calibration))
        if calibration.template is None:
            return plain
        template = _template(calibration.template, f"{place}.template")
        if len(template) < len(plain):
            raise FormatError(
                "header-mismatch",
                f"{place}.template",
                f"has {len(template)} bytes where its fields take {len(plain)}",
            )
        return template

    def messages(self, channel: Channel) -> Iterator[tuple[int, Message]]:
        """Ordinal and message of each."""
        columns = self.columns
        for index in range(self._count):
            seq = int(columns.seq[index]) if columns.seq is not None else None
            blank = self._blanks[int(columns.variant[index])]
            payload = self._wire.patch_head(blank, int(columns.stamp[index]), seq)
            yield int(columns.ordinal[index]), message_at(columns, index, channel, payload)


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
