"""The models of columns and digests: one value per message."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mp4ds.sidecar.fields import Int64, Model
from mp4ds.stamps import decode_column


class Column(Model):
    """A column of 64-bit integers: ``value[i] = value[i-1] + step + residual[i-1]``."""

    start: Int64 = Field(description="The first value.")
    step: Int64 = Field(description="The common difference.")
    values: str = Field(
        description="Residuals of the differences, separated by white space; r*n is n times r."
    )

    def decode(self, count: int) -> NDArray[np.int64]:
        """The values, shape (count,).

        Raises:
            ValueError: The column does not have that length; says why.
        """
        return decode_column(self.start, self.step, self.values, count)


class Columns(Model):
    """One value per message, in the order of the video's frames."""

    log_time: Column = Field(description="When each message was recorded, ns.")
    publish_time: Column | None = Field(None, description="ns; absent: the log times.")
    sequence: Column | None = Field(None, description="MCAP sequence; absent: all 0.")
    stamp: Column = Field(description="Header stamps, ns.")
    seq: Column | None = Field(None, description="ROS 1 header sequence numbers.")
    pts: Column | None = Field(None, description="Presentation times that packets tell.")
    variant: Column | None = Field(
        None, description="Number of the header or calibration of each; absent: all 0."
    )
    ordinal: Column | None = Field(
        None, description="Place of each among the channel's messages; absent: 0, 1, 2 ..."
    )

    def names(self) -> list[str]:
        """Names of the columns that are there."""
        return [name for name in type(self).model_fields if getattr(self, name) is not None]


class Digests(Model):
    """A digest of each original message payload, in frame order."""

    algorithm: Literal["xxh64"] = Field(description="XXH64 with seed 0.")
    values: str = Field(description="16 hexadecimal digits each, separated by white space.")

    def decode(self, count: int) -> NDArray[np.uint64]:
        """The digests, shape (count,).

        Raises:
            ValueError: There are not that many; says so.
        """
        try:
            raw = bytes.fromhex(self.values)
        except ValueError:
            raise ValueError("holds something else than hexadecimal digits") from None
        if len(raw) != 8 * count:
            raise ValueError(f"holds {len(raw) / 8:g} digests where {count} are due")
        return np.frombuffer(raw, dtype=">u8").astype(np.uint64)
