"""Which layout and codec are chosen for a stream, and that the estimate is near the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from compare import compare
from mp4ds.errors import OptionError
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import fit
from mp4ds.packing.options import PackOptions
from mp4ds.video.codecs import lossless_codecs
from mp4ds.video.encoder import Coding, VideoEncoder, bytes_per_frame, choose, encode_on_trial
from pictures import picture
from pixel_kinds import rounded
from round_trips import unpacked
from scenes import scene as source_scene
from sources import SOURCES

Pixels = NDArray[Any]


def chosen(samples: Sequence[Pixels], encoding: str, **options: Any) -> Coding:
    given = {"codec": None, "preset": None, "gop": 60, "threads": 1, **options}
    return choose(samples, ENCODINGS[encoding], **given)


def scene(encoding: str, frames: int = 6, width: int = 96, height: int = 66) -> list[Pixels]:
    rng = np.random.default_rng(1)
    width, height = rounded(ENCODINGS[encoding], width, height)
    return [
        np.ascontiguousarray(picture(encoding, frame=n, width=width, height=height, rng=rng))
        for n in range(frames)
    ]


def video_size(path: Path, samples: Sequence[Pixels], encoding: str, choice: Coding) -> int:
    layout = choice.layout
    pictures = [layout.to_picture(pixels) for pixels in samples]
    height, width = pictures[0][0].shape[:2]
    encoder = VideoEncoder(
        path, choice.recipe, picture_format=layout.pixel_format, width=width, height=height,
        gop=60, threads=1, rate=30.0,
    )  # fmt: skip
    for number, planes in enumerate(pictures):
        encoder.write(planes, number * 33_333)
    encoder.close()
    return path.stat().st_size


# ---------------------------------------------------------------- estimates


@pytest.mark.one_in(6)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_estimate_is_near_the_truth(encoding: str, tmp_path: Path) -> None:
    samples = scene(encoding, 24)
    choice = chosen(samples[:6], encoding)
    layout = choice.layout
    if any(map(layout.values.refuses, samples)):
        samples = [*samples[:6], *samples[5::-1]] * 2
    size = video_size(tmp_path / "v.mp4", samples, encoding, choice)
    assert 0.75 < 60 * choice.bytes_per_frame / (60 / 24 * size) < 1.25


# ---------------------------------------------------------------- choices


@pytest.mark.one_in(5)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_codec_that_was_asked_for(encoding: str) -> None:
    for codec in ["h264", "h265", "ffv1"]:
        samples = scene(encoding)
        able = {
            name
            for layout in ENCODINGS[encoding].exact
            for fitted in [fit(layout, ENCODINGS[encoding], samples)]
            if fitted is not None
            for name in lossless_codecs(fitted.pixel_format)
        }
        assert "ffv1" in able
        if codec in able:
            assert chosen(samples, encoding, codec=codec).recipe.codec == codec
            continue
        with pytest.raises(OptionError, match=f"codec {codec} has no lossless form for .*ffv1"):
            chosen(samples, encoding, codec=codec)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "uyvy", "bayer_rggb8", "nv12"])
def test_large_images_are_tried_in_part(encoding: str) -> None:
    """The estimate is for the whole."""
    samples = scene(encoding, 3, width=1602, height=1202)
    choice = chosen(samples, encoding)
    layout = choice.layout
    whole, *_ = encode_on_trial(
        [layout.to_picture(pixels) for pixels in samples],
        choice.recipe,
        picture_format=layout.pixel_format,
        threads=1,
    )
    assert choice.bytes_per_frame == pytest.approx(bytes_per_frame(whole, 60), rel=0.1)


@pytest.mark.parametrize(("codec", "frames"), [(None, 3), ("ffv1", 0)])
def test_the_next_plan_where_an_encoder_refuses(
    codec: str | None,
    frames: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The encoder may refuse, by its size, what it took of the middle of an image."""
    asked: list[str] = []

    plain = VideoEncoder._open_stream

    def refuses(self: VideoEncoder, *given: Any) -> None:
        asked.append(self.recipe.codec)
        if self.recipe.codec == asked[0]:
            raise ValueError
        plain(self, *given)

    monkeypatch.setattr(VideoEncoder, "_open_stream", refuses)
    paths = SOURCES["mcap-ros2-none"](tmp_path, source_scene("rgb8", frames=3))
    summary = mp4ds.pack(paths, tmp_path / "dataset", PackOptions(codec=codec))
    (topic,) = (topic for topic in summary.topics if topic.topic == "/cam/image_raw")
    assert (topic.frames, topic.messages) == (frames, 3)
    assert codec in (None, asked[0])
    refusal = {f"{codec} does not take pictures of 64x48": (3, 0)}
    assert topic.verbatim == ({} if frames else refusal)
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path, "mcap")) == []


# ---------------------------------------------------------------- purposes


@pytest.mark.parametrize("name", ["still", "moving"])
def test_for_training_there_are_as_many_key_frames_as_cost_little(name: str) -> None:
    samples = scene("mono8", width=320, height=240)
    if name == "still":
        samples = samples[:1] * len(samples)
    usual, training = (
        chosen(samples, "mono8", gop=10, purpose=purpose) for purpose in (None, "training")
    )
    assert training.bytes_per_frame <= 1.15 * usual.bytes_per_frame
    assert (training.gop < 10) == (name == "moving")


@pytest.mark.parametrize(
    ("encoding", "codec"), [("bayer_rggb8", "h264"), ("rgb8", "h264"), ("16UC1", "ffv1")]
)
def test_packing_at_speed(encoding: str, codec: str, tmp_path: Path) -> None:
    """Nothing is tried: parts of any length and rate get the same videos, which are exact."""
    found = []
    for number, made in enumerate((source_scene(encoding, frames=9), source_scene(encoding))):
        folder = tmp_path / str(number)
        folder.mkdir()
        paths = SOURCES["mcap-ros2-none"](folder, made)
        mp4ds.pack(paths, folder / "dataset", PackOptions(purpose="speed", gop=5))
        assert mp4ds.validate(folder / "dataset", deep=True) == []
        assert compare(paths, unpacked(folder, "mcap")) == []
        with mp4ds.open(folder / "dataset") as dataset:
            (video,) = (stream.sidecar.video for stream in dataset.streams)
        found.append(video.model_dump(exclude={"size", "sha256", "index"}))
    assert found[0] == found[1]
    assert (found[0]["codec"], found[0]["options"]["g"]) == (codec, "5")
    assert codec == "ffv1" or found[0]["options"]["preset"] == "ultrafast"


@pytest.mark.parametrize("size", [(70, 20), (20, 70), (320, 16)])
def test_views_of_narrow_images_end(size: tuple[int, int], tmp_path: Path) -> None:
    """SVT-AV1 with several threads waits forever on them."""
    made = source_scene("mono8", frames=3, width=size[0], height=size[1])
    paths = SOURCES["mcap-ros2-none"](tmp_path, made)
    mp4ds.pack(paths, tmp_path / "dataset", PackOptions(view="av1"))
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
