"""Packed in parts, a recording becomes what it becomes in one pass, but for more key frames."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import mp4ds
from coded_scenes import CODED
from compare import compare
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from in_parts import InlineExecutor, facts, leftovers, use
from mp4ds.packing.options import PackOptions
from pictures import ENCODINGS, picture
from round_trips import own_target, unpacked
from scenes import Scene
from sources import SOURCES, TRAITS, odd_scene, scene

TOPIC = "/cam/image_raw"
INDEXED = [
    *("bag-none", "bag-lz4", "bag-bz2", "mcap-ros1-zstd", "mcap-ros2-lz4", "mcap-ros2-none"),
    *("rosbag2-mcap-v9", "rosbag2-mcap-split"),
]


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> InlineExecutor:
    inline = InlineExecutor()
    use(monkeypatch, inline)
    return inline


def compare_packs(
    folder: Path,
    source: str,
    recorded: Scene,
    executor: InlineExecutor,
    **options: Any,
) -> None:
    paths = SOURCES[source](folder / "source", recorded)
    whole = mp4ds.pack(paths, folder / "whole", PackOptions(**options))
    assert executor.ran == []
    parts = mp4ds.pack(paths, folder / "dataset", PackOptions(window=3, **options))
    assert len([name for name in executor.ran if not name.startswith("source")]) > 1
    assert mp4ds.validate(folder / "dataset", deep=True) == []
    assert facts(folder / "dataset") == facts(folder / "whole")
    assert leftovers(folder) == []
    assert [(t.topic, t.messages, t.frames, t.raw_bytes, t.verbatim) for t in parts.topics] == [
        (t.topic, t.messages, t.frames, t.raw_bytes, t.verbatim) for t in whole.topics
    ]
    assert (parts.left_out, parts.skipped) == (whole.left_out, whole.skipped)
    assert compare(paths, unpacked(folder, own_target(source))) == []


@pytest.mark.one_in(12)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding(encoding: str, tmp_path: Path, executor: InlineExecutor) -> None:
    source = INDEXED[ENCODINGS.index(encoding) % 3]
    recorded = scene(encoding, frames=10, width=66, height=46)
    compare_packs(tmp_path, source, recorded, executor)


OTHERS: dict[str, tuple[Callable[[], Scene], str]] = {
    **{name: (partial(scene, "bayer_gbrg8", frames=10), name) for name in SOURCES},
    **{
        f"{name}-{source}": (CODED[name], source)
        for name in CODED
        for source in ("bag-none", "mcap-ros2-zstd")
    },
    **{f"odd-{trait}": (partial(odd_scene, trait), "mcap-ros2-zstd") for trait in TRAITS},
    **{
        f"foxglove-{name}-{source}": (FOXGLOVE[name], source)
        for name in ("raw-rgb8", "raw-padded", "jpeg-cut-one", "video-h264-mid-gop")
        for source in list(FOXGLOVE_SOURCES)[::2]
    },
}


@pytest.mark.one_in(24)
@pytest.mark.parametrize("name", OTHERS)
def test_every_source_and_message(name: str, tmp_path: Path, executor: InlineExecutor) -> None:
    recorded, source = OTHERS[name]
    paths = (SOURCES | FOXGLOVE_SOURCES)[source](tmp_path / "source", recorded())
    mp4ds.pack(paths, tmp_path / "dataset", PackOptions(window=3))
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    to = "mcap" if source in FOXGLOVE_SOURCES else own_target(source)
    assert compare(paths, unpacked(tmp_path, to)) == []
    assert leftovers(tmp_path) == []


@pytest.mark.one_in(2)
@pytest.mark.parametrize("codec", ["av1", "av1-10bit", "h264", "h265"])
def test_a_lossy_profile(codec: str, tmp_path: Path, executor: InlineExecutor) -> None:
    """The parts are decoded alike; each begins with a key frame, and nothing else differs."""
    options = {"quality": "crf=12", "codec": codec}
    recorded = scene("rgb8", frames=10, width=96, height=64, noisy=False)
    paths = SOURCES["bag-none"](tmp_path / "source", recorded)
    mp4ds.pack(paths, tmp_path / "dataset", PackOptions(window=3, **options))
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path, "bag"), ignore_pixels=[TOPIC]) == []
    with mp4ds.open(tmp_path / "dataset") as dataset:
        (stream,) = dataset
        assert len(stream) == 10
        error = [
            np.abs(
                frame.data.astype(int) - picture("rgb8", frame=n, width=96, height=64, rng=None)
            ).mean()
            for n, frame in enumerate(stream)
        ]
    assert max(error) < 12


def test_channels_that_cannot_be_told_apart(tmp_path: Path, executor: InlineExecutor) -> None:
    """Two of the same topic, type and metadata are one: its messages are counted together."""
    (source,) = SOURCES["mcap-ros2-zstd"](tmp_path / "source", scene("mono8", frames=11))
    path = tmp_path / "source" / "twice.mcap"
    with source.open("rb") as read, path.open("wb") as write:
        writer = Writer(write, chunk_size=20_000)
        writer.start("ros2", "")
        ids: dict[tuple[str, int], int] = {}
        for number, (schema, channel, message) in enumerate(make_reader(read).iter_messages()):
            assert schema is not None
            key = (channel.topic, number // 3 % 2)
            if key not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[key] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            writer.add_message(
                ids[key], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()  # type: ignore[no-untyped-call]
    assert len(ids) > len({topic for topic, _ in ids})
    mp4ds.pack(path, tmp_path / "whole")
    mp4ds.unpack(tmp_path / "whole", "mcap", tmp_path / "whole.mcap")
    assert compare([path], tmp_path / "whole.mcap") == []
    mp4ds.pack(path, tmp_path / "dataset", PackOptions(window=2))
    assert len(executor.ran) > 3
    assert facts(tmp_path / "dataset") == facts(tmp_path / "whole")
    assert compare([path], unpacked(tmp_path, "mcap")) == []
