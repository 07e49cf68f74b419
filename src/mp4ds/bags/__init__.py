"""Recordings that others made: readers and writers behind two protocols and one table.

The only package that imports rosbags and mcap.
"""

from __future__ import annotations

from mp4ds.bags.formats import (
    limits_of,
    open_reader,
    open_sources,
    open_writer,
    recording_names,
)
from mp4ds.bags.hashing import SourceHasher
from mp4ds.bags.protocols import BagReader, BagWriter

__all__ = [
    "BagReader",
    "BagWriter",
    "SourceHasher",
    "limits_of",
    "open_reader",
    "open_sources",
    "open_writer",
    "recording_names",
]
