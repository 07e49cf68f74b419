"""What sidecars tell of references: the chains that the packets tell, and no others are read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import closing
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mp4ds
from in_parts import InlineExecutor, use
from mp4ds import yamlio
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.errors import FormatError, VideoError
from mp4ds.format.models import References, video_facts
from mp4ds.format.sidecars import load_stream
from mp4ds.video.access import (
    Chains,
    Structures,
    digest_video,
    packets_of_groups,
    read_structure,
)
from mp4ds.video.codecs import CODECS
from mp4ds.video.mp4 import SampleTable, sample_table_of
from sources import SOURCES, scene
from test_access import written
from test_references import FRAMES, RECIPES

Pieces = list[tuple[int, bytes]]


def sample_reader(path: Path, table: SampleTable) -> Callable[[int], bytes]:
    data = path.read_bytes()
    return lambda sample: data[table.places[sample] :][: table.sizes[sample]]


def chains_of(path: Path, codec: str, recorded: Structures | None) -> list[Pieces]:
    """For every packet the bytes that a decoder is given to show its picture."""
    table = sample_table_of(path)
    read = sample_reader(path, table)
    chains = Chains(table, codec, read, recorded)
    found = []
    for sample in range(len(table.sizes)):
        group = chains.group(sample, sample)
        pieces = [group.pieces[number] for number in group.chain([sample])]
        found.append([(p.sample, chains.cut(group, p, read(p.sample))) for p in pieces])
    return found


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", RECIPES)
def test_recorded_and_parsed_chains_are_the_same(name: str, tmp_path: Path) -> None:
    recipe = RECIPES[name]
    path = written(tmp_path, recipe)
    data = path.read_bytes()
    *digest, found = digest_video(path, recipe.codec)
    assert digest == [len(data), hashlib.sha256(data).hexdigest()]
    assert (found is not None) == CODECS[recipe.codec].is_free
    if found is not None:
        packets = packets_of_groups(sample_table_of(path))
        assert packets.sum() == FRAMES
        again = References.from_structures(found).decode(packets)
        assert list(again.texts) == list(found.texts)
        again.check()
        expected = chains_of(path, recipe.codec, None)
        assert chains_of(path, recipe.codec, again) == expected
        parts = [len(read_structure(again.texts[g])[0]) for g in again.groups]
        assert parts == [1] * len(parts)  # a key frame's packet
        before = [
            count
            for number in again.groups
            for count in accumulate(map(len, read_structure(again.texts[number])))
        ]
        is_plain = [len(chain) for chain in expected] == before
        assert (video_facts(path, recipe.codec)["references"] is None) == again.is_plain
        assert again.is_plain == is_plain


# ---------------------------------------------------------------- in sidecars


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of lossy AV1, of four groups of pictures, with its sidecar."""
    folder = tmp_path_factory.mktemp("packed")
    recorded = scene("rgb8", frames=50, width=96, height=64)
    (path,) = SOURCES["mcap-ros2-none"](folder, recorded)
    mp4ds.pack(path, folder / "d", mp4ds.PackOptions(quality="visual", codec="av1", gop=16))
    return folder / "d"


def stream_of(dataset: Path) -> Path:
    return dataset / "cam_image_raw.yaml"


def test_a_dataset_with_references(packed: Path) -> None:
    sidecar = load_stream(stream_of(packed))
    references = sidecar.video.references
    assert references is not None
    assert references.groups.decode(4).tolist() == [0, 0, 0, 1]
    assert references.split
    assert mp4ds.validate(packed, deep=True) == []


def test_joined_parts_tell_what_the_joined_packets_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = InlineExecutor()
    use(monkeypatch, executor)
    recorded = scene("rgb8", frames=40, width=96, height=64)
    (path,) = SOURCES["mcap-ros2-none"](tmp_path, recorded)
    options = mp4ds.PackOptions(quality="visual", codec="av1", gop=8, window=4)
    mp4ds.pack(path, tmp_path / "d", options)
    assert len(executor.ran) > 2
    video = load_stream(stream_of(tmp_path / "d")).video
    assert video.references is not None
    assert video.references == video_facts(tmp_path / "d" / video.file, "av1")["references"]
    assert mp4ds.validate(tmp_path / "d", deep=True) == []


Change = Callable[[dict[str, Any]], None]


def edited(packed: Path, folder: Path, change: Change) -> Path:
    """The sidecar with other references, beside its video."""
    document = yamlio.load(stream_of(packed).read_bytes(), "here")
    change(document["video"])
    path = folder / "cam_image_raw.yaml"
    path.write_bytes(yamlio.dump(document))
    (folder / "cam_image_raw.mp4").write_bytes((packed / "cam_image_raw.mp4").read_bytes())
    return path


def setting(structures: list[str] | None = None, groups: list[int] | None = None) -> Change:
    def change(video: dict[str, Any]) -> None:
        references = video["references"]
        if structures is not None:
            references["structures"] = structures
        if groups is not None:
            residuals = " ".join(str(b - a) for a, b in pairwise(groups))
            references["groups"] = {"start": groups[0], "step": 0, "values": f"{residuals}\n"}

    return change


def replacing(old: str, new: str) -> Change:
    def change(video: dict[str, Any]) -> None:
        structures = video["references"]["structures"]
        assert old in structures[0]
        structures[0] = structures[0].replace(old, new, 1)

    return change


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("structures", "code"),
    [
        (["k" + " 1" * 2**15], "schema-invalid"),
        (["k" + " 1" * (2**15 - 1)] * 17, "model-invalid"),
    ],
)
def test_too_much(structures: list[str], code: str, packed: Path, tmp_path: Path) -> None:
    path = edited(packed, tmp_path, setting(structures))
    assert [problem.code for problem in mp4ds.validate(path)] == [code]


PLAIN = "k" + " 1" * 15
MISFITS: dict[str, tuple[Change, str]] = {
    "too-few-groups": (setting(groups=[0, 0, 1]), "column of groups"),
    "too-many-groups": (setting(groups=[0, 0, 0, 0, 1]), "column of groups"),
    "no-such-structure": (setting(groups=[0, 0, 0, 2]), "a structure that is not there"),
    "negative": (setting(groups=[0, 0, 0, -1]), "a structure that is not there"),
    "swapped": (setting(groups=[1, 0, 0, 1]), "2 packets in group of pictures 0, which has 16"),
    "packet-missing": (setting([PLAIN[:-2], "k 1"]), "15 packets in group of pictures 0"),
    "packet-more": (setting([PLAIN + " 1", "k 1"]), "17 packets in group of pictures 0"),
}


@pytest.mark.parametrize("name", MISFITS)
def test_references_of_another_video(name: str, packed: Path, tmp_path: Path) -> None:
    change, problem = MISFITS[name]
    path = edited(packed, tmp_path, change)
    (found,) = mp4ds.validate(path)
    assert found.code == "references-invalid"
    assert problem in found.message
    with (
        closing(Topic([Stream(path)])) as stream,
        pytest.raises(FormatError, match=problem) as raised,
    ):
        stream.get([3])
    assert raised.value.code == "references-invalid"


def with_a_frame_less(video: dict[str, Any]) -> None:
    structures = video["references"]["structures"]
    packets = structures[0].split(" ")
    last = max(number for number, packet in enumerate(packets) if "+" in packet)
    packets[last] = packets[last].rpartition("+")[0]
    structures[0] = " ".join([*packets[: last + 1], *["1"] * len(packets[last + 1 :])])


LIES: dict[str, Change] = {
    "plain": setting([PLAIN, "k 1"]),
    "all-key": setting(["k" + " k" * 15, "k k"]),
    "more-frames": replacing("k 1", "k 1+1"),
    "fewer-frames": with_a_frame_less,
    "too-little": replacing("+1,2", "+2"),
    "too-much": replacing(" 2 ", " 1,2 "),
    "many": setting(["+".join(["k"] + ["1"] * 9000) + PLAIN[1:], "k 1"]),
}


@pytest.mark.parametrize("name", LIES)
def test_lies_are_found_and_do_no_harm(name: str, packed: Path, tmp_path: Path) -> None:
    path = edited(packed, tmp_path, LIES[name])
    assert mp4ds.validate(path) == []
    (found,) = mp4ds.validate(path, deep=True)
    assert found.code == "references-invalid"
    assert "group of pictures 0 show others" in found.message
    codes, right = set(), 0
    with closing(Topic([Stream(path)])) as stream:
        every = [frame.data for frame in stream]
        for number in range(48):
            try:
                (one,) = stream.get([number])
            except VideoError as error:
                codes.add(error.code)
            else:
                assert one.data.shape == every[number].shape
                right += np.array_equal(one.data, every[number])
    assert codes <= {"decode-failed"}
    assert right == 48 or name != "too-much"
    assert right < 48 or name not in ("all-key", "more-frames", "fewer-frames", "many")
