"""Image messages into one video and its sidecar, each proven to come back (spec, "Exactness")."""

from __future__ import annotations

import base64
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xxhash

from mp4ds.errors import OptionError
from mp4ds.layouts import ENCODINGS, LAYOUTS, layout_for, padding_is_zero, pixel_view, why_not
from mp4ds.plan import Quality, visual_setting
from mp4ds.records import Channel, Message
from mp4ds.sidecar import (
    CameraInfo,
    ChannelModel,
    Color,
    Digests,
    Header,
    Image,
    StreamSidecar,
    Video,
    dump_document,
)
from mp4ds.sidecar.models import FORMAT_VERSION, MAX_FRAMES
from mp4ds.stamps import PresentationClock
from mp4ds.streams.columns import ColumnsWriter, Unsuited, Variants
from mp4ds.video import Recipe, VideoEncoder, recipe_for
from mp4ds.video.encoder import EncoderRefusedError
from mp4ds.wire import ImageParts, Wire
from mp4ds.wire.formats import WIRES

_MAX_TAIL = 64
_DIGESTS_PER_LINE = 12


@dataclass(frozen=True, slots=True)
class StreamKey:
    """What the messages of one stream have in common."""

    wire: str
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: int

    @classmethod
    def of(cls, wire: Wire, parts: ImageParts) -> StreamKey:
        """The key of a message."""
        return cls(
            wire.name, parts.encoding, parts.width, parts.height, parts.step, parts.is_bigendian
        )


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """How streams are to be encoded.

    Attributes:
        quality: What was asked for.
        codec: Name of the codec, or None for the default.
        preset: Preset of the encoder, or None for the default.
        gop: Most frames between key frames.
        threads: Threads of each encoder.
    """

    quality: Quality
    codec: str | None
    preset: str | None
    gop: int
    threads: int


def choose_recipe(
    encoding_name: str, settings: StreamSettings, rate: float | None
) -> tuple[str, Recipe, str]:
    """Layout and recipe for an encoding.

    Args:
        encoding_name: ROS image encoding that a layout carries.
        settings: What was asked for.
        rate: Frames per second, where known.

    Returns:
        Name of the layout, recipe, and a note where it is not what was asked for.
    """
    encoding = ENCODINGS[encoding_name]
    quality = settings.quality
    lossless = quality.lossless or encoding.lossy is None
    note = "" if lossless == quality.lossless else f"{encoding_name} is kept lossless"
    layout = layout_for(encoding, lossless=lossless)
    crf, preset = quality.crf, settings.preset
    if quality.name == "visual":
        crf, table_preset = visual_setting(rate)
        if settings.codec in (None, "av1"):
            preset = preset or str(table_preset)
    picture_format = layout.pixel_format if layout.pixel_format != "bayer_" else "rgb24"
    if lossless != quality.lossless:
        preset = None  # it was meant for another encoder
    try:
        recipe = recipe_for(
            picture_format, lossless=lossless, codec=settings.codec, crf=crf, preset=preset
        )
    except OptionError as error:
        recipe = recipe_for(picture_format, lossless=lossless, crf=crf)
        note = "; ".join(filter(None, (note, f"coded as {recipe.codec}: {error}")))
    return layout.name, recipe, note


class StreamWriter:
    """One stream being written: accepts messages in order, then makes its sidecar.

    `accept` decides at once and keeps the columns; the job that it returns does the costly
    work and may run in another thread, in order with the stream's other jobs.

    Args:
        stem: File name of video and sidecar, without ending.
        folder: Where to write them.
        channel: The channel of all messages.
        key: What they have in common.
        settings: How to encode.
        rate: Frames per second, where known.

    Raises:
        Unsuited: The encoder does not take such pictures.
    """

    def __init__(
        self,
        stem: str,
        folder: Path,
        *,
        channel: Channel,
        key: StreamKey,
        settings: StreamSettings,
        rate: float | None,
    ) -> None:
        self.stem = stem
        self.channel = channel
        self.key = key
        self.camera_info: CameraInfo | None = None
        layout_name, self._recipe, self.note = choose_recipe(key.encoding, settings, rate)
        self.profile = "lossless" if self._recipe.lossless else str(settings.quality)
        self._layout = LAYOUTS[layout_name]
        self._encoding = ENCODINGS[key.encoding]
        self._folder = folder
        self._wire = WIRES[key.wire]
        self._columns = ColumnsWriter()
        self._headers: Variants[Header] = Variants()
        self._digests = array("Q")
        self._clock = PresentationClock()
        width, height = self._layout.picture_size(key.width, key.height)
        try:
            self._encoder = VideoEncoder(
                self.video_path,
                self._recipe,
                picture_format=picture_format(self._layout.pixel_format, self._encoding.mosaic),
                width=width,
                height=height,
                gop=settings.gop,
                threads=settings.threads,
                rate=rate,
            )
        except EncoderRefusedError as error:
            self.video_path.unlink(missing_ok=True)
            raise Unsuited(str(error)) from None

    @property
    def frames(self) -> int:
        """Messages accepted so far."""
        return len(self._columns)

    @property
    def video_path(self) -> Path:
        """The video being written."""
        return self._folder / f"{self.stem}.mp4"

    @property
    def sidecar_path(self) -> Path:
        """The sidecar that `finish` writes."""
        return self._folder / f"{self.stem}.yaml"

    def accept(self, message: Message, parts: ImageParts, ordinal: int) -> Callable[[], None]:
        """Take a message whose key is this stream's.

        Args:
            message: The message; its payload must stay as it is until the job has run.
            parts: Its parts.
            ordinal: Its place among the channel's messages.

        Returns:
            The job that encodes it.

        Raises:
            Unsuited: The stream cannot carry it exactly; nothing was changed.
        """
        self._columns.check(message)
        if self.frames == MAX_FRAMES:
            raise Unsuited(f"more than {MAX_FRAMES} messages")
        row_bytes = parts.width * self._encoding.pixel_bytes
        if not padding_is_zero(
            parts.pixels, row_bytes=row_bytes, step=parts.step, height=parts.height
        ):
            raise Unsuited("padding between its rows is not zero")
        stamp, variant = self._prove_head(parts)
        self._columns.append(message, stamp=stamp, seq=parts.seq, variant=variant, ordinal=ordinal)
        tick = self._clock.tick(stamp, message.log_time)
        pixels = pixel_view(
            parts.pixels,
            self._encoding,
            width=parts.width,
            height=parts.height,
            step=parts.step,
            is_bigendian=bool(parts.is_bigendian),
        )

        def encode() -> None:
            if self._recipe.lossless:
                self._digests.append(xxhash.xxh64_intdigest(message.data))
            picture = self._layout.to_picture(pixels)
            if picture.dtype == np.dtype(">u2"):
                picture = picture.astype("<u2")
            self._encoder.write(picture, tick)

        return encode

    def _prove_head(self, parts: ImageParts) -> tuple[int, int]:
        """Stamp and header number, after rebuilding the head from them and comparing."""
        if parts.stamp is None:
            raise Unsuited("its stamp has a second or more in nanoseconds")
        if len(parts.tail) > _MAX_TAIL:
            raise Unsuited(f"{len(parts.tail)} bytes follow its pixels")
        head = bytes(parts.head)
        blank = self._wire.patch_head(head, 0, 0)
        if self._wire.patch_head(blank, parts.stamp, parts.seq) != head:
            raise Unsuited("its header does not rebuild")
        tail = bytes(parts.tail)

        def describe() -> Header:
            plain = self._wire.patch_head(self._wire.image_head(parts), 0, 0)
            template = None if plain == blank else base64.b64encode(blank).decode()
            return Header(frame_id=parts.frame_id, template=template, tail=tail.hex())

        return parts.stamp, self._headers.number(blank + b"|" + tail, describe)

    def finish(self, digest: Callable[[Path], tuple[int, str]]) -> StreamSidecar:
        """Complete the video and write the sidecar; all jobs must have run.

        Args:
            digest: Gives the size and SHA-256 of a file.

        Returns:
            The sidecar.

        Raises:
            OSError: The disk refused.
        """
        self._encoder.close()
        size, sha256 = digest(self.video_path)
        key = self.key
        sidecar = StreamSidecar(
            mp4ds=FORMAT_VERSION,
            kind="stream",
            profile=self.profile,
            frames=self.frames,
            channel=ChannelModel.from_record(self.channel),
            wire=key.wire,
            image=Image(
                encoding=key.encoding,
                width=key.width,
                height=key.height,
                step=key.step,
                is_bigendian=key.is_bigendian,
            ),
            headers=self._headers.items,
            video=Video(
                file=self.video_path.name,
                layout=self._layout.name,
                codec=self._recipe.codec,
                pixel_format=self._recipe.pixel_format,
                width=self._encoder.width,
                height=self._encoder.height,
                color=_color(self._recipe.pixel_format, self._layout.name),
                encoder=self._recipe.encoder,
                options=self._encoder.options,
                size=size,
                sha256=sha256,
            ),
            camera_info=self.camera_info,
            columns=self._columns.to_model(),
            digests=self._digests_model() if self._recipe.lossless else None,
        )
        self.sidecar_path.write_bytes(dump_document(sidecar))
        return sidecar

    def _digests_model(self) -> Digests:
        words = [f"{value:016x}" for value in self._digests]
        lines = (
            " ".join(words[start : start + _DIGESTS_PER_LINE])
            for start in range(0, len(words), _DIGESTS_PER_LINE)
        )
        return Digests(algorithm="xxh64", values="\n".join(lines) + "\n")

    def abandon(self) -> None:
        """Stop writing; the caller removes the files."""
        self._encoder.abandon()


def picture_format(layout_format: str, mosaic: str) -> str:
    """A layout's pixel format, completed with the mosaic's pattern where it is Bayer."""
    return f"bayer_{mosaic}8" if layout_format == "bayer_" else layout_format


def _color(pixel_format: str, layout: str) -> Color | None:
    if layout in ("mosaic8", "gray16"):
        return None  # samples of a sensor, no colours to be shown
    rgb = pixel_format in ("rgb24", "bgr24", "bgr0")
    return Color(
        primaries="bt709", transfer="bt709", matrix="gbr" if rgb else "bt709", range="full"
    )


def refuse_unsuited(parts: ImageParts) -> None:
    """Refuse an image that no layout carries.

    Raises:
        Unsuited: Says why.
    """
    reason = why_not(
        parts.encoding,
        width=parts.width,
        height=parts.height,
        step=parts.step,
        size=parts.size,
    )
    if reason:
        raise Unsuited(reason)
