"""Frames decoded from only what they are said to refer to, compared with a whole decode."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, partial
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.error import FFmpegError
from numpy.typing import NDArray

from coded_tools import DECODERS, mutations, refusal, scene
from encoders import Packet
from mp4ds.video import av1
from mp4ds.video.codecs import CODECS
from mp4ds.video.coded import CodedFrame, StreamParser
from mp4ds.video.pixels import ONE_THREAD

WIDTH, HEIGHT, FRAMES, GOP = 128, 96, 45, 20
QUIET = "log-level=error:pools=none:frame-threads=1"
Option = tuple[str, str]


@dataclass(frozen=True)
class Clip:
    """A video's packets in the order coded, and what the track says of the codec."""

    codec: str
    configuration: bytes
    packets: tuple[Packet, ...]


@dataclass(frozen=True)
class Recipe:
    """An encoder, its options and its pixel format."""

    codec: str
    encoder: str
    options: tuple[Option, ...] = ()
    pixel_format: str = "yuv420p"
    gop: int = GOP


def svt(preset: int, *parameters: str, gop: int = GOP) -> Recipe:
    options = (("preset", str(preset)), ("svtav1-params", ":".join(("lp=1", *parameters))))
    return Recipe("av1", "libsvtav1", options, gop=gop)


def x264(*parameters: str, pixel_format: str = "yuv420p", gop: int = GOP) -> Recipe:
    encoder = "libx264rgb" if pixel_format == "rgb24" else "libx264"
    options = (("preset", "medium"), ("x264-params", ":".join(parameters)))
    return Recipe("h264", encoder, options, pixel_format, gop)


def x265(*parameters: str) -> Recipe:
    options = (("preset", "fast"), ("x265-params", ":".join((QUIET, *parameters))))
    return Recipe("h265", "libx265", options)


RECIPES = {
    **{f"svt-{preset}": svt(preset) for preset in (4, 6, 8, 10)},
    **{
        f"svt-6-g{gop}-h{levels}": svt(6, f"hierarchical-levels={levels}", gop=gop)
        for gop, levels in ((10, 2), (30, 3), (45, 4), (40, 5))
    },
    **{f"svt-{preset}-low-delay": svt(preset, "pred-struct=1") for preset in (6, 8, 10)},
    "svt-low-delay-rtc": svt(10, "pred-struct=1", "rtc=1"),
    "svt-intra-only": svt(8, "irefresh-type=1"),
    "svt-overlays": svt(6, "enable-overlays=1"),
    "svt-grain": svt(8, "film-grain=20"),
    "svt-screen": svt(8, "scm=1"),
    "svt-tiles": svt(10, "tile-columns=1", "tile-rows=1"),
    "svt-super-resolution": svt(8, "superres-mode=2"),
    "svt-resized": svt(8, "resize-mode=2"),
    "svt-switch-frames": svt(10, "pred-struct=1", "sframe-dist=8", "sframe-mode=1", gop=45),
    **{
        f"x264-b{b}-{pyramid}-ref{ref}-w{weight}": x264(
            f"bframes={b}:b-adapt=0:b-pyramid={pyramid}:ref={ref}:weightp={weight}:keyint={GOP}"
        )
        for b, pyramid, ref, weight in (
            *((0, "none", 1, 0), (0, "none", 4, 2)),
            *((3, "none", 1, 1), (3, "none", 4, 2), (3, "normal", 4, 1)),
            *((7, "none", 4, 0), (7, "strict", 1, 2), (7, "normal", 4, 2)),
        )
    },
    "x264-slices": x264("bframes=2:slices=3:aud=1:repeat-headers=1"),
    "x264-temporal-direct": x264("bframes=3:direct=temporal:b-pyramid=normal"),
    "x264-lossless-gray": x264("bframes=0:qp=0", pixel_format="gray"),
    "x264-lossless-rgb": x264("bframes=0:qp=0", pixel_format="rgb24"),
    "x265-b0": x265("bframes=0:open-gop=0"),
    "x265-b4": x265("bframes=4:open-gop=0"),
    "x265-b4-pyramid-off": x265("bframes=4:b-pyramid=0:open-gop=0:b-adapt=0:repeat-headers=1"),
    "x265-b4-2-layers": x265("bframes=4:temporal-layers=2:open-gop=0"),
    "x265-b4-3-layers": x265("bframes=4:temporal-layers=3:open-gop=0:b-adapt=0"),
    "x265-leading": x265("bframes=4:open-gop=0:radl=2:scenecut=0:gop-lookahead=4"),
    "ffv1": Recipe("ffv1", "ffv1", (("level", "3"), ("slicecrc", "1"), ("context", "1"))),
    "ffv1-gray16": Recipe("ffv1", "ffv1", (("level", "3"),), "gray16le"),
    "ffv1-golomb": Recipe("ffv1", "ffv1", (("level", "3"), ("coder", "rice"))),
    "mjpeg": Recipe("mjpeg", "mjpeg", (), "yuvj420p"),
}
REFUSED = {
    "x264-open-gop": x264("open-gop=1:bframes=3:b-adapt=0:scenecut=0"),
    "x264-intra-refresh": x264("intra-refresh=1:bframes=0:scenecut=0"),
    "x264-interlaced": x264("interlaced=1:bframes=0"),
    "x265-open-gop": x265("bframes=4:open-gop=1:b-adapt=0:scenecut=0"),
}


def pictures() -> list[NDArray[np.uint8]]:
    """A wall moving past, a post that hides parts of it, flashes, and a cut."""
    made = []
    for number, pixels in enumerate(scene(FRAMES, WIDTH, HEIGHT)):
        shown = cv2.flip(pixels, 1) if number >= FRAMES - 12 else pixels.copy()
        x = 3 * number % WIDTH
        shown[:, x : x + 9] = (200, 30, 90)
        if number % 13 == 5:
            shown = cv2.addWeighted(shown, 0.5, np.full_like(shown, 255), 0.5, 0)
        made.append(shown)
    return made


@cache
def encoded_file(recipe: Recipe) -> bytes:
    """An mp4 of the pictures."""
    os.environ.setdefault("SVT_LOG", "0")
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        options = {"g": str(recipe.gop), **dict(recipe.options)}
        if recipe.encoder.startswith("libx26"):
            name = f"{recipe.codec.replace('h26', 'x26')}-params"
            options[name] += f":keyint={recipe.gop}"
        stream: Any = container.add_stream(recipe.encoder, rate=Fraction(30), options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, recipe.pixel_format
        stream.codec_context.thread_count = 1
        for number, pixels in enumerate(pictures()):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame = frame.reformat(format=recipe.pixel_format, **ONE_THREAD)
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return file.getvalue()


@cache
def encoded(recipe: Recipe) -> Clip:
    with av.open(io.BytesIO(encoded_file(recipe))) as container:
        stream: Any = container.streams.video[0]
        found = [packet for packet in container.demux(stream) if packet.size]
        # what the file says: ffmpeg's parser takes some other pictures for key frames, too
        keys = [entry.is_keyframe for entry in stream.index_entries]
        packets = [Packet(bytes(p), p.pts, key) for p, key in zip(found, keys, strict=True)]
        return Clip(recipe.codec, stream.codec_context.extradata or b"", tuple(packets))


def decoder(clip: Clip) -> Any:
    context: Any = av.CodecContext.create(DECODERS.get(clip.codec, clip.codec), "r")
    if clip.configuration:
        context.extradata = clip.configuration
    if clip.codec == "ffv1":
        context.width, context.height = WIDTH, HEIGHT
    native = {"err_detect": "explode"}  # so that nothing damaged is made up
    context.options = {"max_frame_delay": "1"} if clip.codec == "av1" else native
    context.thread_count = 1
    return context


def shown(clip: Clip, given: Sequence[tuple[bytes, int]]) -> dict[int, bytes]:
    """The samples of every frame that comes out, by time."""
    context = decoder(clip)
    frames = []
    for data, pts in given:
        packet = av.Packet(data)
        packet.pts = pts
        frames += context.decode(packet)
    frames += context.decode(None)
    assert not any(frame.is_corrupt for frame in frames)
    return {frame.pts: samples(frame) for frame in frames}


def samples(frame: Any) -> bytes:
    """All planes without the padding of their lines."""
    parts = []
    for plane in frame.planes:
        rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
        bits = frame.format.components[0].bits
        wide = {"rgb24": 3}.get(frame.format.name, 2 if bits > 8 else 1)
        parts.append(rows[:, : plane.width * wide].tobytes())
    return b"".join((frame.format.name.encode(), *parts))


def parser_of(clip: Clip) -> StreamParser:
    return CODECS[clip.codec].parser(clip.configuration)


def parsed(clip: Clip, first: int = 0) -> list[list[CodedFrame]]:
    """The coded frames of every packet from one on."""
    parser = parser_of(clip)
    return [parser.frames(packet.data, key=packet.is_key) for packet in clip.packets[first:]]


def chains(frames: list[list[CodedFrame]]) -> list[list[tuple[int, int, CodedFrame]]]:
    """For every packet what its shown frame needs and itself, in order: packet, part, frame."""
    every = [
        (number, part, frame)
        for number, found in enumerate(frames)
        for part, frame in enumerate(found)
    ]
    needed: list[list[tuple[int, int, CodedFrame]]] = [[] for _ in frames]
    for at, (number, _, frame) in enumerate(every):
        if not frame.shown:
            continue
        wanted, chosen = {at}, []
        for place in range(at, -1, -1):
            if place in wanted:
                chosen.append(every[place])
                wanted |= {place - distance for distance in every[place][2].references}
        assert min(wanted) >= 0
        needed[number] = chosen[::-1]
    return needed


def cut(clip: Clip, number: int, part: int, frame: CodedFrame) -> bytes:
    """A coded frame; a key frame with its sequence header."""
    data = clip.packets[number].data
    header, start, end = CODECS[clip.codec].parser.spans(data)[part]
    return data[start if frame.references else header : end]


def check(clip: Clip) -> int:
    """Decode the frame of each packet alone; how many coded frames were left out."""
    whole = shown(clip, [(packet.data, packet.number) for packet in clip.packets])
    frames = parsed(clip)
    left_out = 0
    for number, chain in enumerate(chains(frames)):
        assert sum(frame.shown for frame in frames[number]) == 1
        given = [(cut(clip, at, *which), clip.packets[at].number) for at, *which in chain]
        pts = clip.packets[number].number
        assert shown(clip, given)[pts] == whole[pts], f"packet {number}"
        first = max(n for n in range(number + 1) if clip.packets[n].is_key)
        assert chain[0][0] >= first
        left_out += sum(map(len, frames[first : number + 1])) - len(chain)
    return left_out


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", RECIPES)
def test_frames_decode_from_what_they_refer_to(name: str) -> None:
    recipe = RECIPES[name]
    clip = encoded(recipe)
    assert len(clip.packets) == FRAMES
    keys = [number for number, packet in enumerate(clip.packets) if packet.is_key]
    assert len(keys) == 1 if "intra-only" in name else len(keys) >= -(-FRAMES // recipe.gop)
    left_out = check(clip)
    hierarchical = recipe.codec == "av1" or "bframes=" in str(recipe.options)
    flat = any(part in str(recipe.options) for part in ("bframes=0", "pred-struct=1", "sframe"))
    assert flat or not hierarchical or left_out > 0


@pytest.mark.parametrize("name", REFUSED)
def test_what_reaches_across_key_packets_is_refused(name: str) -> None:
    clip = encoded(REFUSED[name])
    parser = parser_of(clip)
    reasons = [refusal(parser.frames, p.data, key=p.is_key) for p in clip.packets]
    first = next(number for number, reason in enumerate(reasons) if reason)
    keys = [number for number, packet in enumerate(clip.packets) if packet.is_key]
    following = next((number for number in keys if number > first), FRAMES)
    assert all(reasons[first:following])


# ---------------------------------------------------------------- NAL units


def with_length(unit: bytes) -> bytes:
    return len(unit).to_bytes(4, "big") + unit


def after_key(clip: Clip, data: bytes) -> str:
    """Why a packet is refused that follows the first."""
    parser = parser_of(clip)
    parser.frames(clip.packets[0].data, key=True)
    return refusal(parser.frames, data, key=False)


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("x264-slices", b"", "one picture"),
        ("x264-slices", with_length(b"\x22\x80\x80"), "partitions"),
        ("x264-slices", with_length(b"\x21\x80") + with_length(b"\x25\x00"), "one picture"),
        ("x264-slices", with_length(b"\x21\x80")[:-1], "length"),
        ("x264-slices", with_length(b"\x06\x05") * 600, "more than"),
        ("x265-b4", with_length(b"\x02\x09\x80"), "one picture"),
        ("x265-b4", with_length(b"\x2a\x01\x80"), "refer to what is before"),
        ("x265-b4", with_length(b"\x44\x01\xf0") + with_length(b"\x02\x01\x80"), "not shown"),
        ("x265-b4", with_length(b"\x42\x01"), "malformed"),
        ("ffv1", b"\0", "short"),
    ],
)
def test_not_a_picture(name: str, data: bytes, reason: str) -> None:
    assert reason in after_key(encoded(RECIPES[name]), data)


# ---------------------------------------------------------------- AV1

Bits = tuple[int, int]
"""A value and how many bits it has."""


def packed(*fields: Bits) -> bytes:
    """Fields after each other, then a one, and zeros up to a byte."""
    text = "".join(f"{value:0{count}b}" for value, count in fields if count) + "1"
    return int(text.ljust(-len(text) % 8 + len(text), "0"), 2).to_bytes(-(-len(text) // 8), "big")


def unit(kind: int, payload: bytes, extension: int | None = None) -> bytes:
    size, left = b"", len(payload)
    while left > 127:
        size, left = size + bytes([left & 127 | 128]), left >> 7
    head = bytes([kind << 3 | 2]) if extension is None else bytes([kind << 3 | 6, extension])
    return head + size + bytes([left]) + payload


def sequence(
    *,
    points: Sequence[int] = (0,),
    timing: Bits = (0, 1),
    after_point: tuple[Bits, ...] = (),
    ids: tuple[int, int] | None = None,
    tools: tuple[Bits, ...] = ((1, 1), (1, 1)),
    order: int = 7,
) -> bytes:
    """A sequence header OBU (5.5.1) of pictures of 16x16.

    Args:
        points: `operating_point_idc` of each.
        timing: `timing_info_present_flag` and what follows it.
        after_point: What follows each of the points.
        ids: `delta_frame_id_length_minus_2` and `additional_frame_id_length_minus_1`.
        tools: From `seq_choose_screen_content_tools` to before the bits of order hints.
        order: `OrderHintBits`, or 0.
    """
    fields: list[Bits] = [(0, 3), (0, 1), (0, 1), timing, (0, 1), (len(points) - 1, 5)]
    for point in points:
        fields += [(point, 12), (8, 5), (0, 1), *after_point]
    fields += [(3, 4), (3, 4), (15, 4), (15, 4)]
    fields += [(0, 1)] if ids is None else [(1, 1), (ids[0], 4), (ids[1], 3)]
    fields += [(0, 3), (0, 4), (order > 0, 1)]
    fields += [(0, 2)] if order else []
    fields += tools
    fields += [(order - 1, 3)] if order else []
    return unit(1, packed(*fields, (0, 8)))


SHOWN_KEY = unit(6, packed((0, 1), (0, 2), (1, 1), (0, 60)))


def inter(
    slots: Sequence[int],
    refresh: int,
    *,
    kind: int = 1,
    shown: bool = True,
    resilient: bool = False,
    screen: tuple[Bits, ...] = ((0, 1),),
    identity: tuple[int, int] = (0, 0),
    order: int = 7,
    short: bool = False,
) -> bytes:
    """An OBU with a frame header (5.9.2), as far as it is read, and tiles that are none."""
    fields: list[Bits] = [(0, 1), (kind, 2), (shown, 1)]
    fields += [] if shown else [(1, 1)]
    fields += [] if kind == 3 else [(resilient, 1)]
    fields += [(1, 1), *screen, (5, identity[0])]
    fields += [] if kind == 3 else [(0, 1)]
    fields += [(3, order)]
    fields += [] if resilient or kind in (2, 3) else [(7, 3)]
    fields += [] if kind == 3 else [(refresh, 8)]
    if kind == 2:
        return unit(6, packed(*fields, (0, 60)))
    fields += [(3, order)] * 8 if resilient or kind == 3 else []
    fields += [(short, 1)] if order else []
    fields += [(1, 3), (2, 3)] if short else []
    for slot in slots:
        fields += [] if short else [(slot, 3)]
        fields += [(4, identity[1])]
    return unit(6, packed(*fields, (0, 60)))


SEQUENCES: dict[str, tuple[bytes, dict[str, Any]]] = {
    "plain": (sequence(), {}),
    "no order": (sequence(order=0), {"order": 0}),
    "ids": (sequence(ids=(9, 2)), {"identity": (14, 11)}),
    "no screen content": (sequence(tools=((0, 1), (0, 1))), {"screen": ()}),
    "screen content": (sequence(tools=((0, 1), (1, 1), (1, 1))), {"screen": ((1, 1),)}),
    "whole motion": (sequence(tools=((1, 1), (0, 1), (1, 1))), {"screen": ((1, 1),)}),
    "some whole motion": (sequence(), {"screen": ((1, 1), (1, 1))}),
    "times": (sequence(timing=(1 << 66, 67)), {}),
    "temporal layers": (sequence(points=(0x103, 0x101)), {}),
    "everything": (
        sequence(ids=(13, 1), order=5, points=(0, 0)),
        {"identity": (17, 15), "order": 5, "screen": ((1, 1), (0, 1))},
    ),
}


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("configured", [True, False])
def test_av1_headers(name: str, configured: bool) -> None:
    """By the tables of the specification: frames fill slots and others name these."""
    head, told = SEQUENCES[name]
    frame = partial(inter, **told)
    parser = CODECS["av1"].parser(b"\x81\0\0\0" + head if configured else b"")
    first = SHOWN_KEY if configured else head + unit(5, b"\4\1") + SHOWN_KEY
    found = parser.frames(first, key=True)
    assert found == [CodedFrame((), shown=True)]
    ((header, _, end),) = parser.spans(first)
    assert (header, end) == (0, len(first))
    # frames 1 to 6 fill slots 1 to 6; slots 0 and 7 still hold the key frame
    for number in range(1, 7):
        body = frame([number - 1] * 7, 1 << number, shown=bool(number % 2))
        (only,) = parser.frames(unit(2, b"") + body, key=False)
        assert only == CodedFrame((1,), bool(number % 2))
        assert parser.spans(unit(2, b"") + body) == [(2, 2, 2 + len(body))]
    slots = (6, 5, 5, 3, 1, 1, 7)  # the seventh frame's
    both = frame(slots, 0, resilient=True) + unit(3, packed((1, 1), (2, 3)))
    seventh, existing = parser.frames(both, key=False)
    assert seventh.references == (1, 2, 4, 6, 7)
    assert (existing.references, existing.shown) == ((6,), True)
    assert [end for *_, end in parser.spans(both)] == [parser.spans(both)[1][1], len(both)]
    (intra,) = parser.frames(frame((), 0x21, kind=2), key=False)
    assert intra.references == (9,)  # the key frame: it is no place to begin
    (after,) = parser.frames(frame([0, 1, 2, 3, 4, 5, 6], 0), key=False)
    assert after.references == (1, 4, 6, 7, 8, 9)
    (switch,) = parser.frames(frame([7] * 7, 0, kind=3), key=False)
    assert switch.references == (11,)
    (last,) = parser.frames(frame([0, 1, 2, 3, 4, 5, 7], 0), key=False)
    assert last.references == (1,)


@pytest.mark.parametrize(
    ("head", "body", "reason"),
    [
        (sequence(points=(0x303,)), b"", "spatial layers"),
        (
            sequence(timing=((1 << 66 | 1) << 47, 114), after_point=((0, 1),)),
            b"",
            "times of a decoder",
        ),
        (sequence(), unit(6, b"\x30" + bytes(20), 0x08), "layers"),
        (sequence(points=(0x103, 0x101)), unit(6, b"\x30" + bytes(20), 0x40), "layers"),
        (sequence(), sequence(order=6) + inter([0] * 7, 0), "changes"),
        (sequence(), unit(4, b"\0"), "tiles without a frame"),
        (sequence(), unit(3, b"\x88") + unit(4, b"\0"), "tiles without a frame"),
        (sequence(), unit(3, inter([0] * 7, 0)[2:]), "whole picture"),
        (sequence(), unit(3, inter([0] * 7, 0)[2:]) + inter([0] * 7, 0), "frame without tiles"),
        (sequence(), unit(7, inter([0] * 7, 0)[2:]), "kind 7"),
        (sequence(), unit(8, b"\0"), "kind 8"),
        (sequence(), unit(5, b"\4\1"), "no whole picture"),
        (sequence(), unit(6, b"\x30"), "ends inside"),
        (sequence(), inter([0] * 7, 0)[:-1], "cut short"),
    ],
)
def test_av1_refused(head: bytes, body: bytes, reason: str) -> None:
    parser = CODECS["av1"].parser()
    found = refusal(parser.frames, head + SHOWN_KEY, key=True)
    found = found or refusal(parser.frames, body, key=False)
    assert reason in found
    assert refusal(parser.frames, inter([0] * 7, 0), key=False)
    assert not refusal(parser.frames, sequence() + SHOWN_KEY, key=True)
    assert not refusal(parser.frames, inter([0] * 7, 0), key=False)


def frame_of(packet: bytes) -> tuple[bytes, bytes, bytes]:
    """What is before the only frame OBU, its payload, and the packet without it."""
    (found,) = [obu for obu in av1.obus(packet) if obu.kind == 6]
    return packet[: found.start], packet[found.payload : found.end], packet[found.end :]


def decodes_to(clip: Clip, given: Sequence[bytes], wanted: bytes) -> bool:
    try:
        frames = shown(clip, [(data, number) for number, data in enumerate(given)])
    except FFmpegError:
        return False
    return frames.get(len(given) - 1) == wanted


def test_av1_headers_and_tiles_apart() -> None:
    """As encoders of graphics cards send them. Where a header ends is tried."""
    clip = encoded(RECIPES["svt-10-low-delay"])
    packets = [packet.data for packet in clip.packets[:5]]
    whole = shown(clip, [(data, number) for number, data in enumerate(packets)])
    apart: list[bytes] = []
    for number, data in enumerate(packets):
        before, payload, _ = frame_of(data)
        tried = (
            before + unit(3, payload[:length] + b"\x80") + unit(4, payload[length:])
            for length in range(4, 90)
        )
        apart.append(next(t for t in tried if decodes_to(clip, [*apart, t], whole[number])))
    split = replace(clip, packets=tuple(Packet(data, n, not n) for n, data in enumerate(apart)))
    check(split)
    for data in apart:
        ((header, _, end),) = CODECS["av1"].parser.spans(data)
        assert (header, end) == (0, len(data))


def hidden_key(clip: Clip, packet: bytes, slot: int) -> bytes:
    """A key frame that is shown made one that is not, kept in one slot."""
    before, payload, _ = frame_of(packet)
    (wanted,) = shown(clip, [(packet, 0)]).values()
    bits = f"{int.from_bytes(b'1' + payload, 'big'):b}"[6:]
    assert bits[:4] == "0001"
    screen = int(bits[5])
    place = 4 + 2 + screen + 1 + 7  # up to the order hint
    for length in range(4, 90):
        head = "000010" + bits[4:place] + f"{1 << slot:08b}" + bits[place : 8 * length]
        for size in (length + 1, length + 2):
            if int(head[8 * size :] or "0", 2):
                continue
            made = int(head[: 8 * size].ljust(8 * size, "0"), 2).to_bytes(size, "big")
            data = before + unit(6, made + payload[length:])
            if decodes_to(clip, [data, show(slot)], wanted):
                return data
    raise AssertionError("the header's end was not found")


def show(slot: int) -> bytes:
    return unit(3, packed((1, 1), (slot, 3)))


def test_av1_key_frames_shown_later() -> None:
    """Showing one fills all slots, as if it came then (7.21)."""
    clip = encoded(RECIPES["svt-10-low-delay"])
    packets = [
        replace(packet, is_key=packet.is_key and not n) for n, packet in enumerate(clip.packets)
    ]
    key = GOP
    assert clip.packets[key].is_key
    hidden = hidden_key(clip, packets[key].data, 7)
    packets[key - 1] = replace(packets[key - 1], data=packets[key - 1].data + hidden)
    packets[key] = replace(packets[key], data=show(7))
    packets = packets[: 2 * GOP]
    changed = replace(clip, packets=tuple(packets))
    check(changed)
    frames = parsed(changed)
    assert [len(found) for found in frames[key - 1 : key + 1]] == [2, 1]
    needed = {at for at, *_ in chains(frames)[key + 3]}
    assert {0, key - 1, key} <= needed <= {0, *range(key - 1, key + 4)}


# ---------------------------------------------------------------- damage


@pytest.mark.parametrize("name", ["svt-8", "x264-slices", "x265-b4-3-layers", "ffv1", "mjpeg"])
def test_damage_is_refused_or_read(name: str) -> None:
    clip = encoded(RECIPES[name])
    for packet in clip.packets[:8]:
        for data in mutations(packet.data, 200, head=100):
            parser = parser_of(clip)
            parser.frames(clip.packets[0].data, key=True)
            refusal(parser.frames, data, key=packet.is_key)  # and raises nothing else
            refusal(parser.frames, clip.packets[1].data, key=False)
    for data in mutations(clip.configuration or b"\0", 500):
        refusal(CODECS[clip.codec].parser, data)
