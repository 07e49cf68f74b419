"""The model of what a video's frames refer to."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mp4ds.coded.structure import (
    MAX_CHARS,
    MAX_STRUCTURE_CHARS,
    MAX_STRUCTURES,
    STRUCTURE_PATTERN,
    Structures,
)
from mp4ds.sidecar.columns import Column
from mp4ds.sidecar.fields import Model
from mp4ds.stamps import encode_column

Structure = Annotated[str, Field(pattern=STRUCTURE_PATTERN, max_length=MAX_STRUCTURE_CHARS)]


class References(Model):
    """What the coded frames of each group of pictures refer to."""

    structures: Annotated[list[Structure], Field(min_length=1, max_length=MAX_STRUCTURES)] = Field(
        description="Those that occur, each of the packets from a key frame to the next."
    )
    groups: Column = Field(description="Number of the structure of each group of pictures.")

    @model_validator(mode="after")
    def _bounded(self) -> References:
        if sum(map(len, self.structures)) > MAX_CHARS:
            raise ValueError(f"the structures have more than {MAX_CHARS} characters together")
        return self

    @property
    def split(self) -> bool:
        """Whether packets hold several coded frames."""
        return any("+" in text for text in self.structures)

    @classmethod
    def from_structures(cls, structures: Structures) -> References:
        """The model of what was found in a video."""
        groups = Column.model_validate(encode_column(structures.groups))
        return cls(structures=list(structures.texts), groups=groups)

    def decode(self, packets: NDArray[np.int64]) -> Structures:
        """The structures of a video.

        Args:
            packets: Of each of its groups of pictures, shape (groups,), at least one.

        Raises:
            ValueError: They are not of such a video; says why.
        """
        try:
            groups = self.groups.decode(len(packets))
        except ValueError as error:
            raise ValueError(f"their column of groups {error}") from None
        structures = Structures(self.structures, groups)
        if problem := structures.mismatch(packets):
            raise ValueError(problem)
        return structures
