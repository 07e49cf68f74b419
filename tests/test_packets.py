"""Packets into mp4 files and back: every byte, and files that play."""

from __future__ import annotations

from array import array
from pathlib import Path

import av
import pytest

from coded_tools import (
    ENCODINGS,
    HEIGHT,
    IN_ORDER,
    WIDTH,
    decodes,
    encode,
    jpeg,
    refusal,
    scene,
)
from mp4ds.errors import VideoError
from mp4ds.video.codecs import CODECS
from mp4ds.video.coded import CodedPicture
from mp4ds.video.h264 import join_plain, split
from mp4ds.video.packets import PacketReader, PacketWriter

STEP = 33_333
SIZE = (WIDTH, HEIGHT)


def write(
    path: Path, codec: str, bodies: list[bytes], ticks: list[int] | None = None
) -> list[CodedPicture]:
    """Write bodies as a topic would be; returns what is known of them."""
    parser = CODECS[codec].parser()
    pictures = [parser.picture(body) for body in bodies]
    first = pictures[0]
    with PacketWriter(
        path, codec, width=first.width, height=first.height, parameters=parser.parameters, rate=30.0
    ) as writer:
        for number, (body, picture) in enumerate(zip(bodies, pictures, strict=True)):
            tick = ticks[number] if ticks else number * STEP
            writer.write(memoryview(body), tick, keyframe=picture.keyframe)
    assert writer.frames == len(bodies)
    return pictures


def read(path: Path, codec: str, pictures: list[CodedPicture]) -> list[bytes]:
    with PacketReader(path, codec=codec, frames=len(pictures)) as reader:
        return [
            CODECS[codec].parser.body(packet, picture.framing)
            for packet, picture in zip(reader.packets(), pictures, strict=True)
        ]


def check(path: Path, codec: str, bodies: list[bytes]) -> None:
    """Write, read, and decode with a decoder that knows nothing of us."""
    pictures = write(path, codec, bodies)
    assert read(path, codec, pictures) == bodies
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    assert [frame.pts for frame in frames] == [number * STEP for number in range(len(bodies))]
    assert not any(frame.is_corrupt for frame in frames)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", IN_ORDER)
def test_packets_come_back(name: str, tmp_path: Path) -> None:
    codec = ENCODINGS[name].codec
    packets = encode(ENCODINGS[name])
    check(tmp_path / "a.mp4", codec, [packet.data for packet in packets])
    with PacketReader(tmp_path / "a.mp4", codec=codec, coded_size=SIZE) as reader:
        assert list(reader.keyframes) == [packet.is_key or codec == "mjpeg" for packet in packets]
        assert reader.ticks == array("q", [number * STEP for number in range(len(packets))])
        everything = list(reader.packets())
        for index in (5, 0, len(packets) - 1, 5):
            assert reader.packet(index) == everything[index]


# ---------------------------------------------------------------- framing


@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_parameters_that_were_sent_before(codec: str, tmp_path: Path) -> None:
    """The track's header holds them, so that the file plays."""
    parser = CODECS[codec].parser()
    kinds = parser.parameter_kinds
    whole = [packet.data for packet in encode(ENCODINGS[codec], frames=8)]
    units = [split(body)[0] for body in whole]
    alone = join_plain([u for u in units[0] if parser.unit_type(u) in kinds])
    bodies = [join_plain([u for u in body if parser.unit_type(u) not in kinds]) for body in units]
    assert refusal(parser.picture, bodies[0])
    assert refusal(parser.picture, alone)
    pictures = [parser.picture(body) for body in bodies]
    path = tmp_path / "a.mp4"
    with PacketWriter(
        path, codec, width=WIDTH, height=HEIGHT, parameters=parser.parameters
    ) as writer:
        for number, (body, picture) in enumerate(zip(bodies, pictures, strict=True)):
            writer.write(body, number * STEP, keyframe=picture.keyframe)
    assert read(path, codec, pictures) == bodies
    with av.open(str(path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 8
    key = next(n for n, picture in enumerate(pictures) if n and picture.keyframe)
    assert decodes(codec, standing_alone(path, codec)[key:]) == 8 - key


# ---------------------------------------------------------------- refusals and faults


@pytest.mark.parametrize("fault", ["tick", "size", "content"])
def test_what_the_index_says_is_compared(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = PacketWriter(tmp_path / "a.mp4", "mjpeg", width=WIDTH, height=HEIGHT)
    for number, picture in enumerate(scene(3)):
        writer.write(jpeg(picture), number * STEP, keyframe=True)
    if fault == "content":
        whole = PacketReader.packet
        monkeypatch.setattr(
            PacketReader, "packet", lambda self, index: whole(self, index)[:-1] + b"\0"
        )
    else:
        column = getattr(writer._written, f"{fault}s")
        column[1] += 1
    with pytest.raises(VideoError, match="as written"):
        writer.close()


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "a.mp4"
    write(path, "mjpeg", [jpeg(picture) for picture in scene(5)])
    return path


# ---------------------------------------------------------------- standing alone


def standing_alone(path: Path, codec: str) -> list[bytes]:
    with PacketReader(path, codec=codec) as packets:
        return [packets.stand_alone(index) for index in range(len(packets))]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", IN_ORDER)
def test_packets_stand_alone(name: str, tmp_path: Path) -> None:
    codec, path = ENCODINGS[name].codec, tmp_path / "a.mp4"
    packets = encode(ENCODINGS[name])
    write(path, codec, [packet.data for packet in packets])
    given = standing_alone(path, codec)
    keys = [number for number, packet in enumerate(packets) if packet.is_key]
    for key in keys:
        assert decodes(codec, given[key:]) == len(packets) - key
    parser = CODECS[codec].parser()
    assert [parser.picture(body).keyframe for body in given] == [
        packet.is_key or codec == "mjpeg" for packet in packets
    ]
