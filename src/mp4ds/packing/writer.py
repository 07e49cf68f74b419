"""Camera messages into one video and its sidecar, each proven to come back (spec, "Exactness")."""

from __future__ import annotations

import base64
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import xxhash

from mp4ds.dataset.rebuild import ColumnsWriter, HeaderTable, digests_model
from mp4ds.errors import OutOfReachError, Refused
from mp4ds.format.fields import FORMAT_VERSION, MAX_FRAMES, Columns, exceeds_padding
from mp4ds.format.models import (
    CameraInfo,
    ChannelModel,
    Header,
    Image,
    PngFile,
    StreamSidecar,
    VideoModel,
    video_facts,
)
from mp4ds.format.sidecars import dump_document
from mp4ds.messages.png import PngRecipe, zlib_fingerprint
from mp4ds.messages.wire import CodedFields
from mp4ds.packing.journal import Journal, StreamNote
from mp4ds.packing.look import CameraMessage
from mp4ds.packing.tracks import StreamSettings, TrackPlan
from mp4ds.records import Channel, Message
from mp4ds.times import PresentationClock

# ---------------------------------------------------------------- writer


class StreamWriter:
    """One stream being written: accepts messages in order, then makes its sidecar.

    `accept` decides at once and keeps the columns; the job that it returns does the costly
    work and may run in another thread, in order with the stream's other jobs.

    Args:
        stem: File name of video and sidecar, without ending.
        folder: Where to write them.
        channel: The channel of all messages.
        seen: What the first of them holds.
        plan: How the video is made.
        settings: How to encode.
        rate: Frames per second, where known.
        journal: Where to note what the sidecar will say; None: nowhere.

    Raises:
        Refused: The encoder does not take such pictures.
    """

    def __init__(
        self,
        stem: str,
        folder: Path,
        *,
        channel: Channel,
        seen: CameraMessage,
        plan: TrackPlan,
        settings: StreamSettings,
        rate: float | None,
        journal: Journal | None = None,
    ) -> None:
        self.channel = channel
        self.camera_info: CameraInfo | None = None
        self.video_path = folder / f"{stem}.mp4"
        self.sidecar_path = folder / f"{stem}.yaml"
        self._plan = plan
        self._columns = ColumnsWriter()
        self._heads = HeaderTable[Header](seen.form)
        self._digests = array("Q")
        self._clock = PresentationClock()
        noted = partial(journal.packet, stem) if journal is not None else None
        self._track = plan.open(self.video_path, seen, settings, rate, noted)
        self._note = StreamNote(
            stem,
            channel.id,
            seen.key,
            plan.profile,
            plan.exact,
            has_seq=seen.parts.seq is not None,
            has_pts=seen.parts.pts is not None,
            video={},
        )
        self._journal = journal
        if journal is not None:
            journal.stream(self._note._replace(video=self._track.describe()))

    @property
    def note(self) -> str:
        """What the user should know of how the video is made; empty if nothing."""
        return self._track.note

    @property
    def frames(self) -> int:
        """Messages accepted so far."""
        return len(self._columns)

    def accept(self, message: Message, seen: CameraMessage, ordinal: int) -> Callable[[], None]:
        """Take a message whose key is this stream's.

        Args:
            message: The message; its payload must stay as it is until the job has run.
            seen: What it holds.
            ordinal: Its place among the channel's messages.

        Returns:
            The job that writes its frame, and raises what `finish` does.

        Raises:
            Refused: The stream cannot carry it exactly; nothing was changed.
        """
        parts = seen.parts
        self._columns.check(message, parts)
        if self.frames == MAX_FRAMES:
            raise Refused(f"more than {MAX_FRAMES} messages")
        if refusal := self._track.refuses(seen):
            raise Refused(refusal)
        variant = self._heads.number(
            parts,
            memoryview(message.data),
            describe=lambda template: self._header(seen, template),
            extra=seen.wrap,
        )
        self._columns.append(message, parts, variant=variant, ordinal=ordinal)
        tick = self._clock.tick(parts.stamp, message.log_time)

        def write() -> None:
            digest = 0
            if self._plan.exact:
                digest = xxhash.xxh64_intdigest(message.data)
                self._digests.append(digest)
            if self._journal is not None:
                times = message.log_time, message.publish_time, message.sequence
                own = parts.stamp, parts.seq or 0, parts.pts or 0
                made = variant, ordinal, tick, len(message.data), digest
                self._journal.frame(self.video_path.stem, (*times, *own, *made))
            try:
                self._track.write(seen, tick)
            except Refused as reason:
                raise self._out_of_reach(reason) from None

        return write

    def finish(self) -> StreamSidecar:
        """Complete the video and write the sidecar; all jobs must have run.

        Returns:
            The sidecar.

        Raises:
            OutOfReachError: The video cannot have the score that was asked for.
            OSError: It cannot be written.
        """
        try:
            self._track.close()
        except Refused as reason:
            raise self._out_of_reach(reason) from None
        sidecar = stream_sidecar(
            self._note._replace(video=self._track.describe()),
            self.channel,
            self.video_path,
            headers=self._heads.items,
            camera_info=self.camera_info,
            columns=self._columns.to_model(),
            frames=self.frames,
            digests=self._digests,
        )
        self.sidecar_path.write_bytes(dump_document(sidecar))
        return sidecar

    def _out_of_reach(self, reason: Refused) -> OutOfReachError:
        stream = (self.channel.id, self._note.key)
        return OutOfReachError(self.channel.topic, stream, str(reason))

    def _header(self, seen: CameraMessage, template: str | None) -> Header:
        """The model of a message's header.

        Raises:
            Refused: The headers would become too large.
        """
        fields, wrap = seen.parts.fields, seen.wrap
        padding = None if wrap.padding is None else base64.b64encode(wrap.padding).decode()
        if exceeds_padding((padding, *(head.padding for head in self._heads.items))):
            raise Refused("too much padding between rows, different in each image")
        header = Header(
            frame_id=seen.parts.frame_id,
            format=fields.format if isinstance(fields, CodedFields) else None,
            template=template,
            framing=wrap.framing,
            prefix=wrap.prefix.hex(),
            png=_png_file(wrap.png) if wrap.png else None,
            padding=padding,
        )
        if self._journal is not None:
            self._journal.header(self.video_path.stem, header)
        return header

    def abandon(self) -> None:
        """Stop writing; the caller removes the files."""
        self._track.abandon()


def stream_sidecar(
    note: StreamNote,
    channel: Channel,
    video: Path,
    *,
    headers: Sequence[Header],
    camera_info: CameraInfo | None,
    columns: Columns,
    frames: int,
    digests: Iterable[int],
) -> StreamSidecar:
    """The sidecar of a stream whose video is finished.

    Args:
        note: How it was made.
        channel: Of its messages.
        video: The file.
        headers: Those of its messages.
        camera_info: The calibrations of its camera.
        columns: What differs between messages, one row for each frame.
        frames: How many there are.
        digests: Of the messages, where they come back to the byte.

    Raises:
        OSError: The video cannot be read.
    """
    key = note.key
    return StreamSidecar(
        mp4ds=FORMAT_VERSION,
        kind="stream",
        profile=note.profile,
        frames=frames,
        channel=ChannelModel.from_record(channel),
        wire=key.wire,
        body=key.body,
        image=Image(
            encoding=key.encoding,
            width=key.width,
            height=key.height,
            step=key.step,
            is_bigendian=key.is_bigendian,
        ),
        headers=list(headers),
        video=VideoModel.model_validate({**note.video, **video_facts(video, note.video["codec"])}),
        camera_info=camera_info,
        columns=columns,
        digests=digests_model(digests) if note.exact else None,
    )


def _png_file(recipe: PngRecipe) -> PngFile:
    return PngFile.model_validate({**asdict(recipe), "deflate": zlib_fingerprint()})
