"""Annex B: NAL units and their framing, apart and together again."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coded_tools import refusal
from mp4ds.video.h264 import (
    H264,
    MAX_UNITS,
    MAX_ZEROS,
    join,
    join_plain,
    split,
    split_length_prefixed,
)

UNIT = st.builds(
    lambda body, last: body.replace(b"\0\0\1", b"\0\0\3") + last,
    st.lists(st.sampled_from([b"\0", b"\1", b"\3", b"\x65", b"\0\0"]), max_size=9).map(b"".join),
    st.sampled_from([b"\1", b"\x80", b"\xff"]),
)
# a unit may not make a start code with the zeros before its last byte
UNITS = st.lists(UNIT.filter(lambda unit: b"\0\0\1" not in unit), min_size=1, max_size=6)


def prefixed(units: list[bytes]) -> bytes:
    return b"".join(len(unit).to_bytes(4, "big") + unit for unit in units)


@pytest.mark.parametrize(
    ("data", "framing"),
    [
        ("00000001 6705", "4"),
        ("000001 6705 000001 6805", "3 3"),
        ("00000001 6705 00000001 6805 00000001 0605 000001 65880102", "4 4 4 3"),
        ("00000001 6705 0000", "4 +2"),
        ("000000000001 6705 0000000000000001 68", "6 8"),
        ("000001 0005 000001 00000305", "3 3"),
        ("000001 00000205", "3"),
    ],
)
def test_framing(data: str, framing: str) -> None:
    packet = bytes.fromhex(data)
    units, found = split(memoryview(packet))
    assert found == framing
    assert units == re.split(b"\0*\0\0\x01", packet.rstrip(b"\0"))[1:]
    assert join(units, framing) == packet
    assert H264.body(prefixed(units), framing) == packet


@settings(deadline=None)
@given(units=UNITS, data=st.data())
def test_any_framing_comes_back(units: list[bytes], data: st.DataObject) -> None:
    lengths = [data.draw(st.integers(3, 9)) for _ in units]
    trailing = data.draw(st.integers(0, 4))
    framing = " ".join(map(str, lengths)) + (f" +{trailing}" if trailing else "")
    packet = join(units, framing)
    assert split(packet) == (units, framing)
    assert H264.body(prefixed(units), framing) == packet
    assert split(join_plain(units)) == (units, " ".join("4" for _ in units))
    assert split_length_prefixed(prefixed(units)) == units


@settings(deadline=None)
@given(st.lists(st.sampled_from([b"\0", b"\1", b"\2", b"\0\0\1", b"e"]), max_size=30).map(b"".join))
def test_any_bytes_come_back_or_are_refused(data: bytes) -> None:
    if not refusal(split, data):
        assert join(*split(data)) == data


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "start code"),
        (b"\0\0\0\5\x67\0\0\1\x65", "start code"),
        (b"\0\0\1", "empty NAL"),
        (b"\0\0\1\x67\0\0\1\0\0\1\x65", "empty NAL"),
        (bytes(MAX_ZEROS + 1) + b"\1\x67", "zero bytes"),
        (b"\0\0\1\x67" + bytes(MAX_ZEROS + 1) + b"\1\x67", "zero bytes"),
        (b"\0\0\1\x67" * (MAX_UNITS + 1), "NAL units"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_not_an_access_unit(data: bytes, reason: str) -> None:
    assert reason in refusal(split, data)


NO_FRAMINGS = (
    *("", " ", "4 ", " 4", "4  4", "2", "0", "-4", "+2", "4 +2 4", "4 +", "4.0", "9999"),
    *("4 +9999", "4\n", "4\t4", "x", "\u0664", "4 4"),
)


@pytest.mark.parametrize("framing", NO_FRAMINGS)
def test_not_a_framing(framing: str) -> None:
    assert refusal(join, [b"\x65"], framing)


@pytest.mark.parametrize(
    "packet", ["00", "00000000", "0000000265", "0000000165 0000", "ffffffff65", "00000001"]
)
def test_lengths_that_do_not_add_up(packet: str) -> None:
    assert "length" in refusal(split_length_prefixed, bytes.fromhex(packet))
    assert refusal(split_length_prefixed, b"\0\0\0\1e" * (MAX_UNITS + 1))
