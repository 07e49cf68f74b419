"""The base of all models of the format, and the types of their fields.

Every model is strict, frozen and closed: an unknown key is an error, a string is no number.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from mp4ds.layouts import MAX_SIDE
from mp4ds.stamps import INT64_MAX, INT64_MIN

T = TypeVar("T")

FORMAT_VERSION = "1.1"
MESSAGES_NAME = "messages.mcap"
MAX_FRAMES = 2 * 10**7  # 92 hours at 60 Hz; bounds what a sidecar can make a reader allocate
MAX_CAMERA_INFOS = 10**7
MAX_VARIANTS = 256
"""Headers or calibrations of a stream: a topic with more is not modelled any further."""
MAX_PADDING = 4 * 2**20
"""Characters of all paddings of a stream: its headers stand in the part of a YAML file that is
parsed as a whole."""

Int64 = Annotated[int, Field(ge=INT64_MIN, le=INT64_MAX)]
Time = Annotated[int, Field(ge=INT64_MIN, le=2**64 - 1)]
Uint32 = Annotated[int, Field(ge=0, le=2**32 - 1)]
Uint64 = Annotated[int, Field(ge=0, le=2**64 - 1)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Count = Annotated[int, Field(ge=0, le=MAX_FRAMES)]
Size = Annotated[int, Field(ge=0, le=INT64_MAX)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
FileName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$", description="A plain file name.")
]
Base64 = Annotated[str, Field(pattern=r"^[A-Za-z0-9+/]*={0,2}$")]
Version = Annotated[str, Field(pattern=r"^(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)$")]
Body = Literal["pixels", "packet", "png", "rvl", "jpeg"]
Profile = Annotated[
    str,
    Field(
        pattern=r"^(lossless|visual|crf=[0-9]{1,2}"
        r"|(vmaf|psnr|ssim)=[0-9]{1,3}(\.[0-9]{1,4})?)$"
    ),
]


class Model(BaseModel):
    """Base of all models: nothing is converted, added or changed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


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


def exceeds_padding(paddings: Iterable[str | None]) -> bool:
    """Whether headers have more of it than one stream may."""
    return sum(len(padding or "") for padding in paddings) > MAX_PADDING


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


def of_types(kind: type[T], values: Mapping[str, Any]) -> T:
    """A dataclass from values as JSON has them.

    Raises:
        ValueError: A value is missing, or not of its field's type.
    """
    adapter: TypeAdapter[T] = TypeAdapter(kind)
    return adapter.validate_python(values)
