"""Frames that are kept for later epochs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")

from mp4ds.torch import FrameDataset, FrameStream  # noqa: E402
from mp4ds.video.access import FrameReader  # noqa: E402
from test_torch import BOTH, FRAMES, LEFT, RIGHT, camera, loader, packed  # noqa: E402

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*fork.*:DeprecationWarning",
    "ignore:This process .* is multi-threaded:DeprecationWarning",
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera in colour and a grey one; not to be changed."""
    cameras = camera(LEFT, "rgb8", 0), camera(RIGHT, "mono8", 1)
    return packed(tmp_path_factory.mktemp("drive") / "0", *cameras)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of the frames that this process decodes."""
    found: list[int] = []
    usual = FrameReader.pictures_of

    def noted(self: FrameReader, numbers: Any, *rest: Any) -> Any:
        found.extend(numbers)
        return usual(self, numbers, *rest)

    monkeypatch.setattr(FrameReader, "pictures_of", noted)
    return found


def frames(dataset: Any) -> list[Any]:
    return [sample[topic] for sample in dataset for topic in dataset.topics]


def equal(one: list[Any], other: list[Any]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"resize": (32, 24), "channels_first": False, "offsets": (-1, 0)},
        {"dtype": "float32", "format": "gray"},
        {"dtype": "float32", "format": "native", "crop": (2, 4, 16, 8)},
    ],
)
@pytest.mark.parametrize("kind", [FrameDataset, FrameStream])
def test_later_epochs_decode_nothing(
    drive: Path, tmp_path: Path, decoded: list[int], kind: Any, options: dict[str, Any]
) -> None:
    if kind is FrameStream:
        options = {name: value for name, value in options.items() if name != "offsets"}
    usual = frames(kind(drive, topics=BOTH, **options))
    kept = kind(drive, topics=BOTH, cache=tmp_path / "kept", **options)
    assert equal(frames(kept), usual)
    decoded.clear()
    assert equal(frames(kept), usual)
    assert equal(frames(kind(drive, topics=BOTH, cache=tmp_path / "kept", **options)), usual)
    assert not decoded


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_share_a_cache(
    drive: Path, tmp_path: Path, decoded: list[int], method: str
) -> None:
    dataset = FrameDataset(drive, topics=BOTH, cache=tmp_path)
    for _ in loader(dataset, 2, method, batch_size=4):
        pass
    decoded.clear()
    assert equal(frames(dataset), frames(FrameDataset(drive, topics=BOTH)))
    assert len(decoded) == 2 * FRAMES  # without a cache, of both cameras


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def blank(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def halve(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize(("harm", "lost"), [(flip, 1), (blank, FRAMES), (halve, FRAMES // 2)])
def test_what_was_torn_is_decoded_again(
    drive: Path, tmp_path: Path, decoded: list[int], harm: Callable[[Path], None], lost: int
) -> None:
    dataset = FrameDataset(drive, topics=[LEFT], cache=tmp_path)
    usual = frames(dataset)
    (file,) = tmp_path.iterdir()
    harm(file)
    decoded.clear()
    assert equal(frames(dataset), usual)
    assert len(decoded) == lost
    assert equal(frames(dataset), usual)
    assert len(decoded) == lost


def test_a_cache_stays_within_its_bounds(drive: Path, tmp_path: Path, decoded: list[int]) -> None:
    usual = frames(FrameDataset(drive, topics=BOTH))
    most = sum(frame.nbytes for frame in usual) // 2
    dataset = FrameDataset(drive, topics=BOTH, cache=tmp_path, cache_bytes=most)
    assert equal(frames(dataset), usual)
    decoded.clear()
    assert equal(frames(dataset), usual)
    assert 0 < len(decoded) < 2 * FRAMES
    assert 0 < sum(file.stat().st_size for file in tmp_path.iterdir()) <= most


def test_frames_of_a_changed_recording_are_new(tmp_path: Path) -> None:
    first, second = (packed(tmp_path / str(seed), camera(LEFT, "rgb8", seed)) for seed in range(2))
    drive = tmp_path / "drive"
    for source in (first, second):
        shutil.copytree(source, drive)
        kept = FrameDataset(drive, cache=tmp_path / "kept")
        assert equal(frames(kept), frames(FrameDataset(source)))
        del kept
        shutil.rmtree(drive)


def test_a_full_disk_is_told_once(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwritev", full)
    dataset = FrameDataset(drive, topics=[LEFT], cache=tmp_path)
    with pytest.warns(UserWarning, match="No space left on device; frames are decoded") as told:
        found = frames(dataset)
    assert len(told) == 1
    assert equal(found, frames(FrameDataset(drive, topics=[LEFT])))
