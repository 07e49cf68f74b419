"""Reads what is there of a damaged sqlite3 storage file of rosbag2."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from mp4ds.bags.mcap_records import DamageError
from mp4ds.bags.protocols import Format
from mp4ds.bags.salvage.losses import LossLog
from mp4ds.bags.salvage.reader import FileSalvage
from mp4ds.bags.salvage.sqlite_cells import Row
from mp4ds.bags.salvage.sqlite_index import MessageIndex, index_messages
from mp4ds.bags.salvage.sqlite_pages import Pages
from mp4ds.bags.salvage.sqlite_tables import Database, MessageRow, message_row
from mp4ds.bags.salvage.sqlite_topics import open_small_tables
from mp4ds.errors import SourceError
from mp4ds.records import Channel, Message, Record, Schema


class SqliteSalvage(FileSalvage):
    """Reads what is there of one ``.db3`` file, page by page. See `SalvageReader`.

    A transaction that was not finished is left out, one that stands in a write-ahead log is
    read from there; the files are not changed and not copied. Messages come by log time. Their
    places, 22 bytes each, are held in memory.

    Args:
        path: The database.
        shown: Its name in errors and tables, where it is a decompressed copy.
        message_decompress: Makes the payload of a message from what the file holds; raises
            `DamageError` for what it cannot read.
        expected: How many messages it should have, where something else tells.

    Attributes:
        tables: Content of the small tables by ``db3:<file>:<column>``, verbatim.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """

    format: Format = "rosbag2"
    profile = "ros2"
    is_ordered = True

    def __init__(
        self,
        path: Path,
        *,
        shown: Path | None = None,
        message_decompress: Callable[[bytes], bytes] | None = None,
        expected: int | None = None,
    ) -> None:
        super().__init__(path, shown)
        self._decompress = message_decompress
        self._expected = expected
        self._rows, self._rows_read, self._given, self._left = 0, 0, 0, 0
        self._small, self._problem = open_small_tables(path, self._shown)
        self._channels = {channel.id: channel for channel in self._small.channels}
        self.tables: Mapping[str, str] = self._small.tables

    @property
    def channels(self) -> Sequence[Channel]:
        """All topics, in the order of their ids."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Message definitions that no topic refers to."""
        return self._small.unused_schemas

    @property
    def start(self) -> int | None:
        """The earliest log time, ns, where sqlite3 can tell it; else None."""
        if self._small.path != self.path:
            return None  # its tables were made anew, without messages
        try:
            return self._small.start
        except SourceError:
            return None

    @property
    def fraction(self) -> float:
        """Part of the messages that `records` has read."""
        return min(1.0, self._rows_read / self._rows) if self._rows else 0.0

    def _lost_in_all(self) -> int | None:
        return None if self._expected is None else max(0, self._expected - self._given)

    def _pass(self, log: LossLog) -> Iterator[Record]:
        self._given = self._rows_read = 0
        size = self.path.stat().st_size
        with Pages(self.path, self._shown) as pages:
            database = Database(pages)
            if self._problem:
                log.lost(None, None, self._problem).add(0, ())
            index = index_messages(database, log, self._expected)
            self._rows = len(index.times)
            self._left = database.pages.all_bytes
            for message in self._messages(database, index, log):
                self._given += 1
                log.gave(message.log_time)
                yield message
                self._position = int(self.fraction * size)
            self._position = size

    def _messages(self, database: Database, index: MessageIndex, log: LossLog) -> Iterator[Message]:
        for position in index.order():
            self._rows_read += 1
            message = self._message(database, index, position, log)
            if message is not None:
                yield message

    def _message(
        self, database: Database, index: MessageIndex, position: int, log: LossLog
    ) -> Message | None:
        number, place = index.pages[position], index.places[position]
        page, rows, _ = database.leaf(number)
        row = rows[place] if place < len(rows) else None
        found = message_row(page, row) if row else None
        if row is None or found is None:
            return None
        try:
            channel, data = self._content(database, page, row, found)
        except _LostError as lost:
            problem, topic = lost.args
            loss = log.lost_of_kind(problem, database.pages.offset(number), problem)
            loss.add(1, topic)
            return None
        return Message(channel, found.time, found.time, 0, data)

    def _content(
        self, database: Database, page: bytes, row: Row, found: MessageRow
    ) -> tuple[Channel, bytes]:
        """Channel and payload of a message.

        Raises:
            _LostError: It cannot be read; says why, and the topics where they are known.
        """
        channel = self._channels.get(found.topic_id)
        if channel is None:
            raise _LostError(f"messages of topic id {found.topic_id}, of which no row tells", ())
        topic = channel.topic
        if found.time < 0:
            raise _LostError(f"messages of {topic} with a time before 1970", [topic])
        payload = database.payload(page, row) if row.size <= self._left else None
        if payload is None:
            problem = f"messages of {topic} of which pages are damaged or missing"
            raise _LostError(problem, [topic])
        self._left -= len(payload)
        data = payload[found.blob :]
        if self._decompress:
            try:
                data = self._decompress(data)
            except DamageError:
                problem = f"messages of {topic} of which the compression is damaged"
                raise _LostError(problem, [topic]) from None
        return channel, data


class _LostError(Exception):
    """A message cannot be read: a phrase, and the topics that it is of."""
