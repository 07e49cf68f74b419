"""The one source of truth for the format: schemas/ and the tables of spec/ are made from it."""

from __future__ import annotations

import base64
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mp4ds.format.fields import (
    MAX_CAMERA_INFOS,
    MAX_FRAMES,
    MAX_VARIANTS,
    Base64,
    Body,
    Column,
    Columns,
    Digests,
    FileName,
    Model,
    Profile,
    Quality,
    Sha256,
    Side,
    Size,
    Uint32,
    Version,
    decode_base64,
    exceeds_padding,
)
from mp4ds.messages.encodings import ENCODINGS, MAX_SIDE, NO_PARAMETERS, LayoutParameters
from mp4ds.messages.layouts import LAYOUTS, Layout, bind, why_not
from mp4ds.messages.png import PNG_ENCODINGS
from mp4ds.messages.serializations import WIRES
from mp4ds.messages.wire import CalibrationFields, ImageFields
from mp4ds.records import Channel, Schema
from mp4ds.times import encode_column
from mp4ds.video.access import (
    MAX_CHARS,
    MAX_STRUCTURE_CHARS,
    MAX_STRUCTURES,
    STRUCTURE_PATTERN,
    Structures,
    digest_video,
)
from mp4ds.video.codecs import CODECS, LEAST_CRF, PACKET_CODECS, VISUAL, QualityTarget
from mp4ds.video.colour import MATRICES
from mp4ds.video.pixels import shows_colours

# ---------------------------------------------------------------- references

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
            raise ValueError(f"the structures have more than {MAX_CHARS} characters in total")
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


# ---------------------------------------------------------------- models

_GREY_OR_COLOUR = frozenset({"mono8", "rgb8"})
_BODY_ENCODINGS = {
    "packet": _GREY_OR_COLOUR,
    "jpeg": _GREY_OR_COLOUR,
    "rvl": frozenset({"16UC1"}),
    "png": frozenset(PNG_ENCODINGS.values()),
}
VIDEO_CODECS = tuple(CODECS)
PIXEL_FORMATS = (
    *("gray", "gray10le", "gray12le", "gray14le", "gray16le"),
    *("rgb24", "bgr24", "bgr0", "bgra"),
    *("gbrp10le", "gbrp12le", "gbrp14le", "gbrp16le"),
    *("gbrap10le", "gbrap12le", "gbrap14le", "gbrap16le"),
    *("yuv420p", "yuv422p", "yuv444p", "yuv420p10le"),
)
_VIEW_FORMATS = ("yuv420p", "yuv420p10le")


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
    message_encoding: str = Field(description="ros1, cdr or protobuf.")
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
    step: Uint32 = Field(description="Bytes per row; what exceeds the pixels is padding.")
    is_bigendian: Annotated[int, Field(ge=0, le=255)] = Field(
        description="The byte as it stands; for samples of several bytes not 0 means big-endian."
    )

    @model_validator(mode="after")
    def _fits(self) -> Image:
        if reason := why_not(self.to_fields()):
            raise ValueError(reason)
        return self

    def to_fields(self) -> ImageFields:
        """The same as messages have it."""
        return ImageFields(self.encoding, self.width, self.height, self.step, self.is_bigendian)


class PngFile(Model):
    """How a PNG file is made of its pixels."""

    filters: str = Field(description="Rule of the row filters (registry, PNG files).")
    level: Annotated[int, Field(ge=1, le=9)] = Field(description="Level of deflate.")
    strategy: Annotated[int, Field(ge=0, le=4)] = Field(description="Strategy of deflate.")
    memory_level: Annotated[int, Field(ge=1, le=9)] = Field(description="Its memory level.")
    window_bits: Annotated[int, Field(ge=9, le=15)] = Field(description="Its window.")
    zlib_header: Annotated[str, Field(pattern=r"^[0-9a-f]{4}$")] = Field(
        description="The two bytes before the deflated data, hexadecimal."
    )
    chunk_bytes: Annotated[int, Field(ge=0, le=2**31)] = Field(
        description="Image data in each IDAT chunk but the last; 0: one chunk."
    )
    deflate: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")] = Field(
        description="Fingerprint of the deflate that makes these bytes (registry, PNG files)."
    )
    before: Base64 = Field("", description="Chunks between the header and the image data.")
    after: Base64 = Field("", description="What follows the image data.")


class Header(Model):
    """The part of a message around its body that does not change from frame to frame."""

    frame_id: str = Field(description="Coordinate frame.")
    format: str | None = Field(None, description="Of a coded image, to the letter.")
    template: Base64 | None = Field(
        None, description="The blank message, where it is not that of a plain serialization."
    )
    framing: Annotated[str, Field(pattern=r"^[0-9a-z +]*$", max_length=4096)] = Field(
        "", description="Of packets: the start codes or delimiter that an mp4 does not keep."
    )
    prefix: Annotated[str, Field(pattern=r"^([0-9a-f]{2})*$", max_length=64)] = Field(
        "", description="Bytes of the body before the coded picture, hexadecimal."
    )
    png: PngFile | None = Field(None, description="How the file in the body is made.")
    padding: Base64 | None = Field(
        None, description="What follows the pixels of each row, deflated; absent: zeros."
    )


class Color(Model):
    """How the video's samples are to be understood; the names are ffmpeg's."""

    primaries: str = Field(description="Colour primaries.")
    transfer: str = Field(description="Transfer characteristics.")
    matrix: str = Field(description="Matrix coefficients.")
    range: Literal["full", "limited"] = Field(description="Range of the samples.")


class VideoModel(Model):
    """The video file and how it was made."""

    file: FileName
    layout: str = Field(description="How pixels became the picture (registry, Layouts).")
    parameters: LayoutParameters | None = Field(None, description="Of the layout, if it has any.")
    codec: str = Field(description="Codec (registry, Codecs).")
    pixel_format: str | None = Field(
        None, description="Pixel format of the coded video; absent for packets as they came."
    )
    width: Annotated[int, Field(ge=1, le=MAX_SIDE + 1)] = Field(description="Picture width.")
    height: Annotated[int, Field(ge=1, le=MAX_SIDE + 1)] = Field(description="Picture height.")
    color: Color | None = Field(None, description="Absent where the samples are not colours.")
    encoder: str = Field("", description="Encoder that made it.")
    options: dict[str, str] = Field(default_factory=dict, description="The encoder's options.")
    size: Size | None = Field(None, description="Bytes.")
    sha256: Sha256 | None = Field(None, description="Of the file.")
    references: References | None = Field(
        None, description="What its frames refer to; absent: the packets tell."
    )
    quality: Quality | None = Field(None, description="Present where a score was asked for.")

    @property
    def matrix(self) -> str | None:
        """Matrix coefficients of the video's colours; None if the video itself tells them."""
        if self.color is None:
            return None if self.pixel_format is None else "bt709"
        return self.color.matrix

    @property
    def full_range(self) -> bool:
        """Whether the video's samples use their full range."""
        return self.color is None or self.color.range == "full"

    @model_validator(mode="after")
    def _known(self) -> VideoModel:
        if self.layout not in LAYOUTS:
            raise ValueError(f"layout {self.layout!r} is not one of {', '.join(LAYOUTS)}")
        if self.codec not in VIDEO_CODECS:
            raise ValueError(f"codec {self.codec!r} is not one of {', '.join(VIDEO_CODECS)}")
        if self.pixel_format not in (*PIXEL_FORMATS, None):
            known = ", ".join(PIXEL_FORMATS)
            raise ValueError(f"pixel format {self.pixel_format!r} is not one of {known}")
        if self.references is not None:
            if not CODECS[self.codec].is_free:
                raise ValueError(f"a video of codec {self.codec} has no references")
            if self.references.split and not CODECS[self.codec].is_split:
                raise ValueError(f"a packet of codec {self.codec} holds one frame")
        return self


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
        None, description="The blank message, where it is not that of a plain serialization."
    )

    @classmethod
    def of(cls, frame_id: str, fields: CalibrationFields, template: str | None) -> Calibration:
        """The calibration of a message."""
        values = asdict(fields)
        region = (*values.pop("roi"), values.pop("roi_do_rectify"))
        roi = dict(zip(Roi.model_fields, region, strict=True)) if any(region) else None
        values |= {name: list(values[name]) for name in "dkrp"}
        values |= {"frame_id": frame_id, "roi": roi, "template": template}
        return cls.model_validate(values)

    @property
    def fields(self) -> CalibrationFields:
        """The fields of its message."""
        values = self.model_dump(exclude={"frame_id", "roi", "template"})
        values |= {name: tuple(values[name]) for name in "dkrp"}
        *roi, do_rectify = self.roi.model_dump().values() if self.roi else (0, 0, 0, 0, 0)
        return CalibrationFields(**values, roi=tuple(roi), roi_do_rectify=do_rectify)


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
    body: Body = Field(
        "pixels", description="What a message's body is to the video (registry, Bodies)."
    )
    image: Image
    headers: Annotated[list[Header], Field(min_length=1, max_length=MAX_VARIANTS)]
    video: VideoModel = Field(description="What messages are made of.")
    view: VideoModel | None = Field(
        None, description="Shows the images, and predicts them; absent: the video does."
    )
    predicted: bool = Field(
        True, description="Of pixels with a view: whether the video has differences to its images."
    )
    camera_info: CameraInfo | None = None
    columns: Columns
    digests: Digests | None = Field(None, description="Present in the lossless profile.")

    @model_validator(mode="after")
    def _consistent(self) -> StreamSidecar:
        for wire in (self.wire, *([self.camera_info.wire] if self.camera_info else [])):
            if wire not in WIRES:
                raise ValueError(f"wire {wire!r} is not one of {', '.join(WIRES)}")
        if self.profile == "lossless" and self.digests is None:
            raise ValueError("a lossless stream must have digests")
        quality = self.video.quality
        if quality and self.profile != str(QualityTarget(quality.metric, quality.target)):
            raise ValueError(
                f"the quality of {self.video.file} does not match the profile {self.profile}"
            )
        width, height = self.layout.picture_size(self.image.width, self.image.height)
        if self.video.width < width or self.video.height < height:
            raise ValueError(f"{self.video.file} is smaller than its pictures of {width}x{height}")
        self._check_body()
        if self.view is not None:
            self._check_view(self.view)
        if not self.predicted and (self.view is None or self.body == "packet"):
            raise ValueError("predicted must be absent without a view of pixels")
        return self

    def _check_view(self, view: VideoModel) -> None:
        if self.profile != "lossless" or self.body not in ("pixels", "png", "packet"):
            raise ValueError(f"a {self.profile} stream with the body {self.body} has no view")
        if not view.file.endswith(".mp4") or self.video.file != exact_name(view.file):
            raise ValueError(f"the video beside {view.file} must be {exact_name(view.file)}")
        if self.is_predicted and self.video.color is not None:
            raise ValueError("video.color must be absent where the view predicts")
        due = ENCODINGS[self.image.encoding].lossy
        if view.layout != due:
            raise ValueError(f"the view has the layout {view.layout}, not {due}")
        # else decoders would differ in what it predicts
        for what, value, known in (
            ("codec", view.codec, LEAST_CRF),
            ("pixel format", view.pixel_format, _VIEW_FORMATS),
            ("matrix", view.color and view.color.matrix, MATRICES),
        ):
            if value not in known:
                raise ValueError(f"the view has the {what} {value}, not {' or '.join(known)}")
        self.seen  # noqa: B018 - checks its pictures

    def _check_body(self) -> None:
        body, encoding = self.body, self.image.encoding
        allowed = _BODY_ENCODINGS.get(body)
        if allowed is not None and encoding not in allowed:
            raise ValueError(f"a stream with the body {body} has no {encoding} images")
        if (self.video.pixel_format is None) != (body == "packet"):
            raise ValueError(
                "video.pixel_format must be absent for the body packet, and only there"
            )
        if body == "packet" and self.video.codec not in PACKET_CODECS:
            raise ValueError(f"packets of codec {self.video.codec} are not supported")
        if body == "jpeg" and self.profile == "lossless":
            raise ValueError("a stream with the body jpeg is not lossless")
        if exceeds_padding(header.padding for header in self.headers):
            raise ValueError("the headers have too much padding in total")
        for number, header in enumerate(self.headers):
            if (header.png is not None) != (body == "png"):
                raise ValueError(
                    f"headers.{number}.png must be present for the body png, and only there"
                )
            if header.padding is not None and body != "pixels":
                raise ValueError(f"headers.{number}.padding is allowed for the body pixels only")

    @property
    def videos(self) -> list[VideoModel]:
        """The video, and the view if there is one."""
        return [self.video, *([self.view] if self.view else [])]

    @property
    def is_predicted(self) -> bool:
        """Whether the video holds the difference of the images to what the view predicts."""
        return self.view is not None and self.predicted and self.body != "packet"

    @property
    def seen(self) -> StreamSidecar:
        """The stream of the view alone; the stream itself if it has none."""
        if self.view is None:
            return self
        video, body = self.view, self.body
        if body == "packet":
            if self.video.codec == "mjpeg":
                body = "jpeg"
            else:
                video = video.model_copy(update={"pixel_format": None})
        alone = {"view": None, "predicted": True, "profile": VISUAL, "digests": None}
        return self.model_validate({**dict(self), **alone, "video": video, "body": body})

    @property
    def keeps_packets(self) -> bool:
        """Whether messages hold the packets of the video, as they were recorded."""
        return self.body == "packet" and self.digests is not None

    @property
    def replaces_packets(self) -> bool:
        """Whether the video has packets of another codec than those recorded: a view's."""
        return self.body == "packet" and self.digests is None

    @property
    def shows_colours(self) -> bool:
        """Whether a player shows the images as they are, in 8-bit colours."""
        layout = self.layout
        size = layout.picture_size(self.image.width, self.image.height)
        return shows_colours(layout.pixel_format, size, (self.video.width, self.video.height))

    @property
    def layout(self) -> Layout:
        """The layout of the video's pictures.

        Raises:
            ValueError: It does not suit the images, or its parameters.
        """
        encoding = ENCODINGS[self.image.encoding]
        return bind(self.video.layout, encoding, self.video.parameters or NO_PARAMETERS)


# ---------------------------------------------------------------- facts of a finished video

EXACT_SUFFIX = ".exact.mp4"
"""Of the name of a video that has a view."""


def exact_name(view: str) -> str:
    """The name of the video beside a view."""
    return view.removesuffix(".mp4") + EXACT_SUFFIX


FACTS = ("file", "size", "sha256", "references")
"""Keys of `mp4ds.format.models.Video`."""


def video_facts(path: Path, codec: str) -> dict[str, Any]:
    """The values of `FACTS` for a finished video.

    Args:
        path: The video.
        codec: Name in the registry.

    Raises:
        OSError: It cannot be read.
    """
    size, sha256, structures = digest_video(path, codec)
    useful = structures is not None and not structures.is_plain
    references = References.from_structures(structures) if structures and useful else None
    return dict(zip(FACTS, (path.name, size, sha256, references), strict=True))
