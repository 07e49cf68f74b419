"""The ROS 1 serialization and ROS 2's CDR, which differ in order, alignment and header.

ROS 1: little-endian, unaligned, header with seq, strings without NUL
(wiki.ros.org/msg, "Fields"). CDR: a four-byte encapsulation, primitives aligned to their
size from there, strings with NUL (OMG DDSI-RTPS 2.5, 10; plain CDR only).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from mp4ds.wire.base import NS, CameraInfoFields, ImageParts, WireError, check_floats, join_stamp
from mp4ds.wire.cursor import Reader, Writer


@dataclass(frozen=True, slots=True)
class RosWire:
    """One of the three plain serializations of ROS camera messages.

    Attributes:
        name: ``ros1``, ``cdr-le`` or ``cdr-be``.
        prefix: The encapsulation that a payload begins with.
        order: Byte order as struct spells it.
        ros2: Whether it is CDR: aligned, NUL-terminated, without seq.
    """

    name: str
    prefix: bytes
    order: str
    ros2: bool

    def split_image(self, data: memoryview) -> ImageParts:
        """See `Wire.split_image`."""
        reader = self._reader(data)
        stamp, seq, frame_id = self._read_header(reader)
        height, width = reader.integer("I"), reader.integer("I")
        encoding = reader.string(terminated=self.ros2)
        is_bigendian = reader.integer("B")
        step, size = reader.integer("I"), reader.integer("I")
        start = reader.offset
        pixels = reader.raw(size)
        return ImageParts(
            stamp=stamp,
            seq=seq,
            frame_id=frame_id,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=is_bigendian,
            step=step,
            size=size,
            head=data[:start],
            pixels=pixels,
            tail=data[reader.offset :],
        )

    def image_head(self, parts: ImageParts) -> bytes:
        """See `Wire.image_head`."""
        writer = self._writer()
        self._write_header(writer, parts.stamp or 0, parts.seq, parts.frame_id)
        writer.put("I", parts.height, parts.width)
        writer.string(parts.encoding, terminated=self.ros2)
        writer.put("B", parts.is_bigendian)
        writer.put("I", parts.step, parts.size)
        return writer.getvalue()

    def patch_head(self, template: bytes, stamp: int, seq: int | None) -> bytes:
        """See `Wire.patch_head`."""
        head = bytearray(template)
        offset = len(self.prefix)
        if not self.ros2:
            struct.pack_into("<I", head, offset, seq or 0)
            offset += 4
        struct.pack_into(
            f"{self.order}{'i' if self.ros2 else 'I'}I", head, offset, *divmod(stamp, NS)
        )
        return bytes(head)

    def split_camera_info(self, data: memoryview) -> tuple[int, int | None, str, CameraInfoFields]:
        """See `Wire.split_camera_info`."""
        reader = self._reader(data)
        stamp, seq, frame_id = self._read_header(reader)
        if stamp is None:
            raise WireError("its stamp has a second or more in nanoseconds")
        height, width = reader.integer("I"), reader.integer("I")
        model = reader.string(terminated=self.ros2)
        count = reader.integer("I")
        if count > 1024:
            raise WireError(f"it has {count} distortion parameters")
        d = reader.take("d", count)
        k, r, p = reader.take("d", 9), reader.take("d", 9), reader.take("d", 12)
        check_floats((*d, *k, *r, *p))
        binning_x, binning_y = reader.integer("I"), reader.integer("I")
        x, y, roi_height, roi_width = (reader.integer("I") for _ in range(4))
        fields = CameraInfoFields(
            height=height,
            width=width,
            distortion_model=model,
            d=d,
            k=k,
            r=r,
            p=p,
            binning_x=binning_x,
            binning_y=binning_y,
            roi=(x, y, roi_height, roi_width),
            roi_do_rectify=reader.integer("B"),
        )
        return stamp, seq, frame_id, fields

    def camera_info(
        self, stamp: int, seq: int | None, frame_id: str, fields: CameraInfoFields
    ) -> bytes:
        """See `Wire.camera_info`."""
        writer = self._writer()
        self._write_header(writer, stamp, seq, frame_id)
        writer.put("I", fields.height, fields.width)
        writer.string(fields.distortion_model, terminated=self.ros2)
        writer.put("I", len(fields.d))
        for matrix in (fields.d, fields.k, fields.r, fields.p):
            writer.put("d", *matrix)
        writer.put("I", fields.binning_x, fields.binning_y, *fields.roi)
        writer.put("B", fields.roi_do_rectify)
        return writer.getvalue()

    def _reader(self, data: memoryview) -> Reader:
        if bytes(data[: len(self.prefix)]) != self.prefix:
            raise WireError("it does not begin like a plain serialization of its kind")
        return Reader(data, len(self.prefix), self.order, aligned=self.ros2)

    def _writer(self) -> Writer:
        return Writer(self.prefix, self.order, aligned=self.ros2)

    def _read_header(self, reader: Reader) -> tuple[int | None, int | None, str]:
        seq = None if self.ros2 else reader.integer("I")
        sec = reader.integer("i" if self.ros2 else "I")
        stamp = join_stamp(sec, reader.integer("I"))
        return stamp, seq, reader.string(terminated=self.ros2)

    def _write_header(self, writer: Writer, stamp: int, seq: int | None, frame_id: str) -> None:
        sec, nanosec = divmod(stamp, NS)
        if not self.ros2:
            writer.put("I", seq or 0)
        writer.put("i" if self.ros2 else "I", sec)
        writer.put("I", nanosec)
        writer.string(frame_id, terminated=self.ros2)
