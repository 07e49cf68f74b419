"""The one source of truth for the format: schemas/ and the tables of spec/ are made from it.

The manifest's part is in manifest.py.

Every model is strict, frozen and closed: an unknown key is an error, a string is no number.
"""

from __future__ import annotations

import base64
import binascii
import re
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mp4ds.layouts import ENCODINGS, LAYOUTS, MAX_SIDE, why_not
from mp4ds.records import Channel, Schema
from mp4ds.stamps import INT64_MAX, INT64_MIN, decode_column
from mp4ds.wire.formats import WIRES

FORMAT_VERSION = "1.0"
MESSAGES_NAME = "messages.mcap"
MAX_FRAMES = 2 * 10**7  # 92 hours at 60 Hz; bounds what a sidecar can make a reader allocate
MAX_CAMERA_INFOS = 10**7
MAX_VARIANTS = 256
"""Headers or calibrations of a stream: a topic with more is not modelled any further."""

CODECS = ("h264", "h265", "av1", "ffv1")
PIXEL_FORMATS = ("gray", "gray16le", "rgb24", "bgr24", "bgr0", "yuv420p")

Int64 = Annotated[int, Field(ge=INT64_MIN, le=INT64_MAX)]
Time = Annotated[int, Field(ge=INT64_MIN, le=2**64 - 1)]
Uint32 = Annotated[int, Field(ge=0, le=2**32 - 1)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Count = Annotated[int, Field(ge=0, le=MAX_FRAMES)]
Size = Annotated[int, Field(ge=0, le=INT64_MAX)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
FileName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$", description="A plain file name.")
]
Base64 = Annotated[str, Field(pattern=r"^[A-Za-z0-9+/]*={0,2}$")]
Version = Annotated[str, Field(pattern=r"^(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)$")]
Profile = Annotated[str, Field(pattern=r"^(lossless|visual|crf=[0-9]{1,2})$")]


class Model(BaseModel):
    """Base of all models: nothing is converted, added or changed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SchemaModel(Model):
    """A message definition, verbatim."""

    name: str = Field(description="Type name as the source spells it.")
    encoding: str = Field(description="ros1msg, ros2msg, ros2idl ...; empty: no definition.")
    text: str | None = Field(None, description="The definition, where it is UTF-8.")
    base64: Base64 | None = Field(None, description="The definition, where it is not.")

    @model_validator(mode="after")
    def _one_form(self) -> SchemaModel:
        if (self.text is None) == (self.base64 is None):
            raise ValueError("a schema has either text or base64")
        if self.base64 is not None:
            decode_base64(self.base64)
        return self

    @classmethod
    def from_record(cls, schema: Schema) -> SchemaModel:
        """The model of a definition."""
        try:
            text = schema.data.decode()
        except UnicodeDecodeError:
            data = base64.b64encode(schema.data).decode()
            return cls(name=schema.name, encoding=schema.encoding, base64=data)
        return cls(name=schema.name, encoding=schema.encoding, text=text)

    def to_record(self) -> Schema:
        """The definition of the model."""
        data = self.text.encode() if self.text is not None else decode_base64(self.base64 or "")
        return Schema(self.name, self.encoding, data)


class ChannelModel(Model):
    """The channel that the messages were recorded on."""

    topic: str = Field(description="Topic name as the source spells it.")
    message_encoding: str = Field(description="ros1 or cdr.")
    schema_: SchemaModel | None = Field(None, alias="schema", description="Message definition.")
    metadata: dict[str, str] = Field(
        default_factory=dict, description="Connection header, QoS, type hash; verbatim."
    )

    @classmethod
    def from_record(cls, channel: Channel) -> ChannelModel:
        """The model of a channel."""
        schema = SchemaModel.from_record(channel.schema) if channel.schema else None
        return cls(
            topic=channel.topic,
            message_encoding=channel.message_encoding,
            schema=schema,
            metadata=dict(channel.metadata),
        )

    def to_record(self, channel_id: int) -> Channel:
        """The channel of the model, under an id of the caller's choice."""
        schema = self.schema_.to_record() if self.schema_ else None
        return Channel(channel_id, self.topic, self.message_encoding, schema, self.metadata)


class Image(Model):
    """What all images of the stream have in common."""

    encoding: str = Field(description="ROS image encoding.")
    width: Side = Field(description="Columns, pixels.")
    height: Side = Field(description="Rows, pixels.")
    step: Uint32 = Field(description="Bytes per row; what exceeds the pixels is zero.")
    is_bigendian: Annotated[int, Field(ge=0, le=255)] = Field(
        description="The byte as it stands; for 16-bit samples not 0 means big-endian."
    )

    @model_validator(mode="after")
    def _fits(self) -> Image:
        reason = why_not(
            self.encoding,
            width=self.width,
            height=self.height,
            step=self.step,
            size=self.step * self.height,
        )
        if reason:
            raise ValueError(reason)
        return self


class Header(Model):
    """The part of a message around its pixels that does not change from frame to frame."""

    frame_id: str = Field(description="Coordinate frame.")
    template: Base64 | None = Field(
        None,
        description="All bytes before the pixels, stamp and seq zero, where they are not those "
        "of a plain serialization (padding that is not zero).",
    )
    tail: Annotated[str, Field(pattern=r"^([0-9a-f]{2})*$", max_length=128)] = Field(
        "", description="All bytes after the pixels, hexadecimal."
    )


class Color(Model):
    """How the video's samples are to be understood; the names are ffmpeg's."""

    primaries: str = Field(description="Colour primaries.")
    transfer: str = Field(description="Transfer characteristics.")
    matrix: str = Field(description="Matrix coefficients.")
    range: Literal["full", "limited"] = Field(description="Range of the samples.")


class Video(Model):
    """The video file and how it was made."""

    file: FileName
    layout: str = Field(description="How pixels became the picture (registry, Layouts).")
    codec: str = Field(description="Codec (registry, Codecs).")
    pixel_format: str = Field(description="Pixel format of the coded video.")
    width: Annotated[int, Field(ge=1, le=MAX_SIDE + 1)] = Field(description="Picture width.")
    height: Annotated[int, Field(ge=1, le=MAX_SIDE + 1)] = Field(description="Picture height.")
    color: Color | None = Field(None, description="Absent where the samples are not colours.")
    encoder: str = Field("", description="Encoder that made it.")
    options: dict[str, str] = Field(default_factory=dict, description="The encoder's options.")
    size: Size | None = Field(None, description="Bytes.")
    sha256: Sha256 | None = Field(None, description="Of the file.")

    @property
    def matrix(self) -> str:
        """Matrix coefficients of the video's colours."""
        return self.color.matrix if self.color else "bt709"

    @property
    def full_range(self) -> bool:
        """Whether the video's samples use their full range."""
        return self.color is None or self.color.range == "full"

    @model_validator(mode="after")
    def _known(self) -> Video:
        if self.layout not in LAYOUTS:
            raise ValueError(f"layout {self.layout!r} is not one of {', '.join(LAYOUTS)}")
        if self.codec not in CODECS:
            raise ValueError(f"codec {self.codec!r} is not one of {', '.join(CODECS)}")
        if self.pixel_format not in PIXEL_FORMATS:
            known = ", ".join(PIXEL_FORMATS)
            raise ValueError(f"pixel format {self.pixel_format!r} is not one of {known}")
        return self


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


class Roi(Model):
    """Region of interest of a CameraInfo."""

    x_offset: Uint32
    y_offset: Uint32
    height: Uint32
    width: Uint32
    do_rectify: Annotated[int, Field(ge=0, le=255)]


Matrix9 = Annotated[list[float], Field(min_length=9, max_length=9)]
Matrix12 = Annotated[list[float], Field(min_length=12, max_length=12)]


class Calibration(Model):
    """The intrinsics of a camera: a CameraInfo without its stamp."""

    frame_id: str = Field(description="Coordinate frame.")
    height: Uint32 = Field(description="Rows of the calibrated image.")
    width: Uint32 = Field(description="Columns of the calibrated image.")
    distortion_model: str
    d: list[float] = Field(description="Distortion parameters.")
    k: Matrix9 = Field(description="Intrinsic matrix by rows.")
    r: Matrix9 = Field(description="Rectification matrix by rows.")
    p: Matrix12 = Field(description="Projection matrix by rows.")
    binning_x: Uint32 = 0
    binning_y: Uint32 = 0
    roi: Roi | None = Field(None, description="Absent: all zero.")
    template: Base64 | None = Field(
        None,
        description="The message with stamp and seq zero, where it is not that of a plain "
        "serialization.",
    )


class CameraInfo(Model):
    """The CameraInfo messages that belong to the stream."""

    channel: ChannelModel
    wire: str = Field(description="Serialization (registry, Wires).")
    messages: Annotated[int, Field(ge=0, le=MAX_CAMERA_INFOS)]
    calibrations: Annotated[list[Calibration], Field(max_length=MAX_VARIANTS)]
    columns: Columns | None = Field(None, description="Absent when there are no messages.")


class StreamSidecar(Model):
    """One stream: a video and everything that turns its frames back into messages."""

    mp4ds: Version = Field(description="Version of the format.")
    kind: Literal["stream"]
    profile: Profile = Field(description="What was asked for; only lossless is exact.")
    stamps: Literal["header", "record-float"] = Field(
        "header", description="record-float: record times that were kept as float seconds."
    )
    frames: Annotated[int, Field(ge=1, le=MAX_FRAMES)] = Field(description="Frames of the video.")
    channel: ChannelModel
    wire: str = Field(description="Serialization (registry, Wires).")
    image: Image
    headers: Annotated[list[Header], Field(min_length=1, max_length=MAX_VARIANTS)]
    video: Video
    camera_info: CameraInfo | None = None
    columns: Columns
    digests: Digests | None = Field(None, description="Present in the lossless profile.")

    @model_validator(mode="after")
    def _consistent(self) -> StreamSidecar:
        for wire in (self.wire, *([self.camera_info.wire] if self.camera_info else [])):
            if wire not in WIRES:
                raise ValueError(f"wire {wire!r} is not one of {', '.join(WIRES)}")
        if self.profile == "lossless" and self.digests is None:
            raise ValueError("a lossless stream has digests")
        encoding = ENCODINGS[self.image.encoding]
        if self.video.layout not in (encoding.exact, encoding.lossy):
            raise ValueError(f"layout {self.video.layout} does not carry {encoding.name} images")
        width, height = LAYOUTS[self.video.layout].picture_size(self.image.width, self.image.height)
        if self.video.width < width or self.video.height < height:
            raise ValueError(f"the video is smaller than its pictures of {width}x{height}")
        return self


def decode_base64(text: str) -> bytes:
    """Decode base64.

    Raises:
        ValueError: It is not base64.
    """
    try:
        data = base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise ValueError(f"{text[:20]!r} is not base64: {error}") from None
    if base64.b64encode(data).decode() != text:
        raise ValueError(f"{text[:20]!r} is not base64: it does not encode what it decodes to")
    return data


def parse_version(text: str) -> tuple[int, int]:
    """Major and minor.

    Raises:
        ValueError: Not of the form MAJOR.MINOR.
    """
    match = re.fullmatch(r"(0|[1-9]\d*)\.(0|[1-9]\d*)", text)
    if not match:
        raise ValueError(f"version {text!r} is not of the form MAJOR.MINOR")
    return int(match.group(1)), int(match.group(2))


def document_of(model: BaseModel) -> dict[str, Any]:
    """JSON-like values of a model, without the keys that have their default."""
    return model.model_dump(mode="json", by_alias=True, exclude_defaults=True)
