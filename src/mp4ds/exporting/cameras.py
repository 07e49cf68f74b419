"""The cameras of an export: which frames are given, when they were taken, and how they look."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.exporting.ledger import Ledger
from mp4ds.exporting.options import ExportOptions
from mp4ds.intervals import intervals, usual_interval
from mp4ds.layouts import ENCODINGS, Encoding, Pixels
from mp4ds.republish.forms import is_inverse_depth
from mp4ds.republish.reduction import times_of
from mp4ds.sidecar import Calibration
from mp4ds.streams import Stream
from mp4ds.streams.calibrations import Placement
from mp4ds.streams.choices import marked
from mp4ds.streams.views import View, view_of
from mp4ds.sync import synchronize
from mp4ds.video import ImageFile, encoding_as

_THINNED = "left out on request (--every, --max-rate)"
_INVERSE = "quantised inverse depths; `mp4ds unpack --images raw` makes depths of them"

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Camera:
    """The frames of a stream that are given, by time.

    Attributes:
        stream: The stream.
        numbers: Numbers of the frames, int64, shape (frames,).
        times: When they were taken, nanoseconds, increasing or equal; shape (frames,).
        view: How they look.
    """

    stream: Stream
    numbers: Integers
    times: Integers
    view: View

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def topic(self) -> str:
        """Topic of the images."""
        return self.stream.topic

    @property
    def frame_id(self) -> str:
        """Coordinate frame of the first image."""
        return self.stream.sidecar.headers[0].frame_id

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what is given, pixels."""
        height, width = self.view.shape[:2]
        if self.view.is_plain:  # of YUV, rows are more than the image has
            return self.stream.image_size
        return width, height

    @property
    def is_as_recorded(self) -> bool:
        """Whether all frames are given, as they were recorded and in their order."""
        is_whole = np.array_equal(self.numbers, np.arange(len(self.stream)))
        return self.view.is_plain and is_whole

    @cached_property
    def calibration(self) -> Calibration | None:
        """The calibration of what is given, when the first frame was taken; None if unknown."""
        if not len(self):
            return None
        found = self.stream.intrinsics_at(int(self.numbers[0]))
        if found is None or not found.k[0]:  # a camera that is not calibrated says zeros
            return None
        return Placement((0, 0, *self.stream.image_size), self.size).calibration(found)

    @property
    def rate(self) -> float:
        """Usual frames in a second; 0 where there is one frame."""
        usual = usual_interval(intervals(self.times))
        return 1e9 / usual if usual else 0.0

    def at(self, places: Integers) -> Camera:
        """The camera with some of its frames only."""
        return replace(self, numbers=self.numbers[places], times=self.times[places])

    def pictures(self) -> Iterator[tuple[int, Pixels]]:
        """What is given of each frame, in the order of the video.

        Yields:
            Place among `numbers`, and pixels of `view.encoding` that are the caller's.

        Raises:
            FormatError: The stream is damaged.
        """
        self.stream.verify_video()
        place_of = np.full(len(self.stream), -1, np.int64)
        place_of[self.numbers] = np.arange(len(self))
        with self.stream.open_video(sequential=True) as decoder:
            for index, picture in self.stream.pictures_in_order(decoder, marked(place_of >= 0)):
                pixels: Pixels = np.empty(self.view.shape, self.view.dtype)
                self.view.give(self.stream.rebuilder.pixels(picture), pixels)
                yield int(place_of[index]), pixels

    def png_files(self) -> Iterator[tuple[int, bytes]]:
        """PNG files of the frames; see `pictures`."""
        file = ImageFile(self.view.encoding.name, "png")
        for place, pixels in self.pictures():
            yield place, file.encode(pixels)


def chosen_cameras(
    streams: Sequence[Stream], options: ExportOptions, ledger: Ledger, notes: list[str]
) -> list[Camera]:
    """The cameras of some streams: those that are calibrated first, then by topic.

    Args:
        streams: The streams.
        options: Which frames, and how.
        ledger: Counts those that are left out.
        notes: Told what frames become.

    Raises:
        OptionError: Frames of a stream cannot be given so.
    """
    reduction = options.reduction
    cameras = []
    for stream in streams:
        sidecar = stream.sidecar
        if any(is_inverse_depth(sidecar, header) for header in sidecar.headers):
            ledger.leave(stream.topic, _INVERSE, len(stream))
            continue
        columns = stream.rebuilder.columns
        kept = np.flatnonzero(reduction.kept(columns))
        ledger.leave(stream.topic, _THINNED, len(stream) - len(kept))
        times = times_of(columns)
        if times is not columns.stamp:
            notes.append(f"{stream.topic}: its stamps do not increase, log times are told instead")
        kept = kept[np.argsort(times[kept], kind="stable")]
        view = _view(stream, options, notes)
        cameras.append(Camera(stream, kept, times[kept], view))
    cameras.sort(key=lambda camera: (camera.calibration is None, camera.topic))
    if options.tolerance_ns is None or len(cameras) < 2:
        return cameras
    return _matched(cameras, options.tolerance_ns, ledger)


def _view(stream: Stream, options: ExportOptions, notes: list[str]) -> View:
    known = ENCODINGS[stream.encoding]
    colours = options.pixels if options.pixels in ("rgb", "gray") else "native"
    if options.pixels == "seen" and not is_plain(known):
        colours = "rgb"
    if colours != "native" and not is_plain(known):
        kind = "a Bayer mosaic" if known.mosaic else "YUV"
        keeps = (
            ", which --pixels native keeps" if known.mosaic and colours != options.pixels else ""
        )
        notes.append(f"{stream.topic}: its pixels are made of {kind}{keeps}")
    if encoding_as(known, "rgb") is None:
        colours = "native"  # depths and other numbers have no colours
    return view_of(
        stream.topic, known, stream.image_size, format=colours, resize=options.resize, crop=None
    )


def is_plain(encoding: Encoding) -> bool:
    """Whether an image of an encoding looks like what it shows: neither a mosaic nor YUV."""
    return not encoding.mosaic and encoding.rows == 1 and encoding.even == (1, 1)


def _matched(cameras: list[Camera], tolerance_ns: int, ledger: Ledger) -> list[Camera]:
    """The frames that every camera has, frame n of each taken at the same time."""
    times = {str(number): camera.times for number, camera in enumerate(cameras)}
    matches = synchronize(times, tolerance_ns=tolerance_ns)
    for number, camera in enumerate(cameras):
        reason = "not every camera has a frame of this time (--sync)"
        ledger.leave(camera.topic, reason, len(matches.unmatched[str(number)]))
    columns = zip(cameras, matches.indices.T, strict=True)
    return [camera.at(places) for camera, places in columns]


def that_png_holds(cameras: Sequence[Camera], ledger: Ledger) -> list[Camera]:
    """Those of which the images can be PNG files; the others are left out."""
    found = []
    for camera in cameras:
        name = camera.view.encoding.name
        try:
            ImageFile(name, "png")
        except OptionError:
            ledger.leave(camera.topic, f"PNG cannot hold {name} images", len(camera))
        else:
            found.append(camera)
    return found


def of_different_times(camera: Camera, ledger: Ledger) -> Camera:
    """The camera with one frame of each time, where files are called by it."""
    is_new = np.diff(camera.times, prepend=camera.times[:1] - 1) != 0
    ledger.leave(
        camera.topic, "another frame has the same time, and so its name", int((~is_new).sum())
    )
    return camera.at(np.flatnonzero(is_new))


def hold_calibration(camera: Camera, ledger: Ledger) -> Calibration | None:
    """The calibration of a camera, counted as held once: formats have no place for its times."""
    info = camera.stream.sidecar.camera_info
    if info is None or camera.calibration is None:
        return None
    topic = info.channel.topic
    columns = camera.stream.camera_info_columns
    if columns is not None:
        used = camera.stream.intrinsics_at(int(camera.numbers[0]))
        same = [number for number, item in enumerate(info.calibrations) if item is used]
        is_same = np.isin(columns.variant, same)
        ledger.hold(topic)
        ledger.leave(topic, "repeats the calibration that is held", int(is_same.sum()) - 1)
        ledger.leave(
            topic, "another calibration: one of each camera is held", int((~is_same).sum())
        )
    return camera.calibration
