"""Packets of video codecs: key frames, sizes, order, and what no mp4 carries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import pytest
from av.bitstream import BitStreamFilterContext

from coded_tools import (
    ENCODINGS,
    IN_ORDER,
    encode,
    mutations,
    refusal,
)
from conftest import real
from encoders import Packet
from mp4ds.video import av1
from mp4ds.video.codecs import CODECS
from mp4ds.video.coded import REORDERED, StreamParser
from mp4ds.video.h264 import H264, join_plain, split
from mp4ds.video.h265 import H265

VIDEO = [name for name in IN_ORDER if ENCODINGS[name].codec in ("h264", "h265", "av1")]
UNITS = {"h264": H264, "h265": H265}


def without(codec: str, body: bytes, *kinds: int) -> bytes:
    """A body without NAL units of some types."""
    units = split(body)[0]
    return join_plain([u for u in units if UNITS[codec].unit_type(u) not in kinds])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", IN_ORDER)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (66, 50), (322, 178)])
def test_streams_in_order(name: str, width: int, height: int) -> None:
    encoding = ENCODINGS[name]
    packets = encode(encoding, frames=11, width=width, height=height)
    parser = CODECS[encoding.codec].parser()
    for packet in packets:
        picture = parser.picture(memoryview(packet.data))
        assert (picture.width, picture.height) == (width, height)
        assert picture.keyframe == (packet.is_key or encoding.codec == "mjpeg")


@pytest.mark.parametrize("name", [name for name in ENCODINGS if name not in IN_ORDER])
def test_pictures_out_of_order(name: str) -> None:
    """All are refused from the first that is sent after one shown later."""
    encoding = ENCODINGS[name]
    packets = encode(encoding, frames=12, gop=12)
    parser = CODECS[encoding.codec].parser()
    reasons = [refusal(parser.picture, packet.data) for packet in packets]
    times = [packet.number for packet in packets]
    first = next(n for n in range(1, len(times)) if times[n] < times[n - 1])
    assert reasons[:first] == [""] * first
    assert set(reasons[first:]) == {REORDERED}


REAL = {
    "bt709_full_range.mp4": "h264",
    "carnd_solidWhiteRight.mp4": "h264",
    "decord_rotated90.mov": "h264",
    "h264_10bits.mp4": "h264",
    "intel_car-detection.mp4": "h264",
    "lerobot_aloha_insertion_human_yuv444.mp4": "h264",
    "nasa_13013.mp4": "h264",
    "sam2_02_cups.mp4": "h264",
    "var_fps_video.mp4": "h264",
    "h265_video.mp4": "h265",
    "av1_video.mkv": "av1",
    "lerobot_follower_wrist_ep4_1frame_av1.mp4": "av1",
}


def packets_of(path: Path, codec: str) -> tuple[list[Packet], tuple[int, int]]:
    """The packets of a real video as they are sent without a container."""
    packets: list[Packet] = []
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context: Any = stream.codec_context
        names = {"h264": "h264_mp4toannexb", "h265": "hevc_mp4toannexb"}
        unpack = BitStreamFilterContext(names[codec], stream) if codec in names else None
        for packet in container.demux(stream):
            found: list[Any] = [packet] if packet.size else []
            if unpack:
                found = list(unpack.filter(packet if packet.size else None))
            packets += [Packet(bytes(p), p.pts, p.is_keyframe) for p in found]
        return packets, (context.width, context.height)


@pytest.mark.parametrize("name", REAL)
def test_real_videos(name: str) -> None:
    """Refused exactly from the first picture that is out of order."""
    packets, size = packets_of(real(f"video/{name}"), REAL[name])
    times = [packet.number for packet in packets]
    expected = next((n for n in range(1, len(times)) if times[n] < times[n - 1]), len(times))
    parser = CODECS[REAL[name]].parser()
    for number, packet in enumerate(packets):
        if number >= expected:
            assert refusal(parser.picture, packet.data) == REORDERED
            continue
        picture = parser.picture(packet.data)
        assert (picture.width, picture.height) == size
        assert picture.keyframe == packet.is_key


# ---------------------------------------------------------------- beginnings and gaps


@pytest.mark.parametrize("name", VIDEO)
def test_after_a_gap_the_next_key_frame_is_awaited(name: str) -> None:
    codec = ENCODINGS[name].codec
    packets = encode(ENCODINGS[name])
    second = next(n for n, packet in enumerate(packets) if n and packet.is_key)
    assert second > 2
    for lose in (StreamParser.leave_out, lambda parser: refusal(parser.picture, b"\xff junk")):
        parser = CODECS[codec].parser()
        parser.picture(packets[0].data)
        lose(parser)
        for packet in packets[1:second]:
            assert "pictures before it" in refusal(parser.picture, packet.data)
        assert parser.picture(packets[second].data).keyframe


@pytest.mark.parametrize("codec", ["h264", "h265", "av1"])
def test_two_pictures_in_one_packet(codec: str) -> None:
    packets = encode(ENCODINGS[codec], frames=3)
    parser = CODECS[codec].parser()
    parser.picture(packets[0].data)
    both = packets[1].data + packets[2].data.removeprefix(av1.DELIMITER)
    assert "more than one picture" in refusal(parser.picture, both)


# ---------------------------------------------------------------- AV1


def obu(kind: int, payload: bytes = b"", flags: int = 2) -> bytes:
    return bytes([kind << 3 | flags, len(payload)]) + payload


UNIT = encode(ENCODINGS["av1"], frames=1)[0].data


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (UNIT + av1.DELIMITER, "temporal delimiter inside"),
        (av1.DELIMITER + UNIT, "temporal delimiter inside"),
        (UNIT + obu(15, b"\0\0"), "padding"),
        (UNIT + obu(8, b"\0\0"), "tile list"),
        (UNIT + obu(7, b"\0\0"), "redundant"),
        (UNIT + obu(9, b"\0\0"), "unknown kind 9"),
        (UNIT + obu(0, b"\0\0"), "unknown kind 0"),
        (UNIT + obu(5, b"\0\0", flags=0), "size"),
        (UNIT + b"\xff\xff", "reserved"),
        (UNIT + b"\x2b\0", "reserved"),
        (UNIT[:-1], "cut short"),
        (UNIT + b"\x2a", "cut short"),
        (UNIT + b"\x2a" + b"\xff" * 9, "cut short"),
        (UNIT + obu(5) * 5000, "more than"),
        (b"", "no picture"),
        (av1.DELIMITER, "no picture"),
        (av1.DELIMITER + av1.sequence_header(UNIT), "no picture"),
        (av1.DELIMITER + obu(6, b"\x10"), "sequence header was not sent"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_no_mp4_keeps_of_av1(body: bytes, reason: str) -> None:
    assert reason in refusal(CODECS["av1"].parser().picture, body)


@pytest.mark.parametrize("name", ["av1", "h264", "h265"])
def test_damage_is_refused_or_read(name: str) -> None:
    packets = encode(ENCODINGS[name], frames=2)
    for packet in packets:
        for damaged in mutations(packet.data, 300, head=120):
            parser = CODECS[ENCODINGS[name].codec].parser()
            refusal(parser.picture, packets[0].data)
            refusal(parser.picture, damaged)  # and raises nothing else
