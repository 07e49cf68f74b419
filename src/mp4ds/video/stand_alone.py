"""Packets of a video for whoever decodes without its mp4."""

from __future__ import annotations

from pathlib import Path

from mp4ds.coded import Refused, annexb, av1, h264, h265
from mp4ds.coded.configuration import parameter_units
from mp4ds.errors import VideoError
from mp4ds.video.packets import PacketReader

_UNITS = {"h264": h264, "h265": h265}


class StandAlonePackets(PacketReader):
    """The packets of a video as they stand alone, for whoever decodes without the mp4.

    H.264 and H.265 come as Annex B with start codes of four bytes, AV1 as temporal units that
    begin with a delimiter; all with the parameters of the stream before each key frame. VP9
    packets and images come as they are.

    Args:
        path: A video without B-frames, such as all that mp4ds writes.
        codec: Name in the registry.
        frames: Number of packets that are due, if known.

    Raises:
        VideoError: As `PacketReader`, or the codec's parameters are damaged.
    """

    def __init__(self, path: Path, *, codec: str, frames: int | None = None) -> None:
        super().__init__(path, codec=codec, frames=frames)
        self._codec = codec
        try:
            self._parameters = parameter_units(codec, self.extradata)
        except Refused as error:
            self.close()
            raise self._damage(error) from None

    def _damage(self, error: Refused) -> VideoError:
        return VideoError("decode-failed", self._path, f"has a packet of which {error}")

    def packet(self, index: int) -> bytes:
        """One packet; see `PacketReader.packet`."""
        packet = super().packet(index)
        parameters = self._parameters if self.keyframes[index] else []
        try:
            if self._codec in _UNITS:
                return _stand_alone(self._codec, packet, parameters)
            if self._codec == "av1":
                needed = [] if parameters and av1.sequence_header(packet) else parameters
                return b"".join((av1.DELIMITER, *needed, packet))
        except Refused as error:
            raise self._damage(error) from None
        return packet


def _stand_alone(codec: str, packet: bytes, parameters: list[bytes]) -> bytes:
    module = _UNITS[codec]
    units = annexb.split_length_prefixed(packet)
    if parameters and not module.has_parameters(units):
        at = 1 if units and module.unit_type(units[0]) == module.AUD else 0
        units[at:at] = parameters
    return annexb.join_plain(units)
