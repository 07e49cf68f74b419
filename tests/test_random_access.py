"""Frames on demand: by number in any order, by stamp, in other formats and sizes."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import mp4ds
from mp4ds.dataset.views import adapted
from mp4ds.format.models import Calibration, Roi
from mp4ds.messages.encodings import ENCODINGS as KNOWN
from mp4ds.plugins.demo import demo
from mp4ds.times import StampIndex
from mp4ds.unpacking.unpack import UnpackOptions
from mp4ds.video.images import Renderer
from pictures import YUV, pixels
from republished import psnr
from round_trips import packed
from sources import ENCODINGS, Scene, odd_scene, scene

TOPIC = "/cam/image_raw"
FRAMES = 9
ORDER = (5, 0, -1, 5, 3, 4, -9, 8)


def recorded(source: Scene) -> list[Any]:
    """Pixels of all images of a scene."""
    return [pixels(m.values) for m in source.messages if m.topic == TOPIC]


@pytest.fixture(scope="module")
def colour(tmp_path_factory: pytest.TempPathFactory) -> Iterator[mp4ds.Topic]:
    """A stream of rgb8 images, of several groups of pictures."""
    folder = tmp_path_factory.mktemp("colour")
    with mp4ds.open(packed(folder, scene("rgb8", frames=12), codec="h264", gop=5)) as dataset:
        yield dataset[TOPIC]


def same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Equal to the bit: NaN and all."""
    return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())


# ---------------------------------------------------------------- by number


@pytest.mark.one_in(4)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_frames_of_every_encoding(encoding: str, tmp_path: Path) -> None:
    source = scene(encoding, frames=FRAMES)
    expected = recorded(source)
    with mp4ds.open(packed(tmp_path, source, gop=4)) as dataset:
        stream = dataset[TOPIC]
        assert stream.encoding == encoding
        assert (stream.shape, stream.dtype) == (expected[0].shape, expected[0].dtype)
        for frame, number in zip(stream.get(ORDER), ORDER, strict=True):
            assert frame.index == number % FRAMES
            assert same(frame.data, expected[number])
            assert frame.data.flags.writeable
        images = [message for message in source.messages if message.topic == TOPIC]
        for frame, message in zip(stream, images, strict=True):
            assert frame.stamp_ns == message.values["header"]["stamp"]
            assert frame.log_time_ns == message.log_time
            assert (frame.frame_id, frame.encoding) == ("cam", encoding)
            assert frame.intrinsics is not None
            assert frame.intrinsics.k[0] == pytest.approx(0.9 * message.values["width"])
        assert same(stream[np.int64(3)].data, expected[3])  # type: ignore[call-overload]
        for part in (slice(None), slice(1, 8, 3), slice(None, None, -2), slice(7, 2, -2),
                     slice(-3, None), slice(5, 5), slice(0, 100)):  # fmt: skip
            found = stream[part]
            assert [frame.index for frame in found] == list(range(FRAMES))[part]
            assert all(same(frame.data, expected[frame.index]) for frame in found)
        assert same(stream.read(ORDER, format="native"), np.stack([expected[i] for i in ORDER]))


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("quality", "codec"), [("visual", None), ("crf=30", None), ("crf=30", "av1-10bit")]
)
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "bayer_grbg8", "nv12"])
def test_frames_of_a_lossy_video_are_those_of_unpack(
    encoding: str, quality: str, codec: str | None, tmp_path: Path
) -> None:
    source = scene(encoding, frames=FRAMES, width=66, height=50)
    dataset = packed(tmp_path, source, quality=quality, codec=codec, gop=4)
    again = mp4ds.unpack(dataset, "bag", tmp_path / "again.bag", UnpackOptions()).output
    mp4ds.pack(again, tmp_path / "exact")
    with mp4ds.open(dataset) as lossy, mp4ds.open(tmp_path / "exact") as exact:
        expected = [frame.data for frame in exact[TOPIC]]
        for frame, number in zip(lossy[TOPIC].get(ORDER), ORDER, strict=True):
            assert same(frame.data, expected[number])
        if encoding == "rgb8":
            assert same(lossy[TOPIC].read(ORDER), np.stack([expected[i] for i in ORDER]))


def test_any_sequence_of_integers(colour: mp4ds.Topic) -> None:
    every = [frame.data for frame in colour]
    for indices in ([], (3,), range(11, -1, -4), np.array([7, -2, 7]), np.arange(4, dtype="u1")):
        numbers = [int(i) for i in indices]
        assert [frame.index for frame in colour.get(indices)] == [i % 12 for i in numbers]
        found = colour.read(indices)
        assert found.shape == (len(numbers), 48, 64, 3)
        assert all(np.array_equal(a, every[i]) for a, i in zip(found, numbers, strict=True))


@pytest.mark.parametrize("index", [12, -13, 2**70])
def test_numbers_out_of_range(index: int, colour: mp4ds.Topic) -> None:
    for ask in (colour.get, colour.read):
        with pytest.raises(
            IndexError, match=rf"{TOPIC} has no frame {index}: its 12 frames are 0 to 11"
        ):
            ask([0, index])


def test_reading_amid_reading(colour: mp4ds.Topic) -> None:
    """Each has its own order, whatever else is asked of the stream meanwhile."""
    every = [frame.data for frame in colour]
    first, last = int(colour.stamps.min()), int(colour.stamps.max()) + 1
    for number, (one, two, frame) in enumerate(
        zip(colour.between(first, last), colour.between(first, last), colour, strict=True)
    ):
        assert (one.index, two.index, frame.index) == (number,) * 3
        other = colour[11 - number]
        for found in (one, two, frame, other):
            assert np.array_equal(found.data, every[found.index])


def test_into_an_array_of_ones_own(colour: mp4ds.Topic) -> None:
    expected = colour.read([2, 9, 2])
    whole = np.full((7, 48, 64, 3), 7, np.uint8)
    out = whole[1:6:2]
    assert colour.read([2, 9, 2], out=out) is out
    assert np.array_equal(out, expected)
    assert (whole[::2] == 7).all()
    turned = np.zeros((3, 3, 48, 64), np.uint8).transpose(0, 2, 3, 1)
    assert np.array_equal(colour.read([2, 9, 2], out=turned), expected)
    small = np.zeros((3, 12, 16, 3), np.uint8)
    colour.read([2, 9, 2], resize=(16, 12), out=small)
    assert np.array_equal(small, colour.read([2, 9, 2], resize=0.25))


# ---------------------------------------------------------------- formats

LIGHT = [name for name in ENCODINGS if name in KNOWN and not name.endswith("C2")
         and name[:3] not in ("8SC", "16S", "32S", "32F", "64F") and name != "16UC1"]  # fmt: skip
DATA = [name for name in ENCODINGS if name not in LIGHT]
_CV_BAYER = {"rggb": "BayerBG", "bggr": "BayerRG", "gbrg": "BayerGR", "grbg": "BayerGB"}
_CV_YUV = {"yuv422": "YUV2RGB_UYVY", "uyvy": "YUV2RGB_UYVY", "yuyv": "YUV2RGB_YUYV",
           "yuv422_yuy2": "YUV2RGB_YUYV", "nv12": "YUV2RGB_NV12",
           "nv21": "YUV2RGB_NV21"}  # fmt: skip


def as_rgb(encoding: str, data: NDArray[Any]) -> NDArray[Any]:
    """What OpenCV makes of an image, or numpy."""
    if encoding[6:10] in _CV_BAYER:
        return cv2.cvtColor(data, getattr(cv2, f"COLOR_{_CV_BAYER[encoding[6:10]]}2RGB"))
    if encoding == "nv24":
        height, width = data.shape[0] // 3, data.shape[1]
        chroma = data[height:].reshape(height, width, 2)
        full = np.dstack([data[:height], chroma[..., 1], chroma[..., 0]]).astype(float)
        y, cr, cb = (full[..., 0] - 16) * 255 / 219, full[..., 1] - 128, full[..., 2] - 128
        rgb = [y + 1.596 * cr, y - 0.392 * cb - 0.813 * cr, y + 2.017 * cb]
        return np.clip(np.dstack(rgb), 0, 255).astype(np.uint8)
    if encoding in YUV:
        return cv2.cvtColor(data, getattr(cv2, f"COLOR_{_CV_YUV[encoding]}"))
    if data.ndim == 2:
        return np.dstack([data] * 3)
    return data[..., :3] if encoding.startswith("rgb") else data[..., 2::-1]


def distance(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Mean difference, as a part of the range."""
    assert (one.dtype, one.shape) == (other.dtype, other.shape)
    return float(np.abs(one.astype(float) - other.astype(float)).mean() / np.iinfo(one.dtype).max)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("encoding", LIGHT)
def test_formats_of_every_encoding(encoding: str, tmp_path: Path) -> None:
    source = scene(encoding, frames=2, width=64, height=48, noisy=False)
    bits = 8 * np.dtype(KNOWN[encoding].dtype).itemsize
    is_exact = encoding not in YUV and not encoding.startswith("bayer")
    with mp4ds.open(packed(tmp_path, source)) as dataset:
        stream = dataset[TOPIC]
        for number, data in enumerate(recorded(source)):
            rgb, bgr, gray = (
                stream.get([number], format=name)[0] for name in ("rgb", "bgr", "gray")
            )
            assert (rgb.encoding, bgr.encoding, gray.encoding) == (
                f"rgb{bits}",
                f"bgr{bits}",
                f"mono{bits}",
            )
            assert rgb.data.dtype == np.dtype(f"u{bits // 8}")
            expected = as_rgb(encoding, data)
            if is_exact:
                assert np.array_equal(rgb.data, expected)
            assert distance(rgb.data, expected) < 0.03
            assert np.array_equal(bgr.data, rgb.data[..., ::-1])
            luma = cv2.cvtColor(rgb.data, cv2.COLOR_RGB2GRAY)
            assert distance(gray.data, luma) < 0.005
            if data.ndim == 2 and is_exact:
                assert np.array_equal(gray.data, data)
            assert rgb.intrinsics is not None
            assert rgb.intrinsics == stream.intrinsics_at(number)
            assert np.array_equal(stream.read([number])[0], rgb.data)


@pytest.mark.parametrize("encoding", DATA)
def test_numbers_are_no_colours(encoding: str, tmp_path: Path) -> None:
    source = scene(encoding, frames=4)
    data = recorded(source)[0]
    with mp4ds.open(packed(tmp_path, source)) as dataset:
        stream = dataset[TOPIC]
        for name in ("rgb", "bgr", "gray"):
            with pytest.raises(mp4ds.OptionError, match=f"{TOPIC} has {encoding} .*native"):
                stream.read([0], format=name)
        (frame,) = stream.get([0], resize=(13, 40), crop=(2, 1, 30, 20))
        rows = [1 + int((row + 0.5) * 20 / 40) for row in range(40)]
        columns = [2 + int((column + 0.5) * 30 / 13) for column in range(13)]
        assert same(frame.data, data[rows][:, columns])
        assert frame.encoding == encoding


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_depths_in_metres(encoding: str, tmp_path: Path) -> None:
    source = scene(encoding, frames=3)
    expected = [data.astype(np.float64) for data in recorded(source)]
    if encoding != "32FC1":
        expected = [data / 1000 for data in expected]
    with mp4ds.open(packed(tmp_path, source)) as dataset:
        stream = dataset[TOPIC]
        found = stream.read(range(3), format="depth_m")
        assert found.dtype == np.float32
        for image, metres in zip(found, expected, strict=True):
            assert same(image, metres.astype(np.float32))
        (frame,) = stream.get([1], format="depth_m", crop=(4, 2, 24, 18), resize=0.5)
        assert (frame.encoding, frame.data.dtype) == ("32FC1", np.float32)
        assert same(frame.data, expected[1][3:20:2, 5:28:2].astype(np.float32))


# ---------------------------------------------------------------- sizes


@pytest.mark.one_in(4)
@pytest.mark.parametrize("size", [(16, 12), (32, 24), (40, 30), (7, 48), (64, 5)])
@pytest.mark.parametrize("name", ["native", "rgb", "bgr", "gray"])
def test_smaller(size: tuple[int, int], name: str, colour: mp4ds.Topic) -> None:
    """By area, as OpenCV does it."""
    (whole,) = colour.read([3], format=name)
    (small,) = colour.read([3], format=name, resize=size)
    expected = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).max() <= 2


@pytest.mark.parametrize("codec", ["h264", "av1", "lossless"])
@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_a_lossy_video_gives_sizes_at_once(
    codec: str, size: tuple[int, int], tmp_path: Path
) -> None:
    """From its own samples; nearly what the whole picture gives, and without loss the same."""
    source = scene("bgr8", noisy=False, frames=6, width=size[0], height=size[1])
    options = {} if codec == "lossless" else {"codec": codec, "quality": "visual"}
    with mp4ds.open(packed(tmp_path, source, **options)) as dataset:
        stream = dataset[TOPIC]
        for name, made in (("rgb", (20, 15)), ("bgr", (100, 80)), ("native", (32, 24))):
            own = "rgb8" if name == "rgb" else "bgr8"
            renderer = Renderer(KNOWN[own], own, crop=None, size=made)
            frames = stream.get(range(6), format=name, resize=made)
            read = stream.read(range(6), format=name, resize=made)
            between = stream.between(0, 2**62, format=name, resize=made)
            wholes = stream.read(range(6), format=name)
            for frame, other, third, whole in zip(frames, read, between, wholes, strict=True):
                assert frame.encoding == own
                assert same(frame.data, other)
                assert same(frame.data, third.data)
                expected = np.empty_like(other)
                renderer.render(whole, expected)
                near = psnr(other, expected)  # of strong colours in few pixels
                assert same(other, expected) if codec == "lossless" else near > 36


def test_parts(colour: mp4ds.Topic) -> None:
    (whole,) = colour.read([3])
    for crop in ((0, 0, 64, 48), (3, 5, 20, 11), (63, 47, 1, 1), np.array([1, 0, 63, 48])):
        x, y, width, height = (int(value) for value in crop)
        part = whole[y : y + height, x : x + width]
        assert np.array_equal(colour.read([3], crop=crop)[0], part)
        assert np.array_equal(colour.get([3], crop=crop)[0].data, part)
        gray = colour.read([3], format="gray")[0][y : y + height, x : x + width]
        assert np.array_equal(colour.read([3], format="gray", crop=crop)[0], gray)
    (small,) = colour.read([3], crop=(8, 4, 32, 40), resize=0.5)
    expected = cv2.resize(whole[4:44, 8:40], (16, 20), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).max() <= 2


@pytest.mark.parametrize("encoding", [*(name for name in ENCODINGS if name.startswith("bayer"))])
def test_a_part_of_a_mosaic_is_a_mosaic(encoding: str, tmp_path: Path) -> None:
    source = scene(encoding, frames=4)
    data = recorded(source)[0]
    block = np.array(list(encoding[6:10])).reshape(2, 2)
    with mp4ds.open(packed(tmp_path, source)) as dataset:
        stream = dataset[TOPIC]
        for x, y in product((0, 1, 2, 3), repeat=2):
            (frame,) = stream.get([0], crop=(x, y, 20, 11))
            assert same(frame.data, data[y : y + 11, x : x + 20])
            rolled = np.roll(block, (-y, -x), (0, 1)).ravel()
            assert frame.encoding == f"bayer_{''.join(rolled)}{encoding[10:]}"
            (rgb,) = stream.read([0], crop=(x, y, 20, 11))
            assert np.array_equal(rgb, stream.read([0])[0][y : y + 11, x : x + 20])
        with pytest.raises(
            mp4ds.OptionError, match="only be cropped and resized as rgb, bgr or gray"
        ):
            stream.get([0], resize=0.5)
        assert stream.read([0], resize=0.5).shape == (1, 24, 32, 3)


@pytest.mark.parametrize("encoding", YUV)
def test_camera_yuv_is_not_cut(encoding: str, tmp_path: Path) -> None:
    with mp4ds.open(packed(tmp_path, scene(encoding, frames=4))) as dataset:
        stream = dataset[TOPIC]
        for options in ({"crop": (0, 0, 2, 2)}, {"resize": 0.5}):
            with pytest.raises(
                mp4ds.OptionError, match="only be cropped and resized as rgb, bgr or gray"
            ):
                stream.get([0], **options)
        (part,) = stream.read([0], crop=(1, 3, 9, 7))
        assert np.array_equal(part, stream.read([0])[0][3:10, 1:10])


# ---------------------------------------------------------------- words

MISTAKES: dict[str, tuple[type[Exception], str]] = {
    "stream[[1, 2]]": (TypeError, r"not [1, 2]: read([0, 5]) and get([0, 5]) take several"),
    "stream[1.0]": (TypeError, "at(stamp_ns) a time"),
    "stream.read(5)": (TypeError, "use [5]"),
    "stream.read([0], resize=224)": (mp4ds.OptionError, "is a factor; for pixels, use (224, 224)"),
    "stream.at(0, tolerance_ns=9)": (mp4ds.FrameNotFoundError, "has no frame within 9 ns near 0 "),
    "stream.at(7, mode='exact')": (mp4ds.FrameNotFoundError, "of exactly 7 ns; the nearest"),
    "stream.at(7, mode='first')": (mp4ds.OptionError, "nearest, before, after, exact"),
    "stream.at(0.5)": (TypeError, "an integer, in nanoseconds, not 0.5: half a second after"),
    "dataset.sync(tolerance_ns=1e6)": (TypeError, "tolerance_ns is an integer, in nanoseconds"),
}


@pytest.mark.parametrize("code", MISTAKES)
def test_what_to_write_instead(code: str, colour: mp4ds.Topic) -> None:
    kind, words = MISTAKES[code]
    with mp4ds.open(colour.streams[0].path) as dataset, pytest.raises(kind, match=re.escape(words)):
        eval(code, {"stream": colour, "dataset": dataset, "np": np})


# ---------------------------------------------------------------- intrinsics


def calibration(**changes: Any) -> Calibration:
    values: dict[str, Any] = {
        "frame_id": "cam",
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "d": [0.1, 0, 0, 0, 0],
        "k": [500, 0, 320, 0, 510, 240, 0, 0, 1],
        "r": np.eye(3).ravel().tolist(),
        "p": [490, 0, 321, -60, 0, 495, 239, 3, 0, 0, 1, 0],
        "template": "AAAA",
    }
    return Calibration(**values | changes)


def seen(matrix: Sequence[float], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixel at which a point of the camera's frame is seen."""
    columns = len(matrix) // 3
    u, v, w = np.reshape(matrix, (3, columns)) @ np.append(point, 1)[:columns]
    return np.array([u / w, v / w])


@settings(max_examples=60, deadline=None)
@given(
    crop=st.tuples(*[st.integers(0, 99)] * 2, *[st.integers(1, 200)] * 2),
    size=st.tuples(*[st.integers(1, 500)] * 2),
    binning=st.integers(0, 2),
    roi=st.tuples(*[st.integers(0, 50)] * 2),
    point=st.tuples(*[st.floats(-1, 1)] * 2, st.floats(0.5, 9)),
)
def test_a_point_is_seen_at_the_pixel_that_shows_it(
    crop: Any, size: Any, binning: int, roi: Any, point: Any
) -> None:
    """Pixels with whole coordinates at their middle: their corners are at halves."""
    region = Roi(x_offset=roi[0], y_offset=roi[1], height=0, width=0, do_rectify=0)
    recorded = calibration(binning_x=binning, binning_y=binning, roi=region)
    made = adapted(recorded, crop, size)
    for name in ("k", "p"):
        full = seen(getattr(recorded, name), np.array(point))
        image = (full - roi) / max(binning, 1)
        scale = np.array(size) / crop[2:]
        due = (image - crop[:2] + 0.5) * scale - 0.5
        assert np.allclose(seen(getattr(made, name), np.array(point)), due, atol=1e-6)
    assert (made.width, made.height) == size
    assert (made.binning_x, made.binning_y, made.roi, made.template) == (0, 0, None, None)
    assert (made.d, made.distortion_model, made.frame_id) == ([0.1, 0, 0, 0, 0], "plumb_bob", "cam")
    Calibration.model_validate(made.model_dump())


def test_the_intrinsics_of_frames(colour: mp4ds.Topic) -> None:
    own = colour.intrinsics_at(0)
    assert own is not None
    for options in ({}, {"format": "bgr"}, {"crop": (0, 0, 64, 48)}, {"resize": 1}):
        assert colour.get([0], **options)[0].intrinsics is own  # type: ignore[arg-type]
    (frame,) = colour.get([0], resize=0.5, crop=(10, 4, 40, 40))
    assert frame.intrinsics is not None
    assert (frame.intrinsics.width, frame.intrinsics.height) == (20, 20)
    fx, cx = own.k[0], own.k[2]
    assert frame.intrinsics.k[0] == pytest.approx(fx / 2)
    assert frame.intrinsics.k[2] == pytest.approx((cx - 10 + 0.5) / 2 - 0.5)
    assert own.k[2] == cx


# ---------------------------------------------------------------- by stamp

NANOSECONDS = st.one_of(st.integers(-9, 9), st.integers(-(2**63), 2**63 - 1))


def wanted(stamps: list[int], time: int, mode: str, tolerance: int | None) -> int | None:
    """The frame that is due, one by one."""
    fits = {
        "nearest": lambda stamp: True,
        "before": lambda stamp: stamp <= time,
        "after": lambda stamp: stamp >= time,
        "exact": lambda stamp: stamp == time,
    }[mode]
    near = [
        (abs(stamp - time), stamp, number)
        for number, stamp in enumerate(stamps)
        if fits(stamp) and (tolerance is None or abs(stamp - time) <= tolerance)
    ]
    return min(near)[2] if near else None


@settings(max_examples=400, deadline=None)
@given(
    stamps=st.lists(NANOSECONDS, min_size=1, max_size=9),
    time=st.one_of(NANOSECONDS, st.integers(-(2**70), 2**70)),
    mode=st.sampled_from(["nearest", "before", "after", "exact"]),
    tolerance=st.one_of(st.none(), st.integers(0, 5), st.integers(0, 2**70)),
)
def test_any_stamps(stamps: list[int], time: int, mode: str, tolerance: int | None) -> None:
    index = StampIndex("/cam", np.array(stamps, np.int64))
    due = wanted(stamps, time, mode, tolerance)
    if due is not None:
        assert index.find(time, mode=mode, tolerance_ns=tolerance) == due
        return
    with pytest.raises(mp4ds.FrameNotFoundError) as caught:
        index.find(time, mode=mode, tolerance_ns=tolerance)
    error = caught.value
    assert isinstance(error, LookupError)
    assert (error.topic, error.stamp_ns) == ("/cam", time)
    assert abs(error.nearest_ns - time) == min(abs(stamp - time) for stamp in stamps)
    for word in ("/cam", str(time), str(error.nearest_ns)):
        assert word in str(error)


def test_frames_by_stamp(colour: mp4ds.Topic) -> None:
    stamps = colour.stamps.tolist()
    for number, stamp in enumerate(stamps):
        for mode in ("nearest", "before", "after", "exact"):
            frame = colour.at(stamp, mode=mode, tolerance_ns=0)
            assert (frame.index, frame.stamp_ns) == (number, stamp)
            assert np.array_equal(frame.data, colour[number].data)
    assert colour.index_at(stamps[4] + 5_000_000) == 4
    assert colour.index_at(stamps[4] + 5_000_000, mode="after") == 5
    assert colour.index_at(np.int64(stamps[4] - 1), mode="before") == 3
    assert colour.at(0, format="gray", resize=0.5).data.shape == (24, 32)


def test_spans_of_time(colour: mp4ds.Topic) -> None:
    stamps = colour.stamps.tolist()
    found = list(colour.between(stamps[2], stamps[7]))
    assert [frame.index for frame in found] == [2, 3, 4, 5, 6]
    assert all(np.array_equal(frame.data, colour[frame.index].data) for frame in found)
    others = colour.between(stamps[2] + 1, stamps[7] + 1)
    assert [frame.index for frame in others] == [3, 4, 5, 6, 7]
    assert list(colour.between(stamps[7], stamps[2])) == []
    assert len(list(colour.between(-(2**70), 2**70))) == 12
    (small,) = colour.between(stamps[0], stamps[1], format="gray", crop=(0, 0, 8, 6))
    assert small.data.shape == (6, 8)
    with pytest.raises(mp4ds.OptionError):  # at once, and not with the first frame
        colour.between(0, 1, format="xyz")


@pytest.mark.parametrize("trait", ["stamp-backward", "stamp-repeated", "stamp-zero"])
def test_stamps_that_are_not_in_order(trait: str, tmp_path: Path) -> None:
    with mp4ds.open(packed(tmp_path, odd_scene(trait))) as dataset:
        stream = dataset["/odd/image"]
        stamps = stream.stamps.tolist()
        order = sorted(range(8), key=lambda number: (stamps[number], number))
        found = list(stream.between(-(2**63), 2**63))
        assert [frame.index for frame in found] == order
        assert all(np.array_equal(frame.data, stream[frame.index].data) for frame in found)
        for stamp in stamps:
            assert stream.at(stamp, mode="exact").index == stamps.index(stamp)


# ---------------------------------------------------------------- documentation


@pytest.mark.slow
def test_the_page_on_frames_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its snippets, one after the other, on what its commands make."""
    page = (Path(__file__).parents[1] / "docs" / "frames.md").read_text()
    snippets = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(snippets) >= 7
    monkeypatch.chdir(tmp_path)
    assert "mp4ds demo demo.mcap\nmp4ds pack demo.mcap -o demo\n" in page
    demo("demo.mcap")
    mp4ds.pack("demo.mcap", "demo")
    shutil.copy("demo/right_image_raw.mp4", "clip.mp4")
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        for snippet in snippets:
            exec(snippet, names)
    names["dataset"].close()
    lines = printed.getvalue().splitlines()
    said = re.findall(r"^print\(.*# ((?:\[|\(|\d|bgr).*)$", page, re.MULTILINE)
    assert len(said) >= 5
    assert set(said) <= set(lines)
