"""Recordings that others made: readers and writers behind two protocols and one table.

The only package that imports rosbags and mcap.
"""

from __future__ import annotations

from mp4ds.bags.convert import Converter
from mp4ds.bags.definitions import ros1_channel
from mp4ds.bags.formats import open_reader, open_sources, open_writer
from mp4ds.bags.hashing import SourceHasher
from mp4ds.bags.protocols import BagReader, BagWriter

__all__ = [
    "BagReader",
    "BagWriter",
    "Converter",
    "SourceHasher",
    "open_reader",
    "open_sources",
    "open_writer",
    "ros1_channel",
]
