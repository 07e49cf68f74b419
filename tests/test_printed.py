"""What commands print of their results, for people."""

from __future__ import annotations

from pathlib import Path

from scenes import START, Record, Scene
from sources import write_bag
from test_bad_input import call


def test_what_has_no_bytes_has_no_ratio(tmp_path: Path) -> None:
    """A slice that holds nothing but messages without fields."""
    words = Record("/chatter", "std_msgs/msg/String", START, {"data": "x"})
    empty = Record("/start", "std_msgs/msg/Empty", START + 10**9, ros1=b"")
    write_bag(tmp_path / "drive.bag", Scene([words, empty]))
    done = call("pack", tmp_path / "drive.bag", "-o", tmp_path / "drive", "--start", "0.5")
    assert (done.code, done.err) == (0, "")
    assert "drive: 0 B -> " in done.out
    assert "times" not in done.out
