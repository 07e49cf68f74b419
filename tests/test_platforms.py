"""Datasets are read where the system lacks what packing in parts needs: on Windows."""

from __future__ import annotations

from pathlib import Path

import pytest

from commands import program

DATASET = Path(__file__).parent / "fixtures/v1.0"
NO_UNIX = """
import os, signal, sys
for name in ("fcntl", "grp", "pwd", "resource", "termios", "tty"):
    sys.modules[name] = None
for name in ("geteuid", "getuid", "sched_getaffinity", "sched_setscheduler", "sysconf"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGTSTP"):
    if hasattr(signal, name):
        delattr(signal, name)
dataset, out = sys.argv[1:]
"""
COMMAND = "sys.argv = ['mp4ds', {}]\nfrom mp4ds.cli import main\nmain()"


READING = {
    "open": """
import mp4ds
with mp4ds.open(dataset) as opened:
    for stream in opened:
        assert stream[-1].data.shape == stream.shape
        assert len(list(stream)) == len(stream.stamps) > 0
        assert stream.at(int(stream.stamps[0])).index == 0
""",
    "validate": "import mp4ds\nassert mp4ds.validate(dataset, deep=True) == []",
    "unpack": "import mp4ds\nassert mp4ds.unpack(dataset, 'mcap', out).messages",
    "validate command": COMMAND.format("'validate', dataset, '--deep'"),
    "unpack command": COMMAND.format("'unpack', dataset, '--to', 'rosbag2', '-o', out"),
    "info command": COMMAND.format("'info', dataset, '--json'"),
    "pack command": COMMAND.format("'pack', dataset, '-o', out, '--help'"),
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("way", READING)
def test_reading_without_unix(way: str, tmp_path: Path) -> None:
    assert program("-c", NO_UNIX + READING[way], DATASET, tmp_path / "out").err == ""
