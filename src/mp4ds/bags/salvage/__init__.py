"""Readers of damaged recordings: they give what is there, and list what is lost."""

from __future__ import annotations

from collections.abc import Sequence

from mp4ds.bags.protocols import BagReader
from mp4ds.bags.salvage.reader import SalvageReader
from mp4ds.records import Loss

__all__ = ["SalvageReader", "losses_of"]


def losses_of(reader: BagReader) -> Sequence[Loss]:
    """What a reader could not read; empty for one that reads everything or fails."""
    losses: Sequence[Loss] = getattr(reader, "losses", ())
    return losses
