"""The columns of a sidecar as arrays, and choices among their messages."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FormatError
from mp4ds.format.fields import Column, Columns, Digests
from mp4ds.messages.wire import Slots
from mp4ds.records import Excerpt
from mp4ds.times import encode_column

_DIGESTS_PER_LINE = 12


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

    @classmethod
    def of_frames(
        cls,
        stamp: NDArray[np.int64],
        log_time: NDArray[np.int64],
        ordinal: NDArray[np.int64] | None = None,
    ) -> DecodedColumns:
        """Those of frames without a sidecar."""
        zeros = np.broadcast_to(np.int64(0), stamp.shape)
        numbers = np.arange(len(stamp)) if ordinal is None else ordinal
        return cls(log_time, log_time, zeros, stamp, None, None, zeros, numbers)

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


# ---------------------------------------------------------------- as a sidecar has them


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
