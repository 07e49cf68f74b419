"""Packets of video codecs: key frames, sizes, order, and what no mp4 carries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import pytest
from av.bitstream import BitStreamFilterContext

from coded_tools import (
    ENCODINGS,
    IN_ORDER,
    Encoding,
    encode,
    hide,
    mutations,
    refusal,
    superframe,
)
from conftest import real
from encoders import Packet
from mp4ds.errors import Refused
from mp4ds.video import av1, h264, h265
from mp4ds.video.codecs import CODECS, PACKET_CODECS
from mp4ds.video.coded import REORDERED, NoPicture, StreamParser, split_superframe
from mp4ds.video.h264 import H264, join_plain, split
from mp4ds.video.h265 import H265

VIDEO = [name for name in IN_ORDER if ENCODINGS[name].codec in ("h264", "h265", "av1", "vp9")]
UNITS = {"h264": H264, "h265": H265}
PARSE_SPS = {"h264": h264.parse_sps, "h265": h265.parse_sps}
START = b"\0\0\0\1"


def first_refused(codec: str, bodies: list[bytes]) -> int | None:
    parser = CODECS[codec].parser()
    for number, body in enumerate(bodies):
        if refusal(parser.picture, body):
            return number
    return None


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


def test_every_codec_is_tried() -> None:
    assert {ENCODINGS[name].codec for name in IN_ORDER} == set(PACKET_CODECS)


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


@pytest.mark.parametrize("name", ["h264-b", "h265-b"])
def test_reordering_that_is_allowed_but_not_done(name: str) -> None:
    """Past the wrap of the picture order count, over several key frames."""
    packets = encode(ENCODINGS[name], frames=150, gop=140, all_p=True)
    assert [packet.number for packet in packets] == list(range(150))
    assert first_refused(ENCODINGS[name].codec, [packet.data for packet in packets]) is None


@pytest.mark.parametrize("name", ["h264", "h264-b"])
def test_parameters_that_do_not_tell_of_reordering(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    packets = [packet.data for packet in encode(ENCODINGS[name], frames=40, gop=30)]
    expected = first_refused("h264", packets)
    monkeypatch.setattr(h264, "_vui_reorder", lambda reader: None)
    assert first_refused("h264", packets) == expected
    assert (expected is None) == ENCODINGS[name].in_order

    def cut_short(reader: object) -> None:
        raise Refused("cut short")

    monkeypatch.setattr(h264, "_vui_reorder", cut_short)
    assert first_refused("h264", packets) == expected


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


@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_parameters_sent_apart(codec: str) -> None:
    """They are kept in mind; the packet that holds nothing else is no frame."""
    kinds = (7, 8) if codec == "h264" else (32, 33, 34)
    body = encode(ENCODINGS[codec], frames=1)[0].data
    units = split(body)[0]
    is_parameter = [UNITS[codec].unit_type(unit) in kinds for unit in units]
    alone = join_plain([u for u, chosen in zip(units, is_parameter, strict=True) if chosen])
    parser = CODECS[codec].parser()
    assert "parameter sets were not sent" in refusal(parser.picture, without(codec, body, *kinds))
    assert parser.parameters == b""
    with pytest.raises(NoPicture):
        parser.picture(alone)
    assert parser.parameters == alone
    assert parser.picture(without(codec, body, *kinds)).keyframe
    assert parser.picture(body).keyframe


@pytest.mark.parametrize("codec", ["h264", "h265"])
@pytest.mark.parametrize("kind", [0, 1, 2])
def test_each_kind_of_parameters_is_needed(codec: str, kind: int) -> None:
    kinds = (7, 8, 8) if codec == "h264" else (32, 33, 34)
    body = encode(ENCODINGS[codec], frames=1)[0].data
    reason = refusal(CODECS[codec].parser().picture, without(codec, body, kinds[kind]))
    assert "parameter sets were not sent" in reason


@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_remarks_and_filler_do_not_matter(codec: str) -> None:
    filler = b"\x0c\xff\xff\x80" if codec == "h264" else b"\x4c\x01\xff\xff\x80"
    packets = encode(ENCODINGS[codec], frames=3)
    parser = CODECS[codec].parser()
    for packet in packets:
        body = packet.data + b"\0\0\1" + filler + b"\0\0"
        assert parser.picture(body).framing.endswith(" 3 +2")
        with pytest.raises(NoPicture):
            parser.picture(START + filler)  # which leaves no gap


@pytest.mark.parametrize("codec", ["h264", "h265", "av1"])
def test_two_pictures_in_one_packet(codec: str) -> None:
    packets = encode(ENCODINGS[codec], frames=3)
    parser = CODECS[codec].parser()
    parser.picture(packets[0].data)
    both = packets[1].data + packets[2].data.removeprefix(av1.DELIMITER)
    assert "more than one picture" in refusal(parser.picture, both)


def test_a_part_of_a_picture() -> None:
    packets = encode(ENCODINGS["h264-slices"], frames=2)
    parser = CODECS["h264"].parser()
    parser.picture(packets[0].data)
    slices = split(packets[1].data)[0]
    assert len(slices) > 2
    assert "part of one" in refusal(parser.picture, join_plain(slices[-2:]))


def test_fields_are_refused() -> None:
    interlaced = Encoding("h264", "libx264", {"bf": "0", "x264-params": "interlaced=1"})
    body = encode(interlaced, frames=1)[0].data
    sps = next(u for u in split(body)[0] if H264.unit_type(u) == h264.SPS)
    assert not h264.parse_sps(sps).frames_only
    parser = CODECS["h264"].parser()
    assert parser.picture(body).height == 48  # a whole picture, although fields could be coded
    units = split(body)[0]
    at = next(n for n, unit in enumerate(units) if H264.unit_type(unit) == h264.IDR)
    bits = bin(int.from_bytes(b"\1" + units[at], "big"))[3:]
    # first_mb 0, slice type, PPS 0, then frame_num of four bits and the flag
    place = 8 + 1 + 7 + 1 + h264.parse_sps(sps).frame_num_bits
    assert bits[9 : 9 + 7] == "0001000"  # slice type 7: I
    field = bits[:place] + "1" + bits[place + 1 :]
    units[at] = int(field, 2).to_bytes(len(units[at]), "big")
    assert "field" in refusal(CODECS["h264"].parser().picture, join_plain(units))


def test_a_picture_that_is_not_shown() -> None:
    packets = [packet.data for packet in encode(ENCODINGS["vp9"], frames=4, gop=9)]
    parser = CODECS["vp9"].parser()
    parser.picture(packets[0])
    with pytest.raises(NoPicture, match="shows no picture"):
        parser.picture(hide(packets[1]))
    both = superframe(packets[1], packets[2])
    assert list(split_superframe(memoryview(both))) == [hide(packets[1]), packets[2]]
    assert not parser.picture(both).keyframe
    assert parser.picture(packets[3]).width == 64
    several = bytearray(both)
    several[0] |= 2
    assert "more than one picture" in refusal(parser.picture, bytes(several))
    assert "superframe" in refusal(parser.picture, b"\x86" + both)


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


def test_a_key_frame_without_its_header() -> None:
    """Decoders cannot begin there, whatever the track says."""
    packets = [packet.data for packet in encode(ENCODINGS["av1"], frames=8)]
    bare = [packet.replace(av1.sequence_header(UNIT), b"") for packet in packets]
    parser = CODECS["av1"].parser()
    assert refusal(parser.picture, bare[0])
    assert refusal(parser.picture, av1.DELIMITER + av1.sequence_header(UNIT))
    assert refusal(parser.picture, bare[0])
    assert parser.picture(packets[0]).keyframe
    assert not any(parser.picture(packet).keyframe for packet in bare[1:])


# ---------------------------------------------------------------- VP9


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda body: b"", "empty"),
        (lambda body: b"\0" + body, "marker"),
        (lambda body: body[:1], "inside of a header"),
        (lambda body: body[:2] + b"\0" + body[3:], "sync code"),
        (lambda body: body + b"\xc9\0\0\0\0\xc9", "superframe"),
        (lambda body: bytes([body[0] | 0x30]) + body[1:], ""),
    ],
)
def test_what_is_no_vp9(change: Callable[[bytes], bytes], reason: str) -> None:
    body = encode(ENCODINGS["vp9"], frames=1)[0].data
    assert not refusal(CODECS["vp9"].parser().picture, body)
    refused = refusal(CODECS["vp9"].parser().picture, change(body))
    assert reason in refused
    assert refused


@pytest.mark.parametrize("name", ["vp9", "vp9-rgb", "av1", "h264", "h265"])
def test_damage_is_refused_or_read(name: str) -> None:
    packets = encode(ENCODINGS[name], frames=2)
    for packet in packets:
        for damaged in mutations(packet.data, 300, head=120):
            parser = CODECS[ENCODINGS[name].codec].parser()
            refusal(parser.picture, packets[0].data)
            refusal(parser.picture, damaged)  # and raises nothing else


@pytest.mark.parametrize("name", ["h264-hrd", "h264-matrix", "h264-10bit", "h265-gray12"])
def test_every_cut_of_parameters_is_refused_or_read(name: str) -> None:
    codec = ENCODINGS[name].codec
    units = split(encode(ENCODINGS[name], frames=1)[0].data)[0]
    sps = next(u for u in units if UNITS[codec].unit_type(u) in (h264.SPS, h265.SPS))
    whole = PARSE_SPS[codec](sps)
    assert (whole.width, whole.height) == (64, 48)
    assert whole.reorder == 0
    for length in range(1, 8):
        assert refusal(PARSE_SPS[codec], sps[:length])
    for damaged in mutations(sps, 400):
        refusal(PARSE_SPS[codec], damaged)
