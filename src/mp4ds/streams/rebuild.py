"""What stands around the bodies of messages, rebuilt from the sidecar; whole calibrations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FormatError
from mp4ds.records import Channel, Message
from mp4ds.sidecar import CameraInfo, Columns
from mp4ds.sidecar.fields import decode_base64
from mp4ds.streams.camera_info import fields_of
from mp4ds.wire import CodedFields, Fields, Form, Slots, Template, WireError, form_of


@dataclass(frozen=True)
class DecodedColumns:
    """The columns of a stream as int64 arrays of shape (messages,); times in nanoseconds."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    stamp: NDArray[np.int64]
    seq: NDArray[np.int64] | None
    pts: NDArray[np.int64] | None
    variant: NDArray[np.int64]
    ordinal: NDArray[np.int64]

    def slots(self, index: int) -> Slots:
        """What fills the blank of a message."""
        return Slots(
            stamp=int(self.stamp[index]),
            seq=None if self.seq is None else int(self.seq[index]),
            pts=None if self.pts is None else int(self.pts[index]),
        )


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
        pts=arrays.get("pts"),
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


def check_slots(columns: DecodedColumns, templates: list[Template], place: str) -> None:
    """Refuse stamps and numbers that the serialization has no bits for.

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
            except WireError as error:
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
    except WireError as error:
        raise FormatError("header-mismatch", f"{place} at channel", str(error)) from None


def template_of(
    form: Form, encoded: str | None, frame_id: str, fields: Fields, place: str
) -> Template:
    """The template of a header or calibration.

    Args:
        form: Of the messages.
        encoded: The blank in base64, or None for a plain one.
        frame_id: What the sidecar says beside it.
        fields: What it says besides; the size of coded images does not count.
        place: Of the template, for errors.

    Raises:
        FormatError: ``header-mismatch``.
    """
    try:
        blank = form.plain(frame_id, fields) if encoded is None else decode_base64(encoded)
        if blank is None:
            raise WireError("a message of this type needs a template")
        parts = form.split(memoryview(blank))
        found = parts.fields
        if isinstance(found, CodedFields):
            found = CodedFields(found.format)
        if (parts.frame_id, found) != (frame_id, fields):
            raise WireError("says something else than the fields beside it")
        return form.template(blank)
    except ValueError as error:
        raise FormatError("header-mismatch", place, str(error)) from None


class CameraInfoRebuilder:
    """Makes the CameraInfo messages of a stream.

    Args:
        camera_info: The stream's; must have messages.
        place: Name of the sidecar, for errors.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(self, camera_info: CameraInfo, place: str) -> None:
        place = f"{place} at camera_info"
        if camera_info.columns is None:
            raise FormatError("column-invalid", place, "has no columns")
        self.columns = decode_columns(
            camera_info.columns, camera_info.messages, len(camera_info.calibrations), place
        )
        form = form_for(camera_info.channel.to_record(0), camera_info.wire, place)
        self._templates = [
            template_of(
                form,
                calibration.template,
                calibration.frame_id,
                fields_of(calibration),
                f"{place}.calibrations.{number}",
            )
            for number, calibration in enumerate(camera_info.calibrations)
        ]
        check_slots(self.columns, self._templates, place)

    def messages(self, channel: Channel, indices: Iterable[int]) -> Iterator[tuple[int, Message]]:
        """Ordinal and message of each one that is wanted.

        Args:
            channel: The channel to make them on.
            indices: Their numbers.
        """
        columns = self.columns
        for index in indices:
            template = self._templates[int(columns.variant[index])]
            payload = b"".join(template.around(columns.slots(index), 0))
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
