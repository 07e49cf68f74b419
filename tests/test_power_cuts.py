"""What may be on the disk after a power cut: the tool that makes it, and a sample of its states."""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import pytest

from power_cut_trials import TRIALS, verdicts
from power_cuts import Disk, run_logged, snapshot
from scenes import scene

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="logs with LD_PRELOAD")

PROGRAM = """
import os
os.chdir(os.environ["DISK_LOG_ROOT"])
with open("old", "r+b") as file:
    file.write(b"b" * 3000)
with open("safe", "wb") as file:
    file.write(b"s" * 5000)
    file.flush()
    os.fsync(file.fileno())
folder = os.open(".", os.O_RDONLY)
os.fsync(folder)
with open("new", "wb") as file:
    file.write(b"n" * 5000)
os.rename("new", "moved")
"""


def test_what_a_disk_may_hold(tmp_path: Path) -> None:
    """What was synced, and of what was not, with its name and its data, anything."""
    root = tmp_path / "root"
    root.mkdir()
    (root / "old").write_bytes(b"a" * 9000)
    before = snapshot(root)
    run_logged([sys.executable, "-c", PROGRAM], root, tmp_path / "log")
    disk = Disk(root, tmp_path / "log", before)
    found: dict[str, set[bytes | None]] = defaultdict(set)
    for seed in range(3000):
        state = disk.state(seed)
        assert state.files == disk.state(seed).files
        assert not {"new", "moved"} <= state.files.keys()
        if state.cut == len(disk.times):
            found["kinds"] |= {state.kind.encode()}
            for name in ("old", "safe", "new", "moved"):
                found[name].add(state.files.get(name))
    assert found["kinds"] == {b"prefix", b"lost", b"torn", b"reordered", b"zeros", b"mixed"}
    assert found["safe"] == {b"s" * 5000}
    olds = {b"a" * 9000, b"b" * 3000 + b"a" * 6000, b"b" * 512 + b"a" * 8488}
    assert olds <= found["old"]
    assert all(len(old or b"") == 9000 for old in found["old"])
    news = {None, b"", b"n" * 5000, b"n" * 512, b"n" * 4096, b"n" * 4096 + bytes(904), bytes(5000)}
    assert news <= found["moved"]
    assert {None, b"", b"n" * 5000} <= found["new"]


@pytest.mark.parametrize(
    "name",
    [
        "record",
        *(pytest.param(name, marks=pytest.mark.slow) for name in TRIALS if name != "record"),
    ],
)
def test_a_sample_of_what_is_left(name: str, tmp_path: Path) -> None:
    """It is recovered, or made by the same command; thousands are tried by the tool."""
    trial = TRIALS[name]
    if name == "record":
        trial = replace(trial, of=lambda: scene("bayer_rggb8", frames=20, width=32, height=24))
    trial.prepare(tmp_path)
    found = [*verdicts(name, tmp_path, 30)]
    assert len(found) >= 30
    wrong = [one for one in found if one["problem"]]
    assert wrong == []
    left = [one for one in found if one["litter"] and one["outcome"] != "complete"]
    assert name == "record" or left == []
