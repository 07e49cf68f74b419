"""Everything around the bodies of messages: collected, rebuilt, and selected."""

from __future__ import annotations

import base64
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FormatError, Refused
from mp4ds.format.fields import (
    MAX_CAMERA_INFOS,
    MAX_VARIANTS,
    Column,
    Columns,
    Digests,
    decode_base64,
)
from mp4ds.format.models import Calibration, CameraInfo, ChannelModel, Roi
from mp4ds.messages.serializations import form_of, wire_of
from mp4ds.messages.wire import (
    CalibrationFields,
    CodedFields,
    Fields,
    Form,
    Parts,
    Slots,
    Template,
    WireError,
    prove,
)
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.times import INT64_MAX, INT64_MIN, Int64Column, encode_column

_DIGESTS_PER_LINE = 12


class ColumnsWriter:
    """The growing columns of one stream or of its camera_info."""

    def __init__(self) -> None:
        self._log_time = Int64Column()
        self._publish_time = Int64Column()
        self._sequence = Int64Column()
        self._stamp = Int64Column()
        self._seq = Int64Column()
        self._pts = Int64Column()
        self._variant = Int64Column()
        self._ordinal = Int64Column()

    def __len__(self) -> int:
        return len(self._log_time)

    @staticmethod
    def check(message: Message, parts: Parts) -> None:
        """Refuse times that a column cannot hold.

        Raises:
            Refused: A time does not fit into a signed 64-bit integer.
        """
        for value in (message.log_time, message.publish_time, parts.pts or 0):
            if not INT64_MIN <= value <= INT64_MAX:
                raise Refused(f"time {value} ns does not fit into 64 bits with sign")

    def append(self, message: Message, parts: Parts, *, variant: int, ordinal: int) -> None:
        """Append one message's values, already checked."""
        self._log_time.append(message.log_time)
        self._publish_time.append(message.publish_time)
        self._sequence.append(message.sequence)
        self._stamp.append(parts.stamp)
        if parts.seq is not None:
            self._seq.append(parts.seq)
        if parts.pts is not None:
            self._pts.append(parts.pts)
        self._variant.append(variant)
        self._ordinal.append(ordinal)

    def to_model(self) -> Columns:
        """The columns as the sidecar holds them."""
        columns = {
            "log_time": self._log_time,
            "publish_time": self._publish_time,
            "sequence": self._sequence,
            "stamp": self._stamp,
            **({"seq": self._seq} if len(self._seq) else {}),
            **({"pts": self._pts} if len(self._pts) else {}),
            "variant": self._variant,
            "ordinal": self._ordinal,
        }
        return columns_model({name: column.to_numpy() for name, column in columns.items()})


def columns_model(values: Mapping[str, NDArray[np.int64]]) -> Columns:
    """Columns as the sidecar stores them, without those that follow from others.

    Args:
        values: All that `Columns` has by name, shape (messages,); ``seq`` and ``pts`` if the
            messages have them.
    """
    log_time, publish_time, ordinal = (
        values[name] for name in ("log_time", "publish_time", "ordinal")
    )
    return Columns(
        log_time=_column(log_time),
        publish_time=None if _same(publish_time, log_time) else _column(publish_time),
        sequence=_unless_zero(values["sequence"]),
        stamp=_column(values["stamp"]),
        seq=_column(values["seq"]) if "seq" in values else None,
        pts=_column(values["pts"]) if "pts" in values else None,
        variant=_unless_zero(values["variant"]),
        ordinal=None if _same(ordinal, np.arange(len(ordinal))) else _column(ordinal),
    )


def digests_model(digests: Iterable[int]) -> Digests:
    """XXH64 digests of messages, as the sidecar holds them."""
    words = [f"{value:016x}" for value in digests]
    lines = (
        " ".join(words[start : start + _DIGESTS_PER_LINE])
        for start in range(0, len(words), _DIGESTS_PER_LINE)
    )
    return Digests(algorithm="xxh64", values="\n".join(lines) + "\n")


def _same(a: NDArray[np.int64], b: NDArray[np.int64]) -> bool:
    return bool(np.array_equal(a, b))


def _unless_zero(values: NDArray[np.int64]) -> Column | None:
    return _column(values) if values.any() else None


def _column(values: NDArray[np.int64]) -> Column:
    return Column.model_validate(encode_column(values))


# ---------------------------------------------------------------- headers

_ModelT = TypeVar("_ModelT")


class MessageSplitter:
    """Splits the messages of one channel; its serialization may change between messages."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._forms: dict[str, Form] = {}

    def split(self, message: Message) -> tuple[Form, Parts]:
        """The form of a message and its parts.

        Raises:
            Refused: It does not parse, or is not modelled.
        """
        data = memoryview(message.data)
        schema = self._channel.schema
        try:
            wire = wire_of(self._channel.message_encoding, data)
            if wire not in self._forms:
                definition = schema.data if schema else b""
                self._forms[wire] = form_of(wire, self._channel.type_name, definition)
            form = self._forms[wire]
            return form, form.split(data)
        except WireError as error:
            raise Refused(f"it does not parse: {error}") from None


class HeaderTable(Generic[_ModelT]):
    """Numbers the distinct blanks of a stream's messages.

    Args:
        form: Of all messages.
    """

    def __init__(self, form: Form) -> None:
        self.form = form
        self.items: list[_ModelT] = []
        self._templates: dict[bytes, Template] = {}
        self._numbers: dict[tuple[bytes, object], int] = {}

    def number(
        self,
        parts: Parts,
        data: memoryview,
        *,
        describe: Callable[[str | None], _ModelT],
        extra: object = None,
    ) -> int:
        """The number of a message's header, after rebuilding and comparing the message.

        Args:
            parts: Of the message.
            data: The message.
            describe: Makes the model of a new header, from its template or None for a plain one.
            extra: What else distinguishes headers.

        Raises:
            Refused: It does not rebuild, or there are too many.
        """
        blank = parts.blank
        try:
            template = self._templates.get(blank) or self.form.template(blank)
            exact = prove(template, parts, data)
        except WireError as error:
            raise Refused(f"its header does not rebuild: {error}") from None
        if not exact:
            raise Refused("its header does not rebuild")
        known = self._numbers.get((blank, extra))
        if known is not None:
            return known
        if len(self.items) == MAX_VARIANTS:
            raise Refused(f"more than {MAX_VARIANTS} different message headers")
        plain = self.form.plain(parts.frame_id, parts.fields)
        self.items.append(describe(None if plain == blank else base64.b64encode(blank).decode()))
        self._templates[blank] = template
        self._numbers[blank, extra] = len(self.items) - 1
        return len(self.items) - 1


# ---------------------------------------------------------------- CameraInfo


class CameraInfoWriter:
    """The calibration messages of one channel."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self._forms = MessageSplitter(channel)
        self._columns = ColumnsWriter()
        self._heads: HeaderTable[Calibration] | None = None

    def accept(self, message: Message, ordinal: int) -> None:
        """Accept a message.

        Args:
            message: The message.
            ordinal: Its position among the channel's messages.

        Raises:
            Refused: It cannot be modelled exactly; nothing was changed.
        """
        form, parts = self._forms.split(message)
        self._columns.check(message, parts)
        if len(self._columns) == MAX_CAMERA_INFOS:
            raise Refused(f"more than {MAX_CAMERA_INFOS} messages")
        fields = parts.fields
        if not isinstance(fields, CalibrationFields):
            raise Refused("it is not a calibration")
        heads = self._heads or HeaderTable[Calibration](form)
        if heads.form.wire != form.wire:
            raise Refused("its byte order differs from the first one's")
        variant = heads.number(
            parts,
            memoryview(message.data),
            describe=lambda template: _calibration(parts.frame_id, fields, template),
        )
        self._heads = heads
        self._columns.append(message, parts, variant=variant, ordinal=ordinal)

    def to_model(self) -> CameraInfo | None:
        """The model, or None if no message was accepted."""
        if self._heads is None:
            return None
        return CameraInfo(
            channel=ChannelModel.from_record(self.channel),
            wire=self._heads.form.wire,
            messages=len(self._columns),
            calibrations=self._heads.items,
            columns=self._columns.to_model(),
        )


def _calibration(frame_id: str, fields: CalibrationFields, template: str | None) -> Calibration:
    x_offset, y_offset, height, width = fields.roi
    roi = Roi(
        x_offset=x_offset,
        y_offset=y_offset,
        height=height,
        width=width,
        do_rectify=fields.roi_do_rectify,
    )
    return Calibration(
        frame_id=frame_id,
        height=fields.height,
        width=fields.width,
        distortion_model=fields.distortion_model,
        d=list(fields.d),
        k=list(fields.k),
        r=list(fields.r),
        p=list(fields.p),
        binning_x=fields.binning_x,
        binning_y=fields.binning_y,
        roi=roi if any((*fields.roi, fields.roi_do_rectify)) else None,
        template=template,
    )


def fields_of(calibration: Calibration) -> CalibrationFields:
    """The fields of a calibration, for serialization."""
    roi = calibration.roi
    return CalibrationFields(
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.distortion_model,
        d=tuple(calibration.d),
        k=tuple(calibration.k),
        r=tuple(calibration.r),
        p=tuple(calibration.p),
        binning_x=calibration.binning_x,
        binning_y=calibration.binning_y,
        roi=(roi.x_offset, roi.y_offset, roi.height, roi.width) if roi else (0, 0, 0, 0),
        roi_do_rectify=roi.do_rectify if roi else 0,
    )


# ---------------------------------------------------------------- rebuild


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
        """The values that fill a message's blank."""
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
        frame_id: The sidecar's value.
        fields: The sidecar's other values; the size of coded images is ignored.
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
            raise WireError("contradicts the fields beside it")
        return form.template(blank)
    except ValueError as error:
        raise FormatError("header-mismatch", place, str(error)) from None


def camera_info_columns(camera_info: CameraInfo, place: str) -> DecodedColumns:
    """The columns of a stream's CameraInfo messages, of which there is at least one.

    Raises:
        FormatError: ``column-invalid``.
    """
    place = f"{place} at camera_info"
    if camera_info.columns is None:
        raise FormatError("column-invalid", place, "has no columns")
    calibrations = len(camera_info.calibrations)
    return decode_columns(camera_info.columns, camera_info.messages, calibrations, place)


class CameraInfoRebuilder:
    """Makes the CameraInfo messages of a stream.

    Args:
        camera_info: The stream's; must have messages.
        columns: Theirs.
        place: Name of the sidecar, for errors.

    Raises:
        FormatError: The sidecar contradicts itself.
    """

    def __init__(self, camera_info: CameraInfo, columns: DecodedColumns, place: str) -> None:
        place = f"{place} at camera_info"
        self.columns = columns
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
        """Ordinal and message of each wanted one.

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


# ---------------------------------------------------------------- choices

Choice = Callable[[DecodedColumns], Iterator[int]]
"""Yields the numbers of the wanted messages, increasing.

The next number is requested only when the previous message has been made, so that it can skip those
for which it is too late by then.
"""


def everything(columns: DecodedColumns) -> Iterator[int]:
    """All messages."""
    return iter(range(len(columns.log_time)))


def within(excerpt: Excerpt, choice: Choice = everything) -> Choice:
    """Restrict the wanted messages to a span of log time."""

    def choose(columns: DecodedColumns) -> Iterator[int]:
        times = columns.log_time
        return (index for index in choice(columns) if excerpt.has_time(int(times[index])))

    return choose


def last_of(end: int, count: int) -> Choice:
    """The last messages before a log time, nanoseconds, as many as there are."""

    def choose(columns: DecodedColumns) -> Iterator[int]:
        return iter(np.flatnonzero(columns.log_time < end)[-count:].tolist())

    return choose


def marked(is_wanted: NDArray[np.bool_], choice: Choice = everything) -> Choice:
    """Restrict the wanted messages to marked ones.

    Args:
        is_wanted: For each message, shape (messages,).
        choice: Says which are wanted.
    """

    def choose(columns: DecodedColumns) -> Iterator[int]:
        return (index for index in choice(columns) if is_wanted[index])

    return choose


def unbroken(
    indices: Iterable[int], keys: Sequence[int], *, from_key: bool = False
) -> Iterator[int]:
    """Packets of a video, including those between that must be decoded first.

    Args:
        indices: Numbers of the wanted packets, increasing.
        keys: Numbers of the key frames, increasing.
        from_key: Start with the key frame before the first one.
    """
    due: int | None = None
    for index in indices:
        at = bisect_right(keys, index)
        key = keys[at - 1] if at else 0
        if due is None:
            due = key if from_key else index
        yield from range(max(due, key), index + 1)
        due = index + 1
