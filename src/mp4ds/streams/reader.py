"""One stream of a dataset, opened: its frames by number, and its messages again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FormatError
from mp4ds.layouts import Picture, Pixels
from mp4ds.outputs import digest_file
from mp4ds.records import Channel, Message
from mp4ds.sidecar import Calibration, StreamSidecar, load_stream
from mp4ds.streams.bodies import MessageRebuilder
from mp4ds.streams.choices import Choice, everything, unbroken
from mp4ds.streams.decoded import DecodedFrames
from mp4ds.streams.rebuild import CameraInfoRebuilder, DecodedColumns, message_at
from mp4ds.video import FrameReader, PacketReader, VideoDecoder, open_frames


class Stream(DecodedFrames):
    """One camera topic (of one geometry), as a sequence of frames. See `Frames`.

    Args:
        path: The sidecar; the video is beside it.
        jpeg_quality: Of the JPEG files that messages of a transcoded stream get, 1 to 100.
        fast_colour: Of videos with halved chroma give it to frames as it is, several times as
            fast as interpolating it as `mp4ds.unpack` does. Messages are not changed by it.

    Raises:
        FormatError: The sidecar or its video breaks a rule of the format.
    """

    def __init__(self, path: Path, *, jpeg_quality: int = 95, fast_colour: bool = False) -> None:
        super().__init__()
        self.path = path
        self._jpeg_quality = jpeg_quality
        self._fast_colour = fast_colour
        self.sidecar: StreamSidecar = load_stream(path)
        self._reader: FrameReader | None = None

    @property
    def topic(self) -> str:
        """Topic of the images."""
        return self.sidecar.channel.topic

    @cached_property
    def video_path(self) -> Path:
        """The stream's video."""
        return self.path.parent / self.sidecar.video.file

    @cached_property
    def rebuilder(self) -> MessageRebuilder:
        """Makes the stream's messages; checks the columns when first used."""
        try:
            size = self.video_path.stat().st_size
        except OSError as error:
            raise FormatError(
                "file-missing", self.video_path, f"cannot be read: {error.strerror}"
            ) from None
        if self.sidecar.frames > size:  # a coded frame takes a byte at least
            raise FormatError(
                "frame-count", self.path, f"claims {self.sidecar.frames} frames in {size} bytes"
            )
        return MessageRebuilder(self.sidecar, str(self.path), jpeg_quality=self._jpeg_quality)

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, shape (frames,)."""
        return self.rebuilder.columns.stamp

    @property
    def log_times(self) -> NDArray[np.int64]:
        """Log times, nanoseconds, shape (frames,)."""
        return self.rebuilder.columns.log_time

    @property
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded."""
        return self.sidecar.image.encoding

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""
        return self.sidecar.image.width, self.sidecar.image.height

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen."""
        return self.sidecar.camera_info.calibrations if self.sidecar.camera_info else []

    @cached_property
    def _info(self) -> CameraInfoRebuilder | None:
        info = self.sidecar.camera_info
        return CameraInfoRebuilder(info, str(self.path)) if info and info.messages else None

    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that held when a frame was recorded: the last before it, else the first.

        Args:
            index: 0 <= index < frames.
        """
        if not self.calibrations:
            return None
        if self._info is None:
            return self.calibrations[0]
        columns = self._info.columns
        place = np.searchsorted(columns.log_time, self.log_times[index], side="right")
        return self.calibrations[int(columns.variant[max(int(place) - 1, 0)])]

    def open_video(self, *, sequential: bool, fast_colour: bool = False) -> VideoDecoder:
        """A decoder of its own for the stream's pictures.

        Args:
            sequential: Decode with all cores, for reading in order.
            fast_colour: As of the stream; never for what messages are made of.

        Raises:
            VideoError: The video cannot be read, or is not what the sidecar says.
        """
        return VideoDecoder(
            self.video_path, **self._promises, sequential=sequential, fast_colour=fast_colour
        )

    @property
    def _promises(self) -> dict[str, Any]:
        """What the sidecar says of the video, as those that decode it ask for it."""
        video = self.sidecar.video
        return {
            "codec": video.codec,
            "coded_size": (video.width, video.height),
            "frames": self.sidecar.frames,
            "picture_format": self.rebuilder.picture_format,
            "picture_size": self.rebuilder.picture_size,
            "matrix": video.matrix,
            "full_range": video.full_range,
        }

    def __len__(self) -> int:
        return self.sidecar.frames

    def pictures_of(self, indices: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """See `DecodedFrames.pictures_of`."""
        if not len(indices):
            return iter(())
        if self._reader is None:
            self._reader = self._open_reader()
        return self._reader.pictures_of(indices)

    def _pictures_apart(self, runs: Iterable[Sequence[int]]) -> Iterator[tuple[int, Picture]]:
        with self._open_reader() as reader:
            for run in runs:
                yield from reader.pictures_of(run)

    def _open_reader(self) -> FrameReader:
        return open_frames(
            self.video_path,
            **self._promises,
            fast_colour=self._fast_colour,
            references=self.sidecar.video.references,
        )

    def _pictures(self) -> Iterator[Picture]:
        with self.open_video(sequential=True, fast_colour=self._fast_colour) as decoder:
            yield from decoder.pictures()

    def _write_pixels(self, picture: Picture, out: Pixels) -> None:
        self.rebuilder.write_pixels(picture, out)

    def _frame_id(self, index: int) -> str:
        return self.sidecar.headers[int(self.rebuilder.columns.variant[index])].frame_id

    def messages(
        self, channel: Channel, choice: Choice = everything
    ) -> Iterator[tuple[int, Message]]:
        """The image messages, each with its place among the channel's messages.

        Args:
            channel: The channel to make them on.
            choice: Which are wanted; see `numbered_makers`. The video is compared with its
                SHA-256 only where all are.

        Raises:
            FormatError: A frame does not decode, or a message does not match its digest.
        """
        columns = self.rebuilder.columns
        if self.sidecar.digests is None and choice is everything:
            self.verify_video()
        for index, make in self.numbered_makers(choice):
            yield int(columns.ordinal[index]), message_at(columns, index, channel, make())

    def payloads(self, choice: Choice = everything) -> Iterator[bytes | bytearray]:
        """The payloads of messages, in order; see `messages`."""
        return (make() for make in self.makers(choice))

    def makers(self, choice: Choice = everything) -> Iterator[Callable[[], bytes | bytearray]]:
        """As `numbered_makers`, without the numbers."""
        return (make for _, make in self.numbered_makers(choice))

    def numbered_makers(
        self, choice: Choice = everything
    ) -> Iterator[tuple[int, Callable[[], bytes | bytearray]]]:
        """For each message its number, and what makes its payload before the next one is taken.

        Args:
            choice: Which are wanted. Packets of a video that refer to others are of no use
                without them: those between two that are wanted come, too.

        Raises:
            FormatError: A frame cannot be read; the makers raise what else is wrong with one.
        """
        rebuilder = self.rebuilder
        if self.sidecar.body == "packet":
            video = self.sidecar.video
            with PacketReader(
                self.video_path,
                codec=video.codec,
                frames=self.sidecar.frames,
                coded_size=(video.width, video.height),
            ) as reader:
                for index in unbroken(choice(rebuilder.columns), reader.key_numbers):
                    yield index, partial(rebuilder.packet_payload, index, reader.packet(index))
            return
        with self.open_video(sequential=True) as decoder:
            for index, picture in self.pictures_in_order(decoder, choice):
                yield index, partial(rebuilder.payload, index, picture)

    def pictures_in_order(
        self, decoder: VideoDecoder, choice: Choice = everything
    ) -> Iterator[tuple[int, Picture]]:
        """Pictures that are wanted, each with its number.

        Args:
            decoder: Of `open_video`.
            choice: Which are wanted. Where all are, the video must not go on after them.

        Yields:
            Views that hold until the next one is asked for.

        Raises:
            VideoError: See `VideoDecoder.pictures`.
        """
        if choice is everything:
            yield from enumerate(decoder.pictures())
        else:
            yield from decoder.pictures_at(choice(self.rebuilder.columns))

    def verify_video(self) -> None:
        """Compare the video with its SHA-256, for where no digest of a message tells damage.

        Raises:
            FormatError: ``file-missing`` or ``hash-mismatch``.
        """
        video = self.sidecar.video
        if not self.video_path.is_file():
            raise FormatError("file-missing", self.video_path, "does not exist")
        if video.sha256 is not None and digest_file(self.video_path)[1] != video.sha256:
            raise FormatError(
                "hash-mismatch",
                self.video_path,
                "does not have the SHA-256 that its sidecar says",
            )

    @property
    def camera_info_columns(self) -> DecodedColumns | None:
        """The columns of the CameraInfo messages, if there are any."""
        return self._info.columns if self._info else None

    def camera_info_messages(
        self, channel: Channel, choice: Choice = everything
    ) -> Iterator[tuple[int, Message]]:
        """The CameraInfo messages, each with its place among the channel's messages.

        Args:
            channel: The channel to make them on.
            choice: Which are wanted.
        """
        if self._info is None:
            return iter(())
        return self._info.messages(channel, choice(self._info.columns))

    def close(self) -> None:
        """Close the video, if it is open."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
