"""Changed recordings and datasets keep to the rules of `benchmarks/fuzz_rules.py`."""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import fuzz
import fuzz_changes
import fuzz_rules
from mp4ds import Mp4dsError
from mp4ds.bags.formats import open_sources
from sources import SOURCES, scene

COUNT = 40


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return fuzz.make_kinds(tmp_path_factory.mktemp("good"))


def test_mutated_files_keep_the_rules(kinds: dict[str, Any], tmp_path: Path) -> None:
    around = tmp_path / "around"
    around.mkdir()
    counts, findings = fuzz.run(kinds, count=COUNT, seed=7, seconds=600.0, around=around)
    assert findings == []
    results = sum(counts.values(), Counter[str]())
    assert sum(results.values()) >= COUNT
    # what is changed is neither refused for its frame alone, nor taken whatever it is
    assert results["refused"] > COUNT // 4
    assert results["packed"] + results["valid"] > COUNT // 5
    assert all(counts[name] for name in kinds)


def test_a_connection_that_is_defined_anew_is_salvaged_as_two(tmp_path: Path) -> None:
    def connection(topic: bytes) -> tuple[Any, bytes]:
        return [(b"op", b"\7"), (b"conn", bytes(4)), (b"topic", topic)], b""

    def message(second: int) -> tuple[Any, bytes]:
        time = (b"time", second.to_bytes(8, "little"))
        return [(b"op", b"\2"), (b"conn", bytes(4)), time], b"data"

    records = [message(1), connection(b"/b"), message(2), connection(b"/b"), message(3)]
    path, out = tmp_path / "drive.bag", tmp_path / "out"
    path.write_bytes(fuzz_changes.build_bag([(b"lz4", records)], [connection(b"/a")]))
    out.mkdir()
    keys = fuzz_rules.read(path, salvage=True)
    assert [key[0][0] for key in keys] == ["/a", "/b", "/b"]
    assert fuzz_rules._check_pack(path, out, keys, "", salvage=True, deep=True)


def test_metadata_with_a_list_that_holds_itself(tmp_path: Path) -> None:
    (folder,) = SOURCES["rosbag2-mcap-v9"](tmp_path, scene("mono8", frames=1))
    path = folder / "metadata.yaml"
    path.write_text(re.sub(r"nsec: .*", "nsec: &a [*a]", path.read_text(), count=1))
    with pytest.raises(Mp4dsError):
        open_sources([folder])
