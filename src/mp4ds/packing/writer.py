"""Camera messages into one video and its sidecar, each proven to come back (spec, "Exactness")."""

from __future__ import annotations

import base64
from array import array
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import xxhash

from mp4ds.dataset.rebuild import ColumnsWriter, HeaderTable, digests_model
from mp4ds.errors import OutOfReachError, Refused
from mp4ds.format.fields import FORMAT_VERSION, MAX_FRAMES, exceeds_padding
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
from mp4ds.packing.inspection import CameraMessage
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
        self._track = plan.open(self.video_path, seen, settings, rate)
        self._key = seen.key

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
            if self._plan.exact:
                self._digests.append(xxhash.xxh64_intdigest(message.data))
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
        key, made = self._key, self._track.describe()
        video = {**made, **video_facts(self.video_path, made["codec"])}
        sidecar = StreamSidecar(
            mp4ds=FORMAT_VERSION,
            kind="stream",
            profile=self._plan.profile,
            frames=self.frames,
            channel=ChannelModel.from_record(self.channel),
            wire=key.wire,
            body=key.body,
            image=Image(
                encoding=key.encoding,
                width=key.width,
                height=key.height,
                step=key.step,
                is_bigendian=key.is_bigendian,
            ),
            headers=self._heads.items,
            video=VideoModel.model_validate(video),
            camera_info=self.camera_info,
            columns=self._columns.to_model(),
            digests=digests_model(self._digests) if self._plan.exact else None,
        )
        self.sidecar_path.write_bytes(dump_document(sidecar))
        return sidecar

    def _out_of_reach(self, reason: Refused) -> OutOfReachError:
        stream = (self.channel.id, self._key)
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
        return Header(
            frame_id=seen.parts.frame_id,
            format=fields.format if isinstance(fields, CodedFields) else None,
            template=template,
            framing=wrap.framing,
            prefix=wrap.prefix.hex(),
            png=_png_file(wrap.png) if wrap.png else None,
            padding=padding,
        )

    def abandon(self) -> None:
        """Stop writing; the caller removes the files."""
        self._track.abandon()


def _png_file(recipe: PngRecipe) -> PngFile:
    return PngFile.model_validate({**asdict(recipe), "deflate": zlib_fingerprint()})
