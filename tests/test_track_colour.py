"""Colours that only the track tells: a decoder without the container gives the same frames."""

from __future__ import annotations

import io
from contextlib import closing
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from conftest import real
from mp4ds.dataset.images import VideoImages
from mp4ds.dataset.topic import Topic
from mp4ds.video.access import FrameReader
from mp4ds.video.mp4 import sample_table_of
from test_references import FRAMES, HEIGHT, RECIPES, WIDTH, encoded_file

NAMES = ("x264-b0-none-ref4-w2", "x265-b0", "svt-8", "ffv1", "mjpeg")
BT709, BT601 = (1, 1, 1), (6, 6, 6)
Tags = tuple[int, int, str]


def tagged(data: bytes, colour: tuple[int, int, int], colour_range: int) -> bytes:
    """The packets of a video in a track that tells of colours."""
    file = io.BytesIO()
    with av.open(io.BytesIO(data)) as source, av.open(file, "w", format="mp4") as target:
        template = source.streams.video[0]
        stream: Any = target.add_stream_from_template(template, opaque=True)
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace = colour
        context.color_range = colour_range
        for packet in source.demux(template):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    return file.getvalue()


def tags(frame: Any) -> Tags:
    return frame.colorspace, frame.color_range, frame.format.name


class Tagged:
    """Gives the tags of frames in the place of pictures."""

    coded_size, is_view = (WIDTH, HEIGHT), False

    def make(self, frame: Any, number: int | None = None, *_: Any) -> Any:
        del number
        return tags(frame)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("colour_range", [1, 2])
@pytest.mark.parametrize("colour", [BT709, BT601])
@pytest.mark.parametrize("name", NAMES)
def test_decoders_know_what_the_track_says(
    name: str, colour: tuple[int, int, int], colour_range: int, tmp_path: Path
) -> None:
    recipe = RECIPES[name]
    path = tmp_path / "v.mp4"
    path.write_bytes(tagged(encoded_file(recipe), colour, colour_range))
    assert tuple(sample_table_of(path).entry.colour.values()) == (*colour, colour_range)
    with av.open(str(path)) as container:
        expected = [tags(frame) for frame in container.decode(video=0)]
    if name in ("ffv1", NAMES[0]):  # whose packets say nothing
        assert expected[0][:2] == (colour[2], colour_range)
    maker: Any = Tagged()
    if name != "mjpeg":  # which libjpeg decodes, whatever the track says
        reader = FrameReader(path, codec=recipe.codec, frames=FRAMES, maker=maker)
        with closing(reader):
            assert [found for _, found in reader.pictures_of(range(FRAMES))] == expected
            assert reader.seeking is None
    video = Topic([VideoImages(path)])
    every = [frame.data for frame in video]
    assert np.array_equal(video.read([7, 30]), [every[7], every[30]])
    video.close()


def test_a_real_one() -> None:
    path = real("video/bt709_full_range.mp4")
    colour = sample_table_of(path).entry.colour
    video = Topic([VideoImages(path)])
    every = [frame.data for frame in video]
    numbers = [len(every) - 1, 0, len(every) // 2]
    assert np.array_equal(video.read(numbers), [every[number] for number in numbers])
    video.close()
    assert tuple(colour.values()) == (1, 1, 1, 2)
