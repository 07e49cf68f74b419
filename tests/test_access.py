"""Frames by number, of which only the chains are decoded: the same as of a whole decode."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import av
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mp4ds.dataset.stream import Layer, Stream
from mp4ds.errors import VideoError
from mp4ds.video.access import FrameReader
from mp4ds.video.decoder import VideoDecoder, read_video_file
from test_references import (
    FRAMES,
    HEIGHT,
    RECIPES,
    WIDTH,
    Recipe,
    encoded_file,
    samples,
)

ALIKE = ("svt-super-resolution", "svt-resized")  # have frames of several sizes


class Samples:
    """Gives the samples of frames in the place of pictures."""

    coded_size = WIDTH, HEIGHT
    is_view = False

    def make(self, frame: Any, number: int | None = None, *_: Any) -> Any:
        assert number is not None
        return samples(frame)


def opened(path: Path, recipe: Recipe) -> FrameReader:
    maker: Any = Samples()
    return FrameReader(path, codec=recipe.codec, frames=FRAMES, maker=maker)


def written(folder: Path, recipe: Recipe) -> Path:
    path = folder / "v.mp4"
    path.write_bytes(encoded_file(recipe))
    return path


def whole(path: Path) -> list[bytes]:
    """The samples of all frames, decoded one after the other."""
    with av.open(str(path)) as container:
        return [samples(frame) for frame in container.decode(video=0)]


def patterns(count: int) -> Iterator[list[int]]:
    """What users ask for, one after the other: single frames, windows, batches, all."""
    rng = random.Random(3)
    yield from ([rng.randrange(count)] for _ in range(12))
    yield from ([number] for number in range(8, 20))
    for _ in range(6):
        first = rng.randrange(count - 5)
        yield list(range(first, first + 5))
        yield sorted(rng.sample(range(count), 9))
    yield list(range(count))
    yield [count - 1]
    yield [0]


# JPEG files are given as libjpeg decodes them, and not as PyAV does: see test_republish.py
@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", [name for name in RECIPES if name not in (*ALIKE, "mjpeg")])
def test_it_is_the_same_frame(name: str, tmp_path: Path) -> None:
    recipe = RECIPES[name]
    path = written(tmp_path, recipe)
    expected = whole(path)
    assert len(expected) == FRAMES
    with closing(opened(path, recipe)) as access:
        for numbers in patterns(FRAMES):
            found = list(access.pictures_of(numbers))
            assert [number for number, _ in found] == numbers
            for number, picture in found:
                assert picture == expected[number], (numbers, number)
        assert access.seeking is None


def test_frames_smaller_than_their_sequence_header_says(tmp_path: Path) -> None:
    path = written(tmp_path, RECIPES["svt-switch-frames"])
    file = read_video_file(path)
    assert file.size == (WIDTH, HEIGHT)
    maker: Any = Samples()
    with VideoDecoder(path, codec="av1", frames=FRAMES, maker=maker, file=file) as decoder:
        assert [picture for _, picture in decoder.pictures_at(range(FRAMES))] == whole(path)


@settings(deadline=None, max_examples=60)
@given(
    requests=st.lists(st.sets(st.integers(0, FRAMES - 1), min_size=1), max_size=6), data=st.data()
)
@pytest.mark.parametrize("name", ["svt-6", "x264-b3-normal-ref4-w1", "x264-lossless-gray"])
def test_any_requests(
    name: str, requests: list[set[int]], data: Any, tmp_path_factory: Any
) -> None:
    recipe = RECIPES[name]
    path = written(tmp_path_factory.mktemp("any"), recipe)
    expected = whole(path)
    with closing(opened(path, recipe)) as access:
        for numbers in map(sorted, requests):
            taken = data.draw(st.integers(0, len(numbers)))  # some are left off in the middle
            pictures = access.pictures_of(numbers)
            for number in numbers[:taken]:
                assert next(pictures) == (number, expected[number])
        assert access.seeking is None


def test_a_file_that_was_cut_short_meanwhile(tmp_path: Path) -> None:
    recipe = RECIPES["svt-8"]
    path = written(tmp_path, recipe)
    access = opened(path, recipe)
    with path.open("r+b") as file:
        file.truncate(int(access.table.places[21]))
    with pytest.raises(VideoError, match=r"frame 21 is cut off"):
        list(access.pictures_of([25]))
    assert [number for number, _ in access.pictures_of([5])] == [5]
    access.close()


@pytest.mark.parametrize("layer", ["exact", "view"])
def test_a_view_with_film_grain(layer: Layer) -> None:
    path = Path(__file__).parents[1] / "conformance/cases/sidecars/invalid/view-grain.yaml"
    access = Stream(path, layer=layer).open_reader()
    with closing(access), pytest.raises(VideoError, match="film grain"):
        list(access.pictures_of([1]))


def test_it_counts_the_frames(tmp_path: Path) -> None:
    maker: Any = Samples()
    reader = FrameReader(written(tmp_path, RECIPES["svt-8"]), codec="av1", frames=3, maker=maker)
    with closing(reader), pytest.raises(VideoError, match=rf"has {FRAMES} frames, not 3"):
        list(reader.pictures_of([0]))
