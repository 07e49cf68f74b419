"""Collecting the columns of a stream."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from mp4ds.records import Message
from mp4ds.sidecar import Column, Columns, Digests
from mp4ds.stamps import INT64_MAX, INT64_MIN, Int64Column, encode_column
from mp4ds.wire import Parts

_DIGESTS_PER_LINE = 12


class Unsuited(Exception):  # noqa: N818 - no error: the message is stored verbatim
    """A message that the stream cannot carry exactly; says why."""


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
            Unsuited: A time is beyond 64 bits with sign.
        """
        for value in (message.log_time, message.publish_time, parts.pts or 0):
            if not INT64_MIN <= value <= INT64_MAX:
                raise Unsuited(f"time {value} ns does not fit into 64 bits with sign")

    def append(self, message: Message, parts: Parts, *, variant: int, ordinal: int) -> None:
        """Append one message's values, checked before."""
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
    """Columns as the sidecar holds them; what follows from the rest is left out.

    Args:
        values: All that `Columns` has by name, shape (messages,); ``seq`` and ``pts`` where
            the messages have them.
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
