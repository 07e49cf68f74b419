"""What a stream's video is made from: pictures encoded here, or copied packets.

Pictures of a stream with a view are the differences of its images to what the view shows.
"""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds.errors import EncoderRefusedError, Refused
from mp4ds.format.fields import Quality as Measured
from mp4ds.format.models import Color
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels, Prediction, native
from mp4ds.messages.layouts import layout_for
from mp4ds.packing.inspection import CameraMessage
from mp4ds.packing.windows import CrfControl, Scores, WindowCoder
from mp4ds.video.codecs import (
    LOSSLESS,
    QualityTarget,
)
from mp4ds.video.decoder import PacketPictures
from mp4ds.video.encoder import Coding, VideoEncoder, predictor
from mp4ds.video.packets import PacketWriter, join_segments
from mp4ds.video.pixels import PlaneSpool

_GREY = 128
_VIEW_THREADS = 2
"""Most threads of a view's encoder beside that of the images, which takes more time than it: with
eight, SVT-AV1 takes two and a half times the memory of two."""


@dataclass(frozen=True, slots=True)
class TrackPlan:
    """How a stream's video is made.

    Attributes:
        coding: How its pictures are encoded; None to copy packets.
        view: How those of a view are; None without a view.
        is_predicted: Whether the pictures are of the differences to the images of the view.
        profile: The profile in its sidecar.
        target: The score that its pictures have to reach, if there is one.
        note: What the user should know about it; empty if nothing.
    """

    coding: Coding | None = None
    view: Coding | None = None
    is_predicted: bool = False
    profile: str = LOSSLESS
    target: QualityTarget | None = None
    note: str = ""

    @property
    def is_exact(self) -> bool:
        """Whether messages are restored byte for byte."""
        return self.profile == LOSSLESS

    @property
    def text(self) -> str:
        """All that decides about the video, in words."""
        own = self.coding.text if self.coding else "copied"
        told = f"{own}, view {self.view.text}" if self.view else own
        return f"{told}, differences" if self.is_predicted else told


class Track(ABC):
    """A video being written.

    Attributes:
        view: The track of the view, where there is one; written with this one.
    """

    view: Track | None = None

    @abstractmethod
    def prove(self, seen: CameraMessage) -> CameraMessage:
        """Prove that the track can carry a message exactly.

        Returns:
            The message for `write`.

        Raises:
            Refused: It cannot.
        """

    @abstractmethod
    def write(self, seen: CameraMessage, tick: int) -> None:
        """Write a message's frame.

        Args:
            seen: The message, as `prove` gave it.
            tick: Presentation time in ticks, greater than the last.

        Raises:
            Refused: The video cannot reach the requested score.
            OSError: It cannot be written.
        """

    @abstractmethod
    def close(self) -> None:
        """Finish the file.

        Raises:
            Refused: The video cannot reach the requested score.
            OSError: It cannot be written.
        """

    @abstractmethod
    def abandon(self) -> None:
        """Close the file as it is; the caller removes it."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """The fields of `mp4ds.format.models.Video`, except for the file."""


def open_track(
    plan: TrackPlan,
    path: Path,
    view_path: Path,
    seen: CameraMessage,
    threads: int,
    rate: float | None,
) -> Track:
    """Begin a video.

    Args:
        plan: How to make it.
        path: The file.
        view_path: That of the view, if there is one.
        seen: The first message.
        threads: Of an encoder.
        rate: Frames per second, where known.

    Raises:
        Refused: The encoder does not support such pictures.
    """
    size = seen.key.width, seen.key.height
    if plan.coding is None:
        own: Track = _CopiedTrack(path, seen, rate)
    elif plan.target is None:
        own = _EncodedTrack(path, plan.coding, size, threads, rate)
    else:
        own = _ScoredTrack(path, WindowCoder(plan.coding, size, plan.target, threads, rate))
    if plan.view is None:
        return own
    few = threads if plan.coding is None else min(threads, _VIEW_THREADS)
    open_view = partial(_EncodedTrack, view_path, plan.view, size, few, rate)
    try:
        if plan.coding is None:
            return _PacketsTrack(own, open_view, seen)
        if plan.is_predicted and isinstance(own, _EncodedTrack):
            return _DifferencesTrack(own, open_view, size)
        return _ViewedTrack(own, open_view)
    except BaseException:
        own.abandon()
        path.unlink(missing_ok=True)
        raise


# ---------------------------------------------------------------- copied


class _CopiedTrack(Track):
    def __init__(self, path: Path, seen: CameraMessage, rate: float | None) -> None:
        self._key = seen.key
        self._begun = False
        self._writer = PacketWriter(
            path,
            seen.key.codec,
            width=seen.key.width,
            height=seen.key.height,
            parameters=seen.parameters,
            rate=rate,
        )

    def prove(self, seen: CameraMessage) -> CameraMessage:
        if not self._begun:
            self._writer.begin(seen.parts.body)
            self._begun = True
        return seen

    def write(self, seen: CameraMessage, tick: int) -> None:
        self._writer.write(seen.parts.body, tick, keyframe=seen.keyframe)

    def close(self) -> None:
        self._writer.close()

    def abandon(self) -> None:
        self._writer.abandon()

    def describe(self) -> dict[str, Any]:
        key = self._key
        return {
            "layout": layout_for(ENCODINGS[key.encoding], lossless=False).name,
            "codec": key.codec,
            "width": key.width,
            "height": key.height,
        }


# ---------------------------------------------------------------- encoded


class _PictureTrack(Track):
    """A track of pictures that are encoded here.

    Attributes:
        coding: How.
        size: Columns and rows of the coded pictures.
        options: Of the encoder.
    """

    coding: Coding
    size: tuple[int, int]
    options: Mapping[str, str]

    def prove(self, seen: CameraMessage) -> CameraMessage:
        if seen.pixels is None:
            raise Refused("it has no pixels")
        return replace(seen, source=self.coding.layout.values.prove(seen.pixels))

    def describe(self) -> dict[str, Any]:
        layout, recipe = self.coding.layout, self.coding.recipe
        color = Color(
            primaries="bt709",
            transfer="bt709",
            matrix=recipe.matrix,
            range="full" if recipe.full_range else "limited",
        )
        return {
            "layout": layout.name,
            "parameters": layout.parameters if layout.parameters.values else None,
            "codec": recipe.codec,
            "pixel_format": recipe.pixel_format,
            "width": self.size[0],
            "height": self.size[1],
            "color": color if layout.is_shown else None,
            "encoder": recipe.encoder,
            "options": dict(self.options),
        }


class _EncodedTrack(_PictureTrack):
    def __init__(
        self,
        path: Path,
        coding: Coding,
        size: tuple[int, int],
        threads: int,
        rate: float | None,
        coded: Callable[[bytes], None] | None = None,
    ) -> None:
        layout = coding.layout
        width, height = layout.picture_size(*size)
        try:
            self._encoder = VideoEncoder(
                path,
                coding.recipe,
                picture_format=layout.pixel_format,
                width=width,
                height=height,
                gop=coding.gop,
                threads=threads,
                rate=rate,
                coded=coded,
            )
        except EncoderRefusedError as error:
            path.unlink(missing_ok=True)
            raise Refused(str(error)) from None
        self.coding = coding
        self.size = self._encoder.width, self._encoder.height
        self.options = self._encoder.options

    def write(self, seen: CameraMessage, tick: int) -> None:
        if seen.source is not None:
            self.encode(seen.source, tick)
        elif seen.pixels is not None:
            self.encode(seen.pixels, tick)

    def encode(self, pixels: Pixels, tick: int, prediction: Prediction | None = None) -> None:
        """Encode an image, given by its source if the layout has that; or its difference."""
        layout = self.coding.layout
        make = layout.arrange if layout.is_source else layout.to_picture
        self._encoder.write(make(pixels, prediction), tick)

    @property
    def configuration(self) -> bytes:
        """What a decoder needs besides the packets."""
        return self._encoder.configuration

    def close(self) -> None:
        self._encoder.close()

    def abandon(self) -> None:
        self._encoder.abandon()


class _ViewedTrack(Track):
    """A track, and a view beside it.

    Args:
        own: The track.
        open_view: Opens the view.
    """

    view: _EncodedTrack

    def __init__(self, own: Track, open_view: Callable[..., _EncodedTrack]) -> None:
        self._own = own
        self.view = open_view()

    def prove(self, seen: CameraMessage) -> CameraMessage:
        self.view.prove(seen)
        return self._own.prove(seen)

    def write(self, seen: CameraMessage, tick: int) -> None:
        self._own.write(seen, tick)
        if seen.pixels is not None:
            self.view.encode(seen.pixels, tick)

    def close(self) -> None:
        self.view.close()
        self._own.close()

    def abandon(self) -> None:
        self.view.abandon()
        self._own.abandon()

    def describe(self) -> dict[str, Any]:
        return self._own.describe()


class _DifferencesTrack(_ViewedTrack):
    """A view, and the differences of the images to those that it shows.

    Images wait for their view: an encoder may look ahead with as many, and holds them too.
    """

    _own: _EncodedTrack

    def __init__(
        self, own: _EncodedTrack, open_view: Callable[..., _EncodedTrack], size: tuple[int, int]
    ) -> None:
        super().__init__(own, partial(open_view, coded=self._follow))
        self._bits = self.view.coding.layout.used_bits
        self._predicted = predictor(self.view.coding, size, self.view.configuration)
        self._waiting: deque[tuple[Pixels, int]] = deque()

    def prove(self, seen: CameraMessage) -> CameraMessage:
        self.view.prove(seen)
        # others can hold every difference
        return self._own.prove(seen) if self._own.coding.layout.is_source else seen

    def write(self, seen: CameraMessage, tick: int) -> None:
        if seen.pixels is None:
            return
        pixels = native(seen.pixels)
        # the message may be gone when its turn comes
        self._waiting.append((pixels.copy() if seen.source is None else seen.source, tick))
        self.view.encode(pixels, tick)

    def _follow(self, packet: bytes | None) -> None:
        for prediction in self._predicted(packet):
            pixels, tick = self._waiting.popleft()
            self._own.encode(pixels, tick, (prediction, self._bits))

    def close(self) -> None:
        try:
            self.view.close()
            self._follow(None)
        except BaseException:
            self._own.abandon()
            raise
        self._own.close()
        if self._waiting:
            raise RuntimeError(f"{len(self._waiting)} frames of {self.view} were not decoded")

    def describe(self) -> dict[str, Any]:
        return {**self._own.describe(), "color": None}


class _PacketsTrack(_ViewedTrack):
    """Packets as they came, and a view of what they show.

    Each has a frame there. One that cannot be decoded is shown as the picture before it, or grey.
    """

    def __init__(
        self, own: Track, open_view: Callable[..., _EncodedTrack], seen: CameraMessage
    ) -> None:
        super().__init__(own, open_view)
        key, layout = seen.key, self.view.coding.layout
        size, encoding = (key.width, key.height), layout.encoding
        self._pictures = PacketPictures[int](key.codec, layout.pixel_format, size)
        self._shown: Pixels = np.full(encoding.shape(*size), _GREY, encoding.dtype)

    def prove(self, seen: CameraMessage) -> CameraMessage:
        return self._own.prove(seen)

    def write(self, seen: CameraMessage, tick: int) -> None:
        self._own.write(seen, tick)
        parameters = seen.parameters if seen.keyframe else b""
        self._show(self._pictures.of(tick, seen.parts.body, parameters))

    def _show(self, pictures: Iterator[tuple[int, Picture | None]]) -> None:
        for tick, picture in pictures:
            if picture is not None:
                (self._shown,) = picture
            self.view.encode(self._shown, tick)

    def close(self) -> None:
        self._show(self._pictures.rest())
        super().close()


# ---------------------------------------------------------------- aimed at a score


class _ScoredTrack(_PictureTrack):
    """The videos of its windows are joined at the end."""

    def __init__(self, path: Path, coder: WindowCoder) -> None:
        self._path = path
        self._coder = coder
        self.coding, self.size = coder.coding, coder.coded_size
        self.options = {**coder.coding.recipe.options, "g": str(coder.coding.gop)}
        self._control = CrfControl(coder.coding, coder.target)
        self._folder = path.with_name(f".{path.stem}.windows")
        self._folder.mkdir()
        self._spool = PlaneSpool(self._folder / "frames.yuv", *coder.coded_size)
        self._ticks = array("q")
        self._segments: list[Path] = []
        self._scores: list[Scores] = []
        self._reencoded = self._limited = 0

    def write(self, seen: CameraMessage, tick: int) -> None:
        self._coder.keep(seen, self._spool)
        self._ticks.append(tick)
        if len(self._spool) == self._coder.frames:
            self._finish_window()

    def _finish_window(self) -> None:
        """Encode the window until it is good enough.

        Raises:
            Refused: No crf is good enough.
        """
        coder, control, frames = self._coder, self._control, len(self._spool)
        number = len(self._segments)

        def place(crf: int) -> Path:
            return self._folder / f"{number:06}-{crf}.mp4"

        scores = coder.tries(control, self._spool, self._ticks[-frames:], place)
        kept = control.accepted
        if kept is None:
            first, last = len(self._ticks) - frames, len(self._ticks) - 1
            made = f"crf {min(scores)} gives frames {first} to {last} of a part "
            raise coder.out_of_reach(control, made)
        control.keep(kept)
        for crf in scores.keys() - {kept}:
            place(crf).unlink()
        self._segments.append(place(kept))
        self._scores.append(scores[kept])
        self._reencoded += len(scores) > 1
        self._limited += control.due < coder.target.score
        self._spool.clear()

    def close(self) -> None:
        try:
            if len(self._spool):
                self._finish_window()
            join_segments(self._segments, self._ticks, self._path)
        finally:
            self.abandon()

    def abandon(self) -> None:
        self._spool.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def describe(self) -> dict[str, Any]:
        quality = Measured.from_scores(
            self._coder.target,
            np.concatenate(self._scores),
            worst_window=min(map(self._coder.mean, self._scores)),
            windows=len(self._scores),
            reencoded=self._reencoded,
            limited=self._limited,
        )
        return {**super().describe(), "quality": quality}
