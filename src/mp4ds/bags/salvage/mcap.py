"""Reads what is there of a damaged MCAP file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from mcap import records as mcap_records
from mcap.opcode import Opcode

from mp4ds.bags.mcap import McapReader
from mp4ds.bags.mcap_declared import Declared
from mp4ds.bags.mcap_records import MAGIC, DamageError, open_source, parse
from mp4ds.bags.ordering import HOLD_BYTES, HoldBack
from mp4ds.bags.protocols import BagReader, Format
from mp4ds.bags.salvage.losses import LossLog
from mp4ds.bags.salvage.mcap_pass import McapPass
from mp4ds.bags.salvage.mcap_summary import SalvagedSummary, read_summary
from mp4ds.bags.salvage.reader import FileSalvage
from mp4ds.bags.salvage.window import Window
from mp4ds.bags.zstd_files import ZstdStream
from mp4ds.errors import SourceError
from mp4ds.records import Channel, ChannelStats, Message, Record, Schema


class McapSalvage(FileSalvage):
    """Reads what is there of an MCAP file. See `SalvageReader`.

    Args:
        path: The file.
        is_compressed: Whether it is compressed by zstd as a whole. Offsets of its losses
            are then those in its content.
        message_decompress: Makes the payload of a message from what the file holds; raises
            `DamageError` for what it cannot read.
        in_file_order: Give messages as they stand in the file, whatever their log times.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """

    format: Format = "mcap"

    def __init__(
        self,
        path: Path,
        *,
        is_compressed: bool = False,
        message_decompress: Callable[[memoryview], bytes] | None = None,
        in_file_order: bool = False,
    ) -> None:
        super().__init__(path)
        open_source(path).close()
        self._is_compressed = is_compressed
        self._decompress = message_decompress
        self._in_file_order = in_file_order
        self._declared = Declared()
        self._given = 0
        self._count: int | None = None
        self._summary = SalvagedSummary() if is_compressed else read_summary(path)
        if is_compressed:
            self._summary.finish()
        self._read_header()
        if not self._summary.is_verified:
            return
        schemas = {schema.id for schema in self._summary.schemas}
        for schema in self._summary.schemas:
            self._declare(lambda: self._declared.add_schema(schema))  # noqa: B023
        for channel in self._summary.channels:
            if not channel.schema_id or channel.schema_id in schemas:
                self._declare(lambda: self._declared.add_channel(channel))  # noqa: B023

    @staticmethod
    def _declare(declare: Callable[[], None]) -> None:
        with contextlib.suppress(DamageError):  # it is told when it is read
            declare()

    def _read_header(self) -> None:
        with self._window() as window:
            frame = bytes(window.peek(2**16))
        if frame[len(MAGIC) : len(MAGIC) + 1] == bytes([Opcode.HEADER]):
            length = int.from_bytes(frame[9:17], "little")
            try:
                header = parse(mcap_records.Header, frame[17 : 17 + length])
            except DamageError:
                return
            self.profile, self.library = header.profile, header.library

    def _window(self) -> Window:
        if self._is_compressed:
            return Window(ZstdStream(self.path), self.path)
        return Window.of_file(self.path)

    @property
    def channels(self) -> Sequence[Channel]:
        """Channels of the summary, then those met while reading."""
        return list(self._declared.channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Schemas that no channel refers to, known so far."""
        return self._declared.unused_schemas

    @property
    def skipped(self) -> Mapping[str, int]:
        """Records that only the application that wrote them understands: name -> count."""
        return dict(self._declared.skipped)

    @property
    def has_statistics(self) -> bool:
        """Whether the file tells how many messages it has."""
        return self._summary.statistics is not None

    @property
    def is_ordered(self) -> bool:
        """Whether messages come in log-time order."""
        return self._summary.chunks.has_messages and not self._in_file_order

    @property
    def start(self) -> int | None:
        """The earliest log time by the summary, ns; None where it does not tell."""
        span = self._summary.chunks.span()
        return span[0] if span else None

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans by the summary, with what is lost; else empty."""
        return self._summary.stats()

    def _lost_in_all(self) -> int | None:
        return None if self._count is None else max(0, self._count - self._given)

    @property
    def _orderly(self) -> Callable[[], BagReader] | None:
        if self._in_file_order or self._summary.chunks.held_in_file_order() <= HOLD_BYTES:
            return None
        return partial(McapReader, self.path, message_decompress=self._decompress)

    def _pass(self, log: LossLog) -> Iterator[Record]:
        self._declared.skipped.clear()
        self._given = 0
        chunks = self._summary.chunks
        held = HoldBack() if self.is_ordered else None
        with self._window() as window:
            reading = McapPass(
                self.path, window, log, self._declared, self._summary, self._decompress
            )
            others: list[Record] = []
            for record in reading.records():
                self._position = window.position
                if isinstance(record, Message):
                    self._given += 1
                    if held is None:
                        yield record
                    else:
                        held.add(record)
                elif record is not None:
                    others.append(record)
                else:
                    if held is not None:
                        yield from held.release(chunks.later_start(reading.offset))
                    yield from others
                    others.clear()
            if held is not None:
                yield from held.release(None)
            self._position = window.position
            self._count = reading.count
            if self.is_alone and not reading.found and not self._declared.channels:
                raise SourceError(self.path, "holds no record of an MCAP file")
