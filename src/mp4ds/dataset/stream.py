"""An open stream of a dataset: its images, and its messages."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from functools import cached_property
from itertools import tee
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.images import Images, NumberedPictures, PredictedFrames
from mp4ds.dataset.rebuild import CalibrationMessages, MessageRebuilder, message_at
from mp4ds.errors import FormatError, OptionError, VideoError
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import Choice, DecodedColumns, decode_columns, everything, unbroken
from mp4ds.format.models import Calibration, StreamSidecar, VideoModel
from mp4ds.format.sidecars import load_stream
from mp4ds.messages import depth
from mp4ds.messages.encodings import Picture, Pixels
from mp4ds.messages.layouts import Layout
from mp4ds.records import Channel, Message
from mp4ds.video.access import FrameReader
from mp4ds.video.codecs import LOSSLESS
from mp4ds.video.decoder import VideoDecoder
from mp4ds.video.media import Media
from mp4ds.video.packets import PacketReader
from mp4ds.video.pixels import PictureMaker, Scale

Layer = Literal["exact", "view"]
"""Which frames are read of a stream that has a view: those recorded, or those that it shows."""


def open_stream(path: Path, layer: Layer | None = None) -> Stream:
    """A `Stream` in a layer; what may be depths is exact in both: a view has 256 levels of it."""
    stream = Stream(path, layer=layer)
    keeps = stream.encoding in depth.DEPTHS and stream.absent is None
    return stream.in_layer("exact") if keeps else stream


class Stream(Images):
    """A video with its sidecar: images of one size and encoding, and their messages.

    Of a stream with a view, one of two layers is read. The view alone is a stream as any other of
    less quality; the exact images are made of both videos.

    Attributes:
        sidecar: The contents of its sidecar, or what it says of the view.
        exact_path: The video that makes the images exact, where there is a view; else None.
        layer: Which frames are read: exact ones as well, where there is no view.
        videos: Its video, and the view that predicts it if there is one.
        sound: Which frames are read of a damaged video: those that `damages` does not name, shape
            (frames,). None: all, and damage is an error.
        jpeg_quality: Quality of the JPEG files in messages of a transcoded stream, 1 to 100.

    Args:
        path: The sidecar; the video is next to it.
        sidecar: Its contents, if already read.
        layer: Which frames to read; None: the exact ones if they are here, else the view.

    Raises:
        FormatError: The sidecar or its video breaks a rule of the format.
    """

    channel: Channel
    jpeg_quality = 95

    def __init__(
        self, path: Path, *, sidecar: StreamSidecar | None = None, layer: Layer | None = None
    ) -> None:
        self.path = path
        self.sound: NDArray[np.bool_] | None = None
        self._whole = whole = sidecar or load_stream(path)
        self.exact_path = path.parent / whole.video.file if whole.view else None
        if self.exact_path and layer is None:
            layer = "exact" if self.exact_path.exists() else "view"
        self.layer: Layer = layer if self.exact_path and layer else "exact"
        self.sidecar = whole.seen if self.layer == "view" else whole
        self.channel = self.sidecar.channel.to_record(0)
        self.topic = self.channel.topic
        self.videos = [(path.parent / video.file, video) for video in self.sidecar.videos]
        if self.exact_path and self.sidecar is whole:  # what a store said of it is kept
            self.videos[0] = self.exact_path, whole.video
        self.video_path = self.videos[0][0]
        image = self.sidecar.image
        self.encoding, self.image_size = image.encoding, (image.width, image.height)
        self.file_suffix = "png" if self.sidecar.body == "png" else ""
        if self.sidecar.body == "packet" and self.sidecar.video.codec == "mjpeg":
            self.file_suffix = "jpg"
        self.is_lossy = self.sidecar.profile != LOSSLESS
        self.shows_colours = self.sidecar.shows_colours and not self.sidecar.is_predicted

    @property
    def topics(self) -> list[str]:
        """Topic of the images, and that of the calibrations if there are any."""
        return [self.topic, *([self.infos.channel.topic] if self.infos else [])]

    @property
    def absent(self) -> VideoModel | None:
        """The video that makes its images exact, if it is missing; all else can be read."""
        is_absent = self.exact_path and self.layer == "view" and not self.exact_path.exists()
        return self._whole.video if is_absent else None

    @property
    def layers(self) -> list[Stream]:
        """The stream, and that of its view if it has one and is not that."""
        other = self.in_layer("view")
        return [self] if other is self else [self, other]

    def in_layer(self, layer: Layer) -> Stream:
        """The stream of a layer; itself if it has only one.

        Raises:
            OptionError: It is not here.
        """
        if layer == self.layer or self.exact_path is None:
            return self
        if layer == "exact" and not self.exact_path.exists():
            raise self._no_exact()
        other = Stream(self.path, sidecar=self._whole, layer=layer)
        other.jpeg_quality = self.jpeg_quality
        if layer == "view":  # of a damaged one, exact frames are lost as well
            other.sound = self.sound
        return other

    @cached_property
    def _view(self) -> Stream | None:
        """What predicts its images; None if nothing does."""
        return self.in_layer("view") if self.sidecar.is_predicted else None

    @cached_property
    def _size(self) -> int:
        """Bytes of the video.

        Raises:
            OptionError: It has the exact frames, and is not here.
            FormatError: It is missing.
        """
        try:
            return self.video_path.stat().st_size
        except OSError as error:
            if self.video_path == self.exact_path and not self.exact_path.exists():
                raise self._no_exact() from None
            problem = f"cannot be read: {error.strerror}"
            if self.layer == "view" and self._whole.is_predicted:
                problem += f"; {self._whole.video.file} only has differences to it: copy it back"
            raise FormatError("file-missing", self.video_path, problem) from None

    def _no_exact(self) -> OptionError:
        return OptionError(
            f"{self.topic} has no exact frames here: {self._whole.video.file} is missing. Copy it "
            f"to {self.path.parent}, or read the layer 'view'."
        )

    def _check_size(self) -> None:
        """Refuse a video that is another one: its frames would be taken for those recorded.

        Raises:
            FormatError: ``size-mismatch``.
        """
        due = self.sidecar.video.size
        if due is not None and self._size != due:
            problem = (
                f"has {self._size} bytes, but its sidecar says {due}: it was cut short or replaced"
            )
            raise FormatError("size-mismatch", self.video_path, problem)

    @cached_property
    def columns(self) -> DecodedColumns:
        """One value per frame: its times, and what fills its message; checked on first use.

        Raises:
            FormatError: ``column-invalid``; or the video is missing, or too short for so many.
        """
        size = self._size
        if self.sidecar.frames > size:  # a coded frame takes at least a byte
            raise FormatError(
                "frame-count", self.path, f"declares {self.sidecar.frames} frames in {size} bytes"
            )
        count, variants = self.sidecar.frames, len(self.sidecar.headers)
        return decode_columns(self.sidecar.columns, count, variants, str(self.path))

    @cached_property
    def infos(self) -> CalibrationMessages | None:
        """Its CameraInfo messages, if there are any."""
        info = self.sidecar.camera_info
        return CalibrationMessages(info, str(self.path)) if info and info.messages else None

    @cached_property
    def layout(self) -> Layout:
        """How the video's pictures hold the images."""
        return self.sidecar.layout

    @cached_property
    def rebuilder(self) -> MessageRebuilder:
        """Makes the stream's messages."""
        return MessageRebuilder(
            self.sidecar,
            self.columns,
            str(self.path),
            self.write_pixels,
            jpeg_quality=self.jpeg_quality,
        )

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen."""
        return self.sidecar.camera_info.calibrations if self.sidecar.camera_info else []

    def calibration_at(self, log_time: int) -> Calibration | None:
        """The calibration that applied at a log time: the last one before it, else the first."""
        if not self.calibrations:
            return None
        if self.infos is None:
            return self.calibrations[0]
        columns = self.infos.columns
        place = np.searchsorted(columns.log_time, log_time, side="right")
        return self.calibrations[int(columns.variant[max(int(place) - 1, 0)])]

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return self.sidecar.headers[int(self.columns.variant[index])].frame_id

    def __len__(self) -> int:
        return self.sidecar.frames

    # ------------------------------------------------------------ pictures

    def open_video(self, *, sequential: bool) -> VideoDecoder:
        """A separate decoder for the stream's pictures.

        Args:
            sequential: Decode with all cores, for reading in order.

        Raises:
            VideoError: The video cannot be read, or does not match the sidecar.
        """
        is_sound = self.sound is None
        return VideoDecoder(self.video_path, **self._expected(), sequential=sequential and is_sound)

    def _expected(self) -> dict[str, Any]:
        """What a decoder may expect of the video, by the sidecar; a maker serves one decoder."""
        _ = self.columns  # which checks that the video is there, and long enough
        image, video = self.sidecar.image, self.sidecar.video
        maker = PictureMaker(
            self.video_path,
            coded_size=(video.width, video.height),
            picture_format=self.layout.pixel_format,
            picture_size=self.layout.picture_size(image.width, image.height),
            matrix=video.matrix,
            full_range=video.full_range,
            is_view=self.layer == "view",
        )
        return {"codec": video.codec, "frames": self.sidecar.frames, "maker": maker}

    def open_reader(self) -> FrameReader | PredictedFrames:
        """A separate decoder for frames by number."""
        self._check_size()
        recorded = self.sidecar.video.references
        references = recorded.decode if recorded else None
        reader = FrameReader(self.video_path, **self._expected(), references=references)
        if self._view is None:
            return reader
        with ExitStack() as failed:
            failed.callback(reader.close)
            shown = self._view.open_reader()
            failed.pop_all()
        return PredictedFrames(reader, shown, self.predicted)

    def write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture, as recorded."""
        if self._view is None:
            self.layout.to_pixels(picture, out)
            return
        *differences, prediction = picture
        bits = self._view.layout.used_bits
        self.layout.to_pixels(tuple(differences), out, (prediction, bits))

    def predicted(self, pictures: NumberedPictures, shown: NumberedPictures) -> NumberedPictures:
        """Pictures of the video, to each of which the view's pixels are added as the last array.

        Args:
            pictures: Of the video, each with its number.
            shown: The same of the view.
        """
        view = self._view or self
        prediction: Pixels | None = None  # one for all: pictures are valid until the next
        for (there, seen), (index, picture) in zip(shown, pictures, strict=True):
            if there != index:  # reading a frame does not compare its digest
                what = f"gives frame {there} where {index} is due"
                raise VideoError("decode-failed", view.video_path, what, frame=index)
            if seen is None or picture is None:
                yield index, None
                continue
            if prediction is None:
                prediction = view.recorded_pixels(seen)
            else:
                view.write_pixels(seen, prediction)
            yield index, (*picture, prediction)

    def depth_header(self, index: int) -> bytes:
        """What gives the quantised depths of a frame in metres; empty for all others.

        Raises:
            OptionError: It is not in the sidecar.
        """
        header = self.sidecar.headers[int(self.columns.variant[index])]
        prefix = bytes.fromhex(header.prefix)
        if not depth.is_quantised(header.format, prefix):
            return b""
        if len(prefix) != depth.HEADER_BYTES:
            raise OptionError(
                f"frame {index} of {self.topic} holds quantised depths without their parameters: "
                "only format='native' is available"
            )
        return prefix

    def pictures(
        self, choice: Choice = everything, scale: Scale | None = None, *, is_strict: bool = True
    ) -> Iterator[tuple[int, Picture]]:
        """The wanted pictures in order, each with its number, from a separate decoder.

        Args:
            choice: Which are wanted.
            scale: See `PictureMaker.make`.
            is_strict: Whether a packet that cannot be decoded is an error, and not left out.

        Yields:
            Views that are valid until the next one is requested.

        Raises:
            VideoError: See `VideoDecoder.pictures_at`.
        """
        is_strict = is_strict or not self.sidecar.keeps_packets
        for index, picture in self.decodable_pictures(choice, scale, is_strict=is_strict):
            if picture is not None:
                yield index, picture

    def decodable_pictures(
        self, choice: Choice = everything, scale: Scale | None = None, *, is_strict: bool
    ) -> NumberedPictures:
        """As `pictures`; those that cannot be decoded may be None.

        Args:
            choice: Which are wanted; may be asked twice.
            scale: See `PictureMaker.make`.
            is_strict: Whether a picture that cannot be decoded is an error, and not None. What was
                recorded as packets may have some without any damage to the video: they refer to
                packets that were lost before they were recorded.
        """
        if is_strict and self.sound is None:
            self._check_size()
        with self.naming_frames():
            if self._view is None:
                yield from self._decoded(choice, scale, is_strict=is_strict)
                return
            self._view.sound = self.sound
            own = its = choice
            if is_strict:  # nothing is asked twice then, and what is late by now differs
                wanted, again = tee(choice(self.columns))
                own, its = lambda _: wanted, lambda _: again
            # in no variables: Python 3.10 leaves this frame in a cycle with what ends it,
            # and both decoders open until the next collection of garbage
            yield from self.predicted(
                self._decoded(own, None, is_strict=is_strict),
                self._view.decodable_pictures(its, is_strict=is_strict),
            )

    def _decoded(self, choice: Choice, scale: Scale | None, *, is_strict: bool) -> NumberedPictures:
        """The pictures of the video; see `pictures`."""
        done = -1
        if self.sound is None:
            try:
                with self.open_video(sequential=True) as decoder:
                    for index, picture in decoder.pictures_at(choice(self.columns), scale):
                        yield index, picture
                        done = index
                return
            except VideoError as error:
                if is_strict or error.frame is None:
                    raise
        # from there on on one core; see the decoder
        with self.open_video(sequential=False) as decoder:
            rest = (index for index in self.sound_of(choice(self.columns)) if index > done)
            for index, found in decoder.decodable_pictures(rest, scale):
                if found is None and is_strict:
                    raise self._undecodable(index)
                yield index, found

    def _undecodable(self, index: int) -> VideoError:
        return VideoError("decode-failed", self.video_path, "cannot be decoded", frame=index)

    # ------------------------------------------------------------ messages

    def messages(
        self, channel: Channel, choice: Choice = everything
    ) -> Iterator[tuple[int, Message]]:
        """The image messages, each with its ordinal.

        Args:
            channel: The channel to make them on.
            choice: Which are wanted; see `payloads`. The video is checked against its SHA-256 only
                if all are.

        Raises:
            FormatError: A frame cannot be decoded, or a message does not match its digest.
        """
        columns = self.columns
        if self.sidecar.digests is None and choice is everything:
            self.verify_video()
        for index, payload in self.payloads(choice):
            yield int(columns.ordinal[index]), message_at(columns, index, channel, payload)

    def payloads(self, choice: Choice = everything) -> Iterator[tuple[int, bytes | bytearray]]:
        """Number and payload of each message.

        Args:
            choice: Which are wanted. Packets that others refer to are included between two wanted
                ones.

        Raises:
            FormatError: A frame cannot be read, or a message does not match its digest.
        """
        rebuilder = self.rebuilder
        if self.sidecar.replaces_packets:
            raise OptionError(
                f"The packets of {self.topic} are not here, only a view in another codec. Unpack "
                "it with `quality` visual, or with `images` raw, jpeg or compressed-video."
            )
        if self.sidecar.keeps_packets:
            with self.naming_frames(), self.open_packets() as reader:
                for index in self.sound_of(unbroken(choice(self.columns), reader.key_numbers)):
                    yield index, rebuilder.packet_payload(index, reader.packet(index))
            return
        with self.naming_frames():
            for index, picture in self.pictures(choice):
                yield index, rebuilder.payload(index, picture)

    def open_packets(self) -> PacketReader:
        """A separate reader of the video's packets.

        Raises:
            VideoError: The video cannot be read, or does not match the sidecar.
        """
        video = self.sidecar.video
        return PacketReader(
            self.video_path,
            codec=video.codec,
            frames=self.sidecar.frames,
            coded_size=(video.width, video.height),
        )

    @property
    def files(self) -> list[Path]:
        """The sidecar and the videos."""
        return [self.path, *(path for path, _ in self.videos)]

    @property
    def hides_frames(self) -> bool:
        """Whether a video hides frames before its first one, which may refer to them."""
        for path, video in self.videos:
            with PacketReader(path, codec=video.codec) as reader:
                if reader.hidden:
                    return True
        return False

    def frame_mappings(self) -> str:
        """What torchcodec takes as `custom_frame_mappings`, so that it need not scan the video.

        Returns:
            JSON: ``pts``, ``duration`` and ``key_frame`` of each frame, in ticks of the video.

        Raises:
            OptionError: The video was cut out of another: torchcodec would give wrong frames.
            VideoError: The video's index cannot be read.
        """
        if self.hides_frames:
            raise OptionError(
                f"topic {self.topic}: torchcodec returns wrong frames at the beginning of a video "
                "cut out of another. Use mp4ds, or a dataset packed with a `codec`."
            )
        with closing(Media(self.video_path)) as media:
            table = media.table
        starts, keys = table.presentation[table.order], table.sync[table.order]
        durations = np.diff(starts, append=2 * starts[-1] - starts[-2] if len(starts) > 1 else 1)
        rows = np.stack([starts, durations, keys], 1).astype(np.int64).tolist()
        names = ("pts", "duration", "key_frame")
        return json.dumps({"frames": [dict(zip(names, row, strict=True)) for row in rows]})

    # ------------------------------------------------------------ damage

    @property
    def is_lost(self) -> bool:
        """Whether none of its frames can be read."""
        return self.sound is not None and not self.sound.any()

    def sound_of(self, indices: Iterable[int]) -> Iterator[int]:
        """Those of some frames that can be read."""
        return (index for index in indices if self.sound is None or self.sound[index])

    def count(self) -> int:
        """How many frames can be read, as far as is known."""
        return len(self) if self.sound is None else int(self.sound.sum())

    def damages(
        self, report: Callable[[int], None] = lambda _: None
    ) -> list[tuple[FormatError, int, int]]:
        """What cannot be read: every frame is decoded, rebuilt and compared.

        Args:
            report: Called with the number of each frame.

        Returns:
            An error for frames in a row that cannot be read for the same reason, which it names by
            number, topic and times, and the first and the last of them.
        """
        rows: list[tuple[FormatError, int, int]] = []
        for error in self._damaged_frames(report):
            # without a number, none of the frames can be read
            first, last = (0, len(self) - 1) if error.frame is None else (error.frame,) * 2
            if rows and error.frame == rows[-1][2] + 1 and error.code == rows[-1][0].code:
                rows[-1] = *rows[-1][:2], last
            else:
                rows.append((error, first, last))
        return [(self.named(error, last), first, last) for error, first, last in rows]

    def _damaged_frames(self, report: Callable[[int], None]) -> Iterator[FormatError]:
        is_packet, makes = self.sidecar.keeps_packets, self.sidecar.body != "packet"
        try:
            rebuilder = self.rebuilder
            with ExitStack() as files:
                frames: Iterable[tuple[int, Picture | None]]
                if is_packet:
                    reader = files.enter_context(self.open_packets())
                    frames = ((index, None) for index in range(len(self)))
                else:
                    frames = self.decodable_pictures(is_strict=False)
                for index, picture in frames:
                    report(index)
                    try:
                        if is_packet:
                            rebuilder.packet_payload(index, reader.packet(index))
                        elif picture is None:
                            raise self._undecodable(index)
                        elif makes:
                            rebuilder.payload(index, picture)
                    except FormatError as error:
                        yield error
        except FormatError as error:
            yield error

    def altered_videos(self) -> Iterator[tuple[Path, FormatError]]:
        """What is wrong with each file of the stream that is missing or has another SHA-256."""
        for path, video in self.videos:
            if not path.is_file():
                yield path, FormatError("file-missing", path, "does not exist")
            elif video.sha256 is not None and digest_file(path)[1] != video.sha256:
                problem = (
                    f"does not match the SHA-256 in its sidecar; it has frames of {self.topic}"
                )
                yield path, FormatError("hash-mismatch", path, problem)

    def verify_video(self) -> None:
        """Check the video against its SHA-256, for when no message digest would reveal damage.

        Not if it is known to be damaged.

        Raises:
            FormatError: ``file-missing`` or ``hash-mismatch``.
        """
        if self.sound is None:
            for _, error in self.altered_videos():
                raise error

    def verify_pictures(self) -> None:
        """Check the video or, if it has no SHA-256, all messages, before pictures are made of it.

        Raises:
            FormatError: It is damaged.
        """
        self.verify_video()
        if self.sidecar.video.sha256 is None and self.sidecar.digests is not None:
            for _ in self.payloads():
                pass
