"""Parts of a recording into one: streams by copying packets, messages by their log times."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.bags import BagReader
from mp4ds.bags.mcap import McapReader
from mp4ds.bags.mcap_write import McapWriter
from mp4ds.errors import FormatError, SourceError
from mp4ds.outputs import digest_file
from mp4ds.packing.manifest import declare_rest
from mp4ds.packing.part import Part, PartStream
from mp4ds.plan import FileNames
from mp4ds.records import Attachment, Channel, Message, MetadataRecord
from mp4ds.sidecar import StreamSidecar, dump_document
from mp4ds.streams import StreamJoin


@dataclass
class _Counts:
    """Messages that earlier parts had, by channel id and by topic."""

    channels: dict[int, int] = field(default_factory=dict)
    topics: dict[str, int] = field(default_factory=dict)


class Assembler:
    """Joins parts.

    Args:
        reader: The recording, indexed.
        selected: Whether a topic is packed.
        folder: The folder to fill, empty.
        threads: Streams that are joined side by side.
    """

    def __init__(
        self,
        reader: BagReader,
        selected: Callable[[str], bool],
        folder: Path,
        *,
        threads: int = 1,
    ) -> None:
        self._reader = reader
        self._selected = selected
        self._threads = threads
        self._whole = Part(folder)
        self._counts = _Counts()
        self._channels: dict[object, list[Channel]] = {}  # by identity: several may be alike
        for channel in reader.channels:
            self._channels.setdefault(channel.identity, []).append(channel)
        self._joins: dict[object, list[StreamJoin]] = {}
        self._order: list[tuple[StreamSidecar, StreamJoin]] = []
        self._chains: dict[str, list[Part]] = {}

    def add(self, part: Part, chain: str) -> None:
        """Take the next part.

        Args:
            part: In the order of time among those of its chain.
            chain: Which parts follow each other without overlapping.

        Raises:
            FormatError: A file of it is damaged.
        """
        part.check_counts(self._reader.channels)
        for stream in part.streams:
            self._add_stream(part, stream)
        self._chains.setdefault(chain, []).append(part)
        whole, counts = self._whole, self._counts
        whole.saw(part.span or ())
        whole.left_out.update(part.left_out)
        whole.skipped.update(part.skipped)
        whole.transforms.extend(part.transforms)
        for channel, count in part.counts.items():
            counts.channels[channel] = counts.channels.get(channel, 0) + count
        for name, topic in part.topics.items():
            before = counts.topics.get(name, 0)
            counts.topics[name] = before + topic.messages
            if name in whole.topics:
                whole.topics[name].extend(topic, before)
            else:
                whole.topics[name] = topic

    def _add_stream(self, part: Part, stream: PartStream) -> None:
        sidecar = stream.sidecar
        video = part.folder / sidecar.video.file
        if digest_file(video) != (sidecar.video.size, sidecar.video.sha256):
            raise _rotten(part, video)
        joins = self._joins.setdefault(sidecar.channel.to_record(0).identity, [])
        join = next((join for join in joins if join.takes(sidecar, video)), None)
        if join is None:
            join = StreamJoin(sidecar, video)
            joins.append(join)
            self._order.append((sidecar, join))
        info = sidecar.camera_info
        join.add(
            sidecar,
            video,
            ordinal=self._before(sidecar.channel.to_record(0)),
            info_ordinal=self._before(info.channel.to_record(0)) if info else 0,
        )

    def _before(self, channel: Channel) -> int:
        alike = self._channels[channel.identity]
        return sum(self._counts.channels.get(item.id, 0) for item in alike)

    def finish(self, report: Callable[[str], None] = lambda _: None) -> Part:
        """Write everything but the manifest.

        Args:
            report: Called with the name of each file that is begun.

        Raises:
            SourceError: The parts do not hold what the recording's index tells.
            OSError: The disk refused.
        """
        self._check_counts()
        names = FileNames()
        whole = self._whole
        named = [names.name_for(first.channel.topic) for first, _ in self._order]

        def write(number: int) -> PartStream:
            (stem, is_renamed), join = named[number], self._order[number][1]
            report(f"{stem}.mp4")
            sidecar = join.finish(stem, whole.folder)
            (whole.folder / f"{stem}.yaml").write_bytes(dump_document(sidecar))
            return PartStream(stem, sidecar, is_renamed)

        # copying and hashing run without Python's lock
        with ThreadPoolExecutor(self._threads) as threads:
            whole.streams.extend(threads.map(write, range(len(named))))
        report(whole.messages_path.name)
        self._write_messages()
        return whole

    def _check_counts(self) -> None:
        """Refuse parts that together have not all messages: an index lies."""
        stats = self._reader.stats()
        for channel in self._reader.channels:
            found = self._counts.channels.get(channel.id, 0)
            if self._selected(channel.topic) and channel.id in stats:
                due = stats[channel.id].count
                if found != due:
                    raise SourceError(
                        self._reader.path,
                        f"is damaged: its index tells of {due} messages on {channel.topic}, "
                        f"and {found} were found",
                    )

    def _write_messages(self) -> None:
        whole = self._whole
        with McapWriter(whole.messages_path, profile=self._reader.profile) as writer:
            chains = [self._records(parts) for parts in self._chains.values()]
            for record in heapq.merge(*chains, key=_time_of):
                if isinstance(record, Message):
                    writer.add_channel(record.channel)
                    writer.write(record)
                elif isinstance(record, Attachment):
                    writer.add_attachment(record)
                else:
                    writer.add_metadata(record)
            declare_rest(whole, self._reader, self._selected, writer)

    def _records(self, parts: Sequence[Part]) -> Iterator[Message | Attachment | MetadataRecord]:
        for part in parts:
            try:
                with McapReader(part.messages_path) as reader:
                    for record in reader.records():
                        if isinstance(record, Message):
                            channel = self._channels[record.channel.identity][0]
                            yield record.of_channel(channel)
                        else:
                            yield record
            except SourceError:
                raise _rotten(part, part.messages_path) from None


def _rotten(part: Part, path: Path) -> FormatError:
    """The error of a part's file that is not what was written; the part is made again."""
    part.forget()
    return FormatError(
        "checksum-mismatch",
        path,
        "was damaged since it was written; run the same command again to make this part anew",
    )


def _time_of(record: Message | Attachment | MetadataRecord) -> int:
    return record.log_time if isinstance(record, Message) else 0
