"""Datasets on the Hugging Face Hub: read where they are by hf://."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import mp4ds
from commands import program
from hub_server import REPOSITORY, Hub, hub_server
from mp4ds.plugins.demo import demo

HOME = f"hf://datasets/{REPOSITORY}"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two datasets, as it is pushed."""
    folder = tmp_path_factory.mktemp("hub")
    (folder / "drives").mkdir()
    for name, seconds in (("first", 0.6), ("second", 0.4)):
        demo(folder / f"{name}.bag", seconds=seconds)
        options = mp4ds.PackOptions(quality="visual" if name == "second" else "lossless")
        mp4ds.pack(folder / f"{name}.bag", folder / "drives" / name, options)
    return folder / "drives"


@pytest.fixture
def hub(drives: Path) -> Iterator[Hub]:
    pytest.importorskip("huggingface_hub")
    with hub_server(drives) as running:
        yield running


def run(hub: Hub, *words: str, folder: Path) -> str:
    """What a program prints that takes the stand-in for the hub."""
    told = {"HF_ENDPOINT": hub.url, "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HOME": str(folder)}
    return program(*words, cwd=folder, env=told).out


def test_frames_are_fetched_by_ranges(hub: Hub, drives: Path, tmp_path: Path) -> None:
    code = f"""
import mp4ds, zlib
with mp4ds.open("{HOME}/first") as dataset:
    stream = dataset["/left/image_raw"]
    print(len(stream), stream.stamps[4], zlib.crc32(stream.read([4, 2]).tobytes()))
    print(zlib.crc32(stream[0].data.tobytes()), stream[0].intrinsics.k[0])
"""
    remote = run(hub, "-c", code, folder=tmp_path)
    assert remote == run(hub, "-c", code.replace(HOME, str(drives)), folder=tmp_path)
    view, video = "first/left_image_raw.mp4", "first/left_image_raw.exact.mp4"
    fetched = sum(count for name, count in hub.sent if name == video)
    assert 0 < fetched < (drives / video).stat().st_size
    videos = {name for name, _ in hub.sent if name.endswith(".mp4")}
    assert videos == {view, video}
    hub.sent.clear()
    run(hub, "-c", code.replace('first")', 'first", layer="view")'), folder=tmp_path)
    assert {name for name, _ in hub.sent if name.endswith(".mp4")} == {view}


@pytest.mark.slow
def test_commands_take_it(hub: Hub, drives: Path, tmp_path: Path) -> None:
    commands = [
        ["info", HOME, "--json"],
        ["validate", f"{HOME}@main/first", "--deep"],
        ["unpack", f"{HOME}/first", "--to", "bag", "-o", "again.bag"],
    ]
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from commands import call
for words in {commands!r}:
    done = call(*words)
    assert done.code == 0, done
    print(done.out, end="\\0")
"""
    listed, said, _ = run(hub, "-c", code, folder=tmp_path).split("\0")[:3]
    assert [Path(item["path"]).name for item in json.loads(listed)] == ["first", "second"]
    assert "no problem" in said
    local = mp4ds.unpack(drives / "first", "bag", tmp_path / "local.bag")
    assert (tmp_path / "again.bag").read_bytes() == Path(local.output).read_bytes()


def test_a_repository_that_is_not_there_is_a_sentence(hub: Hub, tmp_path: Path) -> None:
    code = (
        "import mp4ds\n"
        "for name in ('someone/nothing/first', 'someone/drives/third'):\n"
        "    try:\n"
        "        mp4ds.open(f'hf://datasets/{name}')\n"
        "    except mp4ds.SourceNotFoundError as error:\n"
        "        print(error)\n"
    )
    lines = run(hub, "-c", code, folder=tmp_path).splitlines()
    assert lines == [
        "hf://datasets/someone/nothing/first: no such file or folder. Check the path.",
        "hf://datasets/someone/drives/third: no such file or folder. Check the path.",
    ]
