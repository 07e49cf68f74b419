"""The test recordings say what they claim: everything is decoded again by public libraries."""

from __future__ import annotations

import io
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import encoders
from coded_scenes import CODED, ODD, VERBATIM
from definitions import CODED_VIDEO, COMPRESSED, IMAGE, PACKET, definitions
from pictures import COMMON, CONTENTS, ENCODINGS, YUV, picture, pixels, rows_of, sample_format
from scenes import Record, Scene, instant, scene, typestore
from sources import SOURCES

CODED_TYPES = (COMPRESSED, CODED_VIDEO, PACKET)
FRAMES = 8


def read(record: Record, encoding: str) -> Any:
    """The message, decoded by rosbags."""
    store, payload = typestore(encoding), record.payload(encoding)
    if encoding == "ros1":
        return store.deserialize_ros1(payload, record.msgtype)
    return store.deserialize_cdr(payload, record.msgtype)


def images(made: Scene) -> list[Record]:
    return [record for record in made.messages if record.msgtype in (IMAGE, *CODED_TYPES)]


def payloads(name: str, **options: Any) -> list[bytes]:
    """Data of a coded scene's messages."""
    return [record.values["data"] for record in images(CODED[name](**options))]


def psnr(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))


# ---------------------------------------------------------------- raw images


def test_there_is_every_encoding_once() -> None:
    assert len(set(ENCODINGS)) == len(ENCODINGS) == 53
    assert ENCODINGS[: len(COMMON)] == COMMON


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_raw_images_hold_their_pictures(encoding: str) -> None:
    for wire in ["ros1", "cdr"]:
        for options in [
            {},
            {"width": 31, "height": 15},
            {"pad": 5},
            {"big_endian": True, "pad": 8},
        ]:
            made = images(
                scene(encoding, frames=2, noisy=False, **{"width": 32, "height": 16} | options)
            )
            dtype, samples = sample_format(encoding)
            for number, record in enumerate(made):
                message = read(record, wire)
                width, height = message.width, message.height
                odd = "width" in options and encoding not in YUV
                assert (width, height) == ((31, 15) if odd else (32, 16))
                assert message.encoding == encoding
                assert message.step == width * samples * dtype.itemsize + options.get("pad", 0)
                assert len(message.data) == message.step * rows_of(encoding, height)
                expected = picture(encoding, frame=number, width=width, height=height, rng=None)
                assert expected.dtype == dtype
                assert np.array_equal(pixels(vars(message)), expected, equal_nan=dtype.kind == "f")


@pytest.mark.parametrize("content", CONTENTS)
def test_samples_hold_what_their_content_says(content: str) -> None:
    for encoding in CONTENTS[content]:
        rng = np.random.default_rng(0)
        made = picture(encoding, frame=1, width=64, height=48, rng=rng, content=content)
        if content == "full":
            used = np.bitwise_or.reduce(made.ravel().view(f"u{made.itemsize}"))
            bits = 8 * made.itemsize - (made.dtype.kind == "f")  # distances are not negative
            assert used == 2**bits - 1, encoding
            if made.dtype.kind == "f":
                assert np.isnan(made).any()
                assert np.isinf(made).any()
        elif content == "few-values":
            assert len(np.unique(made)) < 100, encoding
        elif content.startswith("12-bit"):
            shift = 4 if content == "12-bit-high" else 0
            assert int(made.max()) >> shift < 4096
            assert int(made.max()) >> shift > 3000
            assert not (made & ((1 << shift) - 1)).any()
        else:
            seen = made[np.isfinite(made) & (made != 0)]
            thousand = np.round(seen.astype(float) * 1000)
            exact = (thousand / 1000).astype(made.dtype)
            product = thousand.astype(made.dtype) * made.dtype.type(0.001)
            assert np.array_equal(seen, product if "product" in content else exact)
            assert not np.array_equal(exact, product)  # so that both contents matter
            assert (made == 0).any() == ("product" in content)
            assert np.isnan(made).any() != ("product" in content)


@pytest.mark.parametrize("encoding", YUV)
def test_yuv_is_what_opencv_takes_it_for(encoding: str) -> None:
    codes = {"nv12": "NV12", "nv21": "NV21", "uyvy": "UYVY", "yuv422": "UYVY"}
    made = picture(encoding, frame=2, width=64, height=48, rng=None)
    if encoding == "nv24":
        made = np.dstack([made[:48], made[48:].reshape(48, 64, 2)]).astype(float) - (16, 128, 128)
        matrix = np.array([[1.164, 0, 1.596], [1.164, -0.392, -0.813], [1.164, 2.017, 0]])
        rgb = np.clip(made @ matrix.T, 0, 255)
    else:
        rgb = cv2.cvtColor(made, getattr(cv2, f"COLOR_YUV2RGB_{codes.get(encoding, 'YUY2')}"))
    expected = picture("rgb8", frame=2, width=64, height=48, rng=None)
    assert np.abs(rgb.astype(float) - expected).mean() < (1 if encoding == "nv24" else 6)


@pytest.mark.parametrize("encoding", [name for name in ENCODINGS if name.startswith("bayer")])
def test_mosaics_have_the_colours_of_their_places(encoding: str) -> None:
    deep = encoding.endswith("16")
    mosaic = picture(encoding, frame=2, width=64, height=48, rng=None)
    rgb = picture("rgb16" if deep else "rgb8", frame=2, width=64, height=48, rng=None)
    for place, letter in enumerate(encoding[6:10]):
        part = np.s_[place // 2 :: 2, place % 2 :: 2]
        assert np.array_equal(mosaic[part], rgb[part][..., "rgb".index(letter)])


@pytest.mark.parametrize("made", ["rgb", "rgba", "rgb16", "rgba16"])
def test_bgr_is_rgb_backwards(made: str) -> None:
    name = made if "16" in made else f"{made}8"
    forth = picture(name, frame=2, width=16, height=12, rng=None)
    back = picture(name.replace("rgb", "bgr"), frame=2, width=16, height=12, rng=None)
    assert np.array_equal(forth[..., :3], back[..., 2::-1])
    assert np.array_equal(forth[..., 3:], back[..., 3:])


# ---------------------------------------------------------------- coded scenes


@pytest.mark.parametrize("name", CODED)
def test_coded_messages_are_alike_in_both_worlds(name: str) -> None:
    made, again = CODED[name](frames=FRAMES), CODED[name](frames=FRAMES)
    kept = [record for record in images(made) if record.values["data"] or name in VERBATIM]
    assert FRAMES - 2 <= len(kept) <= FRAMES + 2
    for record in images(made):
        ros1, cdr = read(record, "ros1"), read(record, "cdr")
        for field in record.values:
            for message in (ros1, cdr):
                found = getattr(message, field)
                if field == "data":
                    assert bytes(found) == record.values["data"]
                elif field in ("header", "timestamp"):
                    stamp = found.stamp if field == "header" else found
                    given = record.values[field]
                    given = given["stamp"] if field == "header" else given
                    assert stamp.sec * 10**9 + stamp.nanosec == given < record.log_time
                else:
                    assert found == record.values[field]
    assert [r.payload("cdr") for r in made.messages] == [r.payload("cdr") for r in again.messages]


@pytest.mark.parametrize("source", ["bag-none", "rosbag2-sqlite3-v9", "mcap-none-profile"])
@pytest.mark.parametrize("name", ["jpeg-rgb", "video-h264", "ffmpeg-libx264"])
def test_coded_scenes_can_be_written(name: str, source: str, tmp_path: Path) -> None:
    assert all(path.exists() for path in SOURCES[source](tmp_path, CODED[name](frames=3)))


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_definitions_are_those_that_are_written(encoding: str) -> None:
    for msgtype in definitions(encoding):
        version = 1 if encoding == "ros1" else 2
        written = typestore(encoding).generate_msgdef(msgtype, ros_version=version)[0]
        assert ("time timestamp" in written) == (encoding == "ros1" and "foxglove" in msgtype)


PICTURES = [name for name in CODED if name.startswith(("jpeg", "png")) and name not in VERBATIM]


@pytest.mark.parametrize("name", PICTURES)
def test_coded_pictures_decode(name: str) -> None:
    grey = {"jpeg-gray", "jpeg-pillow-gray", "jpeg-format-mono8"}
    for number, data in enumerate(payloads(name, frames=FRAMES)):
        if number == ODD and name.endswith("-one"):
            continue
        assert data.startswith(b"\x89PNG" if name.startswith("png") else b"\xff\xd8")
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        half = name == "jpeg-mixed-sizes" and number >= 2 * ODD
        assert found.shape[:2] == ((24, 32) if half else (48, 64))
        if name in grey:
            assert found.ndim == 2


def test_png_holds_the_picture() -> None:
    for kind, encoding in {"rgb": "bgr8", "gray": "mono8", "16-bit": "mono16"}.items():
        for writer in ("cv2", "cv2-9", "pillow"):
            data = images(CODED[f"png-{kind}-{writer}"](frames=1))[0].values["data"]
            found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            rng = np.random.default_rng(0)
            instant(0, rng)  # drawn before the picture's noise
            expected = picture(encoding, frame=0, width=64, height=48, rng=rng)
            assert np.array_equal(found, expected)


def test_jpeg_kinds() -> None:
    def markers(name: str) -> list[int]:
        return [marker for marker, _ in encoders.jpeg_segments(payloads(name, frames=1)[0])]

    assert 0xC2 in markers("jpeg-progressive")
    assert 0xDD in markers("jpeg-restart")
    assert 0xE1 in markers("jpeg-exif-trailing")
    assert 0xC4 not in markers("jpeg-no-huffman-tables")
    assert 0xC4 in markers("jpeg-rgb")
    for name, sampling in (("jpeg-420", 0x22), ("jpeg-422", 0x21), ("jpeg-444", 0x11)):
        segments = dict(encoders.jpeg_segments(payloads(name, frames=1)[0]))
        assert segments[0xC0][11] == sampling
    assert not any(data.endswith(b"\xff\xd9") for data in payloads("jpeg-exif-trailing"))
    mosaic = Image.open(io.BytesIO(payloads("jpeg-format-bayer", frames=1)[0]))
    assert mosaic.mode == "L"


@pytest.mark.parametrize(
    ("name", "cut"), [("jpeg-cut-one", True), ("jpeg-corrupt-one", False), ("jpeg-empty-one", True)]
)
def test_one_message_is_broken(name: str, cut: bool) -> None:
    for number, (data, whole) in enumerate(zip(payloads(name), payloads("jpeg-rgb"), strict=True)):
        assert (data == whole) == (number != ODD)
        assert data.endswith(b"\xff\xd9") == (number != ODD or not cut)
        assert len(data) < len(whole) or number != ODD or not cut


@given(st.lists(st.lists(st.integers(0, 65535) | st.just(0), min_size=5, max_size=5), min_size=1))
def test_rvl_returns(rows: list[list[int]]) -> None:
    depth = np.array(rows, np.uint16)
    assert np.array_equal(rvl_decoded(encoders.rvl(depth), depth.size), depth.ravel())


def rvl_decoded(data: bytes, count: int) -> np.ndarray[Any, Any]:
    """The decoder of the paper, nibble by nibble."""
    words = struct.unpack(f"<{len(data) // 4}I", data)
    nibbles = (word >> shift & 15 for word in words for shift in range(28, -1, -4))

    def number() -> int:
        value, shift = 0, 0
        for nibble in nibbles:
            value |= (nibble & 7) << shift
            shift += 3
            if nibble < 8:
                break
        return value

    values: list[int] = []
    before = 0
    while len(values) < count:
        values += [0] * number()
        for _ in range(number()):
            zigzag = number()
            before += zigzag >> 1 ^ -(zigzag & 1)
            values.append(before)
    return np.array(values, np.uint16)


@pytest.mark.parametrize("name", [name for name in CODED if name.startswith("depth")])
def test_depth_returns(name: str) -> None:
    rng = np.random.default_rng(0)
    for number, record in enumerate(images(CODED[name](frames=FRAMES))):
        head, body = record.values["data"][:12], record.values["data"][12:]
        if name in VERBATIM:
            assert body == b""
            continue
        if name.endswith("rvl"):
            width, height = struct.unpack("<II", body[:8])
            found = rvl_decoded(body[8:], width * height).reshape(height, width)
        else:
            found = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
        assert found.dtype == np.uint16
        assert head[:4] == bytes(4)
        instant(number, rng)
        encoding = name.split("-")[1]
        made = picture(encoding, frame=number, width=64, height=48, rng=rng)
        if encoding == "16UC1":
            assert np.array_equal(found, made >> 2)
        else:
            a, b = struct.unpack("<ff", head[4:])
            seen = made < 10
            assert np.array_equal(found != 0, seen)
            assert np.abs(a / (found[seen] - b) - made[seen]).max() < 0.01 * 10


# ---------------------------------------------------------------- video packets

VIDEO_NAMES = [n for n in CODED if n.startswith(("video", "ffmpeg")) and n not in VERBATIM]


def decoded(name: str) -> tuple[list[np.ndarray[Any, Any]], list[Record]]:
    """Frames in the order in which the decoder shows them, of all that it can decode."""
    records = images(CODED[name](frames=FRAMES))
    told = records[0].values.get("format") or records[0].values["encoding"]
    codec = next(c for c in ("264", "265", "hevc", "av1", "vp9", "mjpeg") if c in told)
    decoder = {"264": "h264", "265": "hevc", "av1": "libdav1d"}.get(codec, codec)
    context: Any = av.CodecContext.create(decoder, "r")
    context.thread_count = 1
    found = []
    for packet in [*(av.Packet(record.values["data"]) for record in records), None]:
        try:
            found += context.decode(packet)
        except av.error.InvalidDataError:  # before the first key frame, or no frame at all
            assert name.endswith(("mid-gop", "apart"))
    return [frame.to_ndarray(format="rgb24") for frame in found], records


@pytest.mark.parametrize("name", VIDEO_NAMES)
def test_video_packets_decode(name: str) -> None:
    frames, records = decoded(name)
    broken = name.endswith(("mid-gop", "lost"))
    assert len(frames) <= FRAMES if broken else len(frames) == FRAMES
    assert len(frames) >= FRAMES - encoders.GOP
    rng = np.random.default_rng(0)
    for number, frame in enumerate(frames if not broken else []):
        height, width = (24, 32) if name.endswith("resized") and number >= 4 else (48, 64)
        if number == 4 and name.endswith("resized"):
            rng = np.random.default_rng(0)
        shown = number - 4 if name.endswith("resized") and number >= 4 else number
        expected = picture("rgb8", frame=shown, width=width, height=height, rng=rng)
        assert psnr(frame, expected) > 20
    logged = [record.log_time for record in records]
    assert logged == sorted(set(logged))


def test_stamps_are_of_the_frames_shown() -> None:
    for name in ("video-h264-bframes", "video-h265-bframes"):
        stamps = [record.values["timestamp"] for record in images(CODED[name]())]
        assert stamps != sorted(stamps)
        assert len(set(stamps)) == 10
    packets = encoders.packets("h264-bframes", frames=10, width=64, height=48)
    assert [p.number for p in packets] != sorted(p.number for p in packets)


def kinds(data: bytes) -> list[int]:
    """H.264's types of NAL units."""
    return [unit[0] & 31 for _, unit in encoders.nal_units(data)]


def starts(data: bytes) -> set[int]:
    return {length for length, _ in encoders.nal_units(data)}


def test_nal_units_are_as_told() -> None:
    assert starts(payloads("video-h264")[0]) == {3, 4}
    assert all(starts(data) == {3} for data in payloads("video-h264-3-byte"))
    assert all(starts(data) == {4} for data in payloads("video-h264-4-byte"))
    assert [kinds(data)[:2] == [7, 8] for data in payloads("video-h264")] == [
        number % encoders.GOP == 0 for number in range(10)
    ]
    assert Counter(k for data in payloads("video-h264-headers-once") for k in kinds(data))[7] == 1
    assert all(kinds(data)[0] == 9 and 6 in kinds(data) for data in payloads("video-h264-aud-sei"))
    assert all(kinds(data).count(1) in (0, 3) for data in payloads("video-h264-slices"))
    assert kinds(payloads("video-h264-headers-apart")[0]) == [7, 8]
    assert 7 not in kinds(payloads("video-h264-mid-gop")[0])
    first = payloads("video-h264-avcc")[0]
    assert first[:5] == struct.pack(
        ">IB", len(encoders.nal_units(payloads("video-h264")[0])[0][1]), 0x67
    )


@given(st.lists(st.tuples(st.sampled_from([3, 4]), st.binary(min_size=1)), min_size=1))
def test_nal_units_return(units: list[tuple[int, bytes]]) -> None:
    safe = [(length, unit.replace(b"\0", b"\2")) for length, unit in units]
    assert encoders.nal_units(encoders.annexb(safe)) == safe


def test_av1_with_and_without_delimiters() -> None:
    for with_, without in zip(
        payloads("video-av1"), payloads("video-av1-no-delimiter"), strict=True
    ):
        assert with_ == b"\x12\0" + without
        assert not without.startswith(b"\x12\0")


@pytest.mark.parametrize("codec", ["h264", "h265", "av1", "vp9"])
def test_packets_that_are_missing(codec: str) -> None:
    whole = payloads(f"video-{codec}")
    assert payloads(f"video-{codec}-mid-gop") == whole[2:]
    assert payloads(f"video-{codec}-lost") == whole[:5] + whole[6:]


def test_ffmpeg_packets_tell_which_are_key_frames() -> None:
    flags = [record.values["flags"] for record in images(CODED["ffmpeg-libx264"]())]
    assert flags == [number % encoders.GOP == 0 for number in range(10)]
