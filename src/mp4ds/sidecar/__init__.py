"""Sidecars and manifests: the models, their files, and the migration of older versions."""

from __future__ import annotations

from mp4ds.sidecar.io import (
    MANIFEST_NAME,
    dump_document,
    load_document,
    load_manifest,
    load_stream,
    schema_text,
)
from mp4ds.sidecar.manifest import (
    FileEntry,
    Manifest,
    Source,
    StreamEntry,
    TimeRange,
    Verbatim,
)
from mp4ds.sidecar.models import (
    FORMAT_VERSION,
    MESSAGES_NAME,
    Calibration,
    CameraInfo,
    ChannelModel,
    Color,
    Column,
    Columns,
    Digests,
    Header,
    Image,
    Roi,
    SchemaModel,
    StreamSidecar,
    Video,
)

__all__ = [
    "FORMAT_VERSION",
    "MANIFEST_NAME",
    "MESSAGES_NAME",
    "Calibration",
    "CameraInfo",
    "ChannelModel",
    "Color",
    "Column",
    "Columns",
    "Digests",
    "FileEntry",
    "Header",
    "Image",
    "Manifest",
    "Roi",
    "SchemaModel",
    "Source",
    "StreamEntry",
    "StreamSidecar",
    "TimeRange",
    "Verbatim",
    "Video",
    "dump_document",
    "load_document",
    "load_manifest",
    "load_stream",
    "schema_text",
]
