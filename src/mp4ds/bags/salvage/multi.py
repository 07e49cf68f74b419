"""Several recordings that belong together and some of which are damaged, read as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from mp4ds.bags.multi import MultiReader
from mp4ds.bags.salvage.losses import bounded
from mp4ds.bags.salvage.reader import Salvage
from mp4ds.records import Loss


class MultiSalvage(MultiReader):
    """As `MultiReader`, of what can be read of each part. See `SalvageReader`.

    Args:
        openers: Each opens one part; a part is open only while it is read.
    """

    def __init__(self, openers: Sequence[Callable[[], Salvage]]) -> None:
        self._found: dict[int, Sequence[Loss]] = {}
        super().__init__(
            [partial(self._open, number, opener) for number, opener in enumerate(openers)]
        )

    def _open(self, number: int, opener: Callable[[], Salvage]) -> Salvage:
        part = opener()
        part.is_alone = False
        part.when_read = partial(self._found.__setitem__, number)
        return part

    @property
    def losses(self) -> Sequence[Loss]:
        """What could not be read of all parts, in their order."""
        return bounded([loss for number in sorted(self._found) for loss in self._found[number]])
