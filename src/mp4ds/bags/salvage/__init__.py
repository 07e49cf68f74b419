"""Readers of damaged recordings: they give what is there, and list what is lost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mp4ds.lazily import names_of

if TYPE_CHECKING:
    from mp4ds.bags.protocols import BagReader
    from mp4ds.bags.salvage.reader import SalvageReader
    from mp4ds.records import Loss
else:
    __getattr__ = names_of(__name__, reader="SalvageReader")

__all__ = ["SalvageReader", "losses_of"]


def losses_of(reader: BagReader) -> Sequence[Loss]:
    """What a reader could not read; empty for one that reads everything or fails."""
    losses: Sequence[Loss] = getattr(reader, "losses", ())
    return losses
