"""CameraInfo messages into the calibrations and columns of a sidecar."""

from __future__ import annotations

import base64

from mp4ds.records import Channel, Message
from mp4ds.sidecar import Calibration, CameraInfo, ChannelModel, Roi
from mp4ds.sidecar.models import MAX_CAMERA_INFOS
from mp4ds.streams.columns import ColumnsWriter, Unsuited, Variants
from mp4ds.wire import CameraInfoFields, Wire, WireError, wire_for


class CameraInfoWriter:
    """The CameraInfo messages of one channel."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self._wire: Wire | None = None
        self._columns = ColumnsWriter()
        self._calibrations: Variants[Calibration] = Variants()

    def accept(self, message: Message, ordinal: int) -> None:
        """Take a message.

        Args:
            message: The message.
            ordinal: Its place among the channel's messages.

        Raises:
            Unsuited: It cannot be modelled exactly; nothing was changed.
        """
        self._columns.check(message)
        if len(self._columns) == MAX_CAMERA_INFOS:
            raise Unsuited(f"more than {MAX_CAMERA_INFOS} messages")
        data = memoryview(message.data)
        try:
            wire = wire_for(message.channel.message_encoding, data)
            stamp, seq, frame_id, fields = wire.split_camera_info(data)
        except WireError as error:
            raise Unsuited(f"it does not parse: {error}") from None
        if self._wire is not None and wire is not self._wire:
            raise Unsuited("its byte order differs from the first one's")
        payload = bytes(data)
        blank = wire.patch_head(payload, 0, 0)
        if wire.patch_head(blank, stamp, seq) != payload:
            raise Unsuited("its header does not rebuild")

        def describe() -> Calibration:
            plain = wire.camera_info(0, 0, frame_id, fields)
            template = None if plain == blank else base64.b64encode(blank).decode()
            return _calibration(frame_id, fields, template)

        variant = self._calibrations.number(blank, describe)
        self._wire = wire
        self._columns.append(message, stamp=stamp, seq=seq, variant=variant, ordinal=ordinal)

    def to_model(self) -> CameraInfo | None:
        """The model, or None if no message was taken."""
        if self._wire is None:
            return None
        return CameraInfo(
            channel=ChannelModel.from_record(self.channel),
            wire=self._wire.name,
            messages=len(self._columns),
            calibrations=self._calibrations.items,
            columns=self._columns.to_model(),
        )


def _calibration(frame_id: str, fields: CameraInfoFields, template: str | None) -> Calibration:
    x_offset, y_offset, height, width = fields.roi
    roi = Roi(
        x_offset=x_offset,
        y_offset=y_offset,
        height=height,
        width=width,
        do_rectify=fields.roi_do_rectify,
    )
    return Calibration(
        frame_id=frame_id,
        height=fields.height,
        width=fields.width,
        distortion_model=fields.distortion_model,
        d=list(fields.d),
        k=list(fields.k),
        r=list(fields.r),
        p=list(fields.p),
        binning_x=fields.binning_x,
        binning_y=fields.binning_y,
        roi=roi if any((*fields.roi, fields.roi_do_rectify)) else None,
        template=template,
    )


def fields_of(calibration: Calibration) -> CameraInfoFields:
    """The fields of a calibration, as a wire takes them."""
    roi = calibration.roi
    return CameraInfoFields(
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.distortion_model,
        d=tuple(calibration.d),
        k=tuple(calibration.k),
        r=tuple(calibration.r),
        p=tuple(calibration.p),
        binning_x=calibration.binning_x,
        binning_y=calibration.binning_y,
        roi=(roi.x_offset, roi.y_offset, roi.height, roi.width) if roi else (0, 0, 0, 0),
        roi_do_rectify=roi.do_rectify if roi else 0,
    )
