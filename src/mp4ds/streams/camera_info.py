"""CameraInfo messages into the calibrations and columns of a sidecar."""

from __future__ import annotations

from mp4ds.records import Channel, Message
from mp4ds.sidecar import Calibration, CameraInfo, ChannelModel, Roi
from mp4ds.sidecar.fields import MAX_CAMERA_INFOS
from mp4ds.streams.columns import ColumnsWriter, Unsuited
from mp4ds.streams.headers import Forms, Heads
from mp4ds.wire import CalibrationFields


class CameraInfoWriter:
    """The calibration messages of one channel."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self._forms = Forms(channel)
        self._columns = ColumnsWriter()
        self._heads: Heads[Calibration] | None = None

    def accept(self, message: Message, ordinal: int) -> None:
        """Take a message.

        Args:
            message: The message.
            ordinal: Its place among the channel's messages.

        Raises:
            Unsuited: It cannot be modelled exactly; nothing was changed.
        """
        form, parts = self._forms.split(message)
        self._columns.check(message, parts)
        if len(self._columns) == MAX_CAMERA_INFOS:
            raise Unsuited(f"more than {MAX_CAMERA_INFOS} messages")
        fields = parts.fields
        if not isinstance(fields, CalibrationFields):
            raise Unsuited("it is no calibration")
        heads = self._heads or Heads[Calibration](form)
        if heads.form.wire != form.wire:
            raise Unsuited("its byte order differs from the first one's")
        variant = heads.number(
            parts,
            memoryview(message.data),
            describe=lambda template: _calibration(parts.frame_id, fields, template),
        )
        self._heads = heads
        self._columns.append(message, parts, variant=variant, ordinal=ordinal)

    def to_model(self) -> CameraInfo | None:
        """The model, or None if no message was taken."""
        if self._heads is None:
            return None
        return CameraInfo(
            channel=ChannelModel.from_record(self.channel),
            wire=self._heads.form.wire,
            messages=len(self._columns),
            calibrations=self._heads.items,
            columns=self._columns.to_model(),
        )


def _calibration(frame_id: str, fields: CalibrationFields, template: str | None) -> Calibration:
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


def fields_of(calibration: Calibration) -> CalibrationFields:
    """The fields of a calibration, as a wire takes them."""
    roi = calibration.roi
    return CalibrationFields(
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
