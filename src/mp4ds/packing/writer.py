"""Camera messages into one video and its sidecar, each proven to come back (spec, "Exactness")."""

from __future__ import annotations

import base64
from array import array
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import xxhash

from mp4ds.dataset.columns import columns_model, digests_model
from mp4ds.errors import Refused
from mp4ds.format.fields import FORMAT_VERSION, MAX_FRAMES, MAX_VARIANTS, Columns, exceeds_padding
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
from mp4ds.messages.wire import CodedFields, Form, Parts, Template, WireError, prove
from mp4ds.packing.inspection import CameraMessage, StreamKey
from mp4ds.packing.tracks import TrackPlan, open_track
from mp4ds.records import Channel, Message
from mp4ds.times import INT64_MAX, INT64_MIN, PresentationClock

_ModelT = TypeVar("_ModelT")


class OutOfReach(Exception):  # noqa: N818 - no failure: packing starts anew without that score
    """A stream that was started cannot reach the requested score.

    Args:
        stream: Identifies it among the streams of a pack.
        reason: What was tried.
    """

    def __init__(self, stream: tuple[int, StreamKey], reason: str) -> None:
        super().__init__(stream, reason)
        self.stream, self.reason = stream, reason


class ColumnsWriter:
    """The growing columns of one stream or of its camera_info."""

    def __init__(self) -> None:
        self._columns = {name: array("q") for name in Columns.model_fields}

    def __len__(self) -> int:
        return len(self._columns["log_time"])

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
        values = {
            "log_time": message.log_time,
            "publish_time": message.publish_time,
            "sequence": message.sequence,
            "stamp": parts.stamp,
            "seq": parts.seq,
            "pts": parts.pts,
            "variant": variant,
            "ordinal": ordinal,
        }
        for name, value in values.items():
            if value is not None:
                self._columns[name].append(value)

    def to_model(self) -> Columns:
        """The columns as the sidecar holds them."""
        found = self._columns.items()
        return columns_model({name: np.frombuffer(own, np.int64) for name, own in found if own})


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
        threads: Of an encoder.
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
        threads: int,
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
        self._track = open_track(plan, self.video_path, seen, threads, rate)
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
            if self._plan.is_exact:
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
            OutOfReach: The video cannot have the score that was asked for.
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
            digests=digests_model(self._digests) if self._plan.is_exact else None,
        )
        self.sidecar_path.write_bytes(dump_document(sidecar))
        return sidecar

    def _out_of_reach(self, reason: Refused) -> OutOfReach:
        return OutOfReach((self.channel.id, self._key), str(reason))

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
