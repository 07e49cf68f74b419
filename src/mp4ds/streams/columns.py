"""Collecting the columns of a stream and the variants that its messages choose from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.records import Message
from mp4ds.sidecar import Column, Columns
from mp4ds.sidecar.models import MAX_VARIANTS
from mp4ds.stamps import INT64_MAX, INT64_MIN, Int64Column, encode_column

_VariantT = TypeVar("_VariantT")


class Unsuited(Exception):  # noqa: N818 - no error: the message is stored verbatim
    """A message that the stream cannot carry exactly; says why."""


class Variants(Generic[_VariantT]):
    """Numbers the distinct constant parts of messages, by their bytes."""

    def __init__(self) -> None:
        self._numbers: dict[bytes, int] = {}
        self.items: list[_VariantT] = []

    def number(self, key: bytes, make: Callable[[], _VariantT]) -> int:
        """The number of the variant with these bytes; `make` describes a new one.

        Raises:
            Unsuited: There are too many.
        """
        known = self._numbers.get(key)
        if known is not None:
            return known
        if len(self.items) == MAX_VARIANTS:
            raise Unsuited(f"more than {MAX_VARIANTS} different message headers")
        self.items.append(make())
        self._numbers[key] = len(self.items) - 1
        return len(self.items) - 1


class ColumnsWriter:
    """The growing columns of one stream or of its camera_info."""

    def __init__(self) -> None:
        self._log_time = Int64Column()
        self._publish_time = Int64Column()
        self._sequence = Int64Column()
        self._stamp = Int64Column()
        self._seq = Int64Column()
        self._variant = Int64Column()
        self._ordinal = Int64Column()

    def __len__(self) -> int:
        return len(self._log_time)

    @staticmethod
    def check(message: Message) -> None:
        """Refuse times that a column cannot hold.

        Raises:
            Unsuited: A time is beyond 64 bits with sign.
        """
        for value in (message.log_time, message.publish_time):
            if not INT64_MIN <= value <= INT64_MAX:
                raise Unsuited(f"time {value} ns does not fit into 64 bits with sign")

    def append(
        self, message: Message, *, stamp: int, seq: int | None, variant: int, ordinal: int
    ) -> None:
        """Append one message's values, checked before."""
        self._log_time.append(message.log_time)
        self._publish_time.append(message.publish_time)
        self._sequence.append(message.sequence)
        self._stamp.append(stamp)
        if seq is not None:
            self._seq.append(seq)
        self._variant.append(variant)
        self._ordinal.append(ordinal)

    def to_model(self) -> Columns:
        """The columns as the sidecar holds them; what follows from the rest is left out."""
        log_time = self._log_time.to_numpy()
        publish_time = self._publish_time.to_numpy()
        ordinal = self._ordinal.to_numpy()
        return Columns(
            log_time=_column(log_time),
            publish_time=None if _same(publish_time, log_time) else _column(publish_time),
            sequence=_unless_zero(self._sequence.to_numpy()),
            stamp=_column(self._stamp.to_numpy()),
            seq=_column(self._seq.to_numpy()) if len(self._seq) else None,
            variant=_unless_zero(self._variant.to_numpy()),
            ordinal=None if _same(ordinal, np.arange(len(self))) else _column(ordinal),
        )


def _same(a: NDArray[np.int64], b: NDArray[np.int64]) -> bool:
    return bool(np.array_equal(a, b))


def _unless_zero(values: NDArray[np.int64]) -> Column | None:
    return _column(values) if values.any() else None


def _column(values: NDArray[np.int64]) -> Column:
    return Column.model_validate(encode_column(values))
